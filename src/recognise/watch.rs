//! `telemime recognise`.

use std::path::PathBuf;

use anyhow::bail;
use serde::Serialize;
use telemime_operator::demonstration::Demonstration;
use telemime_operator::learn::predictor::states;
use telemime_operator::recognise::{Recogniser, Recognition, Verdict};
use telemime_operator::skill_file;
use telemime_protocol::skill::Skill;

use super::Tuning;
use super::list::skill_files;

/// Say which skill a recording shows, moment by moment, or that it is none of them.
///
/// The recording is given to the recogniser sample by sample, as a live hand would be: no answer knows what comes after it.
#[derive(clap::Args, Debug)]
pub(crate) struct RecogniseArgs {
    /// The recording (CSV: t,x,y,z).
    recording: PathBuf,
    /// The skills to choose from: a folder of *.skill, or one file; may be repeated.
    #[arg(long, value_name = "DIR|FILE", required = true)]
    skills: Vec<PathBuf>,
    #[command(flatten)]
    tuning: Tuning,
    /// Every sample's answer as one line of JSON, instead of the stretches in which the answer stays the same.
    #[arg(long)]
    json: bool,
}

/// The answer to one sample, for machines.
#[derive(Debug, Serialize)]
struct Line<'a> {
    t_s: f64,
    verdict: &'static str,
    /// The skill recognised; null with every other verdict.
    skill: Option<&'a str>,
    best: Option<&'a str>,
    probability: f64,
    none: f64,
    phase: f64,
    phase_sd: f64,
    /// Null without skills.
    novelty: Option<f64>,
}

/// Samples in a row with the same verdict.
struct Stretch {
    from_s: f64,
    to_s: f64,
    first: Recognition,
    last: Recognition,
    least_probability: f64,
    most_novel: f64,
}

pub(crate) fn recognise(args: &RecogniseArgs) -> anyhow::Result<()> {
    let files = skill_files(&args.skills)?;
    if files.is_empty() {
        bail!("no *.skill in what --skills names: telemime learn DIR makes one");
    }
    let skills: Vec<Skill> = files
        .iter()
        .map(skill_file::load)
        .collect::<Result<_, _>>()?;
    let recording = Demonstration::read_csv(&args.recording)?;
    for skill in &skills {
        if skill.was_trained_on(recording.sha256()) {
            eprintln!(
                "note: {} was learned from this very recording: of course it fits",
                skill.name()
            );
        }
    }
    let mut recogniser = Recogniser::new(&skills, args.tuning.options())?;
    let name = |i: usize| skills[i].name();
    let mut stretches: Vec<Stretch> = Vec::new();
    for (state, sample) in states(&recording).zip(recording.samples()) {
        let Some(r) = recogniser.take(&state) else {
            continue;
        };
        if args.json {
            let line = line(&r, sample.t_s, &name);
            say!("{}", serde_json::to_string(&line)?);
            continue;
        }
        match stretches.last_mut() {
            Some(s) if s.last.verdict == r.verdict => {
                s.to_s = sample.t_s;
                s.last = r;
                s.least_probability = s.least_probability.min(r.probability);
                s.most_novel = s.most_novel.max(r.novelty);
            }
            _ => stretches.push(Stretch {
                from_s: sample.t_s,
                to_s: sample.t_s,
                first: r,
                last: r,
                least_probability: r.probability,
                most_novel: r.novelty,
            }),
        }
    }
    if !args.json {
        show(&recording, &stretches, &name);
    }
    Ok(())
}

fn line<'a>(r: &Recognition, t_s: f64, name: &impl Fn(usize) -> &'a str) -> Line<'a> {
    let (verdict, skill) = match r.verdict {
        Verdict::Resting => ("resting", None),
        Verdict::Unknown => ("unknown", None),
        Verdict::Undecided => ("undecided", None),
        Verdict::Skill(i) => ("skill", Some(name(i))),
    };
    Line {
        t_s,
        verdict,
        skill,
        best: r.best.map(name),
        probability: r.probability,
        none: r.none,
        phase: r.phase,
        phase_sd: r.phase_sd,
        novelty: r.novelty.is_finite().then_some(r.novelty),
    }
}

fn show<'a>(recording: &Demonstration, stretches: &[Stretch], name: &impl Fn(usize) -> &'a str) {
    say!(
        "{}: {:.3} s, {} samples",
        recording.name(),
        recording.duration_s(),
        recording.samples().len()
    );
    let percent = |p: f64| format!("{:.0} %", 100.0 * p);
    let width = stretches
        .iter()
        .map(|s| match s.last.verdict {
            Verdict::Skill(i) => name(i).chars().count(),
            _ => "none of these".len(),
        })
        .max()
        .unwrap_or(0);
    for s in stretches {
        let (what, detail) = match s.last.verdict {
            Verdict::Resting => ("at rest", String::new()),
            Verdict::Undecided => (
                "undecided",
                format!("most like {}", s.last.best.map_or("nothing", name)),
            ),
            Verdict::Unknown => {
                let like = s.last.best.map_or("nothing", name);
                (
                    "none of these",
                    format!("nearest {like}, novelty up to {:.1}", s.most_novel),
                )
            }
            Verdict::Skill(i) => (
                name(i),
                format!(
                    "phase {} to {}, probability {} or more",
                    percent(s.first.phase),
                    percent(s.last.phase),
                    percent(s.least_probability)
                ),
            ),
        };
        let text = format!(
            "  {:8.3} to {:8.3} s  {what:width$}  {detail}",
            s.from_s, s.to_s
        );
        say!("{}", text.trim_end());
    }
}
