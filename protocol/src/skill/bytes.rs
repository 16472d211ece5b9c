//! The encoding of a skill, and its parse: raw numbers come in, a checked [`Skill`] goes out.

use nalgebra::{Quaternion, SMatrix, SVector, UnitQuaternion};
use serde::{Deserialize, Serialize};

use super::predictor::RawModel;
use super::{
    Gmm, GmmError, MAX_DURATION_S, MAX_NAME_BYTES, MAX_SKILL_BYTES, MAX_SOURCES, Pace, Parts,
    Placement, Provenance, Samples, Skill, SkillError, SkillId, Stats, TaskFrame, TaskModel, Turn,
    TurnError, TurnMixture, sha256,
};
use crate::predict::TurnModel;
use crate::wire::codec;

#[derive(Serialize, Deserialize)]
struct RawSkill {
    name: String,
    duration_s: f64,
    pace: Pace,
    motion: Vec<RawGaussian>,
    predictor: RawModel,
    turn: Option<RawTurn>,
    grip: Option<Vec<RawOpening>>,
    task: Option<Vec<RawFrame>>,
    stats: Stats,
    samples: Samples,
    provenance: Provenance,
}

/// Orientations as (w, x, y, z).
#[derive(Serialize, Deserialize)]
struct RawTurn {
    motion: Vec<RawTurned>,
    predictor: RawModel,
    /// One a component of the predictor.
    charts: Vec<[f32; 4]>,
}

/// A Gaussian over (t, rotation vector) about (`t_s`, `chart`); the covariance as of [`RawGaussian`].
#[derive(Serialize, Deserialize)]
struct RawTurned {
    weight: f64,
    t_s: f64,
    chart: [f64; 4],
    covariance: [f64; 10],
}

/// A Gaussian over (t, opening).
#[derive(Serialize, Deserialize)]
struct RawOpening {
    weight: f64,
    mean: [f64; 2],
    covariance: [f64; 3],
}

#[derive(Serialize, Deserialize)]
struct RawFrame {
    name: String,
    origin: [f64; 3],
    turn: [f64; 4],
    motion: Vec<RawGaussian>,
}

/// The covariance as its lower triangle, row by row.
#[derive(Serialize, Deserialize)]
struct RawGaussian {
    weight: f64,
    mean: [f64; 4],
    covariance: [f64; 10],
}

pub(super) fn encode(parts: Parts) -> Vec<u8> {
    codec::encode(&RawSkill {
        name: parts.name,
        duration_s: parts.duration_s,
        pace: parts.pace,
        motion: gaussians(&parts.motion),
        predictor: RawModel::pack(&parts.predictor),
        turn: parts.turn.as_ref().map(pack_turn),
        grip: parts.grip.as_ref().map(|grip| {
            let opening = |c: &super::Component<2>| RawOpening {
                weight: c.weight(),
                mean: (*c.mean()).into(),
                covariance: packed(c.covariance()),
            };
            grip.components().iter().map(opening).collect()
        }),
        task: parts.task.as_ref().map(|task| {
            let frame = |f: &TaskFrame| RawFrame {
                name: f.name.clone(),
                origin: f.usual.origin.into(),
                turn: raw_quaternion(&f.usual.turn),
                motion: gaussians(&f.motion),
            };
            task.frames().iter().map(frame).collect()
        }),
        stats: parts.stats,
        samples: parts.samples,
        provenance: parts.provenance,
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
    check_pace(&raw.pace)?;
    check_stats(&raw.stats)?;
    for (field, count) in [
        ("motion", raw.samples.motion),
        ("predictor", raw.samples.predictor),
    ] {
        if count == 0 {
            return Err(SkillError::Samples { field });
        }
    }
    check_provenance(&raw.provenance)?;
    let grip = raw.grip.map(|grip| {
        Gmm::new(
            grip.iter()
                .map(|g| (g.weight, SVector::from(g.mean), unpacked(&g.covariance))),
        )
    });
    let frame = |f: RawFrame| -> Result<_, SkillError> {
        let origin = SVector::from(f.origin);
        if !origin.iter().all(|v: &f64| v.is_finite()) {
            return Err(GmmError::NotFinite { component: 0 }.into());
        }
        Ok(TaskFrame {
            name: f.name,
            motion: mixture(&f.motion)?,
            usual: Placement {
                origin,
                turn: quaternion(f.turn, 0)?,
            },
        })
    };
    let frames = raw
        .task
        .map(|task| task.into_iter().map(frame).collect::<Result<_, _>>());
    let mut id = [0; 16];
    id.copy_from_slice(&sha256(bytes)[..16]);
    let parts = Parts {
        name: raw.name,
        motion: mixture(&raw.motion)?,
        duration_s: raw.duration_s,
        pace: raw.pace,
        predictor: raw.predictor.unpack()?,
        turn: raw.turn.as_ref().map(unpack_turn).transpose()?,
        grip: grip.transpose()?,
        task: frames.transpose()?.map(TaskModel::new).transpose()?,
        stats: raw.stats,
        samples: raw.samples,
        provenance: raw.provenance,
    };
    Ok(Skill {
        parts,
        id: SkillId(id),
        bytes: bytes.to_vec(),
    })
}

fn gaussians(gmm: &Gmm<4>) -> Vec<RawGaussian> {
    let raw = |c: &super::Component<4>| RawGaussian {
        weight: c.weight(),
        mean: (*c.mean()).into(),
        covariance: packed(c.covariance()),
    };
    gmm.components().iter().map(raw).collect()
}

fn mixture(raw: &[RawGaussian]) -> Result<Gmm<4>, GmmError> {
    Gmm::new(
        raw.iter()
            .map(|g| (g.weight, SVector::from(g.mean), unpacked(&g.covariance))),
    )
}

/// The lower triangle, row by row.
fn packed<const D: usize, const N: usize>(covariance: &SMatrix<f64, D, D>) -> [f64; N] {
    let mut packed = [0.0; N];
    packed
        .iter_mut()
        .zip(triangle(D))
        .for_each(|(v, at)| *v = covariance[at]);
    packed
}

fn unpacked<const D: usize, const N: usize>(packed: &[f64; N]) -> SMatrix<f64, D, D> {
    let mut covariance = SMatrix::zeros();
    for (&v, (i, j)) in packed.iter().zip(triangle(D)) {
        covariance[(i, j)] = v;
        covariance[(j, i)] = v;
    }
    covariance
}

fn raw_quaternion(q: &UnitQuaternion<f64>) -> [f64; 4] {
    [q.w, q.i, q.j, q.k]
}

/// Kept as it is: normalising again would change the last bits, and encoding what was decoded gives the same bytes.
fn quaternion([w, x, y, z]: [f64; 4], component: usize) -> Result<UnitQuaternion<f64>, TurnError> {
    let q = Quaternion::new(w, x, y, z);
    // Written so that NaN fails too.
    if !((q.norm_squared() - 1.0).abs() < 1e-6) {
        return Err(TurnError::NotARotation { component });
    }
    Ok(UnitQuaternion::new_unchecked(q))
}

fn pack_turn(turn: &Turn) -> RawTurn {
    let components = turn.motion.gmm().components();
    RawTurn {
        motion: components
            .iter()
            .zip(turn.motion.charts())
            .map(|(c, chart)| RawTurned {
                weight: c.weight(),
                t_s: c.mean()[0],
                chart: raw_quaternion(chart),
                covariance: packed(c.covariance()),
            })
            .collect(),
        predictor: RawModel::pack(turn.predictor.model()),
        charts: turn
            .predictor
            .charts()
            .iter()
            .map(|q| raw_quaternion(q).map(|v| v as f32))
            .collect(),
    }
}

fn unpack_turn(raw: &RawTurn) -> Result<Turn, SkillError> {
    let gmm = Gmm::new(raw.motion.iter().map(|g| {
        let mean = SVector::from([g.t_s, 0.0, 0.0, 0.0]);
        (g.weight, mean, unpacked(&g.covariance))
    }))?;
    let charts = raw
        .motion
        .iter()
        .enumerate()
        .map(|(component, g)| quaternion(g.chart, component))
        .collect::<Result<_, _>>()?;
    let predictor_charts = raw
        .charts
        .iter()
        .enumerate()
        .map(|(component, q)| quaternion(q.map(f64::from), component))
        .collect::<Result<_, _>>()?;
    Ok(Turn {
        motion: TurnMixture::new(gmm, charts)?,
        predictor: TurnModel::new(raw.predictor.unpack()?, predictor_charts)?,
    })
}

fn check_pace(pace: &Pace) -> Result<(), SkillError> {
    if !pace.mean_ln_s.is_finite() {
        return Err(SkillError::Pace { field: "mean" });
    }
    if !(pace.deviation_ln > 0.0 && pace.deviation_ln.is_finite()) {
        return Err(SkillError::Pace { field: "deviation" });
    }
    Ok(())
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

/// The entries of a lower triangle, row by row.
pub(super) fn triangle(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(|i| (0..=i).map(move |j| (i, j)))
}
