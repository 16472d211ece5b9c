//! Recorded demonstrations: `t,x,y,z[,qw,qx,qy,qz][,grip]` CSV, one file each; a folder is a skill.
//! Comment lines may place objects: `# frame NAME x y z [qw qx qy qz]`.

mod error;
mod folder;
pub(crate) mod frames;
mod person;
#[cfg(test)]
mod tests;

use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use sha2::{Digest, Sha256};

use telemime_protocol::pose;
use telemime_protocol::skill::Placement;

pub use error::{DemonstrationError, Notice};
pub use folder::Demonstrations;
pub use person::{PersonPattern, PersonPatternError};

/// A demonstration needs at least this many samples.
pub const LEAST_SAMPLES: usize = 8;

/// The largest coordinate (m) and time (s) a recording may hold: beyond it the unit is wrong.
const LARGEST: f64 = 1e6;

/// A longer time without a sample (s) hides motion, or is stated in another unit.
const LONGEST_GAP_S: f64 = 2.0;

/// A hand moves through less than this; more, and the unit of length is wrong, m.
pub(crate) const LARGEST_EXTENT_M: f64 = 10.0;

/// The hand at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Time since the first sample, s.
    pub t_s: f64,
    /// Position, m.
    pub position: Vector3<f64>,
    /// Orientation, where the recording has it: from the hand's own axes to the tracker's. Of q and −q, which
    /// are the same, the one nearer to the sample before.
    pub orientation: Option<UnitQuaternion<f64>>,
    /// How far the gripper is open, from 0 to 1, where the recording has it.
    pub grip: Option<f64>,
}

impl Sample {
    /// A position (m) at a time (s), and nothing else.
    pub fn at(t_s: f64, position: Vector3<f64>) -> Self {
        Self {
            t_s,
            position,
            orientation: None,
            grip: None,
        }
    }
}

/// The columns of a quaternion, scalar first.
const QUATERNION: [&str; 4] = ["qw", "qx", "qy", "qz"];

/// A quaternion's norm may be off by this much: it is written with a few digits.
const NORM_SLACK: f64 = 0.01;

/// What the times of a recording mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Times {
    /// Only their differences: they count from the first sample, and long holes are refused.
    FromFirst,
    /// What is written.
    AsWritten,
}

/// One performance of a skill: at least [`LEAST_SAMPLES`] finite samples, time strictly ascending.
#[derive(Debug, Clone, PartialEq)]
pub struct Demonstration {
    name: String,
    path: PathBuf,
    samples: Vec<Sample>,
    frames: Vec<(String, Placement)>,
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
        Self::read(path.as_ref(), Times::FromFirst)
    }

    /// Reads what a hand did beside a motion that is played: times are kept, s from its beginning, and holes are where
    /// the hand was not there.
    ///
    /// # Errors
    /// As [`Demonstration::read_csv`], holes of any length allowed.
    pub fn read_beside(path: impl AsRef<Path>) -> Result<Self, DemonstrationError> {
        Self::read(path.as_ref(), Times::AsWritten)
    }

    fn read(path: &Path, times: Times) -> Result<Self, DemonstrationError> {
        let bytes = fs::read(path).map_err(|source| DemonstrationError::Io {
            path: path.to_owned(),
            source,
        })?;
        Self::parse_as(path.to_owned(), &bytes, times)
    }

    /// Parses the content of a CSV file; `path` names it, and need not exist.
    ///
    /// # Errors
    /// As [`Demonstration::read_csv`].
    pub fn parse(path: impl Into<PathBuf>, bytes: &[u8]) -> Result<Self, DemonstrationError> {
        Self::parse_as(path.into(), bytes, Times::FromFirst)
    }

    fn parse_as(path: PathBuf, bytes: &[u8], times: Times) -> Result<Self, DemonstrationError> {
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
        let named = |column: &str| columns.iter().any(|c| c == column);
        let turn = if QUATERNION.into_iter().any(named) {
            let [w, x, y, z] = QUATERNION;
            Some([index(w)?, index(x)?, index(y)?, index(z)?])
        } else {
            None
        };
        let grip = if named("grip") {
            Some(index("grip")?)
        } else {
            None
        };

        let mut samples: Vec<Sample> = Vec::new();
        // Recordings stamped since 1970 are as good as any: only differences mean something.
        let mut zero_s = (times == Times::AsWritten).then_some(0.0);
        let mut record = csv::StringRecord::new();
        while reader
            .read_record(&mut record)
            .map_err(|e| csv_error(&path, &e))?
        {
            let line = record.position().map_or(0, csv::Position::line);
            let mut values = [0.0_f64; 4];
            let number = |at: usize, column| {
                let text = record.get(at).unwrap_or_default();
                text.parse::<f64>()
                    .map_err(|_| DemonstrationError::NotANumber {
                        path: path.clone(),
                        line,
                        column,
                        text: text.to_owned(),
                    })
            };
            for ((value, &at), column) in values.iter_mut().zip(&wanted).zip(["t", "x", "y", "z"]) {
                *value = number(at, column)?;
                if column == "t" && value.is_finite() {
                    *value -= *zero_s.get_or_insert(*value);
                }
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
            let gap_s = samples.last().map_or(0.0, |last| t_s - last.t_s);
            if gap_s > LONGEST_GAP_S && times == Times::FromFirst {
                return Err(DemonstrationError::Gap { path, line, gap_s });
            }
            let orientation = match &turn {
                None => None,
                Some(at) => {
                    let mut q = [0.0; 4];
                    for ((q, &at), column) in q.iter_mut().zip(at).zip(QUATERNION) {
                        *q = number(at, column)?;
                    }
                    let [w, i, j, k] = q;
                    let q = Quaternion::new(w, i, j, k);
                    let norm = q.norm();
                    // Written so that NaN fails too.
                    if !((norm - 1.0).abs() <= NORM_SLACK) {
                        return Err(DemonstrationError::NotARotation { path, line, norm });
                    }
                    let before = samples.last().and_then(|s| s.orientation);
                    let q = UnitQuaternion::from_quaternion(q);
                    let away = before.is_some_and(|b| b.coords.dot(&q.coords) < 0.0);
                    Some(if away {
                        UnitQuaternion::new_unchecked(-q.into_inner())
                    } else {
                        q
                    })
                }
            };
            let grip = grip.map(|at| number(at, "grip")).transpose()?;
            if let Some(value) = grip.filter(|grip| !(0.0..=1.0).contains(grip)) {
                return Err(DemonstrationError::Grip { path, line, value });
            }
            samples.push(Sample {
                t_s,
                position: Vector3::new(x, y, z),
                orientation,
                grip,
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
        let extent_m = extent_m(&samples);
        if extent_m > LARGEST_EXTENT_M {
            return Err(DemonstrationError::Extent { path, extent_m });
        }
        let ignored: Vec<String> = columns
            .iter()
            .enumerate()
            .filter(|(i, _)| !wanted.contains(i) && grip != Some(*i))
            .filter(|(i, _)| !turn.is_some_and(|turn| turn.contains(i)))
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
            frames: frames::parse(&path, bytes)?,
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
        Self::parse(name, csv_text(&[], samples).as_bytes())
    }

    /// The same path in 1/`pace` of the time, sampled evenly at the mean rate of this one; name and hash stay.
    pub(crate) fn paced(&self, pace: f64) -> Self {
        let step_s = self.duration_s() / (self.samples.len() - 1) as f64;
        let steps = (self.duration_s() / (pace * step_s)).floor() as usize;
        let at = |i: usize| {
            let t_s = i as f64 * step_s;
            let own_s = self.samples[0].t_s + t_s * pace;
            Sample {
                t_s,
                position: self.position_at(own_s),
                orientation: self.orientation_at(own_s),
                grip: self.grip_at(own_s),
            }
        };
        Self {
            samples: (0..=steps).map(at).collect(),
            ..self.clone()
        }
    }

    /// The same motion, `by` (m) from here; name, hash and frames stay.
    pub(crate) fn shifted(&self, by: &Vector3<f64>) -> Self {
        let mut copy = self.clone();
        copy.samples.iter_mut().for_each(|s| s.position += by);
        copy
    }

    /// Whether every sample has an orientation.
    pub fn has_orientation(&self) -> bool {
        self.samples.iter().all(|s| s.orientation.is_some())
    }

    /// Whether every sample says how far the gripper is open.
    pub fn has_grip(&self) -> bool {
        self.samples.iter().all(|s| s.grip.is_some())
    }

    /// Its samples and frames as CSV; reading that back gives the same numbers.
    pub fn to_csv(&self) -> String {
        csv_text(&self.frames, &self.samples)
    }

    /// The frames its comment lines `# frame NAME x y z [qw qx qy qz]` place (m), in the order of the file.
    pub fn frames(&self) -> &[(String, Placement)] {
        &self.frames
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
        let (a, b, u) = self.around(t_s);
        a.position.lerp(&b.position, u)
    }

    /// The orientation at `t_s`: along the shortest rotation between samples, the first and last beyond them;
    /// `None` if the recording has none.
    pub fn orientation_at(&self, t_s: f64) -> Option<UnitQuaternion<f64>> {
        let (a, b, u) = self.around(t_s);
        let (a, b) = (a.orientation?, b.orientation?);
        Some(pose::moved(&a, &(pose::between(&a, &b) * u)))
    }

    /// How far the gripper is open at `t_s`: linear between samples, the first and last value beyond them; `None`
    /// if the recording does not say.
    pub fn grip_at(&self, t_s: f64) -> Option<f64> {
        let (a, b, u) = self.around(t_s);
        let (a, b) = (a.grip?, b.grip?);
        Some(a + (b - a) * u)
    }

    /// The samples before and after `t_s`, and how far it is from the one to the other, from 0 to below 1.
    fn around(&self, t_s: f64) -> (&Sample, &Sample, f64) {
        let after = self.samples.partition_point(|s| s.t_s <= t_s);
        let Some(b) = self.samples.get(after) else {
            return (self.last(), self.last(), 0.0);
        };
        if after == 0 {
            return (b, b, 0.0);
        }
        let a = &self.samples[after - 1];
        (a, b, (t_s - a.t_s) / (b.t_s - a.t_s))
    }
}

/// The range of the most moved coordinate, m.
fn extent_m(samples: &[Sample]) -> f64 {
    let mut low = Vector3::repeat(f64::INFINITY);
    let mut high = -low;
    for s in samples {
        low = low.inf(&s.position);
        high = high.sup(&s.position);
    }
    (high - low).max()
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

/// A column that not every sample has is left out.
fn csv_text(frames: &[(String, Placement)], samples: &[Sample]) -> String {
    let mut text = frames::to_text(frames);
    text += "t,x,y,z";
    let turns = samples.iter().all(|s| s.orientation.is_some());
    let grips = samples.iter().all(|s| s.grip.is_some());
    text += if turns { ",qw,qx,qy,qz" } else { "" };
    text += if grips { ",grip\n" } else { "\n" };
    for s in samples {
        let p = &s.position;
        text += &format!("{},{},{},{}", s.t_s, p.x, p.y, p.z);
        if let Some(q) = s.orientation.filter(|_| turns) {
            text += &format!(",{},{},{},{}", q.w, q.i, q.j, q.k);
        }
        if let Some(grip) = s.grip.filter(|_| grips) {
            text += &format!(",{grip}");
        }
        text += "\n";
    }
    text
}
