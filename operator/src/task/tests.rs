use nalgebra::Vector3;
use telemime_protocol::checkpoint::select;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::v1::{Message, RobotControl};

use super::*;
use crate::session::SessionConfig;
use crate::session::tests::info;

pub(crate) fn ready() -> Session {
    let mut session = Session::new(SessionConfig::default(), None, 1);
    let frame = Frame {
        ignorable: false,
        payload: RobotControl::Info(info(None)).encode(),
    };
    session.handle_control(Stamp::ZERO, &frame).unwrap();
    session
}

fn granted() -> Event {
    Event::Engaged {
        engagement: 1,
        t_us: 0,
        hand_m: [0.0; 3],
        tip_m: [0.0; 3],
        hand_q: None,
        tip_q: nalgebra::UnitQuaternion::identity(),
    }
}

fn at(ms: i64) -> Stamp {
    Stamp(ms * 1_000_000)
}

fn points() -> Vec<(f64, Vector3<f64>)> {
    let point = |i: i32| (f64::from(i) * 0.033, Vector3::x() * (0.01 * f64::from(i)));
    (0..60).map(point).collect()
}

fn replay() -> Task {
    Task::replay(Recording {
        samples: points()
            .into_iter()
            .map(|(t_s, x)| Sample::at(t_s, x))
            .collect(),
        rest_s: 0.0,
    })
}

fn play() -> Task {
    let (t, x): (Vec<f64>, Vec<_>) = points().into_iter().unzip();
    Task::play(select::bounded(&t, &x, 0.01).unwrap())
}

/// A shell sleeps until what [`Task::poll_timeout`] names, and advises: it must not find itself there again.
#[test]
fn what_is_due_is_over_once_it_was_done() {
    for mut task in [replay(), play()] {
        let mut session = ready();
        let (mut now, mut asked) = (at(0), 0);
        while now < at(1000) {
            task.advise(now, &mut session);
            if task.phase == Phase::Asked {
                asked += 1;
                task.on_event(now, &Event::Refused(Refusal::ClockUnknown));
            }
            let due = task.poll_timeout().expect("a retry or a sample");
            assert!(due > now, "{now:?}: due again at {due:?}");
            now = due;
        }
        assert!((10..=20).contains(&asked), "{asked} requests in a second");
    }
}

#[test]
fn a_lost_link_leaves_nothing_due_until_the_robot_is_back() {
    let mut task = play();
    task.advise(at(0), &mut ready());
    task.on_event(at(10), &Event::Refused(Refusal::Moving));
    task.on_lost("test");
    assert_eq!(task.poll_timeout(), None);
    assert!(!task.is_over(at(2000)));
    let mut fresh = Session::new(SessionConfig::default(), None, 2);
    task.advise(at(2000), &mut fresh);
    assert_eq!(task.poll_timeout(), None);
    task.advise(at(2100), &mut ready());
    assert_eq!(task.phase, Phase::Asked);
}

#[test]
fn after_a_hold_or_a_stop_nothing_is_asked_again() {
    for event in [
        Event::State(RobotState::Holding, Cause::LeaseExpired),
        Event::State(RobotState::Stopped, Cause::LocalStop),
    ] {
        let (mut task, mut session) = (replay(), ready());
        let mut now = at(0);
        task.advise(now, &mut session);
        assert_eq!(task.phase, Phase::Asked);
        task.on_event(now, &granted());
        task.on_event(now, &event);
        while let Some(due) = task.poll_timeout() {
            now = due;
            assert_ne!(task.phase, Phase::Asked);
            if task.advise(now, &mut session) == Advice::Finished {
                break;
            }
        }
        assert!(matches!(task.outcome(false), Outcome::Interrupted(_)));
        assert!(now > at(1900), "the samples go on: {now:?}");
    }
}

/// Lets the shell's clock run until the task says something else than go on.
fn until_said(task: &mut Task, session: &mut Session, now: &mut Stamp) -> Advice {
    loop {
        let advice = task.advise(*now, session);
        if task.phase == Phase::Asked {
            task.on_event(*now, &granted());
        }
        if advice != Advice::Continue {
            return advice;
        }
        *now = task.poll_timeout().unwrap();
    }
}

#[test]
fn recordings_follow_one_another_when_they_may() {
    let Work::Replay { recording, .. } = replay().work else {
        panic!("a replay")
    };
    let (mut task, mut session) = (replay().and_then(recording), ready());
    let mut now = at(0);
    let said = until_said(&mut task, &mut session, &mut now);
    assert_eq!(said, Advice::Performed);
    let first = task.zero().unwrap();
    assert_eq!(task.advise(now, &mut session), Advice::Between, "said once");
    assert_eq!(task.poll_timeout(), None, "it waits to be told");
    assert!(!task.is_over(at(3_600_000)), "one is left");
    task.go_on();
    assert_eq!(
        until_said(&mut task, &mut session, &mut now),
        Advice::Performed
    );
    assert!(task.zero().unwrap().secs_since(first) > 2.0);
    task.go_on();
    assert_eq!(task.advise(now, &mut session), Advice::Finished);
    assert_eq!(task.outcome(false), Outcome::Completed);
}

#[test]
fn a_stop_between_two_recordings_ends_the_task() {
    let Work::Replay { recording, .. } = replay().work else {
        panic!("a replay")
    };
    let (mut task, mut session) = (replay().and_then(recording), ready());
    let mut now = at(0);
    until_said(&mut task, &mut session, &mut now);
    task.on_event(now, &Event::State(RobotState::Stopped, Cause::LocalStop));
    assert!(task.is_in_trouble());
    task.go_on();
    assert_eq!(task.advise(now, &mut session), Advice::Finished);
    assert!(matches!(task.outcome(false), Outcome::Interrupted(_)));
}

/// What a robot says of the operator before, which ended in the middle of it.
#[test]
fn a_motion_that_ended_before_ours_began_is_not_ours() {
    let ended = Event::State(RobotState::Ready, Cause::PlanFinished);
    for mut task in [replay(), play()] {
        let (mut session, mut now) = (ready(), at(0));
        task.on_event(now, &ended);
        for _ in 0..20 {
            assert_eq!(task.advise(now, &mut session), Advice::Continue);
            task.on_event(now, &ended);
            now = now.offset_by_secs(0.05);
        }
        assert_eq!(task.requests, 1, "it is asked all the same");
        assert!(!task.has_released());
        task.on_event(now, &granted());
        assert!(!task.is_over(now));
    }
    let (mut task, mut session) = (play(), ready());
    task.advise(at(0), &mut session);
    task.on_event(at(50), &granted());
    task.on_event(at(2000), &ended);
    assert!(task.has_released(), "and ours is");
}

#[test]
fn a_motion_that_was_played_is_not_called_back_for() {
    let (mut task, mut session) = (play(), ready());
    task.advise(at(0), &mut session);
    task.on_event(at(50), &granted());
    task.on_event(
        at(2000),
        &Event::State(RobotState::Ready, Cause::PlanFinished),
    );
    assert!(!task.is_over(at(2100)), "the arm comes to rest");
    task.on_lost("cut");
    assert!(task.is_over(at(2100)));
    assert_eq!(task.outcome(false), Outcome::Completed);
}
