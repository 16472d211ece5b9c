//! A further demonstration refines a predictor whose own are no longer at hand.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use telemime_protocol::predict::{Calibration, FEATURES, MAX_KNOTS, Regression, TARGETS};

use super::blocks::{self, Blocks};
use super::generic::Products;
use super::rows::{Scaling, with_copies};
use super::{
    Character, Course, EM_KNOTS, Fitted, PredictorOptions, Row, assign, em_options, queried,
};
use crate::demonstration::Demonstration;
use crate::learn::LearnError;
use crate::learn::trial::Trial;

/// EM steps over the new rows; what the old ones belong to is settled.
const STEPS: usize = 4;

/// One trial changes a calibrated factor at most this much before it is blended.
const MOST_CHANGE: f64 = 4.0;

/// A refined predictor.
pub(in crate::learn) struct Refined<M> {
    pub(in crate::learn) model: M,
    /// Rows that the new demonstration counts for.
    pub(in crate::learn) rows: f64,
    /// Share of the new demonstration's samples that were newer to the old model than 90 % of those held out before.
    pub(in crate::learn) novel: f64,
}

/// Refines a model that stands for `demonstrations` of together `rows` rows.
///
/// Its components give back the scatters they were made of ([`blocks::recovered`]); EM over the new rows adds theirs.
/// The old model has not seen the new demonstration, so that its errors there are as good as a fold of the
/// calibration, and count as one of `demonstrations + 1`.
pub(in crate::learn) fn refine<C: Course>(
    model: &C::Model,
    rows: f64,
    demonstrations: usize,
    d: &Demonstration,
) -> Result<Refined<C::Model>, LearnError> {
    let (inner, charts) = C::parts(model);
    let features = inner.standardisation().clone();
    let options = em_options(&Character {
        bend: 0.0,
        shrinkage: features.shrinkage,
        ridge: features.ridge,
    });
    let scaling = Scaling {
        features: features.clone(),
        target_mean: [0.0; TARGETS],
        target_scale: [1.0; TARGETS],
    };
    let copies = PredictorOptions::default().copies;
    let taken = with_copies::<C>(d, inner.knots(), &UnitQuaternion::identity(), copies);
    let mut products = Products::recovered(inner.generic(), rows);
    products.join(&Products::of(taken.iter()));
    let new: Vec<Row> = taken.iter().map(|row| scaling.row(row)).collect();
    let seen = |k: usize| C::seen(&new, charts.get(k), features.scale[0]);
    let old = blocks::recovered(inner.components(), rows, &options);
    let knots = EM_KNOTS.map(|knot| knot.min(inner.knots()) - 1);
    let floor = knots.map(|knot| options.ridge * variance(&old, knot));
    let mut components = inner.components().to_vec();
    for step in 0..=STEPS {
        let mut shares = vec![0.0; new.len() * components.len()];
        if step < STEPS {
            let joint = |c: &Regression, row: &Row| log_joint(c, row, &knots, &floor);
            assign(&components, &seen, &mut shares, joint);
        } else {
            assign(&components, &seen, &mut shares, queried);
        }
        let stride = components.len();
        for (row, r) in shares.chunks_exact_mut(stride).zip(&new) {
            row.iter_mut().for_each(|share| *share *= r.weight);
        }
        let mut joined = old.clone();
        for (k, b) in joined.iter_mut().enumerate() {
            b.join(&Blocks::of(&seen(k), shares.iter().skip(k).step_by(stride)));
        }
        components = blocks::of_blocks(joined, &scaling, &options)?;
    }
    let mut trial = Trial::<C>::straight(std::slice::from_ref(d), inner.knots());
    trial.hold_out(model, d);
    let novel = trial.beyond(inner.calibration().novelty90);
    let calibration = blend(inner.calibration(), &trial.calibration(), demonstrations);
    let fitted = Fitted {
        knots: inner.knots(),
        standardisation: features,
        components,
        charts: charts.to_vec(),
        generic: products.solve()?,
    };
    Ok(Refined {
        model: C::model(&fitted, calibration)?,
        rows: new.iter().map(|r| r.weight).sum(),
        novel,
    })
}

/// Mean variance of the displacement along an axis at a knot (from 0), m² or rad².
fn variance(blocks: &[Blocks], knot: usize) -> f64 {
    let n: f64 = blocks.iter().map(|b| b.n).sum();
    let at = |b: &Blocks| Vector3::from_column_slice(&b.target_mean[3 * knot..3 * knot + 3]);
    let mean = blocks.iter().map(|b| at(b) * b.n).sum::<Vector3<f64>>() / n;
    let within = |b: &Blocks| b.yy[knot][0] + b.yy[knot][3] + b.yy[knot][5];
    let all = |b: &Blocks| within(b) + b.n * (at(b) - mean).norm_squared();
    blocks.iter().map(all).sum::<f64>() / (3.0 * n) + f64::MIN_POSITIVE
}

/// ln of a component's weight and density at the features, and of the displacements that follow.
///
/// How displacements at different knots vary together is not kept; as they nearly tell the same, the mean of
/// their log densities stands for them.
fn log_joint(c: &Regression, row: &Row, knots: &[usize; 3], floor: &[f64; 3]) -> f64 {
    let e = row.features - c.mean;
    let mut l = super::log_density(c, row);
    for (&knot, &floor) in knots.iter().zip(floor) {
        let at = 3 * knot;
        let foretold = |d: usize| {
            let by_gain: f64 = (0..FEATURES).map(|i| c.gain[i][at + d] * e[i]).sum();
            row.targets[at + d] - c.target[at + d] - by_gain
        };
        let error = Vector3::from_fn(|d, _| foretold(d));
        let [xx, xy, xz, yy, yz, zz] = c.residual[knot];
        let v = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz) + Matrix3::identity() * floor;
        if let Some(v) = v.cholesky() {
            let half_ln_det: f64 = (0..3).map(|d| v.l_dirty()[(d, d)].ln()).sum();
            l -= (0.5 * error.dot(&v.solve(&error)) + half_ln_det) / knots.len() as f64;
        }
    }
    l
}

/// What `before` demonstrations have shown and what one more has. After a single one there was nothing to try the
/// model on: its guesses give way.
fn blend(old: &Calibration, new: &Calibration, before: usize) -> Calibration {
    let share = 1.0 / (before + 1) as f64;
    let tried = if before > 1 { share } else { 1.0 };
    let factor = |old: f64, new: f64| {
        if before > 1 {
            let new = new.clamp(old / MOST_CHANGE, old * MOST_CHANGE);
            old + (new - old) * tried
        } else {
            new
        }
    };
    let mut out = *old;
    for j in 0..MAX_KNOTS {
        out.covariance[j] = factor(old.covariance[j], new.covariance[j]);
        let pairs = out.errors[j].iter_mut().zip(&new.errors[j]);
        for ((old, new), share) in pairs.zip([tried, tried, share, share]) {
            *old += (new - *old) * share;
        }
    }
    out.novelty90 = factor(old.novelty90, new.novelty90);
    out
}

#[cfg(test)]
mod tests {
    use telemime_protocol::predict::Model;

    use super::super::{Places, row_count, train};
    use super::*;
    use crate::demonstration::Sample;

    fn trained() -> (Vec<Demonstration>, Model) {
        let all: Vec<_> = (0..3_u32)
            .map(|n| {
                let own = 1.0 + 0.1 * f64::from(n);
                let samples: Vec<_> = (0..90)
                    .map(|i| {
                        let t_s = f64::from(i) / 30.0;
                        let x = Vector3::new(
                            (2.0 * own * t_s).sin(),
                            (3.1 * t_s).cos() * own,
                            0.2 * (t_s * t_s).sin(),
                        );
                        Sample::at(t_s, x * 0.4)
                    })
                    .collect();
                Demonstration::from_samples(format!("{n}"), &samples).unwrap()
            })
            .collect();
        let options = PredictorOptions {
            components: 5,
            characters: vec![Character::ABRUPT],
            ..PredictorOptions::default()
        };
        let model = train(&all, &[], &options, 0, &mut |_| ()).unwrap();
        (all, model)
    }

    /// Ridge and shrinkage are undone and done again.
    #[test]
    fn what_regressions_give_back_makes_them_again() {
        let (all, model) = trained();
        let rows: f64 = all.iter().map(|d| row_count(d, 0.3)).sum();
        let options = em_options(&Character::ABRUPT);
        let back = blocks::recovered(model.components(), rows, &options);
        let counted: f64 = back.iter().map(|b| b.n).sum();
        assert!((counted - rows).abs() < 1e-6, "{counted} of {rows}");
        let scaling = Scaling {
            features: model.standardisation().clone(),
            target_mean: [0.0; TARGETS],
            target_scale: [1.0; TARGETS],
        };
        let again = blocks::of_blocks(back, &scaling, &options).unwrap();
        for (a, b) in model.components().iter().zip(&again) {
            assert!((a.weight - b.weight).abs() < 1e-12);
            assert!((a.factor - b.factor).abs().max() < 1e-9);
            assert!((a.mean - b.mean).norm() < 1e-12);
            let pairs = a.gain.iter().flatten().zip(b.gain.iter().flatten());
            assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-9));
            let pairs = a.residual.iter().flatten().zip(b.residual.iter().flatten());
            assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-9));
        }
    }

    /// Rows that the old mixture assigns as EM did are worth what they would have been in training.
    #[test]
    fn blocks_joined_are_blocks_of_both() {
        let (all, model) = trained();
        let scaling = Scaling {
            features: model.standardisation().clone(),
            target_mean: [0.0; TARGETS],
            target_scale: [1.0; TARGETS],
        };
        let rows: Vec<Row> = with_copies::<Places>(&all[0], 24, &UnitQuaternion::identity(), 0.0)
            .iter()
            .map(|row| scaling.row(row))
            .collect();
        let shares: Vec<f64> = (0..rows.len()).map(|i| 0.2 + 0.01 * i as f64).collect();
        let whole = Blocks::of(&rows, shares.iter());
        let mut joined = Blocks::of(&rows[..30], shares[..30].iter());
        joined.join(&Blocks::of(&rows[30..], shares[30..].iter()));
        assert!((whole.n - joined.n).abs() < 1e-9);
        for knot in 0..24 {
            for (a, b) in whole.yy[knot].iter().zip(&joined.yy[knot]) {
                assert!((a - b).abs() < 1e-9 * whole.n);
            }
        }
        for (a, b) in whole.target_mean.iter().zip(&joined.target_mean) {
            assert!((a - b).abs() < 1e-12);
        }
    }

    #[test]
    fn the_first_trial_replaces_guesses_and_later_ones_count_alike() {
        let guess = Calibration::UNTRIED;
        let mut seen = guess;
        seen.covariance = [0.5; MAX_KNOTS];
        seen.novelty90 = 1e6;
        seen.errors = [[0.4; 4]; MAX_KNOTS];
        let first = blend(&guess, &seen, 1);
        assert_eq!(first.covariance[3], 0.5);
        // What needs no model was seen before: guesses only of the others.
        assert_eq!(first.errors[3][..2], [0.4; 2]);
        let half = 0.5 * (guess.errors[3][3] + 0.4);
        assert!((first.errors[3][3] - half).abs() < 1e-12);
        let later = blend(&guess, &seen, 3);
        assert!((later.errors[3][0] - (0.75 * guess.errors[3][0] + 0.1)).abs() < 1e-12);
        // A demonstration of something else does not make everything familiar.
        assert!(later.novelty90 <= guess.novelty90 * 1.75 + 1e-9);
    }
}
