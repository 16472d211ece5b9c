//! Learning a skill, and what a message and a tick cost with what is learned: `cargo bench -p telemime-operator --bench learning`.
//!
//! The mixtures are those that learning makes of three demonstrations, and of three with other people's beside them
//! (`telemime learn --others`); the program says first how large they are.

use divan::{Bencher, black_box};
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::learn::{LearnOptions, learn_skill};
use telemime_protocol::predict::{HandState, Params};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;

/// People, of whom the first is the own, and performances of each.
const PEOPLE: u64 = 8;
const PERFORMANCES: u64 = 3;

const PARAMS: Params = Params::only([0.7, 0.1, 0.1]);

fn main() {
    for others in [false, true] {
        let skill = learn(others);
        println!(
            "{} demonstrations by others: {} components, {} bytes",
            options(others).others.len(),
            skill.predictor().components().len(),
            skill.to_bytes().len()
        );
    }
    divan::main();
}

/// Waving to and fro for 4 s at 30 Hz from rest, at a pace, a width and a place of its own; 3 mm of noise.
fn performance(person: u64, index: u64) -> Demonstration {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(100 * person + index);
    let mut about = |mean: f64, by: f64| mean + by * (rng.random::<f64>() - 0.5);
    let (pace, width, lift) = (about(1.0, 0.3), about(0.4, 0.1), about(0.15, 0.05));
    let samples: Vec<_> = (0..120)
        .map(|i| {
            let t_s = f64::from(i) / 30.0;
            let eased = 1.0 - (-2.0 * t_s * t_s).exp();
            let phase = 5.0 * pace * t_s + 0.3 * (1.3 * t_s).sin();
            let x = Vector3::new(
                width * eased * phase.sin(),
                lift * eased * (2.0 * phase).cos(),
                0.1 * eased * (0.5 * phase).sin(),
            );
            Sample::at(t_s, x.map(|v| about(v, 0.006)))
        })
        .collect();
    Demonstration::from_samples(format!("p{person}_{index}"), &samples).expect("samples in order")
}

fn by(person: u64) -> Vec<Demonstration> {
    (0..PERFORMANCES).map(|i| performance(person, i)).collect()
}

fn options(others: bool) -> LearnOptions {
    LearnOptions {
        others: if others {
            (1..PEOPLE).flat_map(by).collect()
        } else {
            Vec::new()
        },
        ..LearnOptions::default()
    }
}

fn learn(others: bool) -> Skill {
    learn_skill("wave", &by(0), &options(others), |_| ()).expect("a skill")
}

/// Everything that `telemime learn` does but for reading and writing: alignment, both mixtures, calibration.
#[divan::bench(args = [false, true], sample_count = 3, sample_size = 1)]
fn learning(bencher: Bencher<'_, '_>, others: bool) {
    let (own, options) = (by(0), options(others));
    bencher.bench_local(|| learn_skill("wave", black_box(&own), &options, |_| ()));
}

/// Two seconds into a performance that was not learned from.
fn hand() -> HandState {
    let driven = performance(0, PERFORMANCES);
    let mut state = HandState::first(Stamp(0), driven.samples()[0].position);
    for s in &driven.samples()[1..60] {
        state.advance(Stamp::from_secs_f64(s.t_s), s.position);
    }
    state
}

/// The forecast that either end makes of a message.
#[divan::bench(args = [false, true])]
fn message(bencher: Bencher<'_, '_>, others: bool) {
    let (skill, hand) = (learn(others), hand());
    bencher.bench_local(|| skill.predictor().forecast(black_box(&hand), &PARAMS));
}

/// One moment of it, which is what a tick asks for.
#[divan::bench(args = [false, true])]
fn tick(bencher: Bencher<'_, '_>, others: bool) {
    let forecast = learn(others).predictor().forecast(&hand(), &PARAMS);
    bencher.bench_local(|| forecast.at(black_box(0.137)));
}
