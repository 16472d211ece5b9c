//! The encoding of a skill, and its parse: raw numbers come in, a checked [`Skill`] goes out.

use nalgebra::{SMatrix, SVector};
use serde::{Deserialize, Serialize};

use super::{
    Gmm, MAX_DURATION_S, MAX_NAME_BYTES, MAX_SKILL_BYTES, MAX_SOURCES, Provenance, Skill,
    SkillError, SkillId, Stats, sha256,
};
use crate::predict::{
    BLOCK, Calibration, FEATURES, MAX_KNOTS, Model, ModelError, Params, Regression,
    Standardisation, TARGETS,
};
use crate::wire::codec::{self, DecodeError};

/// Entries of a packed lower triangle of the features' covariance.
const TRIANGLE: usize = FEATURES * (FEATURES + 1) / 2;

#[derive(Serialize, Deserialize)]
struct RawSkill {
    name: String,
    duration_s: f64,
    motion: Vec<RawGaussian>,
    predictor: RawModel,
    stats: Stats,
    provenance: Provenance,
}

/// The covariance as its lower triangle, row by row.
#[derive(Serialize, Deserialize)]
struct RawGaussian {
    weight: f64,
    mean: [f64; 4],
    covariance: [f64; 10],
}

#[derive(Serialize, Deserialize)]
struct RawModel {
    mean: [f32; FEATURES],
    scale: [f32; FEATURES],
    /// One factor a knot: its length is the number of knots.
    covariance: Vec<f32>,
    straight_m2: Vec<f32>,
    novelty90: f32,
    params: [f32; 3],
    components: Vec<RawRegression>,
}

/// Everything per knot stops at the model's last knot.
#[derive(Serialize, Deserialize)]
struct RawRegression {
    weight: f32,
    mean: [f32; FEATURES],
    /// Lower triangle, row by row.
    factor: Vec<f32>,
    target: Vec<f32>,
    /// Feature by feature.
    gain: Vec<f32>,
    residual: Vec<f32>,
}

pub(super) fn encode(
    name: String,
    motion: &Gmm<4>,
    duration_s: f64,
    predictor: &Model,
    stats: Stats,
    provenance: Provenance,
) -> Vec<u8> {
    let motion = motion
        .components()
        .iter()
        .map(|c| RawGaussian {
            weight: c.weight(),
            mean: (*c.mean()).into(),
            covariance: {
                let mut packed = [0.0; 10];
                packed
                    .iter_mut()
                    .zip(triangle(4))
                    .for_each(|(v, at)| *v = c.covariance()[at]);
                packed
            },
        })
        .collect();
    codec::encode(&RawSkill {
        name,
        duration_s,
        motion,
        predictor: pack(predictor),
        stats,
        provenance,
    })
}

pub(super) fn decode(bytes: &[u8]) -> Result<Skill, SkillError> {
    let raw: RawSkill = codec::decode::<_, MAX_SKILL_BYTES>(bytes)?;
    if !(1..=MAX_NAME_BYTES).contains(&raw.name.len()) {
        return Err(SkillError::Name {
            bytes: raw.name.len(),
        });
    }
    if !(raw.duration_s > 0.0 && raw.duration_s <= MAX_DURATION_S) {
        return Err(SkillError::Duration {
            seconds: raw.duration_s,
        });
    }
    check_stats(&raw.stats)?;
    check_provenance(&raw.provenance)?;
    let motion = Gmm::new(raw.motion.iter().map(|g| {
        let mut covariance = SMatrix::zeros();
        for (&v, (i, j)) in g.covariance.iter().zip(triangle(4)) {
            covariance[(i, j)] = v;
            covariance[(j, i)] = v;
        }
        (g.weight, SVector::from(g.mean), covariance)
    }))?;
    let mut id = [0; 16];
    id.copy_from_slice(&sha256(bytes)[..16]);
    Ok(Skill {
        name: raw.name,
        motion,
        duration_s: raw.duration_s,
        predictor: unpack(&raw.predictor)?,
        stats: raw.stats,
        provenance: raw.provenance,
        id: SkillId(id),
        bytes: bytes.to_vec(),
    })
}

fn check_stats(stats: &Stats) -> Result<(), SkillError> {
    for (field, value) in [
        ("speed", stats.speed95_m_s),
        ("acceleration", stats.acceleration95_m_s2),
        ("reach", stats.reach_m),
    ] {
        if !(value.is_finite() && value >= 0.0) {
            return Err(SkillError::Stats { field });
        }
    }
    let ordered = stats
        .min
        .iter()
        .zip(&stats.max)
        .all(|(a, b)| a.is_finite() && b.is_finite() && a <= b);
    if !ordered {
        return Err(SkillError::Stats {
            field: "bounding box",
        });
    }
    Ok(())
}

fn check_provenance(provenance: &Provenance) -> Result<(), SkillError> {
    let too_long = |field| Err(SkillError::Provenance { field });
    if provenance.producer.len() > MAX_NAME_BYTES {
        return too_long("producer");
    }
    if provenance.sources.len() > MAX_SOURCES {
        return too_long("sources");
    }
    if provenance
        .sources
        .iter()
        .any(|s| s.name.len() > 2 * MAX_NAME_BYTES)
    {
        return too_long("source name");
    }
    Ok(())
}

fn pack(model: &Model) -> RawModel {
    let knots = model.knots();
    let calibration = model.calibration();
    let params = calibration.params;
    let narrow = |v: &[f64]| v.iter().map(|&v| v as f32).collect::<Vec<_>>();
    RawModel {
        mean: model.standardisation().mean.map(|v| v as f32).into(),
        scale: model.standardisation().scale.map(|v| v as f32).into(),
        covariance: narrow(&calibration.covariance[..knots]),
        straight_m2: narrow(&calibration.straight_m2[..knots]),
        novelty90: calibration.novelty90 as f32,
        params: [params.gain, params.trust, params.cv_damping].map(|v| v as f32),
        components: model
            .components()
            .iter()
            .map(|c| RawRegression {
                weight: c.weight as f32,
                mean: c.mean.map(|v| v as f32).into(),
                factor: triangle(FEATURES).map(|at| c.factor[at] as f32).collect(),
                target: narrow(&c.target[..3 * knots]),
                gain: c
                    .gain
                    .iter()
                    .flat_map(|row| narrow(&row[..3 * knots]))
                    .collect(),
                residual: narrow(c.residual[..knots].as_flattened()),
            })
            .collect(),
    }
}

fn unpack(raw: &RawModel) -> Result<Model, SkillError> {
    let knots = raw.covariance.len();
    if !(1..=MAX_KNOTS).contains(&knots) {
        return Err(ModelError::Knots { found: knots }.into());
    }
    if raw.straight_m2.len() != knots {
        return Err(wrong_length("straight").into());
    }
    let [gain, trust, cv_damping] = raw.params.map(f64::from);
    let mut calibration = Calibration {
        covariance: [1.0; MAX_KNOTS],
        straight_m2: [1.0; MAX_KNOTS],
        novelty90: f64::from(raw.novelty90),
        params: Params {
            gain,
            trust,
            cv_damping,
        },
    };
    widen(&mut calibration.covariance, &raw.covariance);
    widen(&mut calibration.straight_m2, &raw.straight_m2);
    let components = raw
        .components
        .iter()
        .map(|c| unpack_regression(c, knots))
        .collect::<Result<_, _>>()?;
    Ok(Model::new(
        knots,
        Standardisation {
            mean: SVector::from(raw.mean.map(f64::from)),
            scale: SVector::from(raw.scale.map(f64::from)),
        },
        components,
        calibration,
    )?)
}

fn unpack_regression(raw: &RawRegression, knots: usize) -> Result<Regression, DecodeError> {
    let row = 3 * knots;
    if raw.factor.len() != TRIANGLE {
        return Err(wrong_length("factor"));
    }
    if raw.target.len() != row {
        return Err(wrong_length("target"));
    }
    if raw.gain.len() != FEATURES * row {
        return Err(wrong_length("gain"));
    }
    if raw.residual.len() != knots * BLOCK {
        return Err(wrong_length("residual"));
    }
    let mut out = Regression {
        weight: f64::from(raw.weight),
        mean: SVector::from(raw.mean.map(f64::from)),
        factor: SMatrix::zeros(),
        target: [0.0; TARGETS],
        gain: [[0.0; TARGETS]; FEATURES],
        residual: [[0.0; BLOCK]; MAX_KNOTS],
    };
    for (&v, at) in raw.factor.iter().zip(triangle(FEATURES)) {
        out.factor[at] = f64::from(v);
    }
    widen(&mut out.target, &raw.target);
    for (to, from) in out.gain.iter_mut().zip(raw.gain.chunks_exact(row)) {
        widen(to, from);
    }
    widen(out.residual.as_flattened_mut(), &raw.residual);
    Ok(out)
}

fn wrong_length(field: &'static str) -> DecodeError {
    DecodeError::Invalid {
        field,
        why: "its length does not fit the number of knots",
    }
}

fn widen(to: &mut [f64], from: &[f32]) {
    for (to, &from) in to.iter_mut().zip(from) {
        *to = f64::from(from);
    }
}

/// The entries of a lower triangle, row by row.
fn triangle(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(|i| (0..=i).map(move |j| (i, j)))
}
