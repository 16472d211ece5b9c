//! The publication's two synthetic tasks, from its formulas.

use nalgebra::Vector2;

use super::Series;

/// Samples of one demonstration.
pub(super) const STEPS: usize = 50;

/// Its ten draws (numpy `RandomState(0)`): per demonstration width s and centre m of the bump.
const DRAWS: [(f64, f64); 10] = [
    (0.2941013086491916, 0.5200078604183611),
    (0.2744684496026435, 0.6120446599600728),
    (0.2966889497537492, 0.4511361060061794),
    (0.27375221043813974, 0.4924321395851151),
    (0.24741952870516104, 0.5205299250969186),
    (0.253601089279022, 0.5727136753481488),
    (0.26902594312867484, 0.5060837508246414),
    (0.2610965808186356, 0.5166837163687134),
    (0.28735197682894015, 0.48974208681170994),
    (0.25782669254127255, 0.4572952130349138),
];

/// One of the two tasks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Task {
    /// A sigmoid with a bump.
    One,
    /// The bump alone.
    Two,
}

impl Task {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::One => "task1",
            Self::Two => "task2",
        }
    }

    /// The threshold of its rule: 4.7 gives the 14 checkpoints it prints for task 1, 25 the 18 of its
    /// slides for task 2.
    pub(super) fn threshold(self) -> f64 {
        match self {
            Self::One => 4.7,
            Self::Two => 25.0,
        }
    }

    /// Its demonstrations (x1, x2) at [`times`]; the first one is what it calls the ground truth.
    pub(super) fn demonstrations(self) -> Vec<Series> {
        let t = times(STEPS);
        let base = standardised(t.iter().map(|&t| {
            const FLOOR: f64 = -854_112.8;
            FLOOR + (4.389788 - FLOOR) / (1.0 + (t / 31.3205).powf(6.971958))
        }));
        DRAWS
            .iter()
            .map(|&(s, m)| {
                let height = 1.0 / (s * (2.0 * std::f64::consts::PI).sqrt());
                let bump = t
                    .iter()
                    .map(|&t| t + height * (-0.5 * ((t - m) / s).powi(2)).exp());
                let x2: Vec<f64> = match self {
                    Self::One => base
                        .iter()
                        .zip(bump)
                        .map(|(y, b)| -0.8 * y + 0.6 * b)
                        .collect(),
                    Self::Two => standardised(bump),
                };
                let (x1, x2) = (aligned(&t, 1.0), aligned(&x2, 2.0));
                x1.zip(x2).map(|(a, b)| Vector2::new(a, b)).collect()
            })
            .collect()
    }
}

/// `count` instants from 0 to 1 (`numpy.linspace`).
pub(super) fn times(count: usize) -> Vec<f64> {
    let last = (count - 1) as f64;
    (0..count).map(|i| i as f64 / last).collect()
}

/// Zero mean, unit population standard deviation.
fn standardised(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let values: Vec<f64> = values.collect();
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    values
        .iter()
        .map(|v| (v - mean) / variance.sqrt())
        .collect()
}

/// Mapped affinely so that the first value is 0 and the last is `goal`.
fn aligned(values: &[f64], goal: f64) -> impl Iterator<Item = f64> + '_ {
    let (first, last) = (values[0], values[values.len() - 1]);
    values
        .iter()
        .map(move |v| (v - first) / (last - first) * goal)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_formulas_give_the_published_demonstrations() {
        let file: serde_json::Value = serde_json::from_str(include_str!(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/tests/vectors/paper_tasks.json"
        )))
        .unwrap();
        for task in [Task::One, Task::Two] {
            let want: Vec<Vec<[f64; 2]>> =
                serde_json::from_value(file[task.name()]["demos"].clone()).unwrap();
            let got = task.demonstrations();
            assert_eq!(want.len(), got.len());
            for (want, got) in want.iter().flatten().zip(got.iter().flatten()) {
                assert!((got - Vector2::from(*want)).norm() < 1e-9);
            }
        }
    }
}
