//! What the document's examples say.

use std::fmt::Debug;

use nalgebra::{SMatrix, SVector, Vector3};
use telemime_protocol::checkpoint::path::{PathBounds, PoseKnot};
use telemime_protocol::checkpoint::{Checkpoint, Grid, Plan, PosePlan};
use telemime_protocol::predict::{
    BLOCK, Calibration, FEATURES, Generic, MAX_KNOTS, Model, Regression, Standardisation, TARGETS,
};
use telemime_protocol::skill::{Gmm, Pace, Parts, Provenance, Samples, Skill, Source, Stats};
use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::knots::{KnotBlock, PathCode};
use telemime_protocol::wire::memory::WireMemory;
use telemime_protocol::wire::pair::{Name, PairMessage};
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::{WirePose, WireRotation, WireTurn};
use telemime_protocol::wire::v1::{Info, Message, Motion, RobotState, Telemetry, WireParams};

pub(super) const STATE: WireState = WireState {
    t_us: 3_000_000,
    x: [4_000, -2_000, 25_000],
    memory: WireMemory {
        exponents: [0x23, 0x45],
        offsets: [[80, -32, 0], [96, -36, 4], [100, -40, 4], [80, -30, 5]],
    },
};

pub(super) const PARAMS: WireParams = WireParams {
    gain: 255,
    inflation: 136,
    weights: [[13, 1, 1], [11, 2, 2], [8, 4, 3]],
};

pub(super) const TURN: WireTurn = WireTurn {
    q: WireRotation([4_000, -2_500, 0]),
    memory: WireMemory {
        exponents: [0x45, 0x66],
        offsets: [[80, -40, 0], [80, -40, 6], [70, -30, 5], [90, -40, 8]],
    },
    params: WireParams {
        gain: 255,
        inflation: 128,
        weights: [[0, 0, 12]; 3],
    },
};

pub(super) const BEND: WireBend = WireBend {
    plan_us: 1_500_000,
    rate: 64,
    left: [200, 0, -50],
    held: Some(WireHeld {
        state: WireState {
            t_us: 3_190_000,
            x: [0, 800, -10],
            memory: WireMemory {
                exponents: [0x23, 0x33],
                offsets: [[0, 80, -2], [0, 90, -2], [1, 120, -4], [1, 125, -4]],
            },
        },
        gain: 255,
        straight: 128,
        weight: [64, 10, 100, 0, -5, 127],
    }),
};

pub(super) const TIP_Q: WireRotation = WireRotation([7_869, -3_976, 0]);

/// Two of them in the motion, the third by the stream.
pub(super) const KNOTS: [PoseKnot; 3] = [
    PoseKnot {
        tick: 240_000,
        x: [35, -20, 250, 78, 16, -10, 0],
        v: [2, -4, 0, 0, 2, 0, -2],
        start: true,
    },
    PoseKnot {
        tick: 270_000,
        x: [40, -20, 251, 77, 19, -12, -1],
        v: [0, 2, 0, 0, 2, 0, 0],
        start: false,
    },
    PoseKnot {
        tick: 280_002,
        x: [43, -21, 251, 77, 20, -12, -1],
        v: [16, 0, -8, 0, 0, 0, 0],
        start: false,
    },
];

pub(super) fn places() -> [PoseKnot; 3] {
    KNOTS.map(|knot| knot.place().into())
}

pub(super) fn pose_code() -> PathCode {
    code(Some(0.05))
}

pub(super) fn code(turn_rad: Option<f64>) -> PathCode {
    PathCode::new(PathBounds::new(0.02, turn_rad), 33_333).unwrap()
}

pub(super) fn motion(checksum: Option<u32>) -> Motion {
    Motion {
        epoch: 7,
        engagement: 1,
        seq: 42,
        lease_ms: 650,
        model: 0,
        params: PARAMS,
        checksum,
        state: STATE,
        pose: WirePose::default(),
        first_knot: 0,
        knots: KnotBlock::pack(&STATE, code(None), &[], &KNOTS[..2]).unwrap(),
    }
}

pub(super) fn plan() -> PosePlan {
    let point = |t_s, x: [f64; 3]| Checkpoint {
        t_s,
        x: SVector::from(x),
    };
    let points = [
        point(0.0, [0.1, 0.0, -0.3]),
        point(0.25, [0.15, 0.05, -0.3]),
        point(0.4, [0.2, 0.01, 0.7]),
    ];
    Plan::quantise(Grid::for_bound(0.004).unwrap(), &points)
        .unwrap()
        .into()
}

/// Two components, three knots; every number is a short binary fraction, so that it survives f32.
pub(super) fn skill() -> Skill {
    let component = |weight, first_mean, target: f64, gain: f64| {
        let mut mean = SVector::<f64, FEATURES>::zeros();
        mean[0] = first_mean;
        let mut target_m = [0.0; TARGETS];
        let mut gains = [[0.0; TARGETS]; FEATURES];
        for knot in 0..3 {
            target_m[3 * knot] = target * (knot + 1) as f64;
            gains[3][3 * knot] = gain * (knot + 1) as f64;
        }
        Regression {
            weight,
            mean,
            factor: SMatrix::identity(),
            target: target_m,
            gain: gains,
            residual: [[0.0625, 0.0, 0.0, 0.0625, 0.0, 0.0625]; MAX_KNOTS],
        }
    };
    const { assert!(BLOCK == 6) };
    let mut calibration = Calibration::UNTRIED;
    calibration.covariance = [2.0; MAX_KNOTS];
    calibration.errors = [[0.03125, 0.0625, 0.25, 0.5]; MAX_KNOTS];
    calibration.novelty90 = 16.0;
    let mut generic = Generic {
        lead: [[0.0; MAX_KNOTS]; 4],
        products: [0.25; 10],
    };
    for knot in 0..3 {
        generic.lead[0][knot] = 0.5 * (knot + 1) as f64;
        generic.lead[2][knot] = 0.125 * (knot + 1) as f64;
    }
    let model = Model::new(
        3,
        Standardisation {
            mean: SVector::zeros(),
            scale: SVector::repeat(0.5),
            bend: [0.125, 0.0],
            ridge: 0.03125,
            shrinkage: 8.0,
        },
        vec![
            component(0.75, 0.0, 0.125, 0.25),
            component(0.25, 1.0, -0.0625, 0.5),
        ],
        generic,
        calibration,
    )
    .unwrap();
    let motion = Gmm::new([(
        1.0,
        SVector::from([1.0, 0.5, 0.0, 2.0]),
        SMatrix::identity(),
    )])
    .unwrap();
    let stats = Stats {
        speed95_m_s: 4.0,
        acceleration95_m_s2: 32.0,
        reach_m: 0.5,
        min: Vector3::new(0.0, -0.5, 1.5),
        max: Vector3::new(0.5, 0.5, 2.5),
    };
    let provenance = Provenance {
        producer: "example".to_owned(),
        seed: 0,
        sources: vec![Source {
            name: "one".to_owned(),
            sha256: [0xab; 32],
        }],
    };
    Skill::new(Parts {
        name: "wave".to_owned(),
        motion,
        duration_s: 2.0,
        pace: Pace {
            mean_ln_s: 0.75,
            deviation_ln: 0.125,
        },
        predictor: model,
        turn: None,
        grip: None,
        task: None,
        stats,
        samples: Samples {
            motion: 60,
            predictor: 58,
        },
        provenance,
    })
    .unwrap()
}

pub(super) fn info() -> Info {
    Info {
        name: "mime7".to_owned(),
        joints: 7,
        speed_m_s: 1.5,
        accel_m_s2: 13.0,
        radius_m: 0.25,
        lag_s: 0.0625,
        model: None,
        state: RobotState::Idle,
    }
}

pub(super) fn telemetry() -> Telemetry {
    Telemetry {
        epoch: 7,
        seq: 300,
        state: RobotState::Engaged,
        engagement: 1,
        t_us: 3_100_000,
        clock_uncertainty_us: 100_500,
        age_ms: 180,
        delay_ms: 101,
        path_frontier: 5,
        received: 40,
        newest_seq: 42,
        dropped: 0,
        clamps: 3,
        tip_m: [0.5, 0.0, 0.25],
        tip_q: TIP_Q,
        grip: Some(255),
        q: vec![0.0, 1.0],
    }
}

/// Bytes that are a message, and nothing but that message.
pub(super) fn message<M: Message + PartialEq + Debug>(message: &M) -> Vec<u8> {
    let bytes = message.encode();
    assert_eq!(M::decode(&bytes).as_ref(), Ok(message));
    bytes
}

pub(super) fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

pub(super) fn pairing(message: PairMessage) -> Vec<u8> {
    let bytes = message.encode();
    let used = bytes.len();
    assert_eq!(PairMessage::decode(&bytes), Ok(Some((message, used))));
    bytes
}
