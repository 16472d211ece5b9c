//! What the tests on the virtual ground share: a person, the skill learned from five performances, an arm.

use std::sync::{Arc, OnceLock};

use nalgebra::Vector3;
use telemime::ground::{Operator, Pair};
use telemime_operator::daemon::{DaemonError, Notice, Summary};
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::learn::{LearnOptions, learn_skill};
use telemime_operator::task::{Recording, Task};
use telemime_protocol::skill::Skill;
use telemime_robot::rig::{Rig, RigOptions};
use telemime_robot::servo::Report;
use telemime_sim::hand::swing;
use telemime_sim::link::{LinkConfig, Loss};

const PERSON: u64 = 3;

/// The hand rests this long before a recording begins, s.
pub(crate) const REST_S: f64 = 1.0;

pub(crate) type Samples = Vec<(f64, Vector3<f64>)>;

/// 100 ± 10 ms one way, 1 % loss.
pub(crate) fn shaped() -> LinkConfig {
    LinkConfig {
        delay_s: 0.1,
        jitter_s: 0.01,
        loss: Loss::random(0.01),
        ..LinkConfig::default()
    }
}

/// A link that is merely slow, so that times can be told to the millisecond.
pub(crate) fn delayed(delay_s: f64) -> LinkConfig {
    LinkConfig {
        delay_s,
        ..LinkConfig::default()
    }
}

/// One performance, m over s from 0.
pub(crate) fn performance(index: u32) -> Samples {
    swing(PERSON, index)
        .into_iter()
        .map(|(t_s, x)| (t_s, Vector3::from(x)))
        .collect()
}

/// The performance nothing was learned from.
pub(crate) fn unseen() -> Samples {
    performance(5)
}

/// The skill of the first five performances; learned once.
pub(crate) fn skill() -> Arc<Skill> {
    static SKILL: OnceLock<Arc<Skill>> = OnceLock::new();
    let learn = || {
        let demonstrations: Vec<_> = (0..5)
            .map(|index| {
                let samples: Vec<_> = performance(index)
                    .into_iter()
                    .map(|(t_s, position)| Sample::at(t_s, position))
                    .collect();
                Demonstration::from_samples(format!("swing {index}"), &samples).unwrap()
            })
            .collect();
        let options = LearnOptions {
            motion_components: 4..=8,
            ..LearnOptions::default()
        };
        Arc::new(learn_skill("swing", &demonstrations, &options, |_| {}).unwrap())
    };
    SKILL.get_or_init(learn).clone()
}

pub(crate) fn rig() -> Rig {
    Rig::load(&RigOptions::default()).unwrap()
}

/// A replay of `samples` after a moment of rest.
pub(crate) fn replay(samples: Samples) -> Task {
    Task::replay(recording(samples))
}

pub(crate) fn recording(samples: Samples) -> Recording {
    Recording {
        samples: samples
            .into_iter()
            .map(|(t_s, x)| Sample::at(t_s, x))
            .collect(),
        rest_s: REST_S,
    }
}

/// An operator on `link` that replays the unseen performance.
pub(crate) fn mirroring(pair: &mut Pair, link: &LinkConfig, seed: u64) -> Operator {
    let config = Default::default();
    pair.operator(replay(unseen()), Some(skill()), config, link, seed)
        .unwrap()
}

/// How an operator ended, and all it noticed.
pub(crate) async fn finish(
    mut operator: Operator,
) -> (Result<Summary, DaemonError>, Task, Vec<Notice>) {
    let (result, task) = (&mut operator.done).await.unwrap();
    let mut notices = Vec::new();
    while let Ok(notice) = operator.notices.try_recv() {
        notices.push(notice);
    }
    (result, task, notices)
}

/// Speed of the tip between two ticks, m/s.
pub(crate) fn speed(a: &Report, b: &Report) -> f64 {
    (b.tip_m - a.tip_m).norm() / b.at.secs_since(a.at)
}
