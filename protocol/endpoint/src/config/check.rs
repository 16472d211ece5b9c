//! A daemon's settings looked at before it is started with them.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt::Write;
use std::path::PathBuf;

use clap::Args;
use clap::parser::ValueSource;
use serde::Serialize;
use toml::Value;

use super::layers::nested;
use super::{Layers, Origin, Place, Problem, Settings, render};
use crate::cli::{one_line, say};

/// Look at a configuration before a daemon is started with it: unknown keys, values that cannot be, and values that
/// cannot be together, each by its line and with what to do.
///
/// Exit code 0 if the daemon would take it, 2 if not.
#[derive(Args, Debug, Clone)]
pub struct CheckArgs {
    /// The TOML file.
    pub file: PathBuf,
    /// Print every setting with its value and where that comes from: flag, environment, file or default.
    #[arg(long)]
    pub explain: bool,
    /// Print one JSON object.
    #[arg(long)]
    pub json: bool,
    /// The daemon's own flags, as it will be started with them.
    #[arg(last = true, value_name = "FLAG")]
    pub flags: Vec<OsString>,
}

#[derive(Serialize)]
struct Report<'a> {
    file: &'a std::path::Path,
    ok: bool,
    problems: Vec<Wrong>,
    settings: Vec<Explained>,
}

#[derive(Serialize)]
struct Wrong {
    place: String,
    line: Option<usize>,
    text: String,
}

#[derive(Serialize)]
struct Explained {
    key: &'static str,
    value: Option<String>,
    origin: &'static str,
    at: Option<String>,
}

/// Checks a configuration and says what was found. Returns whether the daemon would take it.
///
/// # Errors
/// Flags that are none, or stdout's.
pub fn check<D: Settings>(
    args: &CheckArgs,
    environment: &[(String, String)],
) -> anyhow::Result<bool> {
    let sheet = D::sheet();
    let words = std::iter::once(OsString::from(sheet.daemon)).chain(args.flags.iter().cloned());
    let matches = render::command::<D>().try_get_matches_from(words)?;
    let flags = D::from_arg_matches(&matches)?;
    let layers = Layers::read::<D>(Some(&args.file), environment);
    let problems = judged(&flags, &layers, args);

    let mut given = BTreeMap::new();
    for arg in render::command::<D>().get_arguments() {
        let id = arg.get_id().as_str();
        if matches.value_source(id) == Some(ValueSource::CommandLine)
            && let Some(long) = arg.get_long()
        {
            let raw = matches.get_raw(id).into_iter().flatten();
            let raw: Vec<_> = raw.map(|v| v.to_string_lossy().into_owned()).collect();
            given.insert(long.to_owned(), raw.join(" "));
        }
    }
    let replaced = |key: &str| {
        let group = sheet.alternatives.iter().find(|group| group.contains(&key));
        let mut group = group.into_iter().flat_map(|group| group.iter());
        group.any(|other| {
            let flag = sheet.get(other).and_then(|setting| setting.flag);
            flag.is_some_and(|flag| given.contains_key(flag))
        })
    };
    let explained = sheet.settings.iter().map(|setting| {
        let flag = setting.flag.filter(|flag| given.contains_key(*flag));
        let below = layers
            .values
            .get(setting.key)
            .filter(|_| !replaced(setting.key));
        let (value, origin, at) = match (flag, below) {
            (Some(flag), _) => (Some(given[flag].clone()), "flag", Some(format!("--{flag}"))),
            (None, Some((value, Origin::Variable(name)))) => {
                (Some(value.to_string()), "environment", Some(name.clone()))
            }
            (None, Some((value, Origin::File(line)))) => {
                let at = Place::Line(args.file.clone(), *line).to_string();
                (Some(value.to_string()), "file", Some(at))
            }
            (None, None) => (setting.default.clone(), "default", None),
        };
        Explained {
            key: setting.key,
            value,
            origin,
            at,
        }
    });
    let explained: Vec<_> = explained.collect();
    let ok = problems.is_empty();
    if args.json {
        let wrong = |problem: &Problem| Wrong {
            place: problem.place.to_string(),
            line: match problem.place {
                Place::Line(_, line) => Some(line),
                _ => None,
            },
            text: problem.text.clone(),
        };
        say(&serde_json::to_string(&Report {
            file: &args.file,
            ok,
            problems: problems.iter().map(wrong).collect(),
            settings: if args.explain { explained } else { Vec::new() },
        })?)?;
        return Ok(ok);
    }
    let mut out = String::new();
    if args.explain {
        for Explained {
            key,
            value,
            origin,
            at,
        } in &explained
        {
            let value = value.as_deref().unwrap_or("found out at the start");
            let at = at.as_ref().map_or_else(String::new, |at| format!(" {at}"));
            let _ = writeln!(out, "{key} = {value}  # {origin}{at}");
        }
    }
    if ok {
        let set = layers.values.len();
        let _ = write!(
            out,
            "{}: ok, {set} set by file and environment",
            args.file.display()
        );
    }
    if !out.is_empty() {
        say(out.trim_end())?;
    }
    for problem in &problems {
        eprintln!("{problem}");
    }
    Ok(ok)
}

/// All that is wrong: what cannot be read, else each value that cannot be, else two that cannot be together, else the
/// whole.
fn judged<D: Settings>(flags: &D, layers: &Layers, args: &CheckArgs) -> Vec<Problem> {
    if !layers.problems.is_empty() {
        return layers.problems.clone();
    }
    let keys: Vec<_> = layers.values.keys().collect();
    let judge = |flags: &D, some: &[&String]| -> Result<(), String> {
        let values = some.iter().map(|key| (*key, &layers.values[*key].0));
        let settled = flags.clone().over(nested(values));
        let judged = settled.and_then(|settled| settled.judge());
        judged.map_err(|e| one_line(e.chain()))
    };
    let place = |key: &String| match &layers.values[key].1 {
        Origin::File(line) => Place::Line(args.file.clone(), *line),
        Origin::Variable(name) => Place::Variable(name.clone()),
    };
    let said = |key: &String| -> String {
        let value: &Value = &layers.values[key].0;
        format!("`{key} = {value}`")
    };
    let Err(whole) = judge(flags, &keys) else {
        let values = layers.values.iter().map(|(key, (value, _))| (key, value));
        let settled = flags.clone().over(nested(values));
        let rehearsed = settled.and_then(|settled| settled.rehearse());
        let wrong = |e: anyhow::Error| Problem {
            place: Place::Whole,
            text: one_line(e.chain()),
        };
        return rehearsed.map_err(wrong).err().into_iter().collect();
    };
    let mut problems: Vec<_> = keys
        .iter()
        .filter_map(|key| {
            let why = judge(&D::default(), &[key]).err()?;
            Some(Problem {
                place: place(key),
                text: format!("{}: {why}", said(key)),
            })
        })
        .collect();
    if !problems.is_empty() {
        return problems;
    }
    for (i, one) in keys.iter().enumerate() {
        for other in &keys[i + 1..] {
            if let Err(why) = judge(&D::default(), &[one, other]) {
                problems.push(Problem {
                    place: place(one),
                    text: format!(
                        "{} and {} ({}): {why}",
                        said(one),
                        said(other),
                        place(other)
                    ),
                });
            }
        }
    }
    if problems.is_empty() {
        problems.push(Problem {
            place: Place::Whole,
            text: whole,
        });
    }
    problems
}
