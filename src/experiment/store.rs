//! Where results go: a folder that is never overwritten, and can be gone on with.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::judge::Moment;
use super::real::Ground;
use super::row::{Row, line};

/// What every experiment folder holds.
pub(super) const RESULTS: &str = "results.csv";
pub(super) const MANIFEST: &str = "manifest.json";
pub(super) const PLAN: &str = "plan.toml";
/// Runs done so far, in the order they were finished.
const PART: &str = "part.csv";
/// The shard that is all there is.
const ALL: &str = "1/1";
/// Empty; locked by who writes there.
const LOCK: &str = ".lock";
/// The courses of a few runs.
const SERIES: &str = "series";

/// What must be known to repeat an experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Manifest {
    pub(super) title: String,
    /// The file's name, or the ready plan's.
    pub(super) plan: String,
    pub(super) plan_sha256: String,
    pub(super) seed: u64,
    /// Runs of the whole plan.
    pub(super) runs: usize,
    /// Where ours ran.
    pub(super) ground: Ground,
    /// The flags that left a part of the plan out; empty if nothing was.
    pub(super) thinned: String,
    /// Which of how many shards; `1/1` is all, or shards merged.
    pub(super) shard: String,
    /// Recordings, arms and traces, by the paths the plan gives them, with their SHA-256.
    pub(super) inputs: BTreeMap<String, String>,
    pub(super) version: String,
    pub(super) host: Host,
}

/// Before the name of a skill among a manifest's inputs.
pub(super) const SKILL: &str = "skill: ";

impl Manifest {
    /// Whether recorded hands were driven, and not generated ones.
    pub(super) fn is_of_recordings(&self) -> bool {
        self.inputs.keys().any(|input| input.starts_with(SKILL))
    }

    /// How much of the plan, and on which ground.
    pub(super) fn part(&self) -> String {
        match self.thinned.as_str() {
            "" => format!("whole, {}", self.ground),
            thinned => format!("{thinned}, {}", self.ground),
        }
    }
}

/// Where it ran: sine and cosine are the platform's.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Host {
    pub(super) name: String,
    pub(super) os: String,
    pub(super) arch: String,
}

impl Host {
    pub(super) fn here() -> Self {
        Self {
            name: rustix::system::uname()
                .nodename()
                .to_string_lossy()
                .into_owned(),
            os: std::env::consts::OS.into(),
            arch: std::env::consts::ARCH.into(),
        }
    }
}

/// Why a folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub(super) enum StoreError {
    #[error("{path}: {source}")]
    Io { path: PathBuf, source: io::Error },
    #[error(
        "{0}: not a folder of results: there is no {MANIFEST}; `telemime experiment PLAN -o DIR` makes one"
    )]
    NotOurs(PathBuf),
    #[error("{path}: {source}; it was not written by this program, or not to its end")]
    Manifest {
        path: PathBuf,
        source: serde_json::Error,
    },
    #[error(
        "{dir}: holds results of another {what} ({there}, here {here}); nothing is overwritten: choose another folder with -o"
    )]
    Other {
        dir: PathBuf,
        what: &'static str,
        there: String,
        here: String,
    },
    #[error(
        "{path}:{line}: not a result of this plan; move the file away to begin again, or run the plan into another folder"
    )]
    Row { path: PathBuf, line: usize },
    #[error(
        "{path}: run {run} of {runs} is not there, or there twice: the file was cut or changed; run the plan again into another folder"
    )]
    Incomplete {
        path: PathBuf,
        run: usize,
        runs: usize,
    },
    #[error(
        "{0}: is there and is not this plan; nothing is overwritten: choose another folder with -o"
    )]
    Taken(PathBuf),
    #[error("{path}: is not the plan that was run (its SHA-256 is another): put that back")]
    Edited { path: PathBuf },
    #[error("{0}: another process is writing there")]
    Busy(PathBuf),
    #[error(
        "{dir}: not finished: {done} of its runs are there; run the same command again to finish it"
    )]
    Unfinished { dir: PathBuf, done: usize },
    #[error("run {run} ({id}) is in {a} and in {b}, and differs")]
    Differs {
        run: usize,
        id: String,
        a: PathBuf,
        b: PathBuf,
    },
    #[error("run {0} is in none of the folders: every shard must be given")]
    Missing(usize),
}

fn io_at(path: &Path) -> impl FnOnce(io::Error) -> StoreError + use<> {
    let path = path.to_owned();
    |source| StoreError::Io { path, source }
}

/// A folder that results are being written to.
pub(super) struct Store {
    dir: PathBuf,
    part: File,
    /// Nobody else writes there while it is held.
    _lock: File,
    /// Runs finished before.
    pub(super) done: Vec<Row>,
    /// The run that was being written when it ended, if there was one.
    pub(super) half: Option<String>,
}

/// What is found where results are to go.
pub(super) enum Found {
    /// Something to do.
    Open(Box<Store>),
    /// All of it is there.
    Complete(Vec<Row>),
}

impl Store {
    /// Opens `dir` for the runs of `manifest`, or makes it. What another plan, or another version, wrote there is refused.
    pub(super) fn open(dir: &Path, manifest: &Manifest, plan: &str) -> Result<Found, StoreError> {
        if let Some(rows) = complete(dir, manifest)? {
            return Ok(Found::Complete(rows));
        }
        std::fs::create_dir_all(dir.join(SERIES)).map_err(io_at(dir))?;
        let path = dir.join(LOCK);
        let lock = File::create(&path).map_err(io_at(&path))?;
        if lock.try_lock().is_err() {
            return Err(StoreError::Busy(dir.to_owned()));
        }
        // Whoever held the lock may have begun, or finished, since.
        if let Some(rows) = complete(dir, manifest)? {
            return Ok(Found::Complete(rows));
        }
        if !dir.join(MANIFEST).exists() {
            write_plan(dir, plan)?;
            write_manifest(dir, manifest)?;
        }
        Self::part(dir, lock).map(|store| Found::Open(Box::new(store)))
    }

    /// The journal: whole lines are kept, the last one may be half written.
    fn part(dir: &Path, lock: File) -> Result<Self, StoreError> {
        let path = dir.join(PART);
        let file = OpenOptions::new()
            .read(true)
            .append(true)
            .create(true)
            .open(&path)
            .map_err(io_at(&path))?;
        let bytes = std::fs::read(&path).map_err(io_at(&path))?;
        let whole = bytes
            .iter()
            .rposition(|b| *b == b'\n')
            .map_or(0, |at| at + 1);
        let (lines, rest) = bytes.split_at(whole);
        let half = String::from_utf8_lossy(rest);
        let half = half.split(',').nth(1).map(str::to_owned);
        let half = half.or_else(|| (!rest.is_empty()).then(|| "the last one".to_owned()));
        file.set_len(whole as u64).map_err(io_at(&path))?;
        let done = parse_rows(&path, lines, false)?;
        Ok(Self {
            dir: dir.to_owned(),
            part: file,
            _lock: lock,
            done,
            half,
        })
    }

    /// Keeps a finished run.
    pub(super) fn keep(&mut self, row: &Row) -> Result<(), StoreError> {
        let path = self.dir.join(PART);
        self.part.write_all(&row.line()).map_err(io_at(&path))
    }

    /// Keeps the course of a run.
    pub(super) fn series(&self, id: &str, moments: &[Moment]) -> Result<(), StoreError> {
        let header = [
            "t_s", "hand_x", "hand_y", "hand_z", "tip_x", "tip_y", "tip_z", "age_s",
        ];
        let mut out = line(header);
        for m in moments {
            let places = m.hand_m.iter().chain(m.tip_m.iter());
            let mut fields = vec![format!("{:.3}", m.t_s)];
            fields.extend(places.map(|v| format!("{v:.5}")));
            fields.push(m.age_s.map_or(String::new(), |age_s| format!("{age_s:.4}")));
            out.extend(line(fields));
        }
        write_whole(&series_path(&self.dir, id), &out)
    }

    /// Whether the course of a run is there.
    pub(super) fn has_series(&self, id: &str) -> bool {
        series_path(&self.dir, id).exists()
    }

    /// All runs are done: writes the results, in the plan's order.
    pub(super) fn finish(self, mut rows: Vec<Row>) -> Result<(), StoreError> {
        rows.sort_by_key(|row| row.run);
        write_results(&self.dir, &rows)?;
        // The lock last, and while it is held: whoever takes what is gone sees that all is done.
        for path in [self.dir.join(PART), self.dir.join(LOCK)] {
            std::fs::remove_file(&path).map_err(io_at(&path))?;
        }
        Ok(())
    }
}

/// The results that are to be had in `dir`, if all are there; an error if what is there is of something else.
fn complete(dir: &Path, manifest: &Manifest) -> Result<Option<Vec<Row>>, StoreError> {
    if !dir.join(MANIFEST).exists() {
        if dir.join(RESULTS).exists() || dir.join(PART).exists() {
            return Err(StoreError::NotOurs(dir.to_owned()));
        }
        return Ok(None);
    }
    let there = read_manifest(dir)?;
    let other = |what, there: &str, here: &str| StoreError::Other {
        dir: dir.to_owned(),
        what,
        there: there.to_owned(),
        here: here.to_owned(),
    };
    for (what, a, b) in [
        ("plan", &there.plan_sha256, &manifest.plan_sha256),
        ("shard", &there.shard, &manifest.shard),
        ("version", &there.version, &manifest.version),
        ("part of the plan", &there.part(), &manifest.part()),
    ] {
        if a != b {
            return Err(other(what, a, b));
        }
    }
    if there.inputs != manifest.inputs {
        return Err(other("state of the plan's files", "changed", "since"));
    }
    let results = dir.join(RESULTS);
    results
        .exists()
        .then(|| whole(&results, &there))
        .transpose()
}

/// All that a finished folder is to hold; a shard knows only how many runs there are at most.
fn whole(path: &Path, manifest: &Manifest) -> Result<Vec<Row>, StoreError> {
    let rows = read_rows(path)?;
    let runs = manifest.runs;
    let incomplete = |run| StoreError::Incomplete {
        path: path.to_owned(),
        run,
        runs,
    };
    let mut seen = std::collections::BTreeSet::new();
    if let Some(row) = rows
        .iter()
        .find(|row| row.run > runs || !seen.insert(row.run))
    {
        return Err(incomplete(row.run));
    }
    if manifest.shard == ALL
        && let Some(run) = (1..=runs).find(|run| !seen.contains(run))
    {
        return Err(incomplete(run));
    }
    Ok(rows)
}

/// Where the course of a run is.
pub(super) fn series_path(dir: &Path, id: &str) -> PathBuf {
    dir.join(SERIES).join(format!("{id}.csv"))
}

/// Reads a finished folder.
pub(super) fn read(dir: &Path) -> Result<(Manifest, String, Vec<Row>), StoreError> {
    let manifest = read_manifest(dir)?;
    let results = dir.join(RESULTS);
    if !results.exists() {
        let done = std::fs::read_to_string(dir.join(PART)).unwrap_or_default();
        let done = done.lines().count();
        let dir = dir.to_owned();
        return Err(StoreError::Unfinished { dir, done });
    }
    let path = dir.join(PLAN);
    let plan = std::fs::read_to_string(&path).map_err(io_at(&path))?;
    if super::plan::sha256(&plan) != manifest.plan_sha256 {
        return Err(StoreError::Edited { path });
    }
    let rows = whole(&results, &manifest)?;
    for row in &rows {
        check_series(&series_path(dir, &row.id))?;
    }
    Ok((manifest, plan, rows))
}

/// Whether a course, if there is one, has nothing but numbers in every line.
fn check_series(path: &Path) -> Result<(), StoreError> {
    if !path.exists() {
        return Ok(());
    }
    let bytes = std::fs::read(path).map_err(io_at(path))?;
    let mut reader = csv::Reader::from_reader(&bytes[..]);
    let number = |text: &str| text.is_empty() || text.parse().is_ok_and(f64::is_finite);
    let ends = bytes.ends_with(b"\n");
    let wrong = reader
        .records()
        .position(|record| !record.is_ok_and(|record| record.iter().all(number)));
    match wrong.or((!ends).then(|| bytes.split(|b| *b == b'\n').count() - 2)) {
        Some(n) => Err(StoreError::Row {
            path: path.to_owned(),
            line: n + 2,
        }),
        None => Ok(()),
    }
}

/// Puts the shards of one plan together in a new folder.
pub(super) fn merge(out: &Path, dirs: &[PathBuf]) -> Result<usize, StoreError> {
    let mut rows: BTreeMap<usize, (Row, &PathBuf)> = BTreeMap::new();
    let mut first: Option<(Manifest, String)> = None;
    for dir in dirs {
        let (manifest, plan, own) = read(dir)?;
        let (whole, _) = first.get_or_insert_with(|| (manifest.clone(), plan));
        for (what, a, b) in [
            ("plan", &manifest.plan_sha256, &whole.plan_sha256),
            ("version", &manifest.version, &whole.version),
            ("part of the plan", &manifest.part(), &whole.part()),
        ] {
            if a != b {
                return Err(StoreError::Other {
                    dir: dir.clone(),
                    what,
                    there: a.clone(),
                    here: b.clone(),
                });
            }
        }
        if manifest.inputs != whole.inputs {
            return Err(StoreError::Other {
                dir: dir.clone(),
                what: "state of the plan's files",
                there: "changed".into(),
                here: "since".into(),
            });
        }
        for row in own {
            match rows.get(&row.run) {
                Some((held, _)) if *held == row => {}
                Some((held, other)) => {
                    return Err(StoreError::Differs {
                        run: row.run,
                        id: held.id.clone(),
                        a: (*other).clone(),
                        b: dir.clone(),
                    });
                }
                None => {
                    rows.insert(row.run, (row, dir));
                }
            }
        }
    }
    let Some((mut manifest, plan)) = first else {
        return Ok(0);
    };
    if let Some(missing) = (1..=manifest.runs).find(|run| !rows.contains_key(run)) {
        return Err(StoreError::Missing(missing));
    }
    if out.join(MANIFEST).exists() || out.join(RESULTS).exists() {
        return Err(StoreError::Other {
            dir: out.to_owned(),
            what: "experiment",
            there: "results".into(),
            here: "a merge".into(),
        });
    }
    std::fs::create_dir_all(out.join(SERIES)).map_err(io_at(out))?;
    for (row, dir) in rows.values() {
        let from = series_path(dir, &row.id);
        if from.exists() {
            let bytes = std::fs::read(&from).map_err(io_at(&from))?;
            write_whole(&series_path(out, &row.id), &bytes)?;
        }
    }
    manifest.shard = ALL.into();
    write_plan(out, &plan)?;
    write_manifest(out, &manifest)?;
    let rows: Vec<Row> = rows.into_values().map(|(row, _)| row).collect();
    write_results(out, &rows)?;
    Ok(rows.len())
}

/// The plan beside its results; somebody's own file of that name stays.
fn write_plan(dir: &Path, plan: &str) -> Result<(), StoreError> {
    let path = dir.join(PLAN);
    match std::fs::read(&path) {
        Ok(there) if there != plan.as_bytes() => Err(StoreError::Taken(path)),
        Ok(_) => Ok(()),
        Err(e) if e.kind() == io::ErrorKind::NotFound => write_whole(&path, plan.as_bytes()),
        Err(e) => Err(io_at(&path)(e)),
    }
}

fn write_results(dir: &Path, rows: &[Row]) -> Result<(), StoreError> {
    let mut out = line(Row::header());
    rows.iter().for_each(|row| out.extend(row.line()));
    write_whole(&dir.join(RESULTS), &out)
}

fn write_manifest(dir: &Path, manifest: &Manifest) -> Result<(), StoreError> {
    let text = serde_json::to_string_pretty(manifest).expect("a manifest is plain data");
    write_whole(&dir.join(MANIFEST), format!("{text}\n").as_bytes())
}

fn read_manifest(dir: &Path) -> Result<Manifest, StoreError> {
    let path = dir.join(MANIFEST);
    if !path.exists() {
        return Err(StoreError::NotOurs(dir.to_owned()));
    }
    let text = std::fs::read_to_string(&path).map_err(io_at(&path))?;
    serde_json::from_str(&text).map_err(|source| StoreError::Manifest { path, source })
}

fn read_rows(path: &Path) -> Result<Vec<Row>, StoreError> {
    let bytes = std::fs::read(path).map_err(io_at(path))?;
    parse_rows(path, &bytes, true)
}

fn parse_rows(path: &Path, bytes: &[u8], header: bool) -> Result<Vec<Row>, StoreError> {
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .from_reader(bytes);
    let mut rows = Vec::new();
    for (n, record) in reader.records().enumerate() {
        let wrong = || StoreError::Row {
            path: path.to_owned(),
            line: n + 1,
        };
        let record = record.map_err(|_| wrong())?;
        if header && n == 0 {
            if !record.iter().eq(Row::header()) {
                return Err(wrong());
            }
            continue;
        }
        rows.push(Row::from_fields(&record).ok_or_else(wrong)?);
    }
    Ok(rows)
}

/// Whole, or not at all, even if the power fails.
pub(super) fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    let mut half = path.as_os_str().to_owned();
    half.push(".half");
    let half = PathBuf::from(half);
    let write = || {
        let mut file = File::create(&half)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&half, path)
    };
    write().map_err(io_at(path))
}
