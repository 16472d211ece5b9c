//! From demonstrations to a [`Skill`]: alignment, the motion's mixture, the predictor, both calibrated.

pub mod align;
pub mod compare;
pub mod em;
pub mod frames;
pub mod grip;
pub mod kmeans;
pub mod motion;
pub mod predictor;
mod refine;
pub mod select;
mod stats;
#[cfg(test)]
mod tests;
pub(crate) mod trial;
pub mod tube;
pub mod turn;
pub mod variational;
mod warp;

use std::path::PathBuf;

use telemime_protocol::predict::ModelError;
use telemime_protocol::skill::{
    MAX_COMPONENTS, MAX_NAME_BYTES, MAX_SOURCES, Pace, Parts, Provenance, Samples, Skill,
    SkillError, Source, Turn,
};

use crate::demonstration::Demonstration;

pub use predictor::PredictorOptions;
pub use refine::{Refinement, refine};
pub use stats::statistics;

/// Why nothing could be learned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LearnError {
    /// No demonstration was given.
    #[error("no demonstrations: at least one is needed, three or more are better")]
    NoDemonstrations,
    /// More demonstrations than a skill can name as its origin.
    #[error(
        "{found} demonstrations, at most {limit} make one skill: learn from some of them, with --match"
    )]
    TooMany {
        /// How many.
        found: usize,
        /// How many are possible.
        limit: usize,
    },
    /// K is zero or beyond what a mixture may have.
    #[error("{asked} mixture components asked for, 1 to 64 are possible")]
    Components {
        /// K.
        asked: usize,
    },
    /// Fewer rows than a mixture needs.
    #[error("{found} rows of data, at least {needed} are needed")]
    TooFewRows {
        /// Rows.
        found: usize,
        /// Rows needed.
        needed: usize,
    },
    /// A row is not finite, or so large that squares could overflow.
    #[error("row {row} of the data is not finite or beyond 1e12")]
    OutOfRange {
        /// Its index.
        row: usize,
    },
    /// A mixture cannot stand for this many samples.
    #[error(
        "a mixture of {found} effective samples cannot be refined: a positive number is needed"
    )]
    EffectiveSamples {
        /// The number.
        found: f64,
    },
    /// A prior that is no prior.
    #[error("a prior of {found}: concentration and mean precision are positive numbers")]
    Prior {
        /// Its value.
        found: f64,
    },
    /// A demonstration does not say where a frame is.
    #[error(
        "{}: no frame {name:?}; add a line `# frame {name} x y z` (m), or learn without it", path.display()
    )]
    Frame {
        /// The frame.
        name: String,
        /// The demonstration's file.
        path: PathBuf,
    },
    /// A skill is to be refined by what it was learned from.
    #[error("{}: the skill was learned from this very recording; give another one", path.display())]
    AlreadyLearned {
        /// The demonstration's file.
        path: PathBuf,
    },
    /// A skill is to be refined by a demonstration that shows less than those before.
    #[error("{}: no {what}, which the skill has; give a recording with those columns", path.display())]
    Lacks {
        /// The demonstration's file.
        path: PathBuf,
        /// What is missing.
        what: &'static str,
    },
    /// Some demonstrations of a skill show more than others.
    #[error(
        "{}: no {what}, which {other} has; give all recordings of a skill those columns, or none", path.display()
    )]
    Mixed {
        /// The demonstration's file that shows less.
        path: PathBuf,
        /// What it lacks.
        what: &'static str,
        /// The name of one that has it.
        other: String,
    },
    /// An object was seen in one place only.
    #[error(
        "frame {name:?}: one demonstration cannot show what follows the object and what does not; give two or more"
    )]
    FrameAlone {
        /// The frame.
        name: String,
    },
    /// Nothing that the motion may be like.
    #[error("no character to choose from: give one at least")]
    NoCharacter,
    /// The data span no volume, and no ridge was allowed.
    #[error("the data lie in a subspace: no mixture of full covariance fits without a ridge")]
    Singular,
    /// The trained predictor is not valid.
    #[error(transparent)]
    Predictor(#[from] ModelError),
    /// The learned numbers make no valid skill, for example because of its name.
    #[error(transparent)]
    Skill(#[from] SkillError),
}

/// How to learn a skill.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnOptions {
    /// The motion's mixture: number of components to choose from by BIC.
    pub motion_components: std::ops::RangeInclusive<usize>,
    /// The predictor.
    pub predictor: PredictorOptions,
    /// The same motion by other people, for the predictor of positions: it leans on them where the own demonstrations
    /// have nothing to say. They are no sources of the skill.
    pub others: Vec<Demonstration>,
    /// Frames that the motion is also learned relative to: [`frames::START`], [`frames::GOAL`], and what the
    /// recordings place by `# frame` lines. None, and it is not.
    pub frames: Vec<String>,
    /// Seed of every random choice.
    pub seed: u64,
}

impl Default for LearnOptions {
    fn default() -> Self {
        Self {
            motion_components: 1..=MAX_COMPONENTS,
            predictor: PredictorOptions::default(),
            others: Vec::new(),
            frames: Vec::new(),
            seed: 0,
        }
    }
}

/// How far learning has come, and what it found on the way.
#[derive(Debug, Clone, PartialEq)]
pub enum Progress {
    /// The demonstrations lie on one time axis.
    Aligned {
        /// The name of the medoid.
        medoid: String,
        /// Mean duration, s.
        duration_s: f64,
        /// How far the demonstrations are from their mean in proportional time, m (see [`tube`]).
        before_m: f64,
        /// How far aligned, m.
        after_m: f64,
    },
    /// A number of components was tried for the motion.
    Candidate(select::Candidate),
    /// The motion's mixture is chosen.
    Motion {
        /// Components.
        components: usize,
        /// Mean log likelihood, nats a sample (s, m).
        score: f64,
        /// Components that died and were started again or removed, and what floors and shrinkage stand for.
        degenerate: Vec<em::Degenerate>,
    },
    /// The motion was learned relative to a frame.
    Frame {
        /// Its name.
        name: String,
        /// Components.
        components: usize,
        /// How far the frame was from its usual place in the demonstrations, root mean square, m.
        spread_m: f64,
    },
    /// A predictor was trained without one demonstration and tried on it.
    Held {
        /// How many are done.
        done: usize,
        /// Of how many.
        of: usize,
    },
    /// The predictor is trained.
    Predictor {
        /// Components.
        components: usize,
        /// Samples it was trained on.
        samples: usize,
        /// Whether the motion was found to be smooth rather than abrupt.
        smooth: bool,
    },
}

/// Learns a skill from the demonstrations of it.
///
/// The result is already in the form that its encoding gives it: what is learned is what runs.
///
/// # Errors
/// [`LearnError`], one variant a cause.
pub fn learn_skill(
    name: &str,
    demonstrations: &[Demonstration],
    options: &LearnOptions,
    mut progress: impl FnMut(Progress),
) -> Result<Skill, LearnError> {
    if demonstrations.len() > MAX_SOURCES {
        return Err(LearnError::TooMany {
            found: demonstrations.len(),
            limit: MAX_SOURCES,
        });
    }
    let turns = all_or_none(demonstrations, ORIENTATION, Demonstration::has_orientation)?;
    let grips = all_or_none(demonstrations, GRIP, Demonstration::has_grip)?;
    let aligned = align::align(demonstrations)?;
    let tubes = tube::BeforeAfter::of(demonstrations, &aligned);
    progress(Progress::Aligned {
        medoid: demonstrations[aligned.medoid].name().to_owned(),
        duration_s: aligned.duration_s,
        before_m: tubes.before.deviation_m(),
        after_m: tubes.after.deviation_m(),
    });
    let motion = motion::fit(&aligned, options, &mut progress)?;
    let task = if options.frames.is_empty() {
        None
    } else {
        Some(frames::fit(
            &aligned,
            demonstrations,
            options,
            &mut progress,
        )?)
    };
    let predictor = predictor::train(
        demonstrations,
        &options.others,
        &options.predictor,
        options.seed,
        &mut progress,
    )?;
    let turn = if turns {
        Some(Turn {
            motion: turn::fit(&aligned, demonstrations)?,
            predictor: predictor::train_turns(
                demonstrations,
                &options.predictor,
                options.seed,
                &mut progress,
            )?,
        })
    } else {
        None
    };
    let grip = if grips {
        Some(grip::fit(&aligned, demonstrations, options.seed)?)
    } else {
        None
    };
    Ok(Skill::new(Parts {
        name: name.to_owned(),
        motion,
        duration_s: aligned.duration_s,
        pace: pace(demonstrations),
        predictor,
        turn,
        grip,
        task,
        stats: statistics(demonstrations),
        samples: samples(&aligned, demonstrations, options.predictor.copies),
        provenance: provenance(demonstrations, options.seed),
    })?)
}

/// Columns that not every recording has, for people.
const ORIENTATION: &str = "orientation (qw,qx,qy,qz)";
const GRIP: &str = "grip";

/// Whether the demonstrations have something.
fn all_or_none(
    demonstrations: &[Demonstration],
    what: &'static str,
    has: impl Fn(&Demonstration) -> bool,
) -> Result<bool, LearnError> {
    let with = demonstrations.iter().find(|d| has(d));
    let without = demonstrations.iter().find(|d| !has(d));
    match (with, without) {
        (Some(with), Some(without)) => Err(LearnError::Mixed {
            path: without.path().to_owned(),
            what,
            other: with.name().to_owned(),
        }),
        (with, _) => Ok(with.is_some()),
    }
}

/// Durations vary by 5 % at least: a handful of performances cannot show less.
const LEAST_DEVIATION_LN: f64 = 0.05;

/// One performance shows nothing of how durations vary; one person's of one recorded gesture do by 0.06 to 0.25.
const UNTRIED_DEVIATION_LN: f64 = 0.15;

/// The log-normal distribution of the durations.
fn pace(demonstrations: &[Demonstration]) -> Pace {
    let n = demonstrations.len() as f64;
    let ln: Vec<f64> = demonstrations.iter().map(|d| d.duration_s().ln()).collect();
    let mean_ln_s = ln.iter().sum::<f64>() / n;
    let square = ln.iter().map(|v| (v - mean_ln_s).powi(2)).sum::<f64>();
    let deviation_ln = match demonstrations {
        [_] => UNTRIED_DEVIATION_LN,
        _ => (square / (n - 1.0)).sqrt().max(LEAST_DEVIATION_LN),
    };
    Pace {
        mean_ln_s,
        deviation_ln,
    }
}

fn samples(aligned: &align::Aligned, demonstrations: &[Demonstration], copies: f64) -> Samples {
    let rows = demonstrations
        .iter()
        .map(|d| predictor::row_count(d, copies));
    let count = |n: usize| u32::try_from(n).unwrap_or(u32::MAX).max(1);
    Samples {
        motion: count(aligned.paths.len() * aligned.times_s.len()),
        predictor: count(rows.sum::<f64>().round() as usize),
    }
}

/// A recording's name, as much of it as a skill holds.
fn short(name: &str) -> String {
    let mut name = name.to_owned();
    while name.len() > 2 * MAX_NAME_BYTES {
        name.pop();
    }
    name
}

fn provenance(demonstrations: &[Demonstration], seed: u64) -> Provenance {
    let sources = demonstrations
        .iter()
        .map(|d| Source {
            name: short(d.name()),
            sha256: *d.sha256(),
        })
        .collect();
    Provenance {
        producer: concat!("telemime ", env!("CARGO_PKG_VERSION")).to_owned(),
        seed,
        sources,
    }
}
