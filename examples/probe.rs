//! scratch
use nalgebra::Vector3;
use std::sync::Arc;
use telemime::ground::{Pair, run_virtual};
use telemime::measure::{Track, follow, rmse_m};
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::learn::{LearnOptions, learn_skill, predictor::states};
use telemime_operator::session::{FutureBound, SessionConfig};
use telemime_operator::task::{Recording, Task};
use telemime_protocol::predict::{Forecast, Params};
use telemime_robot::rig::{Rig, RigOptions};
use telemime_sim::link::LinkConfig;

fn main() {
    let mode = std::env::args().nth(1).unwrap();
    let eps: Option<f64> = std::env::args().nth(2).map(|s| s.parse().unwrap());
    let rig = Rig::load(&RigOptions::default()).unwrap();
    let mut sums = [0.0; 8];
    let cases: Vec<(String, Vec<Demonstration>, Demonstration)> = if mode == "swing" {
        (0..6u64)
            .map(|seed| {
                let d = |i| {
                    Demonstration::from_samples(
                        format!("p{i}"),
                        &telemime_sim::hand::swing(seed, i)
                            .iter()
                            .map(|(t, x)| Sample {
                                t_s: *t,
                                position: Vector3::from(*x),
                            })
                            .collect::<Vec<_>>(),
                    )
                    .unwrap()
                };
                (format!("seed{seed}"), (0..5).map(d).collect(), d(5))
            })
            .collect()
    } else {
        let dir = std::path::PathBuf::from("/work/shared/data/demos").join(&mode);
        let mut files: Vec<_> = std::fs::read_dir(&dir)
            .unwrap()
            .map(|e| e.unwrap().path())
            .collect();
        files.sort();
        let mut groups: std::collections::BTreeMap<String, Vec<_>> = Default::default();
        for f in files {
            let n = f.file_stem().unwrap().to_str().unwrap().to_owned();
            let p = n
                .rsplit_once('_')
                .map_or("all".to_owned(), |x| x.0.to_owned());
            groups.entry(p).or_default().push(f);
        }
        groups
            .into_iter()
            .map(|(p, fs)| {
                let mut d: Vec<_> = fs
                    .iter()
                    .map(|f| Demonstration::read_csv(f).unwrap())
                    .collect();
                let t = d.pop().unwrap();
                (p, d, t)
            })
            .collect()
    };
    for (name, demos, hand) in cases {
        let skill = learn_skill("s", &demos, &LearnOptions::default(), |_| {}).unwrap();
        let samples: Vec<_> = hand.samples().iter().map(|s| (s.t_s, s.position)).collect();
        let link = LinkConfig {
            delay_s: 0.1,
            jitter_s: 0.01,
            loss: 0.01,
            ..LinkConfig::default()
        };
        let truth = Track::new(samples.clone()).unwrap();
        let end = truth.span_s().1;
        let grid: Vec<f64> = (0..(end * 1000.0) as i32)
            .map(|i| i as f64 * 1e-3)
            .collect();
        let lag = rig.lag_s();
        let model = skill.predictor().clone();
        let reach = skill.stats().reach_m;
        let sts: Vec<_> = states(&hand).collect();
        let skill = Arc::new(skill);
        let (tip, target, mapping, summary, from) = run_virtual(async {
            let mut pair = Pair::start(&rig).unwrap();
            let task = Task::replay(Recording {
                samples: samples.clone(),
                rest_s: 1.0,
            });
            let mut config = SessionConfig::default();
            if let Some(e) = eps {
                config.future_bound = FutureBound::Relative(e);
            }
            let mut operator = pair
                .operator(task, Some(skill.clone()), config, &link, 7)
                .unwrap();
            let (summary, task) = (&mut operator.done).await.unwrap();
            let zero = task.zero().unwrap().0 - 5_400_000_000_000;
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
            let from = tip[0].0;
            (
                Track::new(tip).unwrap(),
                Track::new(target).unwrap(),
                reports.last().unwrap().mapping,
                summary.unwrap(),
                from,
            )
        })
        .unwrap();
        let offline = |gmr: bool, every: f64| {
            follow(&rig, &mapping, from, end, |t| {
                let known = t - 0.1;
                let known = if every > 0.0 {
                    (known / every).floor() * every
                } else {
                    known
                };
                let i = sts.partition_point(|s| s.t.as_secs_f64() <= known);
                if i == 0 {
                    return None;
                }
                let s = &sts[i - 1];
                let f = if gmr {
                    model.forecast(s, &Params::default())
                } else {
                    Forecast::constant_velocity(
                        s,
                        &Params {
                            cv_damping: 0.7,
                            ..Params::default()
                        },
                    )
                };
                Some(f.at(t + lag - s.t.as_secs_f64()).position)
            })
        };
        let a = [
            rmse_m(&tip, &truth, &grid),
            rmse_m(
                &follow(&rig, &mapping, from, end, |t| Some(truth.at(t + lag))).tip,
                &truth,
                &grid,
            ),
            rmse_m(
                &follow(&rig, &mapping, from, end, |t| Some(truth.at(t - 0.1))).tip,
                &truth,
                &grid,
            ),
            {
                let d = Track::new(grid.iter().map(|&t| (t, truth.at(t - 0.1))).collect()).unwrap();
                rmse_m(&d, &truth, &grid)
            },
            rmse_m(&offline(true, 0.0).tip, &truth, &grid),
            rmse_m(&offline(false, 0.0).tip, &truth, &grid),
            summary.engaged.motion.bytes as f64 / (44.0 * summary.counters.samples as f64),
            summary.counters.messages as f64 / (end + 1.3),
        ];
        println!(
            "{name}: scale {:.3} reach {reach:.2} tip {:.4} floor {:.4} same-arm {:.4} ideal {:.4} | ratio ideal {:.2} same {:.2} hidden {:.2} | offline gmr {:.4} cv {:.4} | bytes ratio {:.2} msg/s {:.1} lag {:.0} target lag {:.0} {:?}",
            mapping.scale,
            a[0],
            a[1],
            a[2],
            a[3],
            a[0] / a[3],
            a[0] / a[2],
            (a[2] - a[0]) / (a[2] - a[1]),
            a[4],
            a[5],
            a[6],
            a[7],
            tip.lag_behind(&truth, &grid).0 * 1e3,
            target.lag_behind(&truth, &grid).0 * 1e3,
            summary.outcome
        );
        for i in 0..8 {
            sums[i] += if i < 6 { a[i] * a[i] } else { a[i] };
        }
    }
    let s: Vec<f64> = sums.iter().take(6).map(|v| v.sqrt()).collect();
    println!(
        "ALL ratio ideal {:.3} same {:.3} hidden {:.3} offline gmr/ideal {:.3} cv/ideal {:.3}",
        s[0] / s[3],
        s[0] / s[2],
        (s[2] - s[0]) / (s[2] - s[1]),
        s[4] / s[3],
        s[5] / s[3]
    );
}
