//! The wire, from outside: whatever is sent comes back, and whatever arrives does no harm.

use core::fmt::Debug;

use nalgebra::Vector3;
use proptest::collection::vec;
use proptest::prelude::*;
use telemime_protocol::checkpoint::path::{PathKnot, PoseKnot};
use telemime_protocol::predict::{HandState, Params};
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::DecodeError;
use telemime_protocol::wire::hello::{Answer, Hello, RejectCode};
use telemime_protocol::wire::knots::KnotBlock;
use telemime_protocol::wire::state::{POSITION_STEP_M, WireState};
use telemime_protocol::wire::turn::WirePose;
use telemime_protocol::wire::v1::*;

#[path = "wire/draw.rs"]
mod draw;

use draw::*;

/// A message comes back; what was made of it decodes to nothing else than what it says.
fn travels<M: Message + PartialEq + Debug>(
    message: &M,
    damage: &Damage,
) -> Result<(), TestCaseError> {
    let bytes = message.encode();
    let back = M::decode(&bytes);
    prop_assert_eq!(back.as_ref(), Ok(message));
    honest::<M>(&damage.to(&bytes))
}

fn honest<M: Message>(bytes: &[u8]) -> Result<(), TestCaseError> {
    if let Ok(message) = M::decode(bytes) {
        prop_assert_eq!(message.encode(), bytes);
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 512, ..ProptestConfig::default() })]

    #[test]
    fn operator_control_travels(message in operator_control(), damage in damage()) {
        travels(&message, &damage)?;
    }

    #[test]
    fn robot_control_travels(message in robot_control(), damage in damage()) {
        travels(&message, &damage)?;
    }

    #[test]
    fn operator_datagrams_travel(message in operator_datagram(), damage in damage()) {
        travels(&message, &damage)?;
        prop_assert!(message.encode().len() <= MAX_DATAGRAM_LEN);
    }

    #[test]
    fn robot_datagrams_travel(message in robot_datagram(), damage in damage()) {
        travels(&message, &damage)?;
        prop_assert!(message.encode().len() <= MAX_DATAGRAM_LEN);
    }

    #[test]
    fn arbitrary_bytes_are_honest(bytes in vec(any::<u8>(), 0..300), kind in 0..8u8) {
        let mut typed = bytes.clone();
        if let Some(first) = typed.first_mut() {
            *first = kind;
        }
        for bytes in [&bytes, &typed] {
            honest::<OperatorControl>(bytes)?;
            honest::<RobotControl>(bytes)?;
            honest::<OperatorDatagram>(bytes)?;
            honest::<RobotDatagram>(bytes)?;
        }
    }

    #[test]
    fn greetings_travel_and_damaged_ones_are_honest(
        (a, b, features) in any::<(u16, u16, u64)>(),
        (code, text) in (any::<u16>(), "[a-z é]{0,120}"),
        damage in damage(),
    ) {
        let hello = Hello { min: a.min(b), max: a.max(b), features };
        let bytes = hello.encode();
        prop_assert_eq!(Hello::decode(&bytes), Ok(Some((hello, bytes.len()))));
        let damaged = damage.to(&bytes);
        if let Ok(Some((hello, used))) = Hello::decode(&damaged) {
            prop_assert_eq!(hello.encode(), &damaged[..used]);
        }
        let code = match code { 1 => RejectCode::Version, 2 => RejectCode::Busy, 3 => RejectCode::Malformed, n => RejectCode::Other(n) };
        for answer in [Answer::Ack { version: a, features, epoch: u32::from(b) }, Answer::Reject { code, text }] {
            let bytes = answer.encode();
            prop_assert_eq!(Answer::decode(&bytes), Ok(Some((answer, bytes.len()))));
            let damaged = damage.to(&bytes);
            if let Ok(Some((answer, used))) = Answer::decode(&damaged) {
                prop_assert_eq!(answer.encode(), &damaged[..used]);
            }
        }
    }

    /// Position to 0.05 mm, time to 5 µs, each memory to half of its own step: 1/127 of its largest
    /// coordinate, or 12.5 µm if that is more, however far the others are.
    #[test]
    fn a_state_travels_within_its_steps(
        t_ns in -1_000_000_000_000_000i64..1_000_000_000_000_000,
        x in prop::array::uniform3(-100.0..=100.0f64),
        offsets in prop::array::uniform4(prop::array::uniform3(-1.0..1.0f64)),
        reaches_m in prop::array::uniform4(prop_oneof![Just(0.0), 1e-6..1e-3f64, 1e-3..10.0f64, 10.0..104.0f64]),
    ) {
        let x = Vector3::from(x);
        let offsets: [_; 4] = std::array::from_fn(|i| Vector3::from(offsets[i]) * reaches_m[i]);
        let sent = HandState { t: Stamp(t_ns), x, memory: offsets.map(|o| x - o) };
        let wire = WireState::quantise(&sent).expect("within range");
        let back = wire.dequantise();
        prop_assert!((back.t.0 - t_ns).abs() <= 5000);
        prop_assert!((back.x - x).amax() <= 0.5 * POSITION_STEP_M + 1e-12);
        for (memory, offset) in back.memory.iter().zip(&offsets) {
            let bound_m = (offset.amax() / 127.0).max(1.25e-5) + 1e-9;
            let error_m = (back.x - memory - offset).amax();
            prop_assert!(error_m <= bound_m, "{error_m} m of {bound_m} m");
        }
        // Both ends predict from the same numbers: once rounded, always the same.
        let again = WireState::quantise(&back).expect("still within range").dequantise();
        prop_assert_eq!((again.t, again.x), (back.t, back.x));
    }

    #[test]
    fn parameters_travel_to_the_nearest_step(
        gain in 0.0..=1.0f64,
        octaves in -16.0..=15.8f64,
        shares in prop::array::uniform3(prop::array::uniform4(1e-3..=1.0f64)),
    ) {
        let weights = shares.map(|[a, b, c, d]| [a, b, c].map(|v| v / (a + b + c + d)));
        let sent = Params { gain, inflation: octaves.exp2(), weights };
        prop_assert!(sent.checked().is_ok());
        let wire = WireParams::quantise(&sent);
        let back = wire.dequantise();
        prop_assert!(back.checked().is_ok());
        prop_assert!((sent.gain - back.gain).abs() <= 0.5 / 255.0 + 1e-12);
        prop_assert!((sent.inflation / back.inflation).log2().abs() <= 1.0 / 16.0 + 1e-9);
        for (a, b) in sent.weights.iter().flatten().zip(back.weights.iter().flatten()) {
            // Together they are what holding leaves, which is rounded first.
            prop_assert!((a - b).abs() <= 1.5 / 15.0 + 1e-12);
        }
        let held = |p: &Params| p.weights.map(|band| 1.0 - band.iter().sum::<f64>());
        for (a, b) in held(&sent).into_iter().zip(held(&back)) {
            prop_assert!((a - b).abs() <= 0.5 / 15.0 + 1e-12);
        }
        prop_assert_eq!(WireParams::quantise(&back), wire);
    }
}

#[test]
fn weights_of_more_than_all_are_refused() {
    let heavy = |weights| {
        let state = HandState::first(Stamp(0), Vector3::zeros());
        OperatorDatagram::Motion(Motion {
            epoch: 1,
            engagement: 1,
            seq: 1,
            lease_ms: 10,
            model: 0,
            params: WireParams {
                weights,
                ..WireParams::quantise(&Params::DEFAULT)
            },
            checksum: None,
            state: WireState::quantise(&state).expect("within range"),
            pose: WirePose::default(),
            first_knot: 0,
            knots: KnotBlock::default(),
        })
        .encode()
    };
    let all = [[0, 0, 15], [5, 5, 5], [14, 1, 0]];
    assert!(OperatorDatagram::decode(&heavy(all)).is_ok());
    for band in 0..3 {
        let mut more = all;
        more[band][1] += 1;
        assert!(matches!(
            OperatorDatagram::decode(&heavy(more)),
            Err(DecodeError::Invalid {
                field: "motion.params",
                ..
            })
        ));
    }
}

#[test]
fn counts_beyond_their_limits_are_refused() {
    let knot = |n: i64| {
        PoseKnot::from(PathKnot {
            tick: 3_333 * (n - 2_000),
            x: [1; 3],
            v: [0; 3],
            start: n == 0,
        })
    };
    let block = |knots: usize| {
        let knots: Vec<_> = (0..knots as i64).map(knot).collect();
        let state = WireState::quantise(&HandState::first(Stamp(0), Vector3::zeros()));
        let state = state.expect("within range");
        KnotBlock::pack(&state, code(33_333), &[], &knots).expect("a path can travel")
    };
    let motion = |knots: usize| {
        let state = HandState::first(Stamp(0), Vector3::zeros());
        OperatorDatagram::Motion(Motion {
            epoch: 1,
            engagement: 1,
            seq: 1,
            lease_ms: 10,
            model: 0,
            params: WireParams::quantise(&Params::DEFAULT),
            checksum: None,
            state: WireState::quantise(&state).expect("within range"),
            pose: WirePose::default(),
            first_knot: 0,
            knots: block(knots),
        })
    };
    let decoded = |knots| OperatorDatagram::decode(&motion(knots).encode());
    assert_eq!(decoded(MAX_KNOTS), Ok(motion(MAX_KNOTS)));
    assert!(matches!(
        decoded(MAX_KNOTS + 1),
        Err(DecodeError::Invalid {
            field: "motion.knots",
            ..
        })
    ));
    let tail = |knots| {
        OperatorControl::Path(PathTail {
            engagement: 1,
            state: WireState::quantise(&HandState::first(Stamp(0), Vector3::zeros()))
                .expect("within range"),
            first_knot: 0,
            knots: block(knots),
        })
    };
    let decoded = |knots| OperatorControl::decode(&tail(knots).encode());
    assert_eq!(decoded(MAX_TAIL_KNOTS), Ok(tail(MAX_TAIL_KNOTS)));
    assert!(matches!(
        decoded(MAX_TAIL_KNOTS + 1),
        Err(DecodeError::Invalid {
            field: "path.knots",
            ..
        })
    ));
    let model = |len: usize| OperatorControl::Model {
        id: [0; 16],
        bytes: vec![0; len],
    };
    let decoded = |len| OperatorControl::decode(&model(len).encode());
    assert!(decoded(MAX_MODEL_LEN).is_ok() && decoded(MAX_MODEL_LEN + 1).is_err());
}

#[test]
fn a_state_that_no_integers_hold_is_not_sent() {
    let at = |x: f64, m: f64| {
        let mut state = HandState::first(Stamp(0), Vector3::new(x, 0.0, 0.0));
        state.memory[3] = Vector3::new(0.0, m, 0.0);
        WireState::quantise(&state)
    };
    assert!(at(100.0, 4.0).is_some() && at(-100.0, 104.0).is_some());
    for (x, m) in [
        (100.1, 0.0),
        (f64::NAN, 0.0),
        (f64::INFINITY, 0.0),
        (0.0, 104.1),
        (0.0, 1e300),
        (0.0, f64::INFINITY),
    ] {
        assert_eq!(at(x, m), None, "{x} {m}");
    }
}

#[test]
fn no_skills_tag_is_that_of_none() {
    let mut id = [7; 16];
    assert_eq!(model_tag(&id), 0x0707);
    (id[0], id[1]) = (0, 0);
    assert_eq!(model_tag(&id), 1);
    id[1] = 2;
    assert_eq!(model_tag(&id), 0x0200);
}
