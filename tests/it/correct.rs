//! Play with corrections: a hand bends the motion, takes it over, lets it go, over a shaped link.

use nalgebra::{Matrix3, Vector3};
use telemime::ground::{Pair, run_virtual};
use telemime_operator::cli::{Bounds, infer};
use telemime_operator::daemon::Notice;
use telemime_operator::demonstration::Sample;
use telemime_operator::placed::Motion;
use telemime_operator::session::{Bent, Change, Event, Leeway, SessionConfig};
use telemime_operator::task::Task;
use telemime_protocol::checkpoint::{PoseCurve, PosePlan};
use telemime_protocol::wire::v1::RobotState;
use telemime_robot::servo::Report;
use telemime_sim::hand::push;

use crate::scene::{finish, rig, shaped, skill};

struct Scene {
    plan: PosePlan,
    curve: PoseCurve,
    leeway: Leeway,
}

fn scene() -> Scene {
    let skill = skill();
    let (plan, _) = infer(&skill, Bounds::of(&skill), &[]).unwrap();
    let motion = Motion::new(&skill, &[]).unwrap();
    Scene {
        curve: plan.curve().unwrap(),
        leeway: Leeway::of(&motion, skill.duration_s()),
        plan,
    }
}

fn samples(pushes: &[Vec<(f64, [f64; 3])>]) -> Vec<Sample> {
    let sample = |(t_s, x): &(f64, [f64; 3])| Sample::at(*t_s, Vector3::from(*x));
    pushes.iter().flatten().map(sample).collect()
}

#[test]
fn explore() {
    let scene = scene();
    let end_s = scene.curve.end_s();
    println!("end {end_s}");
    for i in 0..=40 {
        let t = end_s * f64::from(i) / 40.0;
        let m: Matrix3<f64> = scene.leeway.at(t);
        let e = m.symmetric_eigenvalues().map(f64::sqrt);
        let v = scene.curve.position.eval(t.min(end_s)).unwrap();
        println!("{t:.2} dev {:.3} {:.3} {:.3} v {:.2?} x {:.2?}", e[0], e[1], e[2], v.v.as_slice(), v.x.as_slice());
    }
    let pushes = [
        push(1, 2.5, [0.0, 0.0, 0.08], 0.4, 0.8),
        push(1, 5.0, [0.0, 0.0, -0.4], 0.5, 0.8),
    ];
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let task = Task::play_corrected(scene.plan.clone(), scene.leeway.clone(), samples(&pushes));
        let operator = pair
            .operator(task, Some(skill()), SessionConfig::default(), &shaped(), 61)
            .unwrap();
        let (summary, _, notices) = finish(operator).await;
        println!("{:?}", summary);
        for n in &notices {
            match n {
                Notice::Event(t, Event::Correction(c)) => println!("{:?} {:?}", t, c),
                Notice::Event(_, Event::Bent(b)) => println!("at {:.3} plan {:.3} rate {:.2} share {:.2} hand {:.3?} offset {:.3?}", b.at.0 as f64*1e-9, b.plan_s, b.rate, b.share, b.hand_m.map(|h| h[2]), b.offset_m.as_slice()),
                Notice::Event(t, Event::Engaged{t_us,..}) => println!("{t:?} engaged {t_us}"),
                _ => {}
            }
        }
        let reports = pair.robot.reports();
        let mut last: Option<&Report> = None;
        for r in reports.iter().filter(|r| r.state == RobotState::Engaged).step_by(50) {
            let at = r.at.secs_since(r.engaged_at);
            let tip = r.mapping.unplace(r.tip_m);
            let ps = r.plan_s.unwrap();
            let off = tip - scene.curve.position_at(ps);
            println!("{at:.2} plan {ps:.3} off {:.3?}", off.as_slice());
            last = Some(r);
        }
        println!("{:?}", last.map(|r| (r.clamps, r.mapping.scale)));
        let _: Option<(Bent, Change)> = None;
    })
    .unwrap();
}
