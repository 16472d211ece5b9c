//! Mirror over a shaped link, both daemons on the virtual clock.

use std::sync::Arc;

use telemime::ground::{Pair, run_virtual};
use telemime::measure::{Track, follow, rmse_m};
use telemime_operator::demonstration::Demonstration;
use telemime_operator::learn::{LearnOptions, learn_skill};
use telemime_operator::session::SessionConfig;
use telemime_operator::task::{Outcome, Recording, Task};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_sim::link::LinkConfig;

#[test]
fn the_tip_moves_with_the_hand() {
    let dir = std::path::PathBuf::from(std::env::var("TELEMIME_DATA").unwrap())
        .join("data/demos/utd_mhad/a03_wave");
    let read = |n: u32| Demonstration::read_csv(dir.join(format!("a3_s2_t{n}.csv"))).unwrap();
    let skill = learn_skill(
        "wave",
        &[read(1), read(2), read(3)],
        &LearnOptions::default(),
        |_| {},
    )
    .unwrap();
    let rig = Rig::load(&RigOptions::default()).unwrap();
    let hand = read(4);
    let samples: Vec<_> = hand.samples().iter().map(|s| (s.t_s, s.position)).collect();
    let link = LinkConfig {
        delay_s: 0.1,
        jitter_s: 0.01,
        loss: 0.01,
        ..LinkConfig::default()
    };
    let begun = std::time::Instant::now();
    run_virtual(async {
        let mut pair = Pair::start(&rig).unwrap();
        let task = Task::replay(Recording {
            samples: samples.clone(),
            rest_s: 1.0,
        });
        let mut operator = pair
            .operator(
                task,
                Some(Arc::new(skill)),
                SessionConfig::default(),
                &link,
                7,
            )
            .unwrap();
        let (summary, task) = (&mut operator.done).await.unwrap();
        while let Ok(n) = operator.notices.try_recv() {
            let s = format!("{n:?}");
            if !s.contains("Telemetry") {
                println!("{s}");
            }
        }
        println!("{summary:?}");
        let summary = summary.unwrap();
        assert_eq!(summary.outcome, Outcome::Completed);
        let zero = task.zero().unwrap().0 - 5_400_000_000_000;
        let truth = Track::new(samples.clone()).unwrap();
        let end = truth.span_s().1;
        let reports = pair.robot.reports();
        let time = |r: &telemime_robot::servo::Report| (r.at.0 - zero) as f64 * 1e-9;
        let tip: Vec<_> = reports
            .iter()
            .filter(|r| r.engagement != 0)
            .map(|r| (time(r), r.mapping.unplace(r.tip_m)))
            .collect();
        let target: Vec<_> = reports
            .iter()
            .filter(|r| r.engagement != 0)
            .map(|r| (time(r), r.mapping.unplace(r.target_m)))
            .collect();
        let mapping = reports.last().unwrap().mapping;
        let from = tip[0].0;
        println!("from {from} end {end}");
        let tip = Track::new(tip).unwrap();
        let target = Track::new(target).unwrap();
        let grid: Vec<f64> = (0..(end * 1000.0) as i32)
            .map(|i| i as f64 * 1e-3)
            .collect();
        let show = |name: &str, t: &Track| {
            println!(
                "{name}: rmse {:.4} lag {:?}",
                rmse_m(t, &truth, &grid),
                t.lag_behind(&truth, &grid)
            )
        };
        show("tip", &tip);
        show("target", &target);
        let lag = rig.lag_s();
        show(
            "floor",
            &follow(&rig, &mapping, from, end, |t| Some(truth.at(t + lag))).tip,
        );
        show(
            "delayed same arm",
            &follow(&rig, &mapping, from, end, |t| Some(truth.at(t - 0.1))).tip,
        );
        let delayed = Track::new(grid.iter().map(|&t| (t, truth.at(t - 0.1))).collect()).unwrap();
        show("delayed", &delayed);
    })
    .unwrap();
    println!("took {:?}", begun.elapsed());
}
