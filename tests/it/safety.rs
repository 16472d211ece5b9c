//! What must hold whatever the network, the operator or a stranger does.

use telemime::ground::{Operator, Pair, run_virtual};
use telemime_endpoint::Mono;
use telemime_endpoint::cli::Word;
use telemime_operator::daemon::Notice;
use telemime_operator::session::Event;
use telemime_operator::task::Outcome;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::daemon::Notice as RobotNotice;
use telemime_robot::rig::Rig;
use telemime_robot::servo::Report;
use telemime_sim::link::Loss;

use crate::scene::{delayed, finish, mirroring, rig, shaped, skill, speed};

/// At a stop from full speed the arm gets this long to come to rest, s.
const STOP_S: f64 = 0.6;

/// The lease the operator grants by default, s.
const LEASE_S: f64 = 0.65;

/// Waits until the tip is fast, and returns when that was.
async fn full_speed(pair: &Pair) -> Mono {
    let fast = |r: &Report| r.state == RobotState::Engaged && r.reference_m != r.tip_m;
    assert!(pair.wait_for(6.0, fast).await, "it never engaged");
    for _ in 0..8000 {
        pair.run_for(1e-3).await;
        let reports = pair.robot.reports();
        if let [.., a, b] = &reports[..]
            && speed(a, b) > 0.3
        {
            return b.at;
        }
    }
    panic!("it never became fast");
}

/// The tip is where it was, at rest, for the last `span_s`, and nothing follows anything.
pub(crate) fn assert_rested(pair: &Pair, span_s: f64) {
    let reports = pair.robot.reports();
    let last = reports.last().unwrap();
    let ticks = (span_s * 1e3) as usize;
    for r in reports.iter().rev().take(ticks) {
        assert!(
            (r.tip_m - last.tip_m).norm() < 1e-4 && !r.moving,
            "moved at {} s in {:?}",
            r.at.0 as f64 * 1e-9,
            r.state
        );
        assert!(!following(r));
    }
}

fn following(r: &Report) -> bool {
    matches!(r.state, RobotState::Engaged | RobotState::Coasting)
}

/// Tip and joints never exceed what the arm is set to.
pub(crate) fn assert_within_limits(pair: &Pair, rig: &Rig) {
    let info = rig.info();
    let (mut fastest, mut hardest) = (0.0f64, 0.0f64);
    let reports = pair.robot.reports();
    for w in reports.windows(3) {
        let dt_s = w[2].at.secs_since(w[1].at);
        fastest = fastest.max(speed(&w[1], &w[2]));
        let bend = w[2].reference_m - 2.0 * w[1].reference_m + w[0].reference_m;
        hardest = hardest.max(bend.norm() / (dt_s * dt_s));
        for (i, joint) in rig.arm.joints().iter().enumerate() {
            let rate = (w[2].q[i] - w[1].q[i]).abs() / dt_s;
            assert!(rate <= joint.velocity * 1.001, "{}: {rate}", joint.name);
            assert!((joint.lower..=joint.upper).contains(&w[2].q[i]));
        }
    }
    println!("fastest {fastest:.3} m/s, hardest {hardest:.2} m/s²");
    assert!(fastest <= f64::from(info.speed_m_s), "{fastest} m/s");
    assert!(
        hardest <= f64::from(info.accel_m_s2) * 1.001,
        "{hardest} m/s²"
    );
}

/// States and causes in order, from `since` on.
fn history(pair: &Pair, since: Mono) -> Vec<(RobotState, Cause)> {
    let reports = pair.robot.reports();
    let mut seen: Vec<_> = reports
        .iter()
        .filter(|r| r.at >= since)
        .map(|r| (r.state, r.cause))
        .collect();
    seen.dedup();
    seen
}

/// When the robot was first in `state` after `since`, s from it.
fn entered(pair: &Pair, since: Mono, state: RobotState) -> f64 {
    let reports = pair.robot.reports();
    let first = reports.iter().find(|r| r.at >= since && r.state == state);
    first.expect("it gets there").at.secs_since(since)
}

fn events(notices: &[Notice]) -> Vec<&Event> {
    let mut events = Vec::new();
    for notice in notices {
        if let Notice::Event(_, event) = notice {
            events.push(event);
        }
    }
    events
}

#[test]
fn a_cut_link_leaves_a_held_arm_that_nothing_re_engages() {
    let rig = rig();
    run_virtual(async {
        let mut pair = Pair::start(&rig).unwrap();
        let operator = mirroring(&mut pair, &shaped(), 21);
        let cut = full_speed(&pair).await;
        pair.network.set_down(true);
        pair.run_for(2.5).await;
        // The last packet may have been 110 ms on its way.
        let held = entered(&pair, cut, RobotState::Holding);
        assert!(held <= 0.11 + LEASE_S, "{held} s");
        let coasted = entered(&pair, cut, RobotState::Coasting);
        assert!(coasted <= 0.11 + 0.27 && coasted < held, "{coasted} s");
        assert_rested(&pair, 2.5 - held - STOP_S);
        let history = history(&pair, cut);
        assert_eq!(
            history.last(),
            Some(&(RobotState::Holding, Cause::LeaseExpired)),
            "{history:?}"
        );

        let back = pair.now();
        pair.network.set_down(false);
        let (summary, _, notices) = finish(operator).await;
        let summary = summary.unwrap();
        assert_eq!(summary.sessions, 2, "it came back");
        assert!(
            matches!(&summary.outcome, Outcome::Interrupted(why) if why.contains("not engaged again")),
            "{:?}",
            summary.outcome
        );
        assert_rested(&pair, pair.now().secs_since(back));
        let engaged = |e: &&&Event| matches!(e, Event::Engaged { .. });
        assert_eq!(events(&notices).iter().filter(engaged).count(), 1);
        assert_within_limits(&pair, &rig);
    })
    .unwrap();
}

#[test]
fn after_an_outage_the_model_is_not_sent_again() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &delayed(0.1), 22);
        full_speed(&pair).await;
        pair.network.set_down(true);
        pair.run_for(3.0).await;
        pair.network.set_down(false);
        let back = pair.now();
        let (summary, _, notices) = finish(operator).await;
        let summary = summary.unwrap();
        assert_eq!(summary.sessions, 2);
        let ready = events(&notices);
        let ready = ready.iter().filter(|e| matches!(e, Event::Ready)).count();
        assert_eq!(ready, 2, "the second session is ready too");
        let model = skill().to_bytes().len() as u64;
        // Without jitter, that is: reordering makes QUIC send half of a burst twice. The attempts to reach the robot
        // while the link was down are of this, two packets of 1.2 kB each; a second model would be one more.
        let besides = summary.total.sent.bytes - summary.engaged.motion.bytes;
        assert!(
            (model..3 * model).contains(&besides),
            "{besides} B sent besides motion, the model has {model} B",
        );
        assert_rested(&pair, pair.now().secs_since(back));
        // Told at the start of the session, not only with the first change.
        let states = events(&notices).into_iter().filter_map(|e| match e {
            Event::State(state, _) => Some(*state),
            _ => None,
        });
        let states: Vec<_> = states.collect();
        assert_eq!(states.last(), Some(&RobotState::Holding), "{states:?}");
    })
    .unwrap();
}

/// The robot stopped by `stop` within `within_s`, latched, and freed by `reset` without moving.
async fn stopped(
    pair: &mut Pair,
    operator: Operator,
    within_s: f64,
    cause: Cause,
    stop: impl Fn(&Pair, &Operator),
    reset: impl Fn(&Pair, &Operator),
) {
    let pressed = full_speed(pair).await;
    stop(pair, &operator);
    pair.run_for(within_s + STOP_S + 0.3).await;
    let after = entered(pair, pressed, RobotState::Stopped);
    assert!(after <= within_s, "{after} s");
    assert_eq!(
        history(pair, pressed).last(),
        Some(&(RobotState::Stopped, cause))
    );
    assert_rested(pair, 0.3);

    pair.run_for(1.0).await;
    assert_rested(pair, 1.0);
    assert_eq!(
        pair.robot.reports().last().unwrap().state,
        RobotState::Stopped
    );
    let before = pair.now();
    reset(pair, &operator);
    pair.run_for(0.5).await;
    assert_eq!(
        history(pair, before).last(),
        Some(&(RobotState::Ready, Cause::Requested))
    );
    let (summary, _, _) = finish(operator).await;
    assert!(matches!(
        summary.unwrap().outcome,
        Outcome::Interrupted(why) if why.contains("emergency stop")
    ));
    assert_rested(pair, pair.now().secs_since(before));
}

#[test]
fn the_operators_stop_takes_one_way_of_the_link() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &delayed(0.1), 23);
        let stop = |_: &Pair, operator: &Operator| operator.say(Word::Stop);
        let reset = |_: &Pair, operator: &Operator| operator.say(Word::Reset);
        stopped(&mut pair, operator, 0.107, Cause::OperatorStop, stop, reset).await;
    })
    .unwrap();
}

#[test]
fn the_robots_own_stop_is_at_once() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &shaped(), 24);
        let stop = |pair: &Pair, _: &Operator| pair.robot.say(Word::Stop);
        let reset = |pair: &Pair, _: &Operator| pair.robot.say(Word::Reset);
        stopped(&mut pair, operator, 0.003, Cause::LocalStop, stop, reset).await;
    })
    .unwrap();
}

#[test]
fn a_stop_gets_through_a_link_that_loses_most() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &delayed(0.1), 25);
        let pressed = full_speed(&pair).await;
        let mut bad = delayed(0.1);
        bad.loss = Loss::random(0.6);
        pair.set_link(1, &bad, 26);
        operator.say(Word::Stop);
        pair.run_for(0.6).await;
        let after = entered(&pair, pressed, RobotState::Stopped);
        assert!(after <= 0.25, "{after} s: sooner than any lease");
    })
    .unwrap();
}

#[test]
fn a_second_stop_is_confirmed_and_the_repeats_end() {
    let packets = |stops: usize| {
        run_virtual(async {
            let mut pair = Pair::start(&rig()).unwrap();
            let operator = mirroring(&mut pair, &delayed(0.02), 27);
            full_speed(&pair).await;
            for _ in 0..stops {
                operator.say(Word::Stop);
                pair.run_for(0.5).await;
            }
            finish(operator).await.0.unwrap().total.sent.packets
        })
        .unwrap()
    };
    let (once, twice) = (packets(1), packets(2));
    // Unconfirmed, the second would be repeated a hundred times a second to the recording's end.
    assert!(
        twice < once + 50,
        "{once} packets with one stop, {twice} with two"
    );
}

/// The link dies under way, `says` happens `after_s` later, and 3 s after that the link is back.
async fn said_without_a_link(pair: &mut Pair, operator: &Operator, after_s: f64, says: &[Word]) {
    full_speed(pair).await;
    pair.network.set_down(true);
    pair.run_for(after_s).await;
    says.iter().for_each(|word| operator.say(word.clone()));
    pair.run_for(3.0).await;
    assert!(
        !pair
            .robot
            .reports()
            .iter()
            .any(|r| r.state == RobotState::Stopped)
    );
    pair.network.set_down(false);
}

#[test]
fn a_stop_the_link_swallowed_is_made_once_it_is_back() {
    // 0.05 s: the connection is not given up yet; 2 s: it is being dialled again.
    for (after_s, says) in [(0.05, &[Word::Stop][..]), (2.0, &[Word::Stop, Word::Reset])] {
        run_virtual(async {
            let mut pair = Pair::start(&rig()).unwrap();
            let operator = mirroring(&mut pair, &delayed(0.1), 31);
            said_without_a_link(&mut pair, &operator, after_s, says).await;
            let stopped = |r: &Report| r.state == RobotState::Stopped;
            assert!(
                pair.wait_for(10.0, stopped).await,
                "{after_s} s: not stopped"
            );
            let (summary, _, notices) = finish(operator).await;
            assert!(matches!(summary.unwrap().outcome, Outcome::Interrupted(_)));
            let confirmed = Event::State(RobotState::Stopped, Cause::OperatorStop);
            assert!(events(&notices).contains(&&confirmed));
            assert_eq!(
                pair.robot.reports().last().unwrap().cause,
                Cause::OperatorStop
            );
        })
        .unwrap();
    }
}

#[test]
fn a_stop_outlives_the_task_it_interrupts() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &delayed(0.1), 32);
        said_without_a_link(&mut pair, &operator, 0.05, &[Word::Stop]).await;
        pair.network.set_down(true);
        // Longer than the recording: nothing else is left to do.
        pair.run_for(20.0).await;
        assert!(
            !operator.done.is_finished(),
            "the stop is still to be delivered"
        );
        pair.network.set_down(false);
        let stopped = |r: &Report| r.state == RobotState::Stopped;
        assert!(pair.wait_for(12.0, stopped).await);
        finish(operator).await.0.unwrap();
    })
    .unwrap();
}

#[test]
fn an_operator_that_quits_says_that_its_stop_was_not_confirmed() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &delayed(0.1), 33);
        full_speed(&pair).await;
        pair.network.set_down(true);
        pair.run_for(2.0).await;
        operator.say(Word::Stop);
        pair.run_for(0.5).await;
        operator.quit();
        let (summary, _, _) = finish(operator).await;
        assert!(matches!(
            summary.unwrap().outcome,
            Outcome::Interrupted(why) if why.contains("never confirmed")
        ));
    })
    .unwrap();
}

#[test]
fn a_reset_without_a_link_is_said_to_be_discarded() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &delayed(0.1), 34);
        said_without_a_link(&mut pair, &operator, 2.0, &[Word::Reset]).await;
        let (_, _, notices) = finish(operator).await;
        let discarded =
            |n: &Notice| matches!(n, Notice::Note(text) if text.contains("reset is discarded"));
        assert_eq!(notices.iter().filter(|n| discarded(n)).count(), 1);
        assert_eq!(
            pair.robot.reports().last().unwrap().state,
            RobotState::Holding
        );
    })
    .unwrap();
}

#[test]
fn an_operator_that_quits_releases_the_arm() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &shaped(), 28);
        let quit = full_speed(&pair).await;
        operator.quit();
        let (summary, _, _) = finish(operator).await;
        assert!(matches!(summary.unwrap().outcome, Outcome::Interrupted(_)));
        pair.run_for(STOP_S + 0.5).await;
        assert!(!history(&pair, quit).contains(&(RobotState::Holding, Cause::LeaseExpired)));
        assert_eq!(pair.robot.reports().last().unwrap().state, RobotState::Idle);
        assert_rested(&pair, 0.5);
    })
    .unwrap();
}

#[test]
fn an_operator_that_dies_leaves_a_held_arm() {
    let rig = rig();
    run_virtual(async {
        let mut pair = Pair::start(&rig).unwrap();
        let operator = mirroring(&mut pair, &shaped(), 29);
        let killed = full_speed(&pair).await;
        operator.done.abort();
        drop(operator);
        pair.run_for(2.5).await;
        assert!(entered(&pair, killed, RobotState::Holding) <= 0.11 + LEASE_S);
        assert_rested(&pair, 1.0);
        assert_within_limits(&pair, &rig);
        let gone = pair.robot.notices();
        let gone = gone
            .iter()
            .filter(|n| matches!(n, RobotNotice::Disconnected { .. }));
        assert_eq!(gone.count(), 1, "and its place is free");
    })
    .unwrap();
}

#[test]
fn a_robot_daemon_that_stops_leaves_a_stopped_arm() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &shaped(), 30);
        let quit = full_speed(&pair).await;
        pair.robot.quit();
        pair.run_for(2.0).await;
        drop(operator);
        assert!(entered(&pair, quit, RobotState::Stopped) <= 0.003);
    })
    .unwrap();
}
