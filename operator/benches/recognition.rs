//! One sample before a recogniser of eight skills: `cargo bench -p telemime-operator --bench recognition`.

use nalgebra::Vector3;
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::learn::predictor::states;
use telemime_operator::learn::{LearnOptions, learn_skill};
use telemime_operator::recognise::{RecogniseOptions, Recogniser};
use telemime_protocol::skill::Skill;

const SKILLS: usize = 8;

fn main() {
    divan::main();
}

/// A loop that no other skill draws, wider with every performance: enough samples for all components.
fn performance(skill: usize, n: usize) -> Demonstration {
    let size = 0.3 + 0.02 * n as f64;
    let samples: Vec<_> = (0..90)
        .map(|i| {
            let u = i as f64 / 89.0 * std::f64::consts::TAU;
            let (a, b) = (1.0 + (skill % 3) as f64, 1.0 + (skill / 3) as f64);
            let x = Vector3::new((a * u).sin(), 1.0 - (b * u).cos(), 0.3 * u.sin());
            Sample::at(i as f64 / 30.0, x * size)
        })
        .collect();
    Demonstration::from_samples(format!("{skill}_{n}"), &samples).expect("a valid recording")
}

fn skills() -> Vec<Skill> {
    let options = LearnOptions {
        motion_components: 8..=8,
        ..LearnOptions::default()
    };
    (0..SKILLS)
        .map(|skill| {
            let shown: Vec<_> = (0..3).map(|n| performance(skill, n)).collect();
            learn_skill(&format!("loop {skill}"), &shown, &options, |_| ()).expect("a skill")
        })
        .collect()
}

#[divan::bench]
fn a_sample_before_eight_skills(bencher: divan::Bencher) {
    let skills = skills();
    let options = RecogniseOptions::default();
    let mut recogniser = Recogniser::new(&skills, options).expect("recognisable skills");
    let performance = performance(3, 4);
    let states: Vec<_> = states(&performance).collect();
    let mut next = 0;
    bencher.bench_local(|| {
        if next == states.len() {
            recogniser.reset();
            next = 0;
        }
        next += 1;
        recogniser.take(&states[next - 1])
    });
}
