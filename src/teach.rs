//! `telemime learn` and `telemime inspect`.

use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use nalgebra::SVector;
use telemime_operator::demonstration::Demonstrations;
use telemime_operator::learn::{LearnOptions, Progress, learn_skill};
use telemime_operator::skill_file;
use telemime_protocol::skill::{Gmr, Skill};

/// Learn a skill from a folder of demonstrations (CSV: t,x,y,z; one file each) and save it.
#[derive(clap::Args, Debug)]
pub(crate) struct LearnArgs {
    /// The folder; its name becomes the skill's.
    dir: PathBuf,
    /// Where to save the skill [default: NAME.skill].
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Only the files whose names match this pattern (* stands for anything).
    #[arg(long = "match", value_name = "PATTERN")]
    matching: Option<String>,
    /// Seed of every random choice.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Show what a saved skill holds.
#[derive(clap::Args, Debug)]
pub(crate) struct InspectArgs {
    /// The skill file.
    file: PathBuf,
}

pub(crate) fn learn(args: &LearnArgs) -> anyhow::Result<()> {
    let found = Demonstrations::read_dir(&args.dir, args.matching.as_deref())?;
    found
        .notices
        .iter()
        .for_each(|notice| eprintln!("note: {notice}"));
    let options = LearnOptions {
        seed: args.seed,
        ..LearnOptions::default()
    };
    let bar = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}") {
        bar.set_style(style);
    }
    let mut degenerate = Vec::new();
    let mut spread_m = (0.0, 0.0);
    let skill = learn_skill(&found.name, &found.demonstrations, &options, |progress| {
        match &progress {
            Progress::Motion {
                degenerate: found, ..
            } => degenerate.clone_from(found),
            Progress::Aligned {
                before_m, after_m, ..
            } => spread_m = (*before_m, *after_m),
            _ => {}
        }
        bar.set_message(match progress {
            Progress::Aligned { medoid, .. } => format!("aligned to {medoid}"),
            Progress::Candidate(candidate) => format!("motion: {candidate:?}"),
            Progress::Motion { components, .. } => format!("motion: {components} components"),
            Progress::Held { done, of } => format!("calibrating, {done} of {of}"),
            Progress::Predictor { components, .. } => format!("predictor: {components} components"),
        });
        bar.tick();
    })?;
    bar.finish_and_clear();
    for what in degenerate {
        eprintln!("note: the motion's mixture over (t, x, y, z): {what}");
    }
    let path = args
        .output
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("{}.skill", skill.name())));
    skill_file::save(&skill, &path)?;
    describe(&skill);
    if found.demonstrations.len() > 1 {
        say!(
            "  demonstrations: {:.4} m from their mean in proportional time, {:.4} m aligned",
            spread_m.0,
            spread_m.1
        );
    }
    say!("saved to {}", path.display());
    Ok(())
}

pub(crate) fn inspect(args: &InspectArgs) -> anyhow::Result<()> {
    let skill = skill_file::load(&args.file)?;
    describe(&skill);
    for source in &skill.provenance().sources {
        let [a, b, c, d, ..] = source.sha256;
        say!(
            "  from {} (sha256 {a:02x}{b:02x}{c:02x}{d:02x}…)",
            source.name
        );
    }
    let gmr = Gmr::<1, 3>::new(skill.motion())?;
    say!("inferred motion (t s, x y z m, deviation of each m):");
    for i in 0..=10 {
        let t_s = skill.duration_s() * f64::from(i) / 10.0;
        let at = gmr.query(&SVector::from([t_s]));
        let deviation = at.covariance.diagonal().map(f64::sqrt);
        say!(
            "  {t_s:7.3}  {:8.4} {:8.4} {:8.4}   ± {:.4} {:.4} {:.4}",
            at.mean.x,
            at.mean.y,
            at.mean.z,
            deviation.x,
            deviation.y,
            deviation.z
        );
    }
    Ok(())
}

fn describe(skill: &Skill) {
    let (stats, predictor) = (skill.stats(), skill.predictor());
    say!(
        "{} ({}), {} bytes",
        skill.name(),
        skill.id(),
        skill.to_bytes().len()
    );
    say!(
        "  motion: {:.3} s, {} components over (t, x, y, z)",
        skill.duration_s(),
        skill.motion().components().len()
    );
    let pace = |p| skill.pace().quantile_s(p).unwrap_or(f64::NAN);
    say!(
        "  pace: performed in {:.3} s, nine times of ten in {:.3} to {:.3} s",
        pace(0.5),
        pace(0.05),
        pace(0.95)
    );
    say!(
        "  predictor: {} components over the hand's state, {} knots to {:.2} s",
        predictor.components().len(),
        predictor.knots(),
        predictor.knots() as f64 * telemime_protocol::predict::KNOT_SPACING_S
    );
    say!(
        "  hand: 95 % of speeds below {:.2} m/s, of accelerations below {:.1} m/s²; reach {:.3} m",
        stats.speed95_m_s,
        stats.acceleration95_m_s2,
        stats.reach_m
    );
}
