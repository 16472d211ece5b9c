//! Recorded demonstrations: `t,x,y,z` CSV, one file each; a folder is a skill.

use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use nalgebra::Vector3;
use sha2::{Digest, Sha256};

/// A demonstration needs at least this many samples.
pub const LEAST_SAMPLES: usize = 8;

/// The largest coordinate (m) and time (s) a recording may hold: beyond it the unit is wrong.
const LARGEST: f64 = 1e6;

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
    #[error("{}, line 1: {}column {column:?} in {found:?}; the header must name t,x,y,z (s, m) once each", path.display(), if *twice { "second " } else { "no " })]
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

/// The hand at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Time, s.
    pub t_s: f64,
    /// Position, m.
    pub position: Vector3<f64>,
}

/// One performance of a skill: at least [`LEAST_SAMPLES`] finite samples, time strictly ascending.
#[derive(Debug, Clone, PartialEq)]
pub struct Demonstration {
    name: String,
    path: PathBuf,
    samples: Vec<Sample>,
    sha256: [u8; 32],
    columns: Vec<String>,
    notices: Vec<Notice>,
}

impl Demonstration {
    /// Reads one CSV file.
    ///
    /// # Errors
    /// [`DemonstrationError`], one variant a cause.
    pub fn read_csv(path: impl AsRef<Path>) -> Result<Self, DemonstrationError> {
        let path = path.as_ref();
        let bytes = fs::read(path).map_err(|source| DemonstrationError::Io {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(path, &bytes)
    }

    /// Parses the content of a CSV file; `path` names it, and need not exist.
    ///
    /// # Errors
    /// As [`Demonstration::read_csv`].
    pub fn parse(path: impl Into<PathBuf>, bytes: &[u8]) -> Result<Self, DemonstrationError> {
        let path = path.into();
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .comment(Some(b'#'))
            .from_reader(bytes);
        let header = reader.headers().map_err(|e| csv_error(&path, &e))?.clone();
        if header.is_empty() {
            return Err(DemonstrationError::Empty { path });
        }
        let columns: Vec<String> = header
            .iter()
            .map(|c| c.trim_start_matches('\u{feff}').to_owned())
            .collect();
        let index = |column| find_column(&path, &columns, column);
        let wanted = [index("t")?, index("x")?, index("y")?, index("z")?];

        let mut samples: Vec<Sample> = Vec::new();
        let mut record = csv::StringRecord::new();
        while reader
            .read_record(&mut record)
            .map_err(|e| csv_error(&path, &e))?
        {
            let line = record.position().map_or(0, csv::Position::line);
            let mut values = [0.0; 4];
            for ((value, &at), column) in values.iter_mut().zip(&wanted).zip(["t", "x", "y", "z"]) {
                let text = record.get(at).unwrap_or_default();
                *value = text.parse().map_err(|_| DemonstrationError::NotANumber {
                    path: path.clone(),
                    line,
                    column,
                    text: text.to_owned(),
                })?;
                if !usable(*value) {
                    return Err(DemonstrationError::NotFinite {
                        path,
                        line,
                        column,
                        value: *value,
                    });
                }
            }
            let [t_s, x, y, z] = values;
            if let Some(last) = samples.last().filter(|last| t_s <= last.t_s) {
                return Err(DemonstrationError::Unordered {
                    line,
                    t_s,
                    previous_s: last.t_s,
                    path,
                });
            }
            samples.push(Sample {
                t_s,
                position: Vector3::new(x, y, z),
            });
        }
        if samples.is_empty() {
            return Err(DemonstrationError::Empty { path });
        }
        if samples.len() < LEAST_SAMPLES {
            return Err(DemonstrationError::TooShort {
                path,
                found: samples.len(),
            });
        }
        let ignored: Vec<String> = columns
            .iter()
            .enumerate()
            .filter(|(i, _)| !wanted.contains(i))
            .map(|(_, c)| c.clone())
            .collect();
        let notices = if ignored.is_empty() {
            Vec::new()
        } else {
            vec![Notice::IgnoredColumns {
                path: path.clone(),
                columns: ignored,
            }]
        };
        Ok(Self {
            name: path
                .file_stem()
                .map_or_else(String::new, |s| s.to_string_lossy().into_owned()),
            path,
            samples,
            sha256: Sha256::digest(bytes).into(),
            columns,
            notices,
        })
    }

    /// A demonstration that was never a file; its hash is that of the file [`Demonstration::to_csv`] would give.
    ///
    /// # Errors
    /// As [`Demonstration::read_csv`]; lines count the header.
    pub fn from_samples(
        name: impl Into<PathBuf>,
        samples: &[Sample],
    ) -> Result<Self, DemonstrationError> {
        Self::parse(name, csv_text(samples).as_bytes())
    }

    /// Its samples as CSV; reading that back gives the same numbers.
    pub fn to_csv(&self) -> String {
        csv_text(&self.samples)
    }

    /// The file's name without folder and extension.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Where it was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The samples, time strictly ascending.
    pub fn samples(&self) -> &[Sample] {
        &self.samples
    }

    /// SHA-256 of the file's bytes: a recording that was trained on is never replayed as if unseen.
    pub fn sha256(&self) -> &[u8; 32] {
        &self.sha256
    }

    /// What a reader should know about the file.
    pub fn notices(&self) -> &[Notice] {
        &self.notices
    }

    /// From the first sample to the last, s; > 0.
    pub fn duration_s(&self) -> f64 {
        self.last().t_s - self.samples[0].t_s
    }

    /// The last sample.
    pub fn last(&self) -> &Sample {
        &self.samples[self.samples.len() - 1]
    }

    /// The position (m) at `t_s`: linear between samples, the first and last position beyond them.
    pub fn position_at(&self, t_s: f64) -> Vector3<f64> {
        let after = self.samples.partition_point(|s| s.t_s <= t_s);
        let Some(b) = self.samples.get(after) else {
            return self.last().position;
        };
        if after == 0 {
            return b.position;
        }
        let a = &self.samples[after - 1];
        a.position
            .lerp(&b.position, (t_s - a.t_s) / (b.t_s - a.t_s))
    }
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
    /// Reads every `*.csv` of a folder, by name.
    ///
    /// # Errors
    /// [`DemonstrationError`]: of any of the files, or of the folder.
    pub fn read_dir(dir: impl AsRef<Path>) -> Result<Self, DemonstrationError> {
        let dir = dir.as_ref();
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
        let demonstrations = paths
            .iter()
            .map(Demonstration::read_csv)
            .collect::<Result<Vec<_>, _>>()?;
        let Some(first) = demonstrations.first() else {
            return Err(DemonstrationError::NoDemonstrations {
                path: dir.to_owned(),
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
                .collect(),
            demonstrations,
        })
    }
}

fn usable(value: f64) -> bool {
    value.abs() <= LARGEST
}

fn find_column(
    path: &Path,
    columns: &[String],
    column: &'static str,
) -> Result<usize, DemonstrationError> {
    let fault = |twice| DemonstrationError::Column {
        path: path.to_owned(),
        column,
        twice,
        found: columns.join(","),
    };
    let mut found = columns.iter().enumerate().filter(|(_, c)| *c == column);
    let (index, _) = found.next().ok_or_else(|| fault(false))?;
    match found.next() {
        Some(_) => Err(fault(true)),
        None => Ok(index),
    }
}

fn csv_error(path: &Path, error: &csv::Error) -> DemonstrationError {
    let why = match error.kind() {
        csv::ErrorKind::UnequalLengths {
            expected_len, len, ..
        } => format!("{len} fields where the header has {expected_len}"),
        csv::ErrorKind::Utf8 { .. } => "not UTF-8 text".to_owned(),
        _ => error.to_string(),
    };
    DemonstrationError::Csv {
        path: path.to_owned(),
        line: error.position().map_or(1, csv::Position::line),
        why,
    }
}

fn csv_text(samples: &[Sample]) -> String {
    let mut text = String::from("t,x,y,z\n");
    for s in samples {
        let p = &s.position;
        text += &format!("{},{},{},{}\n", s.t_s, p.x, p.y, p.z);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(rows: &[&str]) -> Result<Demonstration, DemonstrationError> {
        Demonstration::parse("skill/take.csv", rows.join("\n").as_bytes())
    }

    fn good(header: &str, row: impl Fn(usize) -> String) -> Vec<String> {
        let mut all = vec![header.to_owned()];
        all.extend((0..10).map(row));
        all
    }

    fn with(line: usize, text: &str) -> Result<Demonstration, DemonstrationError> {
        let mut rows = good("t,x,y,z", |i| format!("{},{},2,3", i as f64 * 0.1, i));
        rows[line - 1] = text.to_owned();
        lines(&rows.iter().map(String::as_str).collect::<Vec<_>>())
    }

    #[test]
    fn columns_may_come_in_any_order_with_others_between() {
        let rows = good("qw, z,t,x,note,y", |i| {
            format!("1,3,{},{i},hi,2", i as f64 * 0.1)
        });
        let d = lines(&rows.iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
        assert_eq!(d.samples()[4].position, Vector3::new(4.0, 2.0, 3.0));
        assert_eq!(d.name(), "take");
        assert_eq!(
            d.notices()[0].to_string(),
            "skill/take.csv: columns qw, note ignored"
        );
    }

    #[test]
    fn every_fault_names_file_line_and_remedy() {
        let cases = [
            (with(1, "t,x,y"), "skill/take.csv, line 1: no column \"z\""),
            (
                with(1, "t,x,y,z,z"),
                "skill/take.csv, line 1: second column \"z\"",
            ),
            (with(4, "0.2,nan,2,3"), "skill/take.csv, line 4: x is NaN"),
            (with(4, "0.2,1,2,inf"), "skill/take.csv, line 4: z is inf"),
            (with(4, "0.2,1,2,1e300"), "skill/take.csv, line 4: z is 1"),
            (
                with(5, "0.2,1,2,3"),
                "skill/take.csv, line 5: t = 0.2 s is not after the previous 0.2 s",
            ),
            (
                with(5, "0.1,1,2,3"),
                "skill/take.csv, line 5: t = 0.1 s is not after",
            ),
            (
                with(6, "0.4,1,2"),
                "skill/take.csv, line 6: 3 fields where the header has 4",
            ),
            (
                with(6, "0.4,1,2,three"),
                "skill/take.csv, line 6: z is \"three\", not a number",
            ),
            (
                with(6, "0.4,1,,3"),
                "skill/take.csv, line 6: y is \"\", not a number",
            ),
            (lines(&[]), "skill/take.csv: no samples"),
            (lines(&["t,x,y,z"]), "skill/take.csv: no samples"),
            (
                lines(&["t,x,y,z", "0,1,2,3"]),
                "skill/take.csv: 1 samples, at least 8",
            ),
        ];
        for (result, expected) in cases {
            let message = result.unwrap_err().to_string();
            assert!(
                message.starts_with(expected),
                "{message:?} for {expected:?}"
            );
            assert!(message.contains("; "), "no remedy in {message:?}");
        }
        let binary = Demonstration::parse("a.csv", b"t,x,y,z\n\xff\xfe,1,2,3\n").unwrap_err();
        assert!(
            binary.to_string().starts_with("a.csv, line 2: not UTF-8"),
            "{binary}"
        );
    }

    #[test]
    fn a_folder_is_a_skill() {
        let root = tempfile::tempdir().unwrap();
        let dir = root.path().join("wave");
        assert!(matches!(
            Demonstrations::read_dir(&dir),
            Err(DemonstrationError::Io { .. })
        ));
        fs::create_dir(&dir).unwrap();
        fs::write(dir.join("readme.txt"), "not a demonstration").unwrap();
        assert!(matches!(
            Demonstrations::read_dir(&dir),
            Err(DemonstrationError::NoDemonstrations { .. })
        ));
        let text = good("t,x,y,z", |i| format!("{i},1,2,3")).join("\n");
        fs::write(dir.join("b.csv"), &text).unwrap();
        fs::write(dir.join("a.csv"), &text).unwrap();
        let skill = Demonstrations::read_dir(&dir).unwrap();
        assert_eq!(skill.name, "wave");
        let names: Vec<_> = skill
            .demonstrations
            .iter()
            .map(Demonstration::name)
            .collect();
        assert_eq!(names, ["a", "b"]);
        assert_eq!(
            skill.demonstrations[0].sha256(),
            skill.demonstrations[1].sha256()
        );

        let wider = good("t,x,y,z,qw", |i| format!("{i},1,2,3,1")).join("\n");
        fs::write(dir.join("c.csv"), wider).unwrap();
        assert!(matches!(
            Demonstrations::read_dir(&dir),
            Err(DemonstrationError::Shape { .. })
        ));
    }

    #[test]
    fn samples_survive_their_csv_to_the_bit() {
        let samples: Vec<Sample> = (0..9)
            .map(|i| Sample {
                t_s: f64::from(i) / 30.0,
                position: Vector3::new(0.1, -1.0 / 3.0, 1e-9 * f64::from(i)),
            })
            .collect();
        let d = Demonstration::from_samples("made", &samples).unwrap();
        assert_eq!(d.samples(), samples);
        let again = Demonstration::parse("made", d.to_csv().as_bytes()).unwrap();
        assert_eq!(again, d);
    }

    #[test]
    fn positions_between_samples_are_linear_and_held_outside() {
        let d = with(2, "0,0,2,3").unwrap();
        assert_eq!(d.position_at(-1.0).x, 0.0);
        assert!((d.position_at(0.25).x - 2.5).abs() < 1e-12);
        assert_eq!(d.position_at(0.9).x, 9.0);
        assert_eq!(d.position_at(5.0).x, 9.0);
    }
}
