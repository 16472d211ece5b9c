//! `telemime confusion`.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use clap::ValueEnum;
use indicatif::ProgressBar;
use telemime_operator::demonstration::{Demonstration, Demonstrations, PersonPattern};
use telemime_operator::learn::LearnOptions;
use telemime_operator::recognise::trial::{self, ONSET_M, Report, Split, TrialOptions};

use super::Tuning;

/// When else recognition is asked, s after the onset.
const ALSO_AT_S: [f64; 5] = [0.0, 0.3, 0.5, 1.0, 1.5];

/// Try recognition on demonstrations held out: which skills are confused, what is refused.
///
/// Each folder is one skill. Every demonstration is performed twice: before skills that were learned without it, and before those without
/// its own skill, to whom it is unknown.
#[derive(clap::Args, Debug)]
pub(crate) struct ConfusionArgs {
    /// Folders of demonstrations, one a skill; two or more.
    #[arg(required = true, num_args = 1..)]
    dirs: Vec<PathBuf>,
    /// A folder of recordings of motion that none of the skills knows; may be repeated.
    #[arg(long, value_name = "DIR")]
    unknown: Vec<PathBuf>,
    /// When to judge, s after the hand has left its place by 5 cm.
    #[arg(long, value_name = "S", default_value_t = 0.7)]
    at: f64,
    /// What is held out of learning.
    #[arg(long, value_enum, default_value_t = Hold::Demonstrations)]
    split: Hold,
    /// Rounds of `--split demonstrations`; one in so many demonstrations is held out.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u8).range(2..))]
    folds: u8,
    /// Where file names hold the person: {} stands for the name, * for anything.
    #[arg(long, value_name = "PATTERN", default_value_t)]
    group_by: PersonPattern,
    #[command(flatten)]
    tuning: Tuning,
    /// Seed of every random choice in learning.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

#[derive(ValueEnum, Debug, Clone, Copy, PartialEq)]
enum Hold {
    /// Whole demonstrations, every N-th: people are known, performances new.
    Demonstrations,
    /// All a person does (see --group-by): people are new.
    Persons,
    /// One performance; skills are learned from that person's others alone.
    Own,
}

pub(crate) fn confusion(args: &ConfusionArgs) -> anyhow::Result<()> {
    let mut sets = Vec::new();
    for dir in &args.dirs {
        sets.push(Demonstrations::read_dir(dir, None)?);
    }
    let mut strangers: Vec<Demonstration> = Vec::new();
    for dir in &args.unknown {
        strangers.extend(Demonstrations::read_dir(dir, None)?.demonstrations);
    }
    let also_at_s = ALSO_AT_S.iter().copied().filter(|s| *s != args.at);
    let options = TrialOptions {
        recognise: args.tuning.options(),
        learn: LearnOptions {
            seed: args.seed,
            ..LearnOptions::default()
        },
        split: match args.split {
            Hold::Demonstrations => Split::Demonstrations {
                folds: usize::from(args.folds),
            },
            Hold::Persons => Split::Persons,
            Hold::Own => Split::Own,
        },
        persons: args.group_by.clone(),
        at_s: args.at,
        also_at_s: also_at_s.collect(),
    };
    let bar = ProgressBar::new_spinner();
    bar.set_message("aligning");
    let done = AtomicUsize::new(0);
    let report = trial::run(&sets, &strangers, &options, |more, of| {
        let done = done.fetch_add(more, Ordering::Relaxed) + more;
        bar.set_message(format!("round {done} of {of}"));
        bar.tick();
    });
    bar.finish_and_clear();
    let report = report?;
    if args.json {
        say!("{}", serde_json::to_string(&report)?);
    } else {
        show(&report);
    }
    Ok(())
}

fn percent(share: Option<f64>) -> String {
    share.map_or_else(|| "–".to_owned(), |s| format!("{:.1} %", 100.0 * s))
}

fn show(report: &Report) {
    say!(
        "{} gestures judged {} s after the hand has moved {} cm ({} not: over before, or not moved); {} rounds of learning",
        report.judged,
        report.at_s,
        100.0 * ONSET_M,
        report.not_judged,
        report.rounds
    );
    let names = report.skills.iter().map(|s| s.name.chars().count());
    let width = names.max().unwrap_or(0);
    let cell = |n: usize| {
        if n == 0 {
            "·".to_owned()
        } else {
            n.to_string()
        }
    };
    let heads: String = (1..=report.skills.len())
        .map(|n| format!("{:>5}", format!("#{n}")))
        .collect();
    say!(
        "\n     {:width$}{heads}   none   none, when left out   phase ±",
        "performed \\ taken for"
    );
    for (n, s) in report.skills.iter().enumerate() {
        let row: String = s
            .taken_for
            .iter()
            .map(|&n| format!("{:>5}", cell(n)))
            .collect();
        say!(
            "{:>4} {:width$}{row}  {:>5}   {:>19}   {:>7}",
            format!("#{}", n + 1),
            s.name,
            cell(s.refused),
            percent(s.refused_left_out),
            percent(s.phase_error)
        );
    }
    let mut at: Vec<usize> = (0..report.best_right.len()).collect();
    at.sort_by(|&a, &b| report.best_right[a].0.total_cmp(&report.best_right[b].0));
    let row = |what: &str, of: &[(f64, Option<f64>)]| {
        let cells: String = at
            .iter()
            .map(|&i| format!("{:>9}", percent(of[i].1)))
            .collect();
        say!("{what:44}{cells}");
    };
    let heads: String = at
        .iter()
        .map(|&i| format!("{:>9}", format!("{} s", report.best_right[i].0)))
        .collect();
    say!("\n{:44}{heads}", "after the onset");
    row("best skill is right", &report.best_right);
    row("recognised: that skill is named", &report.recognised);
    row("known, but none is named", &report.refused_known);
    row(
        "left out of learning, and none is named",
        &report.refused_left_out,
    );
    if report.strangers > 0 {
        row("strangers, and none is named", &report.refused_strangers);
        say!(
            "strangers were taken for a known skill {} of the time they moved ({} recordings)",
            percent(report.strangers_time_accepted),
            report.strangers
        );
    }
    say!("\nother thresholds, at {} s:", report.at_s);
    for o in &report.roc {
        let strangers = match o.refused_strangers {
            Some(share) => format!(", {} of strangers", percent(Some(share))),
            None => String::new(),
        };
        say!(
            "  --reject-above {:<6.3} refuses {:>6} of known, {:>6} of left out{strangers}",
            o.reject_above,
            percent(Some(o.refused_known)),
            percent(o.refused_left_out)
        );
    }
    say!(
        "\nphase: off by {} of the skill's length on average",
        percent(report.phase_error)
    );
}
