//! scratch
use nalgebra::Vector3;
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::learn::{LearnOptions, Progress, learn_skill};
fn main() {
    let d = |i| {
        Demonstration::from_samples(
            format!("p{i}"),
            &telemime_sim::hand::swing(7, i)
                .iter()
                .map(|(t, x)| Sample {
                    t_s: *t,
                    position: Vector3::from(*x),
                })
                .collect::<Vec<_>>(),
        )
        .unwrap()
    };
    let demos: Vec<_> = (0..5).map(d).collect();
    learn_skill("s", &demos, &LearnOptions::default(), |p| {
        if let Progress::Candidate(c) = p {
            println!("{} {:.1} {:.3}", c.components, c.bic, c.score)
        }
    })
    .unwrap();
}
