//! The link goes, and comes back; so do processes. How soon there is a session again, and what never happens.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use nalgebra::Vector3;
use telemime::ground::{Operator, Pair, run_virtual};
use telemime_endpoint::External;
use telemime_endpoint::cli::Word;
use telemime_operator::daemon::Notice;
use telemime_operator::session::Event;
use telemime_operator::task::Task;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::clock::Origin;
use telemime_robot::daemon::Notice as RobotNotice;
use telemime_robot::servo::Report;
use telemime_sim::link::{LinkConfig, Loss, Rate};

use crate::scene::{Samples, delayed, replay, rig, skill};

/// The most that may pass between attempts, s.
const REDIAL_S: f64 = 0.25;

/// Slack for the virtual clock's ticks and quinn's timers, s.
const SLACK_S: f64 = 0.02;

/// A hand that goes to and fro for a long time.
fn waving(span_s: f64) -> Samples {
    let sample = |i: u32| {
        let t_s = f64::from(i) / 30.0;
        (t_s, Vector3::new(0.1 * (2.0 * t_s).sin(), 0.0, 2.0))
    };
    (0..(span_s * 30.0) as u32).map(sample).collect()
}

fn operator(pair: &mut Pair, link: &LinkConfig, seed: u64) -> Operator {
    let task: Task = replay(waving(120.0));
    let config = Default::default();
    pair.operator(task, Some(skill()), config, link, seed)
        .unwrap()
}

/// What an operator has noticed so far, sorted.
#[derive(Debug, Default)]
struct Heard {
    sessions: usize,
    engaged: usize,
    telemetry: usize,
}

fn hear(operator: &mut Operator, heard: &mut Heard) {
    while let Ok(notice) = operator.notices.try_recv() {
        match notice {
            Notice::Connected { .. } => {
                heard.sessions += 1;
                heard.telemetry = 0;
            }
            Notice::Event(_, Event::Engaged { .. }) => heard.engaged += 1,
            Notice::Event(_, Event::Telemetry(_)) => heard.telemetry += 1,
            _ => {}
        }
    }
}

/// Lets time pass until the operator hears from the robot (in another session, if one is asked for); how long that
/// took, s.
async fn heard_again(
    pair: &Pair,
    operator: &mut Operator,
    heard: &mut Heard,
    anew: bool,
) -> Option<f64> {
    let sessions = heard.sessions + usize::from(anew);
    let since = pair.now();
    heard.telemetry = 0;
    while pair.now().secs_since(since) < 30.0 {
        pair.run_for(1e-3).await;
        hear(operator, heard);
        if heard.telemetry > 0 && heard.sessions >= sessions {
            return Some(pair.now().secs_since(since));
        }
    }
    None
}

/// The arm from `since` on: whether it ever followed.
fn followed(reports: &[Report], since: telemime_endpoint::Mono) -> bool {
    let follows = |r: &&Report| matches!(r.state, RobotState::Engaged | RobotState::Coasting);
    reports
        .iter()
        .filter(|r| r.at >= since)
        .any(|r| follows(&r))
}

/// An outage of a link that was known for so long: how long after its end there was news again, and over how many sessions.
async fn outage(link: &LinkConfig, known_s: f64, outage_s: f64, seed: u64) -> (f64, usize) {
    let rtt_s = 2.0 * link.delay_s;
    let mut pair = Pair::start(&rig()).unwrap();
    let mut operator = operator(&mut pair, link, seed);
    let engaged = pair
        .wait_for(20.0, |r| r.state == RobotState::Engaged)
        .await;
    assert!(engaged, "RTT {rtt_s} s");
    pair.run_for(known_s + (seed % 7) as f64 * 0.037).await;
    let mut heard = Heard::default();
    hear(&mut operator, &mut heard);
    pair.network.set_down(true);
    pair.run_for(outage_s).await;
    hear(&mut operator, &mut heard);
    let back = pair.now();
    pair.network.set_down(false);
    let took = heard_again(&pair, &mut operator, &mut heard, false).await;
    let took = took.unwrap_or_else(|| panic!("RTT {rtt_s} s, outage {outage_s} s: never back"));
    pair.run_for(1.0).await;
    hear(&mut operator, &mut heard);
    assert_eq!(heard.engaged, 1, "it never engages again by itself");
    // A lease outlasts the shortest outages; once it has ended nothing moves any more.
    if outage_s > 1.0 {
        assert!(!followed(&pair.robot.reports(), back));
    }
    (took, heard.sessions)
}

#[test]
fn news_is_back_two_round_trips_and_a_redial_after_the_link() {
    let outages = [0.2, 0.5, 0.9, 1.1, 1.7, 3.1, 7.3, 20.0, 60.0];
    for (i, rtt_s) in [0.02, 0.1, 0.3, 0.6].into_iter().enumerate() {
        for (j, outage_s) in outages.into_iter().enumerate() {
            let seed = (10 * i + j) as u64;
            run_virtual(async {
                let (took, sessions) = outage(&delayed(rtt_s / 2.0), 1.0, outage_s, seed).await;
                println!("RTT {rtt_s} s, outage {outage_s} s: {took:.3} s, {sessions} sessions");
                // Telemetry comes half a round trip and up to its interval after the greeting's answer.
                let most = 2.0 * rtt_s + REDIAL_S + 0.05 + SLACK_S;
                assert!(
                    took <= most,
                    "RTT {rtt_s} s, outage {outage_s} s, seed {seed}: {took} s"
                );
            })
            .unwrap();
        }
    }
}

/// What the operator has yet to say is no reason for the robot to stay busy with a session that the operator has given up.
#[test]
fn an_operator_whose_words_nobody_takes_ends_the_session_at_both_ends() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let mut operator = operator(&mut pair, &delayed(0.03), 70);
        assert!(
            pair.wait_for(20.0, |r| r.state == RobotState::Engaged)
                .await
        );
        let mut heard = Heard::default();
        hear(&mut operator, &mut heard);
        pair.network.set_down(true);
        // More than QUIC takes while nothing is acknowledged, and the queue before it.
        for _ in 0..20_000 {
            operator.say(Word::Stop);
        }
        pair.run_for(0.1).await;
        pair.network.set_down(false);
        let took = heard_again(&pair, &mut operator, &mut heard, true).await;
        assert!(took.is_some(), "never back");
        let why = pair
            .robot
            .notices()
            .iter()
            .find_map(|notice| match notice {
                RobotNotice::Disconnected { why, .. } => Some(why.clone()),
                _ => None,
            })
            .unwrap();
        assert_eq!(
            why,
            "closed by the peer: the peer does not read what is sent"
        );
        assert!(pair.wait_for(1.0, |r| r.state == RobotState::Stopped).await);
    })
    .unwrap();
}

/// A greeting that overtakes the handshake's last packet would be thrown away, and cost a round trip more.
#[test]
fn news_is_back_as_soon_over_a_link_that_reorders() {
    for (delay_s, jitter_s) in [(0.02, 0.005), (0.05, 0.01), (0.1, 0.03)] {
        let link = LinkConfig {
            jitter_s,
            ..delayed(delay_s)
        };
        let most_s = 4.0 * (delay_s + jitter_s) + REDIAL_S + 0.05 + SLACK_S;
        let mut all: Vec<f64> = (0..16)
            .map(|seed| {
                let outage_s = 2.0 + 0.117 * seed as f64;
                let (took_s, _) = run_virtual(outage(&link, 3.0, outage_s, seed)).unwrap();
                assert!(
                    took_s <= most_s,
                    "{delay_s} ± {jitter_s} s, seed {seed}: {took_s} s of {most_s}"
                );
                took_s
            })
            .collect();
        all.sort_by(f64::total_cmp);
        println!(
            "{delay_s} ± {jitter_s} s each way: median {:.3} s, largest {:.3} of {most_s:.3}",
            all[8], all[15]
        );
    }
}

#[test]
fn a_link_that_is_dead_one_way_only_is_back_as_soon() {
    for (seed, rtt_s) in [(40, 0.1), (42, 0.6)] {
        for up in [true, false] {
            run_virtual(async {
                let mut pair = Pair::start(&rig()).unwrap();
                let link = delayed(rtt_s / 2.0);
                let mut operator = operator(&mut pair, &link, seed);
                assert!(
                    pair.wait_for(20.0, |r| r.state == RobotState::Engaged)
                        .await
                );
                let (ours, robot) = (operator.addr, pair.robot_addr());
                let (from, to) = if up { (ours, robot) } else { (robot, ours) };
                let dead = LinkConfig {
                    loss: Loss::random(1.0),
                    ..link.clone()
                };
                pair.network.link(from, to, dead, seed);
                pair.run_for(8.0).await;
                pair.network.link(from, to, link.clone(), seed);
                let mut heard = Heard::default();
                hear(&mut operator, &mut heard);
                let took = heard_again(&pair, &mut operator, &mut heard, false).await;
                println!(
                    "RTT {rtt_s} s, dead {}: {took:?}",
                    if up { "up" } else { "down" }
                );
                let most = 2.0 * rtt_s + REDIAL_S + 0.05 + SLACK_S;
                assert!(
                    took.is_some_and(|t| t <= most),
                    "RTT {rtt_s} s, up {up}: {took:?}"
                );
            })
            .unwrap();
        }
    }
}

#[test]
fn a_thin_link_is_not_drowned_by_attempts() {
    run_virtual(async {
        let thin = LinkConfig {
            rate: Some(Rate::bits(64_000)),
            ..delayed(0.05)
        };
        let mut pair = Pair::start(&rig()).unwrap();
        let mut operator = operator(&mut pair, &thin, 30);
        assert!(
            pair.wait_for(30.0, |r| r.state == RobotState::Engaged)
                .await
        );
        pair.network.set_down(true);
        pair.run_for(5.0).await;
        pair.network.set_down(false);
        let mut heard = Heard::default();
        hear(&mut operator, &mut heard);
        let took = heard_again(&pair, &mut operator, &mut heard, true).await;
        println!("64 kbit/s: {took:?}");
        assert!(took.is_some_and(|t| t < 5.0), "{took:?}");
        pair.run_for(5.0).await;
        hear(&mut operator, &mut heard);
        assert_eq!(heard.sessions, 2, "and it lasts");
    })
    .unwrap();
}

#[test]
fn a_link_that_comes_back_slower_is_reached_by_the_patient_attempts() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let mut operator = operator(&mut pair, &delayed(0.01), 50);
        assert!(
            pair.wait_for(20.0, |r| r.state == RobotState::Engaged)
                .await
        );
        pair.network.set_down(true);
        pair.run_for(3.0).await;
        // Four of the former round trips are 80 ms, so that most attempts get 500 ms; two of these take 1.6 s.
        pair.set_link(1, &delayed(0.4), 51);
        pair.network.set_down(false);
        let mut heard = Heard::default();
        let took = heard_again(&pair, &mut operator, &mut heard, false).await;
        assert!(took.is_some_and(|t| t < 10.0 + 2.0), "{took:?}");
    })
    .unwrap();
}

#[test]
fn an_operator_that_moves_to_another_address_keeps_its_session_and_its_engagement() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let mut operator = operator(&mut pair, &delayed(0.05), 60);
        assert!(
            pair.wait_for(20.0, |r| r.state == RobotState::Engaged)
                .await
        );
        pair.run_for(2.0).await;
        let moved = pair.now();
        let to = std::net::SocketAddr::from(([198, 51, 100, 9], 55_555));
        for (from, to) in [(to, pair.robot_addr()), (pair.robot_addr(), to)] {
            pair.network.link(from, to, delayed(0.08), 61);
        }
        operator.rebind(&pair.network, to).unwrap();
        pair.run_for(5.0).await;
        let mut heard = Heard::default();
        hear(&mut operator, &mut heard);
        assert_eq!((heard.sessions, heard.engaged), (1, 1));
        let reports = pair.robot.reports();
        let held = |r: &&Report| r.at >= moved && r.state == RobotState::Holding;
        assert_eq!(reports.iter().filter(held).count(), 0, "not even a hold");
    })
    .unwrap();
}

#[test]
fn an_operator_that_was_killed_and_started_again_does_not_wait_for_its_own_ghost() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let first = operator(&mut pair, &delayed(0.02), 70);
        assert!(pair.wait_for(20.0, |r| r.state == RobotState::Engaged).await);
        pair.run_for(1.0).await;
        first.kill(&pair.network);
        let mut second = operator(&mut pair, &delayed(0.02), 71);
        let mut heard = Heard::default();
        let took = heard_again(&pair, &mut second, &mut heard, true).await.unwrap();
        println!("back {took:.3} s after the kill");
        // The robot must not take a session over that still speaks: half a second of silence first.
        assert!(took <= 0.5 + 2.0 * 0.04 + REDIAL_S + 0.05 + SLACK_S, "{took} s");
        let replaced = |n: &RobotNotice| matches!(n, RobotNotice::Disconnected { why, .. } if why.contains("come back"));
        assert!(pair.robot.notices().iter().any(replaced));
    })
    .unwrap();
}

#[test]
fn two_operators_with_one_key_do_not_push_each_other_out() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let mut first = operator(&mut pair, &delayed(0.02), 80);
        assert!(
            pair.wait_for(20.0, |r| r.state == RobotState::Engaged)
                .await
        );
        let mut second = operator(&mut pair, &delayed(0.02), 81);
        pair.run_for(4.0).await;
        let (mut one, mut two) = (Heard::default(), Heard::default());
        hear(&mut first, &mut one);
        hear(&mut second, &mut two);
        assert_eq!((one.sessions, two.sessions), (1, 0));
    })
    .unwrap();
}

#[test]
fn a_robot_that_was_killed_and_started_again_is_found_at_once() {
    run_virtual(async {
        let rig = rig();
        for seed in 90..94 {
            let mut pair = Pair::start(&rig).unwrap();
            let mut operator = operator(&mut pair, &delayed(0.05), seed);
            assert!(
                pair.wait_for(20.0, |r| r.state == RobotState::Engaged)
                    .await
            );
            pair.run_for(1.0).await;
            let mut heard = Heard::default();
            hear(&mut operator, &mut heard);
            pair.restart_robot(&rig).unwrap();
            let back = pair.now();
            let took = heard_again(&pair, &mut operator, &mut heard, true)
                .await
                .unwrap();
            println!("seed {seed}: {took:.3} s");
            // Packets of the old session meet a robot that resets it (RFC 9000 §10.3): one round trip, and as above.
            assert!(
                took <= 3.0 * 0.1 + REDIAL_S + 0.05 + SLACK_S,
                "seed {seed}: {took} s"
            );
            pair.run_for(2.0).await;
            hear(&mut operator, &mut heard);
            assert_eq!((heard.sessions, heard.engaged), (2, 1), "seed {seed}");
            assert!(!followed(&pair.robot.reports(), back), "seed {seed}");
        }
    })
    .unwrap();
}

/// How the robot saw the session clock when its last session ended: the error and its bound, s, and where from.
fn clock_error(pair: &Pair) -> (f64, f64, Origin) {
    let notices = pair.robot.notices();
    let ended = notices.iter().rev().find_map(|n| match n {
        RobotNotice::Disconnected {
            clock: Some((offset_s, bound_s)),
            origin,
            ..
        } => Some((*offset_s, *bound_s, *origin)),
        _ => None,
    });
    let (offset_s, bound_s, origin) = ended.unwrap();
    // The common clock shows minus this when the session clock shows 0.
    let truth_s = -(pair.to_mono(Stamp(0)).0 as f64) * 1e-9;
    (offset_s - truth_s, bound_s, origin)
}

/// An operator whose packets take 140 ms, and the robot's 60 ms.
fn lopsided(pair: &mut Pair, seed: u64) -> Operator {
    let operator = operator(pair, &delayed(0.1), seed);
    let (ours, robot) = (operator.addr, pair.robot_addr());
    pair.network.link(ours, robot, delayed(0.14), seed);
    pair.network.link(robot, ours, delayed(0.06), seed + 1);
    operator
}

#[test]
fn disciplined_clocks_take_the_asymmetry_out_and_one_that_is_set_stops_the_arm() {
    const DISPERSION: Duration = Duration::from_micros(50);
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = lopsided(&mut pair, 100);
        pair.run_for(3.0).await;
        operator.quit();
        operator.done.await.unwrap().0.unwrap();
        pair.run_for(0.5).await;
        let (error_s, bound_s, origin) = clock_error(&pair);
        assert_eq!(origin, Origin::RoundTrips);
        assert!(
            (error_s.abs() - 0.04).abs() < 2e-3,
            "half the asymmetry: {error_s}"
        );
        assert!(bound_s > error_s.abs() && bound_s < 0.105, "{bound_s}");

        let ahead = || Arc::new(AtomicI64::new(1_792_000_000_000_000_000));
        let (robots, operators) = (ahead(), ahead());
        let ours = External::stated(robots, DISPERSION);
        let theirs = External::stated(operators.clone(), DISPERSION);
        let mut pair = Pair::start_disciplined(&rig(), ours, theirs).unwrap();
        let operator = lopsided(&mut pair, 102);
        assert!(
            pair.wait_for(20.0, |r| r.state == RobotState::Engaged)
                .await
        );
        pair.run_for(1.0).await;
        // Somebody sets the operator's clock by 5 ms: no round trip could tell.
        operators.fetch_add(5_000_000, Ordering::Relaxed);
        assert!(pair.wait_for(0.5, |r| r.state == RobotState::Holding).await);
        let cause = pair.robot.reports().last().map(|r| r.cause);
        assert_eq!(cause, Some(Cause::ClockStep));
        operators.fetch_sub(5_000_000, Ordering::Relaxed);
        pair.run_for(1.0).await;
        operator.quit();
        operator.done.await.unwrap().0.unwrap();
        pair.run_for(0.5).await;
        let (error_s, bound_s, origin) = clock_error(&pair);
        assert_eq!(origin, Origin::Disciplined);
        assert!(
            error_s.abs() < 1e-3 && bound_s < 1e-3,
            "{error_s} ± {bound_s}"
        );
    })
    .unwrap();
}
