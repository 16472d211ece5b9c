//! The link against netem's closed forms.

mod chance;
mod queue;
mod traces;
mod words;

use super::*;

const MS: i64 = 1_000_000;

fn link(text: &str) -> LinkConfig {
    text.parse().unwrap_or_else(|e| panic!("{text}: {e}"))
}

/// Fates of packets of `len` bytes, one every `gap_ns`.
fn run(text: &str, seed: u64, packets: i64, gap_ns: i64, len: usize) -> Vec<Fate> {
    let mut link = Link::new(link(text), seed);
    (0..packets).map(|i| link.send(i * gap_ns, len)).collect()
}

/// Delays of the packets themselves, s.
fn delays_s(fates: &[Fate], gap_ns: i64) -> Vec<f64> {
    let delay = |(i, fate): (usize, &Fate)| match fate.packet {
        Outcome::Deliver(d) => Some((d.at_ns - i as i64 * gap_ns) as f64 * 1e-9),
        _ => None,
    };
    fates.iter().enumerate().filter_map(delay).collect()
}

/// Mean, standard deviation and the correlation of neighbours.
fn moments(x: &[f64]) -> (f64, f64, f64) {
    let n = x.len() as f64;
    let mean = x.iter().sum::<f64>() / n;
    let var = x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    let cov = x
        .windows(2)
        .map(|w| (w[0] - mean) * (w[1] - mean))
        .sum::<f64>()
        / n;
    (mean, var.sqrt(), cov / var)
}

fn share(fates: &[Fate], of: impl Fn(&Fate) -> bool) -> f64 {
    fates.iter().filter(|f| of(f)).count() as f64 / fates.len() as f64
}

fn arrivals_ns(fates: &[Fate]) -> Vec<Option<i64>> {
    fates.iter().map(Fate::arrival_ns).collect()
}
