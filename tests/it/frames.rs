//! Motions relative to frames: a moved goal is reached, a held-out performance foretold from its own ends.

use nalgebra::{SVector, UnitQuaternion, Vector3};
use telemime_operator::demonstration::{Demonstration, Demonstrations, Sample};
use telemime_operator::learn::frames::{GOAL, START, placement};
use telemime_operator::learn::{LearnOptions, align, frames, learn_skill, motion};
use telemime_operator::placed::{Motion, Placed};
use telemime_protocol::skill::{Gmm, Gmr, Placement, TaskModel};
use telemime_sim::hand::reach;

use crate::data::needs;

/// A motion learned both ways.
struct Learned {
    plain: Gmm<4>,
    task: TaskModel,
    duration_s: f64,
}

fn learn(demonstrations: &[Demonstration]) -> Learned {
    let options = LearnOptions {
        frames: vec![START.to_owned(), GOAL.to_owned()],
        ..LearnOptions::default()
    };
    let aligned = align::align(demonstrations).unwrap();
    Learned {
        plain: motion::fit(&aligned, &options, &mut |_| ()).unwrap(),
        task: frames::fit(&aligned, demonstrations, &options, &mut |_| ()).unwrap(),
        duration_s: aligned.duration_s,
    }
}

impl Learned {
    fn plain(&self) -> impl Fn(f64) -> Vector3<f64> + '_ {
        let gmr = Gmr::<1, 3>::new(&self.plain).unwrap();
        move |t_s| gmr.query(&SVector::from([t_s])).mean
    }

    fn placed<'a>(&'a self, at: &'a [Placement]) -> impl Fn(f64) -> Vector3<f64> + 'a {
        move |t_s| self.task.at(t_s, at).unwrap().mean
    }
}

/// Root mean square distance of a performance from a motion of `duration_s`, each point at its own share of the
/// time as dynamic time warping finds it.
fn rms_m(d: &Demonstration, duration_s: f64, motion: impl Fn(f64) -> Vector3<f64>) -> f64 {
    let n = 120;
    let path: Vec<_> = (0..n)
        .map(|i| motion(duration_s * f64::from(i) / f64::from(n - 1)))
        .collect();
    let warp_s = align::warp_to(&path, d);
    let start_s = d.samples()[0].t_s;
    let square =
        |(x, t_s): (&Vector3<f64>, &f64)| (x - d.position_at(start_s + t_s)).norm_squared();
    (path.iter().zip(&warp_s).map(square).sum::<f64>() / f64::from(n)).sqrt()
}

fn performance(index: u32, goal: Vector3<f64>) -> Demonstration {
    let samples: Vec<_> = reach(3, index, goal.into())
        .into_iter()
        .map(|(t_s, x)| Sample::at(t_s, Vector3::from(x)))
        .collect();
    Demonstration::from_samples(format!("reach {index}"), &samples).unwrap()
}

/// Goals on a table, at the corners and the middle of a square of ±10 cm.
fn corner(i: u32) -> Vector3<f64> {
    let side = |bit: u32| if bit == 0 { -0.1 } else { 0.1 };
    let away = if i == 4 {
        Vector3::zeros()
    } else {
        Vector3::new(side(i & 1), 0.02 * side(i & 2), side(i & 2))
    };
    Vector3::new(0.25, -0.15, 2.05) + away
}

#[test]
fn a_moved_goal_is_reached_from_its_own_start() {
    for count in [1, 3, 5] {
        let demonstrations: Vec<_> = (0..count)
            .map(|i| performance(i, corner((i + 4) % 5)))
            .collect();
        let learned = learn(&demonstrations);
        // Inside the demonstrated square, and 30 % beyond its corners.
        for (place, goal) in [
            ("inside", corner(4) + Vector3::new(0.05, 0.0, -0.04)),
            ("beyond", corner(4) + (corner(1) - corner(4)) * 1.3),
            ("beyond", corner(4) + (corner(2) - corner(4)) * 1.3),
        ] {
            let truth = performance(50, goal);
            let at = [START, GOAL].map(|name| placement(&truth, name).unwrap());
            let (plain, placed) = (learned.plain(), learned.placed(&at));
            let end = |motion: &dyn Fn(f64) -> Vector3<f64>| {
                (motion(learned.duration_s) - at[1].origin).norm()
            };
            let (missed, reached) = (end(&plain), end(&placed));
            let begun = (placed(0.0) - at[0].origin).norm();
            let (without, with) = (
                rms_m(&truth, learned.duration_s, &plain),
                rms_m(&truth, learned.duration_s, &placed),
            );
            println!(
                "{count} demonstrations, {place}: end off by {:.1} mm (plain {:.1}), start by {:.1}; whole motion {:.1} mm RMS (plain {:.1})",
                reached * 1e3,
                missed * 1e3,
                begun * 1e3,
                with * 1e3,
                without * 1e3
            );
            // The ends are samples of a sensor with 4 mm of noise.
            let bar_m = if count == 1 { 0.012 } else { 0.006 };
            assert!(reached < bar_m && begun < bar_m, "{reached} {begun}");
            assert!(missed > 5.0 * reached);
            assert!(with < 0.015 && with < 0.2 * without, "{with} {without}");
            // Early on the motion is the one seen from the start, drawn back and up, wherever it leads.
            let early_s = 0.2 * learned.duration_s;
            let from_start = Gmr::<1, 3>::new(&learned.task.frames()[0].motion).unwrap();
            let shape = from_start.query(&SVector::from([early_s])).mean;
            let apart = (placed(early_s) - at[0].origin - shape).norm();
            println!(
                "  {:.1} mm off the start's own view after a fifth of the time, {:.0} mm away",
                apart * 1e3,
                shape.norm() * 1e3
            );
            // Little of how far the goal has moved.
            assert!(apart < 0.15 * missed, "{apart} m of {missed}");
        }
    }
}

/// What is asked for is a goal turned by a quarter: its last centimetres and the hand turn with it, the start does not.
#[test]
fn a_turned_goal_is_approached_from_the_turned_side() {
    let demonstrations: Vec<_> = (0..5)
        .map(|i| {
            let d = performance(i, corner(i));
            let end_s = d.last().t_s;
            let posed = |s: &Sample| Sample {
                orientation: Some(UnitQuaternion::from_euler_angles(
                    0.2,
                    1.1 * s.t_s / end_s,
                    0.0,
                )),
                ..*s
            };
            let samples: Vec<_> = d.samples().iter().map(posed).collect();
            Demonstration::from_samples(d.name(), &samples).unwrap()
        })
        .collect();
    let options = LearnOptions {
        frames: vec![START.to_owned(), GOAL.to_owned()],
        ..LearnOptions::default()
    };
    let skill = learn_skill("reach", &demonstrations, &options, |_| ()).unwrap();
    let usual = skill.task().unwrap().frames()[1].usual;
    let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let goal = |turn| Placed {
        name: GOAL.to_owned(),
        origin: usual.origin,
        turn,
    };
    let straight = Motion::new(&skill, &[goal(None)]).unwrap();
    let turned = Motion::new(&skill, &[goal(Some(quarter * usual.turn))]).unwrap();
    let end_s = skill.duration_s();
    let hand = turned.turn_at(end_s).unwrap();
    assert!(hand.angle_to(&(quarter * usual.turn)) < 0.05);
    let first = turned.turn_at(0.0).unwrap();
    assert!(first.angle_to(&straight.turn_at(0.0).unwrap()) < 0.05);
    // Down from above, 3 cm before the end, becomes sideways.
    let near_s = 0.8 * end_s;
    let way = |m: &Motion| m.at(near_s).mean - usual.origin;
    let (from, to) = (way(&straight), way(&turned));
    println!(
        "{:.0} mm before the goal: {:.1} mm off the turned way",
        from.norm() * 1e3,
        (quarter * from - to).norm() * 1e3
    );
    assert!(from.norm() > 0.02 && (quarter * from - to).norm() < 0.3 * from.norm());
    assert!((turned.at(end_s).mean - usual.origin).norm() < 0.006);
    assert!((turned.at(0.0).mean - straight.at(0.0).mean).norm() < 0.006);
}

/// Bars: what was measured, and a tenth.
#[test]
fn a_held_out_task_is_foretold_from_its_ends() {
    for (set, bar_m) in [("pouring", 0.0205), ("openbox", 0.0115)] {
        let Some(folder) = needs(&format!("data/demos/robottasks/{set}")) else {
            return;
        };
        let all = Demonstrations::read_dir(folder, None)
            .unwrap()
            .demonstrations;
        // Without frames; start and goal placed; turned as the hand was there, too.
        let mut squares = [0.0; 3];
        for held in 0..all.len() {
            let mut others = all.clone();
            let truth = others.remove(held);
            let learned = learn(&others);
            let turned = [START, GOAL].map(|name| placement(&truth, name).unwrap());
            let mut placed = turned;
            for (at, frame) in placed.iter_mut().zip(learned.task.frames()) {
                at.turn = frame.usual.turn;
            }
            for (sum, error_m) in squares.iter_mut().zip([
                rms_m(&truth, learned.duration_s, learned.plain()),
                rms_m(&truth, learned.duration_s, learned.placed(&placed)),
                rms_m(&truth, learned.duration_s, learned.placed(&turned)),
            ]) {
                *sum += error_m * error_m;
            }
        }
        let [without, with, turned] = squares.map(|sum| (sum / all.len() as f64).sqrt());
        println!(
            "{set}: {:.1} mm RMS without frames, {:.1} with start and goal, {:.1} turned too",
            without * 1e3,
            with * 1e3,
            turned * 1e3
        );
        assert!(
            with < bar_m && with < 0.75 * without,
            "{set}: {with} {without}"
        );
    }
}
