//! What can be wrong with a recording, and what is only worth knowing.

use std::fmt;
use std::io;
use std::path::PathBuf;

use super::LEAST_SAMPLES;

/// Why a recording cannot be learned from. Every message names the file, the line and the remedy.
#[derive(Debug, thiserror::Error)]
pub enum DemonstrationError {
    /// The file or folder cannot be read.
    #[error("{}: {source}; check that it exists and may be read", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The folder holds no `*.csv`.
    #[error("{}: no *.csv in this folder; a skill is a folder with one CSV for each demonstration", path.display())]
    NoDemonstrations {
        /// The folder.
        path: PathBuf,
    },
    /// The folder's name cannot name a skill.
    #[error("{}: the folder's name cannot name a skill (UTF-8, 1 to 64 bytes); rename it", path.display())]
    FolderName {
        /// The folder.
        path: PathBuf,
    },
    /// Nothing in the file, or a header only.
    #[error("{}: no samples; record it again or remove the file", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// A column is missing from the header, or there twice.
    #[error("{}, line 1: {}column {column:?} in {found:?}; the header must name t,x,y,z (s, m) once each, and all of qw,qx,qy,qz or none", path.display(), if *twice { "second " } else { "no " })]
    Column {
        /// The file.
        path: PathBuf,
        /// The column.
        column: &'static str,
        /// Whether it is there twice.
        twice: bool,
        /// The header found.
        found: String,
    },
    /// The text is not CSV: a line with too many or too few fields, a broken quote, no UTF-8.
    #[error("{}, line {line}: {why}; every line must have the fields of the header", path.display())]
    Csv {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What the reader said.
        why: String,
    },
    /// A field that is not a number.
    #[error("{}, line {line}: {column} is {text:?}, not a number; correct or remove the line", path.display())]
    NotANumber {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The column.
        column: &'static str,
        /// The field.
        text: String,
    },
    /// A number that is NaN, infinite or absurdly large.
    #[error("{}, line {line}: {column} is {value}, expected a finite number in s or m; correct or remove the line", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The column.
        column: &'static str,
        /// The number.
        value: f64,
    },
    /// Four numbers that are not a rotation.
    #[error("{}, line {line}: qw,qx,qy,qz have norm {norm}, not 1; correct or remove the line", path.display())]
    NotARotation {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// Their norm.
        norm: f64,
    },
    /// A gripper's opening outside its range.
    #[error("{}, line {line}: grip is {value}, expected 0 (closed) to 1 (open); scale the column", path.display())]
    Grip {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The opening.
        value: f64,
    },
    /// A comment that begins with the word `frame` and places none.
    #[error("{}, line {line}: {why}; write `# frame NAME x y z [qw qx qy qz]` (m), or begin the comment with another word", path.display())]
    Frame {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What is wrong with it.
        why: String,
    },
    /// Time stands still or runs backwards.
    #[error("{}, line {line}: t = {t_s} s is not after the previous {previous_s} s; sort by time and remove repeated lines", path.display())]
    Unordered {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// Its time, s.
        t_s: f64,
        /// The time on the line before, s.
        previous_s: f64,
    },
    /// Fewer than [`LEAST_SAMPLES`].
    #[error("{}: {found} samples, at least {LEAST_SAMPLES} are needed; record it again or remove the file", path.display())]
    TooShort {
        /// The file.
        path: PathBuf,
        /// Samples found.
        found: usize,
    },
    /// The columns differ from those of the folder's first file.
    #[error("{}: columns {found:?} differ from {expected:?} of {}; export all demonstrations of a skill alike", path.display(), first.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Its columns.
        found: String,
        /// The folder's first file.
        first: PathBuf,
        /// The columns of that.
        expected: String,
    },
}

/// Something a reader should know but that prevents nothing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Notice {
    /// Columns that are not used.
    IgnoredColumns {
        /// The file.
        path: PathBuf,
        /// Their names.
        columns: Vec<String>,
    },
}

impl fmt::Display for Notice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::IgnoredColumns { path, columns } => {
                write!(
                    f,
                    "{}: columns {} ignored",
                    path.display(),
                    columns.join(", ")
                )
            }
        }
    }
}
