//! `telemime learn` and `telemime inspect`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};
use telemime_operator::demonstration::{Demonstration, Demonstrations};
use telemime_operator::learn::{LearnOptions, Progress, learn_skill, refine};
use telemime_operator::placed::{Motion, Placed};
use telemime_operator::skill_file;
use telemime_protocol::skill::Skill;

use crate::cli::plural;
use crate::figure;
use crate::picture::{self, Subject};

/// Learn a skill from a folder of demonstrations (CSV: t,x,y,z; one file each) and save it.
///
/// With --update, refine a saved skill by further demonstrations, without those it was learned from.
#[derive(clap::Args, Debug)]
pub(crate) struct LearnArgs {
    /// The folder; its name becomes the skill's. With --update, folders or files to refine it by.
    #[arg(value_name = "DIR", required = true)]
    dirs: Vec<PathBuf>,
    /// Where to save the skill [default: NAME.skill; with --update, the file that is refined].
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Only the files whose names match this pattern (* stands for anything).
    #[arg(long = "match", value_name = "PATTERN")]
    matching: Option<String>,
    /// Learn the motion relative to these frames too, so that they can be moved when it is played: start and goal are where
    /// a recording begins and ends; others are where its lines `# frame NAME x y z [qw qx qy qz]` say.
    #[arg(
        long,
        value_name = "NAME,…",
        value_delimiter = ',',
        conflicts_with = "update"
    )]
    frames: Vec<String>,
    /// The same motion by other people, same format: where the own demonstrations have nothing to say, the predictor leans
    /// on what these have in common with them. Own recordings found there are passed over.
    #[arg(long, value_name = "DIR", conflicts_with = "update")]
    others: Option<PathBuf>,
    /// Refine this skill; each new demonstration weighs as much as each it was learned from.
    #[arg(long, value_name = "SKILL")]
    update: Option<PathBuf>,
    /// Seed of every random choice.
    #[arg(long, default_value_t = 0, conflicts_with = "update")]
    seed: u64,
    /// Draw what was learned: demonstrations, Gaussians, inferred motion and its region (.svg or .png).
    #[arg(long, value_name = "FILE", conflicts_with = "update")]
    figure: Option<PathBuf>,
    /// Print one JSON object instead, as `inspect --json` does.
    #[arg(long)]
    json: bool,
}

/// A frame that was less than this about its usual place shows nothing of what moves with it, root mean square, m.
const LEAST_SPREAD_M: f64 = 0.01;

/// Show what a saved skill holds.
#[derive(clap::Args, Debug)]
pub(crate) struct InspectArgs {
    /// The skill file.
    file: PathBuf,
    /// Show the motion with this frame placed anew, m in the recordings' axes; may be repeated.
    #[arg(long, value_name = "NAME=x,y,z[,qw,qx,qy,qz]")]
    frame: Vec<Placed>,
    /// Draw it: Gaussians, inferred motion and its region (.svg or .png).
    #[arg(long, value_name = "FILE")]
    figure: Option<PathBuf>,
    /// Draw the demonstrations too: the folder it was learned from.
    #[arg(long, value_name = "DIR", requires = "figure")]
    demos: Option<PathBuf>,
    /// Draw this recording too, to compare with.
    #[arg(long, value_name = "FILE", requires = "figure")]
    truth: Option<PathBuf>,
    /// Share of performances that the region drawn is to hold.
    #[arg(long, value_name = "P", default_value_t = 0.95, value_parser = share)]
    confidence: f64,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

fn share(text: &str) -> Result<f64, String> {
    let share = text.parse::<f64>().ok().filter(|p| (0.0..1.0).contains(p));
    share.ok_or_else(|| format!("`{text}` is not a share from 0 to below 1"))
}

/// The recordings in `dir` that are not among the own ones.
fn others(dir: &Path, own: &[Demonstration]) -> anyhow::Result<Vec<Demonstration>> {
    let mut found = Demonstrations::read_dir(dir, None)?;
    let is_own = |d: &Demonstration| own.iter().any(|own| own.sha256() == d.sha256());
    found.demonstrations.retain(|d| !is_own(d));
    if found.demonstrations.is_empty() {
        bail!(
            "{}: nothing but the own recordings; give a folder of other people's, or leave out --others",
            dir.display()
        );
    }
    Ok(found.demonstrations)
}

pub(crate) fn learn(args: &LearnArgs) -> anyhow::Result<()> {
    if let Some(old) = &args.update {
        return update(args, old);
    }
    let [dir] = args.dirs.as_slice() else {
        bail!("one folder makes one skill; with --update several refine one");
    };
    if let Some(drawing) = &args.figure {
        figure::check(drawing)?;
    }
    let found = Demonstrations::read_dir(dir, args.matching.as_deref())?;
    found
        .notices
        .iter()
        .for_each(|notice| eprintln!("note: {notice}"));
    let others = match &args.others {
        Some(dir) => others(dir, &found.demonstrations)?,
        None => Vec::new(),
    };
    let options = LearnOptions {
        seed: args.seed,
        frames: args.frames.clone(),
        others,
        ..LearnOptions::default()
    };
    let bar = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}") {
        bar.set_style(style);
    }
    let mut degenerate = Vec::new();
    let mut still = Vec::new();
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
        if let Progress::Frame { name, spread_m, .. } = &progress
            && *spread_m < LEAST_SPREAD_M
        {
            still.push((name.clone(), *spread_m));
        }
        bar.set_message(match progress {
            Progress::Aligned { medoid, .. } => format!("aligned to {medoid}"),
            Progress::Candidate(candidate) => format!("motion: {candidate:?}"),
            Progress::Motion { components, .. } => format!("motion: {components} components"),
            Progress::Frame { name, .. } => format!("motion as seen from {name}"),
            Progress::Held { done, of } => format!("calibrating, {done} of {of}"),
            Progress::Predictor { components, .. } => format!("predictor: {components} components"),
        });
        bar.tick();
    })?;
    bar.finish_and_clear();
    for what in degenerate {
        eprintln!("note: the motion's mixture over (t, x, y, z): {what}");
    }
    for (name, spread_m) in still {
        eprintln!(
            "note: frame {name} was within {:.0} mm of one place: what moves with it is a guess; demonstrate with it elsewhere",
            spread_m * 1e3
        );
    }
    let path = args
        .output
        .clone()
        .unwrap_or_else(|| PathBuf::from(format!("{}.skill", skill.name())));
    skill_file::save(&skill, &path)?;
    let motion = Motion::new(&skill, &[])?;
    if let Some(figure) = &args.figure {
        let subject = Subject {
            skill: &skill,
            motion: &motion,
            demonstrations: &found.demonstrations,
            truth: None,
            confidence: 0.95,
        };
        picture::figure(&subject)?.write(figure)?;
        eprintln!("drawn in {}", figure.display());
    }
    if args.json {
        say!("{}", serde_json::to_string(&told(&skill, &motion))?);
        return Ok(());
    }
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

/// `telemime learn --update`: each demonstration in turn, and then one file, whole.
fn update(args: &LearnArgs, old: &Path) -> anyhow::Result<()> {
    let mut skill = skill_file::load(old)?;
    let mut demonstrations = Vec::new();
    for path in &args.dirs {
        if path.is_dir() {
            let found = Demonstrations::read_dir(path, args.matching.as_deref())?;
            demonstrations.extend(found.demonstrations);
        } else {
            demonstrations.push(Demonstration::read_csv(path)?);
        }
    }
    for d in &demonstrations {
        d.notices()
            .iter()
            .for_each(|notice| eprintln!("note: {notice}"));
        let (refined, what) =
            refine(&skill, d).with_context(|| format!("{} is unchanged", old.display()))?;
        if what.is_unlike() {
            eprintln!(
                "note: {} is unlike what {} has seen: {:.0} % of it is newer than 90 % of a usual performance; if it is another gesture, learn it as a skill of its own",
                what.name,
                skill.name(),
                what.novel * 100.0
            );
        }
        for ignored in what.ignored {
            eprintln!(
                "note: {} has {ignored}, which {} was not taught: it is not learned",
                what.name,
                skill.name()
            );
        }
        skill = refined;
    }
    let path = args.output.as_deref().unwrap_or(old);
    skill_file::save(&skill, path)?;
    if args.json {
        let motion = Motion::new(&skill, &[])?;
        say!("{}", serde_json::to_string(&told(&skill, &motion))?);
        return Ok(());
    }
    describe(&skill);
    say!(
        "refined by {}, saved to {}",
        plural(demonstrations.len(), "demonstration", "demonstrations"),
        path.display()
    );
    Ok(())
}

pub(crate) fn inspect(args: &InspectArgs) -> anyhow::Result<()> {
    let skill = skill_file::load(&args.file)?;
    let motion = Motion::new(&skill, &args.frame)?;
    if let Some(figure) = &args.figure {
        let demonstrations = match &args.demos {
            Some(dir) => picture::learned_from(&skill, dir)?,
            None => Vec::new(),
        };
        let truth = args
            .truth
            .as_ref()
            .map(Demonstration::read_csv)
            .transpose()?;
        let subject = Subject {
            skill: &skill,
            motion: &motion,
            demonstrations: &demonstrations,
            truth: truth.as_ref(),
            confidence: args.confidence,
        };
        picture::figure(&subject)?.write(figure)?;
        eprintln!("drawn in {}", figure.display());
    }
    if args.json {
        say!("{}", serde_json::to_string(&told(&skill, &motion))?);
        return Ok(());
    }
    describe(&skill);
    for source in &skill.provenance().sources {
        let [a, b, c, d, ..] = source.sha256;
        say!(
            "  from {} (sha256 {a:02x}{b:02x}{c:02x}{d:02x}…)",
            source.name
        );
    }
    say!("inferred motion (t s, x y z m, deviation of each m):");
    for i in 0..=10 {
        let t_s = skill.duration_s() * f64::from(i) / 10.0;
        let at = motion.at(t_s);
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

/// What `inspect --json` prints; `docs/commands.md` describes it.
fn told(skill: &Skill, motion: &Motion) -> serde_json::Value {
    let stats = skill.stats();
    let sources = skill.provenance().sources.iter();
    let hex = |bytes: &[u8]| bytes.iter().map(|b| format!("{b:02x}")).collect::<String>();
    let motion: Vec<_> = (0..=100)
        .map(|i| {
            let t_s = skill.duration_s() * f64::from(i) / 100.0;
            let at = motion.at(t_s);
            let covariance: Vec<Vec<f64>> = at
                .covariance
                .row_iter()
                .map(|row| row.iter().copied().collect())
                .collect();
            let q = motion.turn_at(t_s).map(|q| [q.w, q.i, q.j, q.k]);
            serde_json::json!({
                "t_s": t_s,
                "x_m": at.mean.as_slice(),
                "covariance_m2": covariance,
                "q": q,
            })
        })
        .collect();
    let frames = skill.task().map_or(&[][..], |task| task.frames());
    serde_json::json!({
        "name": skill.name(),
        "id": skill.id().to_string(),
        "bytes": skill.to_bytes().len(),
        "duration_s": skill.duration_s(),
        "pace": skill.pace(),
        "motion_components": skill.motion().components().len(),
        "predictor_components": skill.predictor().components().len(),
        "predictor_knots": skill.predictor().knots(),
        "orientation": skill.turn().is_some(),
        "gripper": skill.grip().is_some(),
        "frames": frames.iter().map(|f| f.name.clone()).collect::<Vec<_>>(),
        "stats": stats,
        "producer": skill.provenance().producer,
        "seed": skill.provenance().seed,
        "sources": sources
            .map(|s| serde_json::json!({"name": s.name, "sha256": hex(&s.sha256)}))
            .collect::<Vec<_>>(),
        "motion": motion,
    })
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
    if let Some(turn) = skill.turn() {
        say!(
            "  orientation: {} components over (t, rotation); predictor of {}",
            turn.motion.charts().len(),
            turn.predictor.charts().len()
        );
    }
    if let Some(grip) = skill.grip() {
        say!(
            "  gripper: {} components over (t, opening)",
            grip.components().len()
        );
    }
    for frame in skill.task().iter().flat_map(|task| task.frames()) {
        let (o, q) = (frame.usual.origin, frame.usual.turn);
        say!(
            "  frame {}: {} components; usually at {:.3} {:.3} {:.3} m, turned {:.3} {:.3} {:.3} {:.3} (w x y z)",
            frame.name,
            frame.motion.components().len(),
            o.x,
            o.y,
            o.z,
            q.w,
            q.i,
            q.j,
            q.k
        );
    }
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
