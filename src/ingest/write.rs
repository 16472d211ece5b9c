//! The folder that demonstrations are written to.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use telemime_operator::ingest::Take;

/// Why a recording's demonstrations are not written; then none of them is.
#[derive(Debug, thiserror::Error)]
pub(super) enum WriteError {
    /// The file system refused.
    #[error("{}: {source}; check that it may be written", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Something is there already.
    #[error("{}: {} exists; --force overwrites it", raw.display(), path.display())]
    Exists {
        /// The recording.
        raw: PathBuf,
        /// Where its demonstration should go.
        path: PathBuf,
    },
    /// Two recordings of one name.
    #[error("{}: {} was written from another recording of that name just now; rename one, or use two folders", raw.display(), path.display())]
    Taken {
        /// The recording.
        raw: PathBuf,
        /// Where its demonstration should go.
        path: PathBuf,
    },
    /// The output would replace an input.
    #[error("{}: {} is itself one of the recordings; choose another folder (-o)", raw.display(), path.display())]
    Input {
        /// The recording.
        raw: PathBuf,
        /// Where its demonstration should go.
        path: PathBuf,
    },
    /// A skill's demonstrations have the same columns.
    #[error(
        "{}: columns {found} where {} has {expected}; one folder is one skill: import it into another (-o)",
        raw.display(), beside.display()
    )]
    Shape {
        /// The recording.
        raw: PathBuf,
        /// Its columns.
        found: String,
        /// A file in the folder.
        beside: PathBuf,
        /// The columns of that.
        expected: String,
    },
}

/// The output folder.
pub(super) struct Folder {
    dir: PathBuf,
    force: bool,
    inputs: BTreeSet<PathBuf>,
    /// A demonstration in the folder, and its header.
    shape: Option<(PathBuf, String)>,
    written: BTreeSet<PathBuf>,
    stale: Vec<PathBuf>,
}

impl Folder {
    /// Makes the folder if need be.
    pub(super) fn open(dir: &Path, inputs: &[PathBuf], force: bool) -> Result<Self, WriteError> {
        let io = |source| WriteError::Io {
            path: dir.to_owned(),
            source,
        };
        fs::create_dir_all(dir).map_err(io)?;
        let inputs = inputs.iter().filter_map(|p| p.canonicalize().ok());
        Ok(Self {
            dir: dir.to_owned(),
            force,
            inputs: inputs.collect(),
            shape: None,
            written: BTreeSet::new(),
            stale: Vec::new(),
        })
    }

    /// Writes the demonstrations of one recording: `NAME.csv`, or `NAME_01.csv` and so on.
    pub(super) fn write(&mut self, raw: &Path, takes: &[Take]) -> Result<Vec<PathBuf>, WriteError> {
        let stem = raw
            .file_stem()
            .map_or_else(String::new, |s| s.to_string_lossy().into_owned());
        let name = |i: usize| match takes.len() {
            1 => self.dir.join(format!("{stem}.csv")),
            n => {
                let width = n.to_string().len().max(2);
                self.dir.join(format!("{stem}_{:0width$}.csv", i + 1))
            }
        };
        let paths: Vec<PathBuf> = (0..takes.len()).map(name).collect();
        for path in &paths {
            let (raw, path) = (raw.to_owned(), path.clone());
            if self.written.contains(&path) {
                return Err(WriteError::Taken { raw, path });
            }
            if path.canonicalize().is_ok_and(|p| self.inputs.contains(&p)) {
                return Err(WriteError::Input { raw, path });
            }
            if path.exists() && !self.force {
                return Err(WriteError::Exists { raw, path });
            }
        }
        let texts: Vec<String> = takes.iter().map(Take::to_csv).collect();
        let header = texts.first().map_or("", |t| first_line(t)).to_owned();
        let earlier = self.earlier(&stem)?;
        // What is about to be replaced does not say what belongs here.
        let others = earlier.others.iter().filter(|p| !paths.contains(p));
        if self.shape.is_none() {
            self.shape = others
                .filter_map(|p| {
                    Some((
                        p.clone(),
                        first_line(&fs::read_to_string(p).ok()?).to_owned(),
                    ))
                })
                .next();
        }
        match &self.shape {
            Some((beside, expected)) if *expected != header => {
                return Err(WriteError::Shape {
                    raw: raw.to_owned(),
                    found: header,
                    beside: beside.clone(),
                    expected: expected.clone(),
                });
            }
            Some(_) => {}
            None => self.shape = paths.first().map(|p| (p.clone(), header)),
        }
        for (path, text) in paths.iter().zip(&texts) {
            whole(path, text).map_err(|source| WriteError::Io {
                path: path.clone(),
                source,
            })?;
        }
        let stale = earlier.same_recording.into_iter();
        self.stale
            .extend(stale.filter(|p| !paths.contains(p) && !self.written.contains(p)));
        self.written.extend(paths.iter().cloned());
        Ok(paths)
    }

    /// Demonstrations that bear the name of a recording imported now, and did not come from it now.
    pub(super) fn stale(&self) -> impl Iterator<Item = &PathBuf> {
        self.stale.iter().filter(|p| !self.written.contains(*p))
    }

    fn earlier(&self, stem: &str) -> Result<Earlier, WriteError> {
        let io = |source| WriteError::Io {
            path: self.dir.clone(),
            source,
        };
        let mut earlier = Earlier::default();
        for entry in fs::read_dir(&self.dir).map_err(io)? {
            let path = entry.map_err(io)?.path();
            if path
                .extension()
                .is_some_and(|e| e.eq_ignore_ascii_case("csv"))
            {
                earlier.others.push(path);
            }
        }
        earlier.others.sort();
        let same = |p: &&PathBuf| {
            let name = p.file_stem().map(|s| s.to_string_lossy().into_owned());
            name.is_some_and(|name| match name.strip_prefix(stem) {
                Some("") => true,
                Some(rest) => rest
                    .strip_prefix('_')
                    .is_some_and(|n| n.len() >= 2 && n.bytes().all(|b| b.is_ascii_digit())),
                None => false,
            })
        };
        earlier.same_recording = earlier.others.iter().filter(same).cloned().collect();
        Ok(earlier)
    }
}

/// CSV files in the folder.
#[derive(Default)]
struct Earlier {
    others: Vec<PathBuf>,
    same_recording: Vec<PathBuf>,
}

fn first_line(text: &str) -> &str {
    text.lines().next().unwrap_or("")
}

/// Beside its place first, then there: a file is whole or as it was.
fn whole(path: &Path, text: &str) -> io::Result<()> {
    let beside = path.with_extension(format!("csv.{}.part", std::process::id()));
    fs::write(&beside, text)
        .and_then(|()| fs::rename(&beside, path))
        .inspect_err(|_| {
            let _ = fs::remove_file(&beside);
        })
}
