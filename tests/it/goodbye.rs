//! The path at the robot is whole when the engagement ends, and however it ends: both daemons on the virtual clock.

use nalgebra::Vector3;
use telemime::ground::{Operator, Pair, run_virtual};
use telemime_endpoint::cli::Word;
use telemime_operator::daemon::Notice;
use telemime_operator::session::{Event, SessionConfig};
use telemime_operator::task::Outcome;
use telemime_protocol::spline::HermiteSpan;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::RobotState;
use telemime_robot::daemon::{Notice as RobotNotice, PathPoint};
use telemime_robot::servo::Report;
use telemime_sim::link::{LinkConfig, Loss};

use crate::scene::{delayed, finish, replay, rig, shaped, unseen};

const BOUND_M: f64 = 0.01;

/// Knots and stamps lie on ticks of 10 µs; at 10 m/s that is 0.1 mm.
const TICK_S: f64 = 1e-5;

/// How the engagement ends.
#[derive(Clone, Copy, Debug, PartialEq)]
enum End {
    /// The user quits.
    Quits,
    /// The same, and at that moment nothing more arrives at the robot for so long, s.
    QuitsUnheard(f64),
    /// Nothing arrives at the robot for so long, s, and its arm stops by itself.
    Stops(f64),
}

/// The robot's path and the samples the operator took of a hand that was followed, on the session's clock; and what the
/// operator noted.
struct Ended {
    path: Vec<PathPoint>,
    taken: Vec<(f64, Vector3<f64>)>,
    notes: Vec<String>,
}

/// No message from the operator arrives.
fn silence(pair: &Pair, operator: &Operator, link: &LinkConfig, seed: u64) {
    let dead = LinkConfig {
        loss: Loss::random(1.0),
        ..link.clone()
    };
    let robot = pair.robot_addr();
    pair.network.link(operator.addr, robot, dead, seed);
}

fn run(link: &LinkConfig, seed: u64, end: End) -> Ended {
    let follows = |r: &Report| r.state == RobotState::Engaged;
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let config = SessionConfig {
            path_bound_m: Some(BOUND_M),
            ..SessionConfig::default()
        };
        let task = replay(unseen());
        let mut operator = pair.operator(task, None, config, link, seed).unwrap();
        assert!(pair.wait_for(20.0, follows).await, "seed {seed}");
        pair.run_for(1.7).await;
        let mut left = pair.now();
        let unheard_s = match end {
            End::Quits => None,
            End::QuitsUnheard(s) | End::Stops(s) => Some(s),
        };
        if unheard_s.is_some() {
            silence(&pair, &operator, link, seed);
        }
        if !matches!(end, End::Stops(_)) {
            operator.quit();
        }
        if let Some(span_s) = unheard_s {
            pair.run_for(span_s).await;
            let robot = pair.robot_addr();
            pair.network.link(operator.addr, robot, link.clone(), seed);
        }
        let mut notes = Vec::new();
        while let Some(notice) = operator.notices.recv().await {
            match notice {
                Notice::Note(text) => notes.push(text.into_owned()),
                // From then on the hand drives nothing.
                Notice::Event(at, Event::State(RobotState::Holding, _)) => {
                    left = pair.to_mono(at);
                }
                _ => {}
            }
        }
        let (summary, task, _) = finish(operator).await;
        assert_eq!(summary.unwrap().sessions, 1);
        pair.run_for(0.5).await;
        let mut paths = pair
            .robot
            .notices()
            .clone()
            .into_iter()
            .filter_map(|n| match n {
                RobotNotice::Path(path) => Some(path),
                _ => None,
            });
        let path = paths.next().expect("a path");
        let zero_s = task.zero().unwrap().as_secs_f64();
        let left_s = (left.0 - pair.to_mono(Stamp::ZERO).0) as f64 * 1e-9;
        let first_s = path.first().map_or(f64::INFINITY, |k| k.0) - TICK_S;
        let samples = unseen().into_iter().map(|(t_s, x)| (t_s + zero_s, x));
        Ended {
            // The runtime's timers are of 1 ms: a sample that is due just then may or may not be taken.
            taken: samples
                .filter(|(t_s, _)| (first_s..left_s - 2e-3).contains(t_s))
                .collect(),
            path,
            notes,
        }
    })
    .unwrap()
}

impl Ended {
    /// At how many samples the path is not there, and how far it is off at the others, m.
    fn missed(&self) -> (usize, f64) {
        let (mut absent, mut worst_m) = (0, 0.0f64);
        for (t_s, x) in &self.taken {
            let after = self.path.partition_point(|k| k.0 <= t_s - TICK_S);
            let Some([a, b]) = after
                .max(1)
                .checked_sub(1)
                .and_then(|i| self.path.get(i..i + 2))
            else {
                absent += 1;
                continue;
            };
            let [from, to] = [a, b].map(|k| [k.1, k.2].map(Vector3::from));
            let span = HermiteSpan::<3>::new(b.0 - a.0, from, to).unwrap();
            let into_s = (t_s - a.0).clamp(0.0, b.0 - a.0);
            worst_m = worst_m.max((span.eval(into_s).unwrap().x - x).norm());
        }
        (absent, worst_m)
    }

    #[track_caller]
    fn is_whole(&self) {
        let (absent, worst_m) = self.missed();
        let taken = self.taken.len();
        println!("{taken} samples, {} knots, {worst_m} m", self.path.len());
        assert!(taken > 20, "{taken} samples");
        assert_eq!(absent, 0, "of {taken} samples");
        assert!(worst_m <= BOUND_M + 1e-4, "{worst_m} m");
    }
}

/// Whoever quits over a link that loses a fifth of all messages leaves the end of the path there. (With a wait of a second
/// these three did not.)
#[test]
fn an_operator_that_quits_leaves_the_whole_path() {
    let link = LinkConfig {
        loss: Loss::random(0.2),
        ..shaped()
    };
    for seed in [10, 24, 60] {
        let ended = run(&link, seed, End::Quits);
        ended.is_whole();
        assert_eq!(ended.notes, [""; 0]);
    }
}

/// The release is lost, and the first that QUIC says again.
#[test]
fn the_end_of_the_path_outlasts_a_silence() {
    let ended = run(&delayed(0.1), 5, End::QuitsUnheard(0.9));
    ended.is_whole();
    assert_eq!(ended.notes, [""; 0]);
}

#[test]
fn whoever_could_not_leave_it_says_so() {
    let ended = run(&delayed(0.1), 5, End::QuitsUnheard(8.0));
    assert!(ended.missed().0 > 0, "nothing of the end arrived");
    assert!(
        ended.notes.iter().any(|n| n.contains("not confirmed")),
        "{:?}",
        ended.notes
    );
}

/// The lease ends, the link goes on: the hand was told about a moment later, and until then it was followed.
#[test]
fn an_arm_that_stops_by_itself_gets_the_whole_path_too() {
    run(&delayed(0.1), 5, End::Stops(0.8)).is_whole();
}

/// A hand is followed; its operator quits, is not heard for so long, s, and meanwhile is told to stop. What came of it, and
/// whether the arm was stopped for good.
fn stopped_at_goodbye(unheard_s: f64) -> (Outcome, bool) {
    let link = delayed(0.1);
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let config = SessionConfig::default();
        let task = replay(unseen());
        let operator = pair.operator(task, None, config, &link, 5).unwrap();
        let follows = |r: &Report| r.state == RobotState::Engaged;
        assert!(pair.wait_for(20.0, follows).await);
        pair.run_for(1.0).await;
        if unheard_s > 0.0 {
            silence(&pair, &operator, &link, 5);
            operator.quit();
            pair.run_for(0.5 * unheard_s).await;
            operator.say(Word::Stop);
            pair.run_for(0.5 * unheard_s).await;
            let robot = pair.robot_addr();
            pair.network.link(operator.addr, robot, link.clone(), 5);
        } else {
            operator.say(Word::Stop);
            operator.quit();
        }
        let (summary, ..) = finish(operator).await;
        pair.run_for(0.5).await;
        let last = pair.robot.reports().last().map(|r| r.state);
        (summary.unwrap().outcome, last == Some(RobotState::Stopped))
    })
    .unwrap()
}

#[test]
fn a_stop_is_heard_while_an_operator_leaves() {
    for unheard_s in [0.0, 0.4, 0.7] {
        let (outcome, stopped) = stopped_at_goodbye(unheard_s);
        assert!(stopped, "after {unheard_s} s: {outcome:?}");
    }
}

/// Nothing arrives any more: who said stop is told that nobody confirmed it.
#[test]
fn a_stop_that_nobody_heard_is_said_to_be_none() {
    let (outcome, stopped) = stopped_at_goodbye(1.6);
    let Outcome::Interrupted(why) = outcome else {
        panic!("{outcome:?}");
    };
    assert!(!stopped && why.contains("never confirmed"), "{why}");
}

#[test]
fn who_quits_twice_does_not_wait_for_a_robot_that_hears_nothing() {
    let link = delayed(0.1);
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let config = SessionConfig::default();
        let task = replay(unseen());
        let operator = pair.operator(task, None, config, &link, 5).unwrap();
        let follows = |r: &Report| r.state == RobotState::Engaged;
        assert!(pair.wait_for(20.0, follows).await);
        silence(&pair, &operator, &link, 5);
        operator.quit();
        pair.run_for(0.5).await;
        assert!(!operator.done.is_finished(), "it waits");
        let again = pair.now();
        operator.quit();
        let _ = finish(operator).await;
        let took_s = (pair.now().0 - again.0) as f64 * 1e-9;
        // QUIC's own farewell is three of its probe time-outs.
        assert!(took_s < 2.0, "{took_s} s");
    })
    .unwrap();
}
