//! `telemime select`: which mixture tells a motion best.

use std::ops::RangeInclusive;
use std::path::PathBuf;

use indicatif::{ProgressBar, ProgressStyle};
use nalgebra::{Vector3, Vector4};
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use serde::Serialize;
use telemime_operator::demonstration::Demonstrations;
use telemime_operator::learn::compare::{CompareOptions, Criterion, Kind, Row, Table, compare};
use telemime_operator::learn::{align, em::Covariance, motion};
use telemime_protocol::skill::MAX_COMPONENTS;

/// Compare mixtures for a folder of demonstrations: kinds, numbers of components, criteria.
///
/// Joint over (t, x, y, z) or one for each dimension over (t, x_d); full, tied or diagonal covariances;
/// by EM or variational. For each kind the number of components by BIC, by AIC, by the likelihood of
/// demonstrations left out in turn, and by the rule of `telemime learn`; `*` marks the best of a column.
#[derive(clap::Args, Debug)]
pub(crate) struct Args {
    /// The folder (CSV: t,x,y,z; one file each).
    #[arg(required_unless_present = "function", conflicts_with = "function")]
    dir: Option<PathBuf>,
    /// Instead of a folder: eight noisy performances of a known function f: R → R³ (a trefoil), so that
    /// the distance to the truth can be shown.
    #[arg(long)]
    function: bool,
    /// Only the files whose names match this pattern (* stands for anything).
    #[arg(long = "match", value_name = "PATTERN", conflicts_with = "function")]
    matching: Option<String>,
    /// Numbers of components to try.
    #[arg(long, value_name = "FROM..TO", default_value = "1..15", value_parser = range)]
    components: RangeInclusive<usize>,
    /// Print every kind with every number of components, not only those chosen.
    #[arg(long)]
    all: bool,
    /// Seed of every random choice.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print one JSON object to stdout, everything else to stderr.
    #[arg(long)]
    json: bool,
}

fn range(text: &str) -> Result<RangeInclusive<usize>, String> {
    let (from, to) = text.split_once("..").unwrap_or((text, text));
    let number = |t: &str| {
        let t = t.strip_prefix('=').unwrap_or(t);
        t.parse::<usize>()
            .map_err(|_| format!("{t:?} is not a number; write FROM..TO, for example 1..15"))
    };
    let (from, to) = (number(from)?, number(to)?);
    if from == 0 || from > to || to > MAX_COMPONENTS {
        return Err(format!(
            "{from}..{to}: numbers of components ascend and lie in 1..{MAX_COMPONENTS}"
        ));
    }
    Ok(from..=to)
}

/// What is compared.
struct Subject {
    name: String,
    rows: Vec<Vec<Vector4<f64>>>,
    truth: Option<Vec<(f64, Vector3<f64>)>>,
}

/// The JSON object.
#[derive(Serialize)]
struct Report<'a> {
    name: &'a str,
    #[serde(flatten)]
    table: &'a Table,
    chosen: Vec<Chosen<'a>>,
}

#[derive(Serialize)]
struct Chosen<'a> {
    #[serde(flatten)]
    kind: Kind,
    bic: Option<&'a Row>,
    aic: Option<&'a Row>,
    held_out: Option<&'a Row>,
    regression: Option<&'a Row>,
}

/// Runs `telemime select`.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let subject = match &args.dir {
        Some(dir) => from_folder(dir, args.matching.as_deref())?,
        None => trefoil(args.seed),
    };
    let jobs = Kind::all().len() * args.components.clone().count();
    let bar = ProgressBar::new(jobs as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {pos}/{len} {msg}") {
        bar.set_style(style);
    }
    let options = CompareOptions {
        components: args.components.clone(),
        seed: args.seed,
        truth: subject.truth.as_deref(),
    };
    let table = compare(&subject.rows, &options, |row| {
        bar.set_message(format!("{}, K = {}", row.kind, row.components));
        bar.inc(1);
    });
    bar.finish_and_clear();
    let table = table?;
    let text = text(&subject.name, &table, args.all);
    if args.json {
        eprint!("{text}");
        let chosen = Kind::all()
            .into_iter()
            .map(|kind| {
                let best = |criterion| table.best(criterion, Some(kind));
                Chosen {
                    kind,
                    bic: best(Criterion::Bic),
                    aic: best(Criterion::Aic),
                    held_out: best(Criterion::HeldOut),
                    regression: best(Criterion::Regression),
                }
            })
            .collect();
        let report = Report {
            name: &subject.name,
            table: &table,
            chosen,
        };
        say!("{}", serde_json::to_string(&report)?);
    } else {
        say!("{}", text.trim_end());
    }
    Ok(())
}

fn from_folder(dir: &std::path::Path, matching: Option<&str>) -> anyhow::Result<Subject> {
    let found = Demonstrations::read_dir(dir, matching)?;
    found
        .notices
        .iter()
        .for_each(|notice| eprintln!("note: {notice}"));
    let aligned = align::align(&found.demonstrations)?;
    Ok(Subject {
        name: found.name,
        rows: motion::rows(&aligned),
        truth: None,
    })
}

/// Eight performances of a trefoil of 0.5 m in 4 s, each with a size of its own and 5 mm of noise.
fn trefoil(seed: u64) -> Subject {
    const SAMPLES: u32 = 100;
    let at = |t_s: f64| {
        let a = std::f64::consts::TAU * t_s / 4.0;
        Vector3::new(
            0.17 * (a.sin() + 2.0 * (2.0 * a).sin()) / 3.0 * 1.5,
            0.17 * (a.cos() - 2.0 * (2.0 * a).cos()) / 3.0 * 1.5,
            -0.1 * (3.0 * a).sin(),
        )
    };
    let times = || (0..SAMPLES).map(|i| 4.0 * f64::from(i) / f64::from(SAMPLES - 1));
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let rows = (0..8)
        .map(|_| {
            let size = 1.0 + 0.1 * (rng.random::<f64>() - 0.5);
            times()
                .map(|t_s| {
                    // A sum of four has nearly the shape of a normal distribution.
                    let mut noise = || {
                        0.005
                            * 3.0_f64.sqrt()
                            * ((0..4).map(|_| rng.random::<f64>()).sum::<f64>() - 2.0)
                    };
                    let x = at(t_s) * size + Vector3::from_fn(|_, _| noise());
                    Vector4::new(t_s, x.x, x.y, x.z)
                })
                .collect()
        })
        .collect();
    Subject {
        name: "trefoil, f: R → R³".into(),
        rows,
        truth: Some(times().map(|t_s| (t_s, at(t_s))).collect()),
    }
}

const TITLES: [&str; 4] = ["BIC", "AIC", "held out", "regression"];

fn value(criterion: Criterion, row: &Row) -> String {
    match criterion {
        Criterion::Bic => format!("{:.0}", row.bic),
        Criterion::Aic => format!("{:.0}", row.aic),
        Criterion::HeldOut => row.held_out.map_or("–".into(), |v| format!("{v:.3}")),
        Criterion::Regression => format!("{:.0}", row.regression),
    }
}

fn is(a: Option<&Row>, b: &Row) -> bool {
    a.is_some_and(|a| a.kind == b.kind && a.components == b.components)
}

fn text(name: &str, table: &Table, all: bool) -> String {
    let mut out = format!(
        "{name}: {} demonstrations, {} samples of (t s, x y z m)\n",
        table.demonstrations, table.samples
    );
    let truth = table.rows.iter().any(|row| row.rmse_m.is_some());
    let width = 41;
    let mut line = |cells: Vec<String>| {
        let (first, rest) = cells.split_first().expect("a line has a first cell");
        let mut line = format!("{first:<width$}");
        rest.iter().for_each(|cell| line += &format!("{cell:>14}"));
        out.push_str(line.trim_end());
        out.push('\n');
    };
    let star = |criterion, row: &Row| {
        if is(table.best(criterion, None), row) {
            "*"
        } else {
            " "
        }
    };
    if all {
        let mut titles = vec![
            "mixture".to_owned(),
            "K".into(),
            "used".into(),
            "numbers".into(),
            "ln L/N".into(),
        ];
        titles.extend(TITLES.map(str::to_owned));
        if truth {
            titles.push("to truth, mm".into());
        }
        line(titles);
        for row in &table.rows {
            let mut cells = vec![
                row.kind.to_string(),
                row.components.to_string(),
                row.effective.to_string(),
                row.parameters.to_string(),
                format!("{:.3}", row.score),
            ];
            for criterion in Criterion::ALL {
                cells.push(format!("{}{}", value(criterion, row), star(criterion, row)));
            }
            if let Some(rmse_m) = row.rmse_m {
                cells.push(format!("{:.2}", rmse_m * 1e3));
            }
            line(cells);
        }
    } else {
        let mut titles = vec!["mixture: K, and the criterion's value".to_owned()];
        titles.extend(TITLES.map(|title| format!("{title} ")));
        if truth {
            titles.push("to truth, mm".into());
        }
        line(titles);
        for kind in Kind::all() {
            let mut cells = vec![kind.to_string()];
            for criterion in Criterion::ALL {
                cells.push(table.best(criterion, Some(kind)).map_or("–".into(), |row| {
                    let value = value(criterion, row);
                    format!("{}: {value}{}", row.components, star(criterion, row))
                }));
            }
            let shown = table.best(Criterion::HeldOut, Some(kind));
            if let Some(rmse_m) = shown.and_then(|row| row.rmse_m) {
                cells.push(format!("{:.2}", rmse_m * 1e3));
            }
            line(cells);
        }
    }
    let full = Kind {
        covariance: Covariance::Full,
        ..Kind::all()[0]
    };
    if let Some(row) = table.best(Criterion::Regression, Some(full)) {
        out.push_str(&format!(
            "telemime learn takes `{full}` by the last column (here K = {}): it judges the motion to be played, while a\n\
             density is content with the places a hand keeps returning to. It searches up to 64 components.\n",
            row.components
        ));
    }
    out.push_str("BIC, AIC, regression: lower is better; held out (nats a sample): higher is.");
    if truth {
        out.push_str(" To truth: of the one by held out.");
    }
    out.push('\n');
    let last = table.rows.iter().map(|row| row.components).max();
    let at_end = |criterion: &Criterion| {
        let best = table.best(*criterion, None);
        best.is_some_and(|row| Some(row.components) == last)
    };
    if let Some(last) = last.filter(|last| *last < MAX_COMPONENTS)
        && Criterion::ALL.iter().any(at_end)
    {
        out.push_str(&format!(
            "{last} is the last number tried and the best by some column: more may be better, try --components 1..{}.\n",
            (2 * last).min(MAX_COMPONENTS)
        ));
    }
    let degenerate = table.rows.iter().filter(|row| !row.degenerate.is_empty());
    let degenerate = degenerate.count();
    if degenerate > 0 {
        out.push_str(&format!(
            "{degenerate} of {} fits met data that could not say all (empty components, floors): --json lists them.\n",
            table.rows.len()
        ));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_read_and_refused() {
        assert_eq!(range("1..15"), Ok(1..=15));
        assert_eq!(range("3..=4"), Ok(3..=4));
        assert_eq!(range("7"), Ok(7..=7));
        for bad in ["0..3", "5..2", "1..65", "a..b", "", ".."] {
            assert!(range(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_known_function_is_found_by_a_mixture_of_enough_components() {
        let subject = trefoil(1);
        let options = CompareOptions {
            components: 5..=6,
            seed: 1,
            truth: subject.truth.as_deref(),
        };
        let table = compare(&subject.rows[..3], &options, |_| ()).unwrap();
        assert_eq!(table.rows.len(), 2 * Kind::all().len());
        for row in &table.rows {
            assert!(row.score.is_finite() && row.held_out.is_some() && row.rmse_m.is_some());
        }
        let best = table.best(Criterion::HeldOut, None).unwrap();
        assert!(best.rmse_m.unwrap() < 0.04, "{best:?}");
        let text = text("x", &table, false);
        assert_eq!(text.matches('*').count(), 4, "{text}");
    }
}
