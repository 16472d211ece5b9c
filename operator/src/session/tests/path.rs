//! The path: complete at the robot, to both bounds, whatever the link does to it.

use super::*;
use telemime_protocol::checkpoint::path::{
    POSE, PathBounds, PathDecoder, TICK_NS, pose as on_path, tick_of,
};
use telemime_protocol::pose;
use telemime_protocol::wire::knots::PathCode;
use telemime_protocol::wire::v1::{MAX_DATAGRAM_LEN, MAX_KNOTS, MAX_TAIL_KNOTS};

/// How the bench's path is written: [`Bench::sample`] takes one every 33 ms.
fn code(bounds: PathBounds) -> PathCode {
    PathCode::new(bounds, 33_000).unwrap()
}

const BOUND_M: f64 = 0.005;
const BOUND_RAD: f64 = 0.02;

fn config(bound_m: f64) -> SessionConfig {
    SessionConfig {
        future_bound: FutureBound::Absolute(0.05),
        path_bound_m: Some(bound_m),
        path_turn_bound_rad: BOUND_RAD,
        ..SessionConfig::default()
    }
}

/// What the robot ends with.
struct Streamed {
    path: PathDecoder<POSE>,
    samples: Vec<HandSample>,
    made: u32,
    /// Knots in all messages.
    carried: usize,
}

impl Streamed {
    /// The largest errors, m and rad, and over how many samples.
    fn worst(&self) -> (f64, f64, usize) {
        let frontier = self.path.frontier().unwrap();
        let first = self.path.knots().next().unwrap().t;
        let (mut worst_m, mut worst_rad, mut covered) = (0.0f64, 0.0f64, 0);
        for sample in &self.samples {
            let tick = Stamp(tick_of(sample.t) * TICK_NS);
            if tick < first || tick > frontier {
                continue;
            }
            covered += 1;
            let at = self.path.eval(tick).expect("no hole").x;
            worst_m = worst_m.max((on_path::place(&at) - sample.x).norm());
            if let Some(q) = sample.orientation {
                worst_rad = worst_rad.max(on_path::turn(&at).unwrap().angle_to(&q));
            }
        }
        (worst_m, worst_rad, covered)
    }
}

/// A hand for some seconds, perhaps with an orientation, over a link that loses what `lost` says, acknowledged six
/// samples late.
fn streamed(turns: bool, lost: impl Fn(usize) -> bool, acknowledge: bool) -> Streamed {
    let wrist = |i: u32| {
        let phase = 0.29 * f64::from(i);
        // Through more than half a turn, where q and −q change places.
        let turned = Vector3::new(2.0 * phase.sin(), 0.5, 1.5 * (0.6 * phase).cos());
        // Out of sight now and then.
        (turns && i % 37 != 5).then(|| pose::exp(&turned))
    };
    let hand = |i: u32| {
        let phase = 0.37 * f64::from(i);
        home() + Vector3::new(phase.sin(), (0.7 * phase).cos(), 0.0) * 0.3
    };
    let mut bench = Bench::ready(config(BOUND_M), None);
    (0..30).for_each(|_| {
        bench.turned(home(), wrist(0));
    });
    bench.grant();
    let bounds = PathBounds::new(BOUND_M, turns.then_some(BOUND_RAD));
    let [OperatorControl::Engage(engage)] = &bench.control[..] else {
        panic!("{:?}", bench.control)
    };
    assert_eq!(engage.path_bounds(), bounds);
    let code = code(bounds);
    let mut path = PathDecoder::new(code.grid(), 4096);
    let (mut frontier, mut sent, mut carried) = (0u32, 0, 0);
    let mut acknowledgements = std::collections::VecDeque::from([0; 6]);
    let mut samples = Vec::new();
    for i in 0..300 {
        bench.forget();
        samples.push(bench.turned(hand(i), wrist(i)));
        for motion in bench.motions() {
            sent += 1;
            carried += motion.knots.count(MAX_KNOTS).unwrap();
            if lost(sent) {
                continue;
            }
            let Some(known) = frontier.checked_sub(motion.first_knot) else {
                continue;
            };
            let before = path.before(known as usize).unwrap();
            let knots = motion.knots.unpack(&motion.state, code, &before, MAX_KNOTS);
            for knot in knots.unwrap().iter().skip(known as usize) {
                path.append(knot).unwrap();
                frontier += 1;
            }
        }
        acknowledgements.push_back(frontier);
        let seen = acknowledgements.pop_front().unwrap_or_default();
        if acknowledge {
            bench.receives(&RobotDatagram::Telemetry(telemetry(i, seen)));
        }
    }
    let made = bench.session.counters().knots;
    assert!(
        frontier + 12 >= made || !acknowledge,
        "{frontier} of {made}"
    );
    Streamed {
        path,
        samples,
        made,
        carried,
    }
}

#[test]
fn the_robot_ends_with_the_whole_path_whatever_is_lost() {
    for (name, lost) in [
        ("nothing", (|_| false) as fn(usize) -> bool),
        ("every third", |n| n % 3 == 0),
        ("bursts of four", |n| n % 12 < 4),
    ] {
        for turns in [false, true] {
            let run = streamed(turns, lost, true);
            let (worst_m, worst_rad, covered) = run.worst();
            assert!(run.made > 40, "{}", run.made);
            assert!(worst_m <= BOUND_M, "{name}: {worst_m} m off");
            assert!(worst_rad <= BOUND_RAD, "{name}: {worst_rad} rad off");
            assert_eq!(worst_rad > 0.0, turns);
            assert!(covered > 255, "{name}: {covered} of 300 samples");
            let (made, carried) = (run.made as usize, run.carried);
            assert!(
                name != "nothing" || carried <= 2 * made,
                "{carried} carried, {made} made"
            );
        }
    }
}

#[test]
fn what_is_not_acknowledged_is_sent_again() {
    let Streamed { made, carried, .. } = streamed(false, |_| false, false);
    assert!(
        carried > 3 * made as usize,
        "{carried} carried, {made} made"
    );
}

/// What the robot makes of the path tails among `control`.
pub(super) fn by_stream(control: &[OperatorControl], bound_m: f64) -> PathDecoder<POSE> {
    let code = code(PathBounds::new(bound_m, None));
    let mut path = PathDecoder::new(code.grid(), 4096);
    let mut frontier = 0;
    for message in control {
        let OperatorControl::Path(tail) = message else {
            continue;
        };
        assert_eq!(
            (tail.engagement, tail.first_knot),
            (1, frontier),
            "in order"
        );
        let before = path.before(0).unwrap();
        let knots = tail
            .knots
            .unpack(&tail.state, code, &before, MAX_TAIL_KNOTS);
        for knot in &knots.unwrap() {
            path.append(knot).unwrap();
            frontier += 1;
        }
    }
    path
}

#[test]
fn a_path_that_no_datagram_delivers_goes_by_the_stream_to_its_last_sample() {
    const BOUND_M: f64 = 0.002;
    let mut bench = Bench::engaged(config(BOUND_M), None);
    let mut samples = Vec::new();
    for i in 0..1200 {
        // Too abrupt for any span to cover two steps.
        let x = home() + Vector3::new(f64::from(i * i % 17), f64::from(i % 5), 0.0) * 0.01;
        bench.sample(x);
        samples.push((bench.now, x));
        let held = bench.control.len();
        let made = bench.session.counters().knots as usize;
        assert_eq!(held, made / 257, "one tail a backlog, {made} knots");
    }
    let end_before = by_stream(&bench.control, BOUND_M).frontier().unwrap();
    assert!(bench.now.secs_since(end_before) < 257.0 * 0.033 + 0.1);
    bench.session.release();
    bench.drain();
    let release = OperatorControl::Release { engagement: 1 };
    assert_eq!(
        bench.control.last(),
        Some(&release),
        "the path comes before"
    );
    let path = by_stream(&bench.control, BOUND_M);
    for (t, x) in &samples {
        let tick = Stamp(tick_of(*t) * TICK_NS);
        let error_m =
            (on_path::place(&path.eval(tick).expect("no hole, to the last").x) - x).norm();
        assert!(error_m <= BOUND_M, "{error_m} m off");
    }
}

#[test]
fn the_longest_knots_still_fit_a_datagram() {
    let config = SessionConfig {
        path_turn_bound_rad: 1e-6,
        ..config(1e-6)
    };
    for turns in [false, true] {
        let (longest, most) = longest(config, turns);
        assert!(
            if turns { most >= 6 } else { most == 24 },
            "{most}: a message full of knots"
        );
        assert!(
            longest <= MAX_DATAGRAM_LEN && longest > 500,
            "{longest} bytes"
        );
    }
}

/// The longest datagram, and the most knots in one.
fn longest(config: SessionConfig, turns: bool) -> (usize, usize) {
    let wrist = |i: i32| {
        let turned = Vector3::new(f64::from(i * 7919 % 200), f64::from(i % 3), 1.0) * 0.01;
        turns.then(|| pose::exp(&turned))
    };
    let mut bench = Bench::ready(config, None);
    bench.turned(home(), wrist(0));
    bench.grant();
    let (mut longest, mut most) = (0, 0);
    for i in 0..200 {
        bench.forget();
        // At rest, so that short codes are expected; then through the whole space, and lost for a while in between.
        let far = f64::from(i * 7919 % 200) - 100.0;
        let x = if i < 40 {
            home()
        } else {
            Vector3::new(far, -far, far * 0.5)
        };
        if i % 7 == 0 {
            bench.idle(600);
        }
        bench.turned(x, wrist(if i < 40 { 0 } else { i }));
        for motion in bench.motions() {
            most = most.max(motion.knots.count(MAX_KNOTS).unwrap());
            longest = longest.max(OperatorDatagram::Motion(motion).encode().len());
        }
    }
    (longest, most)
}

#[test]
fn what_was_acknowledged_is_not_sent_by_the_stream() {
    let mut bench = Bench::engaged(config(0.02), None);
    for i in 0..90 {
        let phase = 0.37 * f64::from(i);
        bench.sample(home() + Vector3::new(phase.sin(), phase.cos(), 0.0) * 0.3);
    }
    let made = bench.session.counters().knots;
    bench.receives(&RobotDatagram::Telemetry(telemetry(1, made - 2)));
    bench.session.release();
    bench.drain();
    let [OperatorControl::Path(tail), OperatorControl::Release { .. }] = &bench.control[..] else {
        panic!("{:?}", bench.control)
    };
    assert_eq!(
        (tail.first_knot, tail.knots.count(MAX_TAIL_KNOTS)),
        (made - 2, Ok(3)),
        "two and the last"
    );
    assert_eq!(bench.session.counters().knots, made + 1);
}
