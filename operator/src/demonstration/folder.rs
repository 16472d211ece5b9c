//! A folder of recordings: the demonstrations of one skill.

use std::fs;
use std::path::{Path, PathBuf};

use super::{Demonstration, DemonstrationError, Notice};

/// Whether `name` matches `pattern`, in which `*` stands for any text. Each piece between stars is taken where
/// it first occurs, which never rules a later one out.
pub(super) fn matches(pattern: &str, name: &str) -> bool {
    let Some((head, rest)) = pattern.split_once('*') else {
        return pattern == name;
    };
    let Some(mut name) = name.strip_prefix(head) else {
        return false;
    };
    let (middle, tail) = rest.rsplit_once('*').unwrap_or(("", rest));
    for piece in middle.split('*') {
        let Some(at) = name.find(piece) else {
            return false;
        };
        name = &name[at + piece.len()..];
    }
    name.ends_with(tail)
}

/// The demonstrations of one skill.
#[derive(Debug, Clone, PartialEq)]
pub struct Demonstrations {
    /// The skill's name: that of the folder.
    pub name: String,
    /// At least one, by file name.
    pub demonstrations: Vec<Demonstration>,
    /// What a reader should know about the files.
    pub notices: Vec<Notice>,
}

impl Demonstrations {
    /// Reads every `*.csv` of a folder, by name; with a `pattern`, those whose name without the ending
    /// matches it (`*` stands for anything).
    ///
    /// # Errors
    /// [`DemonstrationError`]: of any of the files, or of the folder.
    pub fn read_dir(
        dir: impl AsRef<Path>,
        pattern: Option<&str>,
    ) -> Result<Self, DemonstrationError> {
        let dir = dir.as_ref();
        if dir.is_file() {
            return Err(DemonstrationError::NoFolder {
                path: dir.to_owned(),
            });
        }
        let io = |source| DemonstrationError::Io {
            path: dir.to_owned(),
            source,
        };
        let name = dir
            .canonicalize()
            .map_err(io)?
            .file_name()
            .and_then(|n| n.to_str())
            .filter(|n| (1..=64).contains(&n.len()))
            .ok_or_else(|| DemonstrationError::FolderName {
                path: dir.to_owned(),
            })?
            .to_owned();
        let mut paths = Vec::new();
        for entry in fs::read_dir(dir).map_err(io)? {
            let path = entry.map_err(io)?.path();
            if path
                .extension()
                .is_some_and(|e| e.eq_ignore_ascii_case("csv"))
            {
                paths.push(path);
            }
        }
        paths.sort();
        let all = paths.len();
        if let Some(pattern) = pattern {
            let name = |p: &PathBuf| {
                p.file_stem()
                    .is_some_and(|n| matches(pattern, &n.to_string_lossy()))
            };
            paths.retain(name);
        }
        let demonstrations = paths
            .iter()
            .map(Demonstration::read_csv)
            .collect::<Result<Vec<_>, _>>()?;
        let Some(first) = demonstrations.first() else {
            return Err(match pattern {
                Some(pattern) if all > 0 => DemonstrationError::NoMatch {
                    path: dir.to_owned(),
                    pattern: pattern.to_owned(),
                    all,
                },
                _ => DemonstrationError::NoDemonstrations {
                    path: dir.to_owned(),
                },
            });
        };
        if let Some(other) = demonstrations.iter().find(|d| d.columns != first.columns) {
            return Err(DemonstrationError::Shape {
                path: other.path.clone(),
                found: other.columns.join(","),
                first: first.path.clone(),
                expected: first.columns.join(","),
            });
        }
        Ok(Self {
            name,
            notices: demonstrations
                .iter()
                .flat_map(|d| d.notices.iter().cloned())
                .chain(copies(&demonstrations))
                .collect(),
            demonstrations,
        })
    }
}

/// Recordings that are there twice, to the byte.
fn copies(demonstrations: &[Demonstration]) -> Vec<Notice> {
    let mut found = Vec::new();
    for (n, d) in demonstrations.iter().enumerate() {
        if let Some(first) = demonstrations[..n].iter().find(|o| o.sha256 == d.sha256) {
            found.push(Notice::Copy {
                path: d.path.clone(),
                first: first.path.clone(),
            });
        }
    }
    found
}
