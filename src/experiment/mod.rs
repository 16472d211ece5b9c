//! `telemime experiment`: a plan's runs, on the virtual ground repeatable to the byte, or in real time.

mod baseline;
mod drive;
mod factor;
mod figures;
mod judge;
mod method;
mod plan;
mod plans;
mod real;
pub(crate) mod report;
mod row;
mod run;
mod store;
mod subject;
mod trace;

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context, bail};
use indicatif::{ProgressBar, ProgressStyle};

use method::Method;
use plan::Plan;
use real::Ground;
pub(crate) use real::Missing;
use run::{Timing, all, inputs, list, rigs};
use store::{Found, Host, Manifest, Store};

/// Where results go unless told otherwise.
const OUT: &str = "runs";

/// A plan's runs: both daemons on a virtual clock, and what they are held against, repeatable to the byte.
///
/// PLAN is a TOML file, or one of the ready plans (--list). Every run is the daemons' own sessions, codec, predictor, servo and
/// arm over real QUIC and the link model, or a baseline through the same link and arm. Runs that are done are kept: the same
/// command again goes on where it was interrupted. `telemime report DIR` shows the results.
#[derive(clap::Args, Debug)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: Option<What>,
    /// A file, or a ready plan.
    #[arg(required_unless_present_any = ["list", "print"])]
    plan: Option<String>,
    /// Where results go; nothing there is overwritten [default: runs/PLAN].
    #[arg(short, long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Only the I-th of N parts of the runs: for machines side by side.
    #[arg(long, value_name = "I/N", default_value_t)]
    shard: Shard,
    /// Where the daemons run; what they are held against is computed wherever that is.
    #[arg(long, value_enum, default_value_t)]
    ground: Ground,
    /// Of every list of link seeds only the first N: a look at a large plan.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    seeds: Option<u16>,
    /// Only the first N people.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    people: Option<u16>,
    /// Threads [default: all cores, in real time one]; on the virtual ground the results do not depend on it.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Say how many runs there are, and of what, and do none.
    #[arg(long)]
    dry_run: bool,
    /// List the ready plans, and every factor a plan may name.
    #[arg(long, conflicts_with = "json")]
    list: bool,
    /// Print a ready plan, to be changed.
    #[arg(long, value_name = "NAME")]
    print: Option<String>,
    /// Print one JSON object to stdout, everything else to stderr.
    #[arg(long)]
    json: bool,
}

#[derive(clap::Subcommand, Debug)]
enum What {
    /// Put the shards of one plan together: the same results as without shards.
    Merge(MergeArgs),
}

/// Put the shards of one plan together: the same results as without shards.
#[derive(clap::Args, Debug)]
struct MergeArgs {
    /// The shards' folders.
    #[arg(required = true, value_name = "DIR")]
    dirs: Vec<PathBuf>,
    /// A new folder for the whole.
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
}

/// A part of the runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Shard {
    /// From 1 on.
    part: usize,
    of: usize,
}

impl Default for Shard {
    fn default() -> Self {
        Self { part: 1, of: 1 }
    }
}

impl std::fmt::Display for Shard {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.part, self.of)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/');
        let numbers = parts.and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
        match numbers {
            Some((part, of)) if (1..=of).contains(&part) => Ok(Self { part, of }),
            _ => Err("write for example 2/5: the second of five".into()),
        }
    }
}

/// Runs `telemime experiment`.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    if let Some(What::Merge(merge)) = &args.what {
        let runs = store::merge(&merge.out, &merge.dirs)?;
        eprintln!("{runs} runs in {}", merge.out.display());
        return Ok(());
    }
    if args.list {
        say!("{}", plans::listed());
        return Ok(());
    }
    if let Some(name) = &args.print {
        let Some(text) = plans::ready(name) else {
            bail!("{name}: no such plan; --list names them");
        };
        say!("{}", text.trim_end());
        return Ok(());
    }
    let name = args.plan.as_deref().context("which plan?")?;
    let mut plan = read(name)?;
    let thinned = plan.thin(args.seeds.map(usize::from), args.people.map(usize::from));
    let ours = plan.cells.iter().map(|c| &c.settings);
    let ours = ours.filter(|s| s.method == Method::Ours);
    ours.clone().try_for_each(|s| args.ground.fits(s))?;
    args.ground.missing(ours)?;
    // Runs in real time must not take each other's.
    let threads = match (args.threads, args.ground) {
        (Some(n), _) => usize::from(n),
        (None, Ground::Virtual) => 0,
        (None, Ground::Loopback | Ground::Netns) => 1,
    };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()?;
    pool.install(|| execute(args, name, &plan, &thinned))
}

fn read(name: &str) -> anyhow::Result<Plan> {
    let path = Path::new(name);
    if !path.is_file()
        && let Some(text) = plans::ready(name)
    {
        return Ok(Plan::parse(name, text, Path::new("."))?);
    }
    let text = std::fs::read_to_string(path).with_context(|| {
        format!("{name}: neither a file nor a ready plan; `telemime experiment --list` names those")
    })?;
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    Ok(Plan::parse(name, &text, folder.unwrap_or(Path::new(".")))?)
}

fn execute(args: &Args, name: &str, plan: &Plan, thinned: &str) -> anyhow::Result<()> {
    let rigs = rigs(plan)?;
    let materials = subject::materials(plan)?;
    let skills = materials.len();
    let total = plan.cells.len() * skills;
    let Shard { part, of } = args.shard;
    let is_own = |number: usize| number % of == part % of;
    if args.dry_run {
        let here = (1..=total).filter(|&n| is_own(n)).count();
        let (title, settings) = (&plan.title, plan.cells.len());
        if args.json {
            say!(
                "{}",
                serde_json::json!({ "title": title, "runs": total, "here": here, "settings": settings, "skills": skills })
            );
        } else {
            say!("{title}: {total} runs, {here} here: {settings} settings, {skills} skills");
        }
        return Ok(());
    }
    let learned = AtomicUsize::new(0);
    let subjects = subject::subjects(materials, plan.seed, || {
        let n = learned.fetch_add(1, Ordering::Relaxed) + 1;
        eprintln!("learned {n} of {skills} skills");
    })?;
    let own = list(plan, &subjects)
        .into_iter()
        .filter(|run| is_own(run.number));
    let stem = Path::new(name).file_stem().unwrap_or_default();
    let out = args.out.clone().unwrap_or_else(|| {
        let mut folder = stem.to_owned();
        if args.ground != Ground::Virtual {
            folder.push(format!("-{}", args.ground));
        }
        if of > 1 {
            folder.push(format!("-{part}-of-{of}"));
        }
        Path::new(OUT).join(folder)
    });
    let own: Vec<_> = own.collect();
    let manifest = Manifest {
        title: plan.title.clone(),
        plan: Path::new(name)
            .file_name()
            .map_or_else(String::new, |n| n.to_string_lossy().into_owned()),
        plan_sha256: plan.hash(),
        seed: plan.seed,
        runs: total,
        ground: args.ground,
        thinned: thinned.to_owned(),
        shard: args.shard.to_string(),
        inputs: inputs(plan, &subjects)?,
        version: env!("CARGO_PKG_VERSION").into(),
        host: Host::here(),
    };
    let store = match Store::open(&out, &manifest, &plan.text)? {
        Found::Complete(rows) => {
            eprintln!("{}: all {} runs are there", out.display(), rows.len());
            return done(args, &out, total, rows.len(), None);
        }
        Found::Open(store) => *store,
    };
    if let Some(id) = &store.half {
        eprintln!("run {id} was half written and is done again");
    }
    let mut rows = store.done.clone();
    let known: std::collections::BTreeMap<_, _> =
        own.iter().map(|run| (run.id.as_str(), run)).collect();
    if let Some(row) = rows.iter().find(|row| {
        let run = known.get(row.id.as_str());
        run.is_none_or(|run| run.number != row.run)
    }) {
        bail!(
            "{}: run {} is none of this plan's; choose another folder with -o",
            out.display(),
            row.id
        );
    }
    rows.sort_by_key(|row| row.run);
    rows.dedup_by_key(|row| row.run);
    // A course that is missing is a run that is.
    rows.retain(|row| !known[row.id.as_str()].shown || store.has_series(&row.id));
    let finished: std::collections::BTreeSet<String> =
        rows.iter().map(|row| row.id.clone()).collect();
    let left: Vec<_> = own
        .into_iter()
        .filter(|run| !finished.contains(&run.id))
        .collect();
    if !finished.is_empty() {
        eprintln!("{} runs are there already", finished.len());
    }
    let bar = ProgressBar::new(left.len() as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:30} {pos}/{len} runs, {eta} left") {
        bar.set_style(style);
    }
    let store = Mutex::new(store);
    bar.tick();
    let result = all(args.ground, plan, &rigs, &left, &store, || bar.inc(1));
    bar.finish_and_clear();
    let (new, timing) = result?;
    rows.extend(new);
    let count = rows.len();
    let store = store.into_inner().expect("no code panics while it writes");
    store.finish(rows)?;
    done(args, &out, total, count, Some(timing))
}

/// Says what there is now, and what it cost.
fn done(
    args: &Args,
    out: &Path,
    total: usize,
    count: usize,
    timing: Option<Timing>,
) -> anyhow::Result<()> {
    let per_core =
        |simulated_s: f64, computed_s: f64| (computed_s > 0.0).then(|| simulated_s / computed_s);
    let speed = timing.and_then(|t| per_core(t.simulated_s, t.computed_s));
    let ours = timing.and_then(|t| per_core(t.ours_simulated_s, t.ours_computed_s));
    if let Some(t) = timing {
        let text = serde_json::to_string_pretty(&t)?;
        store::write_whole(&out.join("timing.json"), format!("{text}\n").as_bytes())?;
        eprintln!(
            "{} runs, {:.0} simulated seconds in {:.1} s: {:.0} a second and core (ours alone: {:.0})",
            t.runs,
            t.simulated_s,
            t.elapsed_s,
            speed.unwrap_or(0.0),
            ours.unwrap_or(0.0),
        );
    }
    if args.json {
        say!(
            "{}",
            serde_json::json!({
                "dir": out,
                "runs": count,
                "runs_of_plan": total,
                "simulated_seconds_per_second_and_core": speed,
                "simulated_seconds_per_second_and_core_ours": ours,
            })
        );
    } else {
        say!("{}", out.join(store::RESULTS).display());
        if args.shard.of > 1 {
            eprintln!("telemime experiment merge DIR… -o DIR puts the shards together");
        } else {
            eprintln!("telemime report {} shows them", out.display());
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
