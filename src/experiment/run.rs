//! The list of runs, and running it on all cores.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Instant;

use rayon::prelude::*;
use sha2::{Digest, Sha256};
use telemime_robot::rig::{Rig, RigError, RigOptions};

use super::factor::{FACTORS, Settings};
use super::judge::{Moment, judge};
use super::method::Method;
use super::plan::{Cell, Plan, hex};
use super::real::{self, Ground, RealError};
use super::row::Row;
use super::store::{SKILL, Store, StoreError};
use super::subject::{Subject, SubjectError};
use super::trace::Outcome;
use super::{baseline, drive};
use crate::ground::PairError;

/// Why an experiment did not come to its end.
#[derive(Debug, thiserror::Error)]
pub(super) enum RunError {
    #[error(transparent)]
    Subject(#[from] SubjectError),
    #[error(transparent)]
    Rig(#[from] RigError),
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("{path}: {source}")]
    Input {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("run {id}: {source}")]
    Ground { id: String, source: PairError },
    #[error("run {id}: {source}")]
    Real { id: String, source: RealError },
}

/// One run to do.
pub(super) struct Run<'a> {
    /// Its place in the whole list, from 1 on.
    pub(super) number: usize,
    pub(super) id: String,
    pub(super) subject: &'a Subject,
    pub(super) cell: &'a Cell,
    /// Its course is kept, for figures.
    pub(super) shown: bool,
}

/// Every run of the plan, in order: setting by setting, subject by subject.
pub(super) fn list<'a>(plan: &'a Plan, subjects: &'a [Subject]) -> Vec<Run<'a>> {
    let mut shown = BTreeSet::new();
    let first_seed = |cell: &Cell| {
        let mut texts = cell.texts.clone();
        texts[FACTORS.len() - 1].clear();
        texts
    };
    let mut runs = Vec::with_capacity(plan.cells.len() * subjects.len());
    for cell in &plan.cells {
        let first = shown.insert(first_seed(cell));
        for (n, subject) in subjects.iter().enumerate() {
            runs.push(Run {
                number: runs.len() + 1,
                id: id(plan, subject, cell),
                subject,
                cell,
                shown: first && n == 0,
            });
        }
    }
    runs
}

/// Two that agree have the same settings, subject and seed.
fn id(plan: &Plan, subject: &Subject, cell: &Cell) -> String {
    let mut hash = Sha256::new();
    hash.update(plan.seed.to_le_bytes());
    let driven = drive::driven(&cell.settings, subject).sha256();
    hash.update(subject.skill.id().0);
    hash.update(driven);
    for text in &cell.texts {
        hash.update(text.as_bytes());
        hash.update([0]);
    }
    hex(&hash.finalize()[..6])
}

/// The same chances for every method, other ones for every recording.
fn chances(plan: &Plan, subject: &Subject, settings: &Settings) -> u64 {
    let mut hash = Sha256::new();
    hash.update(plan.seed.to_le_bytes());
    hash.update(drive::driven(settings, subject).sha256());
    hash.update(settings.link_seed.to_le_bytes());
    u64::from_le_bytes(*hash.finalize().first_chunk().expect("32 bytes"))
}

/// Every arm the plan names, ready.
pub(super) type Rigs = BTreeMap<(Option<PathBuf>, u64, u64), Rig>;

fn rig_key(settings: &Settings) -> (Option<PathBuf>, u64, u64) {
    let arm = settings.arm.clone();
    (
        arm,
        settings.omega.to_bits(),
        settings.dead_time_s.to_bits(),
    )
}

/// Loads every arm once.
pub(super) fn rigs(plan: &Plan) -> Result<Rigs, RigError> {
    let mut rigs = Rigs::new();
    for cell in &plan.cells {
        let settings = &cell.settings;
        if let std::collections::btree_map::Entry::Vacant(place) = rigs.entry(rig_key(settings)) {
            let mut options = RigOptions {
                urdf: settings.arm.clone(),
                ..RigOptions::default()
            };
            options.control.omega = settings.omega;
            options.control.dead_time_s = settings.dead_time_s;
            place.insert(Rig::load(&options)?);
        }
    }
    Ok(rigs)
}

/// What running cost.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub(super) struct Timing {
    /// Runs done now.
    pub(super) runs: usize,
    /// Simulated, s.
    pub(super) simulated_s: f64,
    /// Computed, summed over the threads, s.
    pub(super) computed_s: f64,
    /// From the first run to the last, s.
    pub(super) elapsed_s: f64,
    /// Of ours alone: both daemons, QUIC, servo and arm.
    pub(super) ours_simulated_s: f64,
    /// Computed for ours, s.
    pub(super) ours_computed_s: f64,
}

/// Does `runs`, each on one thread, ours on `ground`; on the virtual one the results do not depend on how many there are.
/// `progress` hears of each one done, from any thread.
pub(super) fn all(
    ground: Ground,
    plan: &Plan,
    rigs: &Rigs,
    runs: &[Run<'_>],
    store: &Mutex<Store>,
    progress: impl Fn() + Sync,
) -> Result<(Vec<Row>, Timing), RunError> {
    let began = Instant::now();
    let done = runs
        .par_iter()
        .map(|run| {
            let since = thread_cpu_s();
            let (row, moments, simulated_s) = one(ground, plan, rigs, run)?;
            let computed_s = thread_cpu_s() - since;
            let mut store = store.lock().expect("no code panics while it writes");
            if run.shown {
                store.series(&run.id, &moments)?;
            }
            store.keep(&row)?;
            drop(store);
            progress();
            let ours = run.cell.settings.method == Method::Ours;
            Ok((row, simulated_s, computed_s, ours))
        })
        .collect::<Result<Vec<_>, RunError>>()?;
    let mut timing = Timing {
        runs: done.len(),
        elapsed_s: began.elapsed().as_secs_f64(),
        ..Timing::default()
    };
    let rows = done
        .into_iter()
        .map(|(row, simulated_s, computed_s, ours)| {
            timing.simulated_s += simulated_s;
            timing.computed_s += computed_s;
            if ours {
                timing.ours_simulated_s += simulated_s;
                timing.ours_computed_s += computed_s;
            }
            row
        });
    let rows = rows.collect();
    Ok((rows, timing))
}

/// CPU time of this thread, s: others on the host do not make a run longer.
fn thread_cpu_s() -> f64 {
    let spent = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    spent.tv_sec as f64 + spent.tv_nsec as f64 * 1e-9
}

fn one(
    ground: Ground,
    plan: &Plan,
    rigs: &Rigs,
    run: &Run<'_>,
) -> Result<(Row, Vec<Moment>, f64), RunError> {
    let (settings, subject) = (&run.cell.settings, run.subject);
    let rig = &rigs[&rig_key(settings)];
    let (axes, seed) = (plan.motion.axes, chances(plan, subject, settings));
    let id = || run.id.clone();
    let ours = settings.method == Method::Ours;
    let ground = if ours { ground } else { Ground::Virtual };
    let trace = match ground {
        _ if !ours => baseline::drive(settings, subject, rig, axes, seed),
        Ground::Virtual => drive::drive(settings, subject, rig, axes, seed)
            .map_err(|source| RunError::Ground { id: id(), source })?,
        Ground::Loopback | Ground::Netns => real::drive(ground, settings, subject, axes, seed)
            .map_err(|source| RunError::Real { id: id(), source })?,
    };
    let (figures, moments) = judge(settings, subject, &trace, axes);
    let row = Row {
        run: run.number,
        id: run.id.clone(),
        subject: subject.name.clone(),
        person: subject.person.clone(),
        ground: ground.name().to_owned(),
        texts: run.cell.texts.clone(),
        outcome: match &trace.outcome {
            Outcome::Followed => "followed".to_owned(),
            Outcome::Stopped(_, why) => format!("stopped: {why}"),
            Outcome::NotDriven(why) => format!("not driven: {why}"),
        },
        figures,
    };
    Ok((row, moments, trace.simulated_s))
}

/// SHA-256 of every file that the plan's results depend on, by its path.
pub(super) fn inputs(
    plan: &Plan,
    subjects: &[Subject],
) -> Result<BTreeMap<String, String>, RunError> {
    let mut inputs = BTreeMap::new();
    let hash = |path: PathBuf| match std::fs::read(&path) {
        Ok(bytes) => Ok(hex(&Sha256::digest(bytes))),
        Err(source) => Err(RunError::Input { path, source }),
    };
    let short = |path: &Path| {
        let short = path.strip_prefix(&plan.folder).unwrap_or(path);
        short.display().to_string()
    };
    for cell in &plan.cells {
        if let Some(path) = &cell.settings.arm {
            inputs.insert(short(path), hash(path.clone())?);
        }
    }
    for link in plan
        .cells
        .iter()
        .flat_map(|c| [&c.settings.up, &c.settings.down])
    {
        if let Some(trace) = &link.trace {
            let path = trace.path();
            inputs.insert(short(path), hash(plan.folder.join(path))?);
        }
    }
    if !plan.motion.folders.is_empty() {
        for subject in subjects {
            for d in [&subject.on_model, &subject.off_model] {
                inputs.insert(short(d.path()), hex(d.sha256()));
            }
            let skill = format!("{SKILL}{}", subject.name);
            inputs.insert(skill, hex(&subject.skill.id().0));
        }
    }
    Ok(inputs)
}
