//! The clutch of the page, on a clock of our own.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::checkpoint::select;
use telemime_protocol::skill::example;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::turn::WireRotation;
use telemime_protocol::wire::v1::{
    Cause, Message, OperatorControl, OperatorDatagram, Refusal, RobotControl, RobotState,
};

use super::super::live::{Known, LEASE_S};
use super::super::{Act, Command, Holding, Live, Port, Said, seat};
use crate::session::tests::info;
use crate::session::{Output, Session, SessionConfig};

const MS: i64 = 1_000_000;

/// A skill whose motion is a metre straight on.
fn straight() -> Known {
    let x = [Vector3::zeros(), Vector3::x() * 0.5, Vector3::x()];
    Known {
        skill: Arc::new(example(2, 24)),
        plan: Some(select::bounded(&[0.0, 1.0, 2.0], &x, 0.01).unwrap().into()),
    }
}

struct Bench {
    live: Live,
    port: Port,
    session: Session,
    now: Stamp,
    control: Vec<OperatorControl>,
    motions: usize,
}

impl Bench {
    fn new() -> Self {
        Self::knowing(Vec::new())
    }

    fn knowing(known: Vec<Known>) -> Self {
        let (live, port) = seat(UnitQuaternion::identity(), 1.0, known, None);
        let config = SessionConfig {
            scale: Some(0.5),
            ..SessionConfig::default()
        };
        let mut bench = Self {
            live,
            port,
            session: Session::new(config, None, 1),
            now: Stamp(3_000 * MS),
            control: Vec::new(),
            motions: 0,
        };
        bench.hears(&RobotControl::Info(info(None)));
        bench
    }

    /// As the shell does after everything.
    fn settle(&mut self) {
        loop {
            while let Some(event) = self.session.poll_event() {
                self.live.on_event(self.now, &event);
            }
            self.live.advise(self.now, &mut self.session);
            let mut quiet = true;
            while let Some(output) = self.session.poll_output() {
                quiet = false;
                match output {
                    Output::Control(bytes) => {
                        self.control.push(OperatorControl::decode(&bytes).unwrap());
                    }
                    Output::Datagram { bytes, .. } => {
                        let said = OperatorDatagram::decode(&bytes).unwrap();
                        self.motions += usize::from(matches!(said, OperatorDatagram::Motion(_)));
                    }
                }
            }
            if quiet {
                return;
            }
        }
    }

    fn hears(&mut self, message: &RobotControl) {
        let frame = Frame {
            ignorable: false,
            payload: message.encode(),
        };
        self.session.handle_control(self.now, &frame).unwrap();
        self.settle();
    }

    fn says(&mut self, page: u64, command: Command) -> Option<Act> {
        let said = Said::Command(command);
        let act = self
            .live
            .handle(self.now, page, said, Some(&mut self.session));
        self.settle();
        act
    }

    fn holds(&mut self, page: u64, what: Holding) -> Option<Act> {
        let (t, x) = (self.now.0 as f64 * 1e-6, [0.5, 0.0, 0.25]);
        let skill = None;
        self.says(page, Command::Hold { what, skill, t, x })
    }

    /// The hand, from a page whose clock is `late_ms` behind at times.
    fn hand(&mut self, page: u64, x: f64, late_ms: f64) {
        let t = self.now.0 as f64 * 1e-6 - late_ms;
        self.says(
            page,
            Command::Hand {
                t,
                x: [x, 0.0, 0.25],
            },
        );
    }

    fn granted(&mut self, engagement: u32) {
        self.hears(&RobotControl::Engaged {
            engagement,
            t_us: self.now.0 / 1000,
            hand_m: [1.0, 0.0, 0.5],
            tip_m: [0.6, 0.0, 0.25],
            hand_q: None,
            tip_q: WireRotation::default(),
        });
        self.state(RobotState::Engaged, Cause::Requested);
    }

    fn state(&mut self, state: RobotState, cause: Cause) {
        self.changed(state, cause, 1);
    }

    fn changed(&mut self, state: RobotState, cause: Cause, changes: u32) {
        self.hears(&RobotControl::State {
            state,
            cause,
            changes,
        });
    }

    fn wait(&mut self, ms: i64) {
        let until = Stamp(self.now.0 + ms * MS);
        while let Some(due) = self.live.poll_timeout().filter(|due| *due <= until) {
            self.now = self.now.max(due);
            self.settle();
            if self.live.poll_timeout() == Some(due) {
                break;
            }
        }
        self.now = until;
        self.settle();
    }

    fn engages(&self) -> usize {
        self.control
            .iter()
            .filter(|m| matches!(m, OperatorControl::Engage(_)))
            .count()
    }

    fn releases(&self) -> usize {
        self.control
            .iter()
            .filter(|m| matches!(m, OperatorControl::Release { .. }))
            .count()
    }

    fn last_note(&mut self) -> String {
        self.live
            .handle(self.now, 0, Said::Here, Some(&mut self.session));
        self.settle();
        let snapshot = self.port.snapshots.borrow().clone();
        snapshot
            .notes
            .last()
            .map(|(_, text)| text.clone())
            .unwrap_or_default()
    }
}

fn driving() -> Bench {
    let mut bench = Bench::new();
    bench.holds(1, Holding::Hand);
    assert_eq!((bench.engages(), bench.releases()), (1, 0));
    bench.granted(1);
    for i in 0..20 {
        bench.wait(16);
        bench.hand(1, 0.5 + 0.002 * f64::from(i), 0.0);
    }
    assert!(bench.motions > 0, "the hand travels");
    bench
}

#[test]
fn a_page_that_falls_silent_has_let_go_and_its_return_engages_nothing() {
    let mut bench = driving();
    bench.wait((LEASE_S * 1e3) as i64 - 2);
    assert_eq!(bench.releases(), 0, "within its lease");
    bench.wait(2);
    assert_eq!(bench.releases(), 1, "at its end");
    let motions = bench.motions;
    for _ in 0..20 {
        bench.wait(16);
        bench.hand(1, 0.6, 0.0);
    }
    assert_eq!(
        (bench.engages(), bench.releases(), bench.motions),
        (1, 1, motions)
    );
    assert!(bench.last_note().contains("silent"));
}

#[test]
fn a_hand_that_rests_holds_on() {
    let mut bench = driving();
    for _ in 0..100 {
        bench.wait(50);
        bench.hand(1, 0.54, 0.0);
    }
    assert_eq!(bench.releases(), 0);
}

#[test]
fn a_page_that_is_gone_has_let_go_at_once() {
    let mut bench = driving();
    bench
        .live
        .handle(bench.now, 1, Said::Gone, Some(&mut bench.session));
    bench.settle();
    assert_eq!(bench.releases(), 1);
}

#[test]
fn one_page_drives_and_anybody_stops() {
    let mut bench = driving();
    bench.holds(2, Holding::Hand);
    bench.says(2, Command::Release {});
    bench.hand(2, 0.9, 0.0);
    assert_eq!(
        (bench.engages(), bench.releases(), bench.live.refused()),
        (1, 0, 1)
    );
    assert!(bench.last_note().contains("another page"));
    assert!(matches!(bench.says(2, Command::Stop {}), Some(Act::Stop)));
    assert_eq!(bench.releases(), 1);
    bench.hand(1, 0.6, 0.0);
    assert_eq!(bench.engages(), 1, "what was stopped stays stopped");
}

/// Two pages saw the same stop; one of them has reset it and stopped anew before the other's reset arrives.
#[test]
fn a_reset_leaves_no_stop_that_its_page_has_not_seen() {
    let mut bench = driving();
    bench.changed(RobotState::Stopped, Cause::OperatorStop, 4);
    bench.last_note();
    let snapshot = bench.port.snapshots.borrow().clone();
    let seen = snapshot.robot.as_ref().unwrap();
    assert_eq!((seen.state.as_str(), seen.changes), ("Stopped", 4));
    let changes = seen.changes;
    bench.says(2, Command::Reset { changes });
    assert_eq!(
        bench.control.pop(),
        Some(OperatorControl::Reset { changes })
    );
    bench.changed(RobotState::Ready, Cause::Requested, 5);
    bench.changed(RobotState::Stopped, Cause::OperatorStop, 6);
    bench.says(1, Command::Reset { changes });
    assert!(!matches!(
        bench.control.last(),
        Some(OperatorControl::Reset { .. })
    ));
    assert!(bench.last_note().contains("reset again"));
    bench.says(1, Command::Reset { changes: 6 });
    assert_eq!(
        bench.control.pop(),
        Some(OperatorControl::Reset { changes: 6 })
    );
}

#[test]
fn what_the_robot_let_go_is_not_taken_up_again() {
    for state in [RobotState::Holding, RobotState::Stopped] {
        let mut bench = driving();
        bench.state(state, Cause::LeaseExpired);
        for _ in 0..10 {
            bench.wait(16);
            bench.hand(1, 0.6, 0.0);
        }
        assert_eq!(bench.engages(), 1, "{state:?}");
        assert_eq!(bench.port.snapshots.borrow().holder, None);
    }
}

/// The state in which the last session left the robot comes after a request: it ends nothing, and whatever does end it ends it
/// at both ends.
#[test]
fn what_is_asked_for_before_the_robot_says_that_it_holds_is_still_let_go() {
    for what in [Holding::Hand, Holding::Play] {
        let mut bench = Bench::knowing(vec![straight()]);
        bench.holds(1, what);
        bench.state(RobotState::Holding, Cause::ConnectionLost);
        if what == Holding::Play {
            bench.hears(&RobotControl::PlanStored { id: 1 });
        }
        bench.granted(1);
        assert_eq!((bench.engages(), bench.releases()), (1, 0), "{what:?}");
        bench.says(1, Command::Release {});
        assert_eq!(bench.releases(), 1, "{what:?}");
        assert!(!bench.session.is_driving());
    }
}

#[test]
fn what_is_declined_while_the_robot_follows_is_let_go_at_both_ends() {
    let mut bench = driving();
    let reason = Refusal::BadModel;
    bench.hears(&RobotControl::Refused { reason });
    assert_eq!(bench.releases(), 1);
    assert!(!bench.session.is_driving());
}

#[test]
fn who_only_watches_does_not_change_what_is_driven() {
    let mut bench = driving();
    let others = [
        Command::Predict { gain: 0.0 },
        Command::Discard {},
        Command::Use {
            skill: "line".into(),
        },
    ];
    for command in others {
        bench.says(2, command);
    }
    assert_eq!(bench.live.refused(), 3);
    assert!(bench.last_note().contains("another page"));
}

#[test]
fn the_hand_is_shown_where_the_tip_is_to_be() {
    let mut bench = driving();
    bench
        .live
        .handle(bench.now, 1, Said::Here, Some(&mut bench.session));
    bench.settle();
    let shown = bench.port.snapshots.borrow().clone();
    // hand₀ (1, 0, 0.5) is tip₀ (0.6, 0, 0.25) at a scale of one half: 0.1 m ahead of what the page says.
    let hand = shown.hand.as_ref().unwrap().p;
    assert!(
        (hand[0] - 0.638).abs() < 1e-6 && (hand[2] - 0.25).abs() < 1e-6,
        "{hand:?}"
    );
    assert!((shown.offset[0] - 0.1).abs() < 1e-6);
    let tube = &shown.path;
    assert!(
        tube.len() > 5 && (tube[0][0] - hand[0]).abs() < 0.05,
        "{tube:?}"
    );
}

#[test]
fn a_request_that_may_be_made_again_is_and_another_is_not() {
    let mut bench = Bench::new();
    bench.holds(1, Holding::Hand);
    let reason = Refusal::Moving;
    bench.hears(&RobotControl::Refused { reason });
    bench.wait(49);
    bench.hand(1, 0.5, 0.0);
    assert_eq!(bench.engages(), 1);
    bench.wait(2);
    assert_eq!(bench.engages(), 2);
    let reason = Refusal::Stopped;
    bench.hears(&RobotControl::Refused { reason });
    bench.wait(190);
    assert_eq!(bench.engages(), 2);
    assert!(bench.last_note().contains("Stopped"));
}

#[test]
fn strokes_move_nothing_and_two_can_be_learned_from() {
    let mut bench = Bench::new();
    assert!(
        bench
            .says(1, Command::Learn { name: "arc".into() })
            .is_none()
    );
    for stroke in 0..2 {
        bench.holds(1, Holding::Record);
        for i in 0..80 {
            bench.wait(16);
            bench.hand(1, 0.5 + 0.1 * (f64::from(i) * 0.04).sin(), 0.0);
        }
        bench.says(1, Command::Release {});
        assert_eq!(bench.port.snapshots.borrow().strokes.len(), stroke + 1);
    }
    // A touch is no stroke.
    bench.holds(1, Holding::Record);
    bench.says(1, Command::Release {});
    assert_eq!(bench.port.snapshots.borrow().strokes.len(), 2);
    assert!(
        bench.control.is_empty() && bench.motions == 0,
        "the arm hears nothing of it"
    );
    let Some(Act::Learn { name, strokes, .. }) =
        bench.says(1, Command::Learn { name: "arc".into() })
    else {
        panic!("two strokes are enough");
    };
    assert_eq!((name.as_str(), strokes.len()), ("arc", 2));
    let samples = strokes[0].samples();
    let step_s = samples[1].t_s - samples[0].t_s;
    assert!((step_s - 0.016).abs() < 1e-6, "{step_s}");
    // Hand metres: the page's are the tip's, at a scale of one half.
    assert!((samples[0].position.x - 1.0).abs() < 1e-9);
}

#[test]
fn jitter_of_the_browser_is_no_motion_of_the_hand() {
    let mut bench = Bench::new();
    bench.holds(1, Holding::Record);
    for i in 0..60 {
        bench.wait(16);
        // Every third message is 7 ms late, and says when it was true.
        bench.hand(
            1,
            0.5 + 0.002 * f64::from(i),
            if i % 3 == 0 { 7.0 } else { 0.0 },
        );
    }
    bench.says(1, Command::Release {});
    bench.holds(1, Holding::Record);
    for i in 0..60 {
        bench.wait(16);
        bench.hand(1, 0.5 + 0.002 * f64::from(i), 0.0);
    }
    bench.says(1, Command::Release {});
    let Some(Act::Learn { strokes, .. }) = bench.says(
        1,
        Command::Learn {
            name: "line".into(),
        },
    ) else {
        panic!("two strokes are enough");
    };
    let steps = strokes[0].samples().windows(2).map(|w| w[1].t_s - w[0].t_s);
    let steps: Vec<_> = steps.collect();
    // 16 ± 7 ms, as the hand was seen, and not 16 throughout, as the messages came.
    assert!(steps.iter().any(|s| (s - 0.009).abs() < 1e-3), "{steps:?}");
    assert!(steps.iter().any(|s| (s - 0.023).abs() < 1e-3), "{steps:?}");
}

#[test]
fn without_a_link_only_a_stop_is_kept() {
    let (mut live, _port) = seat(UnitQuaternion::identity(), 1.0, Vec::new(), None);
    let now = Stamp(MS);
    let hold = Command::Hold {
        what: Holding::Hand,
        skill: None,
        t: 0.0,
        x: [0.0; 3],
    };
    for command in [
        hold,
        Command::Reset { changes: 1 },
        Command::Learn { name: "arc".into() },
    ] {
        assert!(live.handle(now, 1, Said::Command(command), None).is_none());
    }
    assert_eq!(live.refused(), 3);
    let stop = live.handle(now, 1, Said::Command(Command::Stop {}), None);
    assert!(matches!(stop, Some(Act::Stop)));
}

#[test]
fn prediction_is_switched_while_it_drives() {
    let mut bench = driving();
    bench.says(1, Command::Predict { gain: 0.0 });
    for i in 0..12 {
        bench.wait(16);
        bench.hand(1, 0.54 + 0.01 * f64::from(i), 0.0);
    }
    let told = bench.session.told().unwrap();
    let moved = (told.at(0.3).position - told.at(0.0).position).norm();
    assert!(
        moved < 1e-9,
        "without prediction the hand is where it was: {moved}"
    );
    bench.says(1, Command::Predict { gain: 1.0 });
    for i in 0..12 {
        bench.wait(16);
        bench.hand(1, 0.66 + 0.01 * f64::from(i), 0.0);
    }
    let told = bench.session.told().unwrap();
    assert!((told.at(0.1).position - told.at(0.0).position).norm() > 0.005);
}
