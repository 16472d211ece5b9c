//! Play: a learned motion, from its checkpoints to the tip, over a shaped link.

use nalgebra::{SVector, Vector3};
use telemime::ground::{Pair, run_virtual};
use telemime_operator::daemon::Notice;
use telemime_operator::session::{Event, GO_S, SessionConfig};
use telemime_operator::task::{Outcome, Task};
use telemime_protocol::checkpoint::{Plan, select};
use telemime_protocol::skill::{Gmr, Skill};
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::servo::{RAMP_S, Report};

use crate::scene::{delayed, rig, shaped, skill};

const BOUND_M: f64 = 0.01;

/// The skill's motion, inferred every 10 ms, and its checkpoints.
pub(crate) fn inferred(skill: &Skill) -> (Vec<f64>, Vec<Vector3<f64>>, Plan<3>) {
    let gmr = Gmr::<1, 3>::new(skill.motion()).unwrap();
    let steps = (skill.duration_s() * 100.0) as usize;
    let t: Vec<f64> = (0..=steps).map(|i| i as f64 * 0.01).collect();
    let x: Vec<_> = t
        .iter()
        .map(|&t| gmr.query(&SVector::from([t])).mean)
        .collect();
    let plan = select::bounded(&t, &x, BOUND_M).unwrap();
    (t, x, plan)
}

#[test]
fn a_skill_is_played_from_checkpoints_to_tip() {
    let skill = skill();
    let (t, x, plan) = inferred(&skill);
    let rebuilt = plan.spline().unwrap();
    assert!(plan.len() < t.len() / 4, "{} checkpoints", plan.len());
    for (t, x) in t.iter().zip(&x) {
        let t = t.min(rebuilt.span_s().1);
        let error_m = (rebuilt.eval(t).unwrap().x - x).norm();
        assert!(error_m <= BOUND_M * 1.01, "{error_m} m off at {t} s");
    }
    run_virtual(async {
        let rig = rig();
        let mut pair = Pair::start(&rig).unwrap();
        let config = SessionConfig::default();
        let mut operator = pair
            .operator(
                Task::play(plan.clone()),
                Some(skill.clone()),
                config,
                &shaped(),
                51,
            )
            .unwrap();
        let (summary, _) = (&mut operator.done).await.unwrap();
        let summary = summary.unwrap();
        assert_eq!(summary.outcome, Outcome::Completed);
        let goes = (rebuilt.span_s().1 / GO_S) as u32;
        assert!(
            (goes..=goes + 8).contains(&summary.counters.messages),
            "{} messages",
            summary.counters.messages
        );

        let reports = pair.robot.reports();
        let first = reports.iter().find(|r| r.engagement.number == 1).unwrap();
        assert!((first.mapping.hand_m - rebuilt.eval(0.0).unwrap().x).norm() < 1e-9);
        let (mut worst_m, mut ticks) = (0.0f64, 0);
        for r in reports.iter().filter(|r| r.state == RobotState::Engaged) {
            let t_s = r.at.secs_since(r.engaged_at);
            if t_s < RAMP_S + 0.1 || t_s > rebuilt.span_s().1 {
                continue;
            }
            let wanted = rebuilt.eval(t_s).unwrap().x;
            worst_m = worst_m.max((r.mapping.unplace(r.tip_m) - wanted).norm());
            ticks += 1;
        }
        println!(
            "worst {worst_m:.4} m of {:.2} m reach",
            skill.stats().reach_m
        );
        assert!(f64::from(ticks) > 800.0 * (rebuilt.span_s().1 - RAMP_S));
        assert!(worst_m < 0.03 * skill.stats().reach_m, "{worst_m} m");

        let ended = reports
            .iter()
            .find(|r| r.cause == Cause::PlanFinished)
            .unwrap();
        assert_eq!(ended.state, RobotState::Ready);
        let late_s = ended.at.secs_since(ended.engaged_at) - rebuilt.span_s().1;
        assert!((0.0..0.5).contains(&late_s), "{late_s} s after its end");
        let holds = |r: &&Report| r.state == RobotState::Holding;
        assert_eq!(reports.iter().filter(holds).count(), 0);
    })
    .unwrap();
}

#[test]
fn a_plan_whose_operator_falls_silent_is_not_played_on() {
    let skill = skill();
    let (.., plan) = inferred(&skill);
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let mut operator = pair
            .operator(
                Task::play(plan),
                Some(skill),
                Default::default(),
                &delayed(0.05),
                52,
            )
            .unwrap();
        assert!(pair.wait_for(3.0, |r| r.state == RobotState::Engaged).await);
        pair.run_for(1.0).await;
        pair.network.set_down(true);
        assert!(pair.wait_for(0.8, |r| r.state == RobotState::Holding).await);
        pair.run_for(2.0).await;
        pair.network.set_down(false);
        let (summary, _) = (&mut operator.done).await.unwrap();
        assert!(matches!(summary.unwrap().outcome, Outcome::Interrupted(_)));
        pair.run_for(1.0).await;
        let reports = pair.robot.reports();
        let last = reports.last().unwrap();
        assert_eq!(last.cause, Cause::LeaseExpired);
        let rested = |r: &Report| (r.tip_m - last.tip_m).norm() < 1e-4;
        let held = reports
            .iter()
            .position(|r| r.state == RobotState::Holding)
            .unwrap();
        let moved = reports[held..].iter().rposition(|r| !rested(r));
        assert!(
            moved.is_some_and(|ticks| ticks < 500),
            "at rest {moved:?} ms after the lease"
        );
        let mut engagements = 0;
        while let Ok(notice) = operator.notices.try_recv() {
            engagements += u32::from(matches!(notice, Notice::Event(_, Event::Engaged { .. })));
        }
        assert_eq!(engagements, 1);
    })
    .unwrap();
}
