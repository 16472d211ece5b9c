//! Play with corrections: a hand bends the motion, takes it over, lets it go, over a shaped link.

use std::sync::{Arc, OnceLock};

use nalgebra::{Matrix3, Vector3};
use telemime::ground::{Pair, run_virtual};
use telemime_endpoint::Mono;
use telemime_operator::cli::{Bounds, infer};
use telemime_operator::daemon::Notice;
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::learn::{LearnOptions, learn_skill};
use telemime_operator::placed::Motion;
use telemime_operator::session::{Bent, Change, Event, Leeway, SessionConfig};
use telemime_operator::task::{Outcome, Task};
use telemime_protocol::checkpoint::{PoseCurve, PosePlan};
use telemime_protocol::skill::Skill;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::servo::Report;
use telemime_sim::hand::{carry, push};

use crate::safety::{assert_rested, assert_within_limits};
use crate::scene::{finish, rig, shaped};

const PERSON: u64 = 3;
const GOAL: [f64; 3] = [0.35, -0.1, 2.0];

/// A hand that carries something to the same place from wherever it was: sure of the end, not of the beginning.
fn carried() -> Arc<Skill> {
    static SKILL: OnceLock<Arc<Skill>> = OnceLock::new();
    let learn = || {
        let demonstrations: Vec<_> = (0..5)
            .map(|index| {
                let samples: Vec<_> = carry(PERSON, index, GOAL, 5.0)
                    .iter()
                    .map(|(t_s, x)| Sample::at(*t_s, Vector3::from(*x)))
                    .collect();
                Demonstration::from_samples(format!("carry {index}"), &samples).unwrap()
            })
            .collect();
        let options = LearnOptions {
            motion_components: 4..=8,
            ..LearnOptions::default()
        };
        Arc::new(learn_skill("carry", &demonstrations, &options, |_| {}).unwrap())
    };
    SKILL.get_or_init(learn).clone()
}

struct Scene {
    plan: PosePlan,
    curve: PoseCurve,
    leeway: Leeway,
}

fn scene() -> Scene {
    let skill = carried();
    let (plan, _) = infer(&skill, Bounds::of(&skill), &[]).unwrap();
    let motion = Motion::new(&skill, &[]).unwrap();
    Scene {
        curve: plan.curve().unwrap(),
        leeway: Leeway::of(&motion, skill.duration_s()),
        plan,
    }
}

impl Scene {
    fn corrected(&self, pushes: &[Vec<(f64, [f64; 3])>]) -> Task {
        let sample = |(t_s, x): &(f64, [f64; 3])| Sample::at(*t_s, Vector3::from(*x));
        let samples = pushes.iter().flatten().map(sample).collect();
        Task::play_corrected(self.plan.clone(), self.leeway.clone(), samples)
    }

    /// How far the tip is beside the plan, hand metres.
    fn beside(&self, report: &Report) -> Vector3<f64> {
        let plan_s = report.plan_s.unwrap_or(f64::MAX);
        report.mapping.unplace(report.tip_m) - self.curve.position_at(plan_s)
    }

    /// The mean of that over the moments since the engage, s.
    fn mean_beside(&self, reports: &[Report], from_s: f64, to_s: f64) -> Vector3<f64> {
        let within: Vec<_> = playing(reports)
            .filter(|(t_s, _)| (from_s..to_s).contains(t_s))
            .map(|(_, r)| self.beside(r))
            .collect();
        within.iter().sum::<Vector3<f64>>() / within.len() as f64
    }

    /// The hand's share W as the covariances have it.
    fn share(&self, plan_s: f64) -> Matrix3<f64> {
        let leeway = self.leeway.at(plan_s);
        let hand = SessionConfig::default().hand_sigma_m;
        let both = leeway + Matrix3::identity() * (hand * hand);
        leeway * both.try_inverse().unwrap()
    }
}

/// Ticks of the engagement, with the time since it began, s.
fn playing(reports: &[Report]) -> impl Iterator<Item = (f64, &Report)> {
    reports
        .iter()
        .filter(|r| r.plan_s.is_some())
        .map(|r| (r.at.secs_since(r.engaged_at), r))
}

/// What the hand did, with when the robot heard of it, and all the robot was told.
fn heard(pair: &Pair, notices: &[Notice]) -> (Vec<(Mono, Change)>, Vec<Bent>) {
    let (mut changes, mut bents) = (Vec::new(), Vec::new());
    for notice in notices {
        match notice {
            Notice::Event(at, Event::Correction(change)) => {
                changes.push((pair.to_mono(*at).offset_by_secs(0.1), *change));
            }
            Notice::Event(_, Event::Bent(bent)) => bents.push(*bent),
            _ => {}
        }
    }
    (changes, bents)
}

fn named(changes: &[(Mono, Change)]) -> Vec<Change> {
    changes.iter().map(|(_, change)| *change).collect()
}

/// The target never leaps, hand metres a tick, and what changes moves it no more than any other message may.
fn assert_no_leap(reports: &[Report], changes: &[(Mono, Change)]) {
    let leap = |w: &[Report]| (w[1].target_m - w[0].target_m).norm() / w[1].mapping.scale;
    let playing: Vec<_> = reports
        .iter()
        .filter(|r| r.plan_s.is_some())
        .copied()
        .collect();
    let worst = playing.windows(2).map(leap).fold(0.0, f64::max);
    for (at, change) in changes {
        let near = |w: &&[Report]| w[1].at.secs_since(*at).abs() < 0.03;
        let there = playing
            .windows(2)
            .filter(near)
            .map(leap)
            .fold(0.0, f64::max);
        println!("{change:?}: {:.1} mm in a tick", there * 1e3);
        // A message that comes 10 ms early or late is 10 mm of what is let go 0.3 m aside; an ordinary one may move the
        // target by more.
        assert!(there < 0.04, "{there} m at {change:?}");
    }
    println!("worst {:.1} mm in a tick", worst * 1e3);
    assert!(worst < 0.05, "{worst} m in a tick");
}

#[test]
fn a_push_bends_as_far_as_the_skill_leaves_open_and_letting_go_returns() {
    let scene = scene();
    let end_s = scene.curve.end_s();
    let way = [0.0, 0.08, 0.0];
    let starts_s = [0.08 * end_s, 0.6 * end_s];
    let pushes = starts_s.map(|at_s| push(1, at_s, way, 0.4, 0.8));
    run_virtual(async {
        let rig = rig();
        let mut pair = Pair::start(&rig).unwrap();
        let operator = pair
            .operator(
                scene.corrected(&pushes),
                Some(carried()),
                SessionConfig::default(),
                &shaped(),
                61,
            )
            .unwrap();
        let (summary, _, notices) = finish(operator).await;
        assert_eq!(summary.unwrap().outcome, Outcome::Completed);
        let (changes, bents) = heard(&pair, &notices);
        let one = [Change::Grabbed, Change::Released];
        assert_eq!(named(&changes), [one, one].concat());
        let reports = pair.robot.reports();
        let mut shares = Vec::new();
        for at_s in starts_s {
            let (from_s, to_s) = (at_s + 0.75, at_s + 1.15);
            let there = scene.mean_beside(&reports, from_s, to_s);
            let asked = scene.share(0.5 * (from_s + to_s)) * Vector3::from(way);
            println!("{at_s:.2} s: beside {there:.3?}, asked {asked:.3?}");
            assert!((there - asked).norm() < 0.012, "{there} for {asked}");
            shares.push(asked.norm() / 0.08);
            // Let go: a third after 0.3 s, nothing after a second and a half.
            let let_go_s = at_s + 1.2 + 0.12;
            let third = scene.mean_beside(&reports, let_go_s + 0.28, let_go_s + 0.4);
            assert!(third.norm() < 0.5 * asked.norm() + 0.004, "{third}");
            let after = scene.mean_beside(&reports, let_go_s + 1.4, let_go_s + 1.6);
            assert!(after.norm() < 4e-3, "{after}");
        }
        assert!(shares[0] > shares[1] + 0.3, "{shares:?}");
        assert_no_leap(&reports, &changes);
        assert_within_limits(&pair, &rig);
        // The beginning's push has the hand's own time; nothing else has moved the plan's.
        let last = bents.last().unwrap();
        assert!(last.rate > 0.98 && last.offset_m.norm() < 2e-3);
    })
    .unwrap();
}

#[test]
fn opposition_slows_the_plan_then_takes_it_over_and_letting_go_resumes_it() {
    let scene = scene();
    let end_s = scene.curve.end_s();
    let middle_s = 0.45 * end_s;
    let velocity = scene.curve.position.eval(middle_s).unwrap().v;
    let way = -velocity.normalize() * 0.3;
    // At first it only drags, then it insists.
    let drag = push(1, middle_s, (way * 0.27).into(), 0.4, 0.6);
    let at_s = drag.last().unwrap().0 + 1.0 / 30.0;
    let origin = Vector3::from(drag.last().unwrap().1);
    let insist: Vec<_> = push(2, at_s, (way * 0.73).into(), 0.4, 1.0);
    let from = Vector3::from(insist[0].1);
    let insist = insist
        .into_iter()
        .map(|(t_s, x)| (t_s, (Vector3::from(x) - from + origin).into()));
    let hand: Vec<_> = drag.iter().copied().chain(insist).collect();
    let let_go_s = hand.last().unwrap().0;
    run_virtual(async {
        let rig = rig();
        let mut pair = Pair::start(&rig).unwrap();
        let operator = pair
            .operator(
                scene.corrected(&[hand]),
                Some(carried()),
                SessionConfig::default(),
                &shaped(),
                62,
            )
            .unwrap();
        let (summary, _, notices) = finish(operator).await;
        assert_eq!(summary.unwrap().outcome, Outcome::Completed);
        let (changes, bents) = heard(&pair, &notices);
        assert_eq!(
            named(&changes),
            [Change::Grabbed, Change::TakenOver, Change::Released]
        );
        let reports = pair.robot.reports();
        let plan_s = |since_s: f64| {
            let (_, r) = playing(&reports).find(|(t_s, _)| *t_s >= since_s).unwrap();
            r.plan_s.unwrap()
        };
        let pace = |from_s: f64, to_s: f64| (plan_s(to_s) - plan_s(from_s)) / (to_s - from_s);
        let (before, dragged) = (pace(0.5, middle_s), pace(middle_s + 0.7, at_s));
        let (taken, after) = (
            pace(let_go_s - 0.3, let_go_s),
            pace(let_go_s + 1.2, let_go_s + 1.6),
        );
        println!("pace {before:.2}, dragged {dragged:.2}, taken over {taken:.2}, after {after:.2}");
        assert!((before - 1.0).abs() < 0.01 && (after - 1.0).abs() < 0.05);
        assert!(dragged < 0.7 && taken < 0.1);
        // It drives alone: all of its way counts, from where the plan waits.
        let there = scene.mean_beside(&reports, let_go_s - 0.2, let_go_s);
        assert!((there - way).norm() < 0.03, "{there} for {way}");
        let later = scene.mean_beside(&reports, let_go_s + 1.8, let_go_s + 2.0);
        assert!(later.norm() < 0.01, "{later}");
        // The plan is played to its end, later by as long as it was held up.
        let (took_s, _) = playing(&reports).last().unwrap();
        assert!(took_s > end_s + 1.0, "{took_s} s of {end_s} s");
        assert!(bents.iter().all(|b| (0.0..=1.5).contains(&b.rate)));
        assert_no_leap(&reports, &changes);
        assert_within_limits(&pair, &rig);
    })
    .unwrap();
}

#[test]
fn a_link_cut_while_a_hand_holds_on_stops_the_arm_by_its_lease() {
    let scene = scene();
    let at_s = 0.3 * scene.curve.end_s();
    let hand = push(1, at_s, [0.0, 0.1, 0.0], 0.6, 3.0);
    run_virtual(async {
        let rig = rig();
        let mut pair = Pair::start(&rig).unwrap();
        let operator = pair
            .operator(
                scene.corrected(&[hand]),
                Some(carried()),
                SessionConfig::default(),
                &shaped(),
                63,
            )
            .unwrap();
        let pushing =
            |r: &Report| r.plan_s.is_some_and(|s| s > at_s) && scene.beside(r).norm() > 0.04;
        assert!(pair.wait_for(8.0, pushing).await, "it was never pushed");
        pair.network.set_down(true);
        let cut = pair.now();
        assert!(pair.wait_for(0.8, |r| r.state == RobotState::Holding).await);
        assert!(pair.now().secs_since(cut) <= 0.65 + 0.115);
        pair.run_for(0.6).await;
        pair.network.set_down(false);
        let (summary, _, _) = finish(operator).await;
        assert!(matches!(summary.unwrap().outcome, Outcome::Interrupted(_)));
        pair.run_for(1.0).await;
        assert_eq!(
            pair.robot.reports().last().unwrap().cause,
            Cause::LeaseExpired
        );
        assert_rested(&pair, 1.0);
        assert_within_limits(&pair, &rig);
        // What was not heard of was not made up: the push went no farther than the hand had pushed.
        let reports = pair.robot.reports();
        let farthest = playing(&reports)
            .map(|(_, r)| scene.beside(r).norm())
            .fold(0.0, f64::max);
        println!("{:.0} mm aside at most", farthest * 1e3);
        assert!(farthest < 0.15, "{farthest} m");
    })
    .unwrap();
}
