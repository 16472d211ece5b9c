//! Recorded links.

use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::config::Probability;

/// How a trace file is to be read. All loop at their end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TraceFormat {
    /// One-way delays, ms, one a line, packet by packet.
    Delays,
    /// Round trips, ms, one a line, packet by packet; half of each goes to either direction.
    Rtt,
    /// CSV with a header: `t_s` and any of `delay_ms`, `loss` (a fraction), `rate_kbit`; each row holds until the next.
    Series,
    /// Columns 1, 3, 5 and 7 of `rate_up,rate_down,delay_up,delay_down,loss_up,loss_down,t_ms` (Mbit/s, ms), no header.
    StarlinkUp,
    /// Columns 2, 4, 6 and 7 of the same.
    StarlinkDown,
    /// Mahimahi's delivery opportunities: ms, one a line, 1500 B each.
    Mahimahi,
}

impl TraceFormat {
    /// All there are.
    pub const ALL: [Self; 6] = [
        Self::Delays,
        Self::Rtt,
        Self::Series,
        Self::StarlinkUp,
        Self::StarlinkDown,
        Self::Mahimahi,
    ];

    /// The word for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Delays => "delays",
            Self::Rtt => "rtt",
            Self::Series => "series",
            Self::StarlinkUp => "starlink-up",
            Self::StarlinkDown => "starlink-down",
            Self::Mahimahi => "mahimahi",
        }
    }
}

/// Why a trace cannot be played.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TraceError {
    /// The file cannot be read.
    #[error("{}: cannot be read ({why}): is the name right? It begins at the folder this runs in, in a plan at the plan's", path.display())]
    Read {
        /// Which file.
        path: PathBuf,
        /// The system's reason.
        why: String,
    },
    /// The file is compressed.
    #[error("{}: is xz-compressed: unpack it first (xz -dk {})", path.display(), path.display())]
    Compressed {
        /// Which file.
        path: PathBuf,
    },
    /// Its format is not known from its first line.
    #[error("{}: say which format it has: delays, rtt, series, starlink-up, starlink-down or mahimahi (only a series names its columns)", path.display())]
    Format {
        /// Which file.
        path: PathBuf,
    },
    /// Nothing is in it.
    #[error("{}: holds no values", path.display())]
    Empty {
        /// Which file.
        path: PathBuf,
    },
    /// A line makes no sense.
    #[error("{}:{line}: {what}", path.display())]
    Line {
        /// Which file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// What is wrong with it.
        what: String,
    },
}

/// A recorded link, read and ready to be replayed.
#[derive(Clone, PartialEq)]
pub struct Trace {
    path: PathBuf,
    format: Option<TraceFormat>,
    recording: Arc<Recording>,
}

impl fmt::Debug for Trace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Trace({}, {:?})", self.path.display(), self.format)
    }
}

/// What a file held, in the link's units.
#[derive(Debug, PartialEq)]
pub(super) enum Recording {
    /// Of packet after packet, ns.
    Delays(Vec<i64>),
    /// Each from its time on.
    Steps { steps: Vec<Step>, period_ns: i64 },
    /// Times at which 1500 B leave, ns.
    Opportunities { at_ns: Vec<i64>, period_ns: i64 },
}

/// What a link is for a while.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Step {
    pub(super) from_ns: i64,
    pub(super) delay_ns: i64,
    pub(super) loss: Probability,
    /// Bytes a second; 0 is no limit.
    pub(super) rate: u64,
}

/// Bytes of one of Mahimahi's delivery opportunities.
pub(super) const OPPORTUNITY_BYTES: usize = 1500;

impl Trace {
    /// Reads `path`; without a format it must say what its columns are.
    ///
    /// # Errors
    /// [`TraceError`], by file and line.
    pub fn open(path: &Path, format: Option<TraceFormat>) -> Result<Self, TraceError> {
        Self::open_in(Path::new(""), path, format)
    }

    /// As [`Trace::open`], for a path seen from `base`.
    ///
    /// # Errors
    /// [`TraceError`], by file and line.
    pub fn open_in(
        base: &Path,
        path: &Path,
        format: Option<TraceFormat>,
    ) -> Result<Self, TraceError> {
        let found = base.join(path);
        let bytes = std::fs::read(&found).map_err(|e| TraceError::Read {
            path: found.clone(),
            why: e.to_string(),
        })?;
        if bytes.starts_with(b"\xfd7zXZ\0") {
            return Err(TraceError::Compressed { path: found });
        }
        let text = String::from_utf8(bytes).map_err(|e| {
            let read = &e.as_bytes()[..e.utf8_error().valid_up_to()];
            Reader { path: &found }.error(
                1 + read.iter().filter(|b| **b == b'\n').count(),
                "is not text",
            )
        })?;
        let recording = Reader { path: &found }.read(&text, format)?;
        Ok(Self {
            path: path.to_owned(),
            format,
            recording: Arc::new(recording),
        })
    }

    /// The file, as it was named.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The format, as it was named.
    pub fn format(&self) -> Option<TraceFormat> {
        self.format
    }

    pub(super) fn recording(&self) -> &Recording {
        &self.recording
    }

    /// Whether it brings a bottleneck of its own.
    pub fn has_rate(&self) -> bool {
        match &*self.recording {
            Recording::Delays(_) => false,
            Recording::Steps { steps, .. } => steps.iter().any(|s| s.rate > 0),
            Recording::Opportunities { .. } => true,
        }
    }

    /// Values in it: delays, rows or opportunities.
    pub fn len(&self) -> usize {
        match &*self.recording {
            Recording::Delays(delays) => delays.len(),
            Recording::Steps { steps, .. } => steps.len(),
            Recording::Opportunities { at_ns, .. } => at_ns.len(),
        }
    }

    /// Never: a trace without values is refused.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

struct Reader<'a> {
    path: &'a Path,
}

/// Where the values of a row of steps are.
struct Columns {
    count: usize,
    t: usize,
    t_unit_ns: f64,
    delay: Option<usize>,
    loss: Option<usize>,
    rate: Option<usize>,
    rate_unit_bytes_s: f64,
}

const LONGEST_MS: f64 = 3.6e6;

impl Reader<'_> {
    fn error(&self, line: usize, what: impl Into<String>) -> TraceError {
        TraceError::Line {
            path: self.path.to_owned(),
            line,
            what: what.into(),
        }
    }

    fn read(&self, text: &str, format: Option<TraceFormat>) -> Result<Recording, TraceError> {
        let path = || self.path.to_owned();
        let mut lines = text
            .lines()
            .enumerate()
            .map(|(i, line)| (i + 1, line.trim()))
            .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
            .peekable();
        let first = lines.peek().ok_or(TraceError::Empty { path: path() })?;
        let named = first.1.split(',').any(|word| word.trim() == "t_s");
        match format {
            None if named => {}
            None => return Err(TraceError::Format { path: path() }),
            Some(_) => {}
        }
        match format.unwrap_or(TraceFormat::Series) {
            TraceFormat::Delays => self.delays(lines, 1.0),
            TraceFormat::Rtt => self.delays(lines, 0.5),
            TraceFormat::Mahimahi => self.opportunities(lines),
            TraceFormat::Series => {
                let columns = match lines.next() {
                    Some((line, header)) => self.columns(line, header)?,
                    None => return Err(TraceError::Empty { path: path() }),
                };
                self.steps(lines, &columns)
            }
            TraceFormat::StarlinkUp => self.steps(lines, &starlink(0)),
            TraceFormat::StarlinkDown => self.steps(lines, &starlink(1)),
        }
    }

    fn delays<'t>(
        &self,
        lines: impl Iterator<Item = (usize, &'t str)>,
        share: f64,
    ) -> Result<Recording, TraceError> {
        let delay = |(line, text): (usize, &str)| {
            let ms = text
                .parse::<f64>()
                .ok()
                .filter(|ms| (0.0..=LONGEST_MS).contains(ms));
            ms.map(|ms| (ms * share * 1e6).round() as i64)
                .ok_or_else(|| {
                    self.error(
                        line,
                        format!("`{text}` is not a delay: one number of milliseconds a line"),
                    )
                })
        };
        Ok(Recording::Delays(
            lines.map(delay).collect::<Result<_, _>>()?,
        ))
    }

    fn opportunities<'t>(
        &self,
        lines: impl Iterator<Item = (usize, &'t str)>,
    ) -> Result<Recording, TraceError> {
        let (mut at_ns, mut last_line) = (Vec::new(), 0);
        for (line, text) in lines {
            let ms = text.parse::<u32>().map_err(|_| {
                self.error(
                    line,
                    format!("`{text}` is not a whole number of milliseconds"),
                )
            })?;
            let ns = i64::from(ms) * 1_000_000;
            if at_ns.last().is_some_and(|before| ns < *before) {
                return Err(self.error(line, format!("{ms} ms comes before the line above it")));
            }
            at_ns.push(ns);
            last_line = line;
        }
        let period_ns = at_ns.last().copied().unwrap_or(0);
        if period_ns == 0 {
            return Err(self.error(last_line, "the last opportunity must be later than 0 ms"));
        }
        Ok(Recording::Opportunities { at_ns, period_ns })
    }

    fn columns(&self, line: usize, header: &str) -> Result<Columns, TraceError> {
        let names: Vec<&str> = header.split(',').map(str::trim).collect();
        let known = ["t_s", "delay_ms", "loss", "rate_kbit"];
        if let Some(strange) = names.iter().find(|name| !known.contains(name)) {
            let what =
                format!("`{strange}` is no column of a series: t_s, delay_ms, loss, rate_kbit");
            return Err(self.error(line, what));
        }
        let place = |name| names.iter().position(|n| *n == name);
        if names.len() < 2
            || known
                .iter()
                .any(|k| names.iter().filter(|n| *n == k).count() > 1)
        {
            let what = "a series has t_s and at least one of delay_ms, loss, rate_kbit, each once";
            return Err(self.error(line, what));
        }
        let Some(t) = place("t_s") else {
            return Err(self.error(line, "a series needs a column t_s"));
        };
        Ok(Columns {
            count: names.len(),
            t,
            t_unit_ns: 1e9,
            delay: place("delay_ms"),
            loss: place("loss"),
            rate: place("rate_kbit"),
            rate_unit_bytes_s: 125.0,
        })
    }

    fn steps<'t>(
        &self,
        lines: impl Iterator<Item = (usize, &'t str)>,
        columns: &Columns,
    ) -> Result<Recording, TraceError> {
        let mut steps: Vec<Step> = Vec::new();
        let mut zero_ns = 0;
        for (line, text) in lines {
            let mut values = [f64::NAN; 7];
            let mut count = 0;
            for word in text.split(',') {
                let value = word.trim().parse::<f64>().ok().filter(|v| v.is_finite());
                let value = value.ok_or_else(|| {
                    self.error(line, format!("`{}` is not a number", word.trim()))
                })?;
                if let Some(place) = values.get_mut(count) {
                    *place = value;
                }
                count += 1;
            }
            if count != columns.count {
                let what = format!("{count} values where {} belong", columns.count);
                return Err(self.error(line, what));
            }
            let within = |at: Option<usize>, name: &str, range: std::ops::RangeInclusive<f64>| {
                let value = at.map(|i| values[i]);
                match value {
                    Some(v) if !range.contains(&v) => Err(self.error(
                        line,
                        format!("{name} {v} is outside {} to {}", range.start(), range.end()),
                    )),
                    _ => Ok(value),
                }
            };
            let t = within(Some(columns.t), "time", 0.0..=1e9)?.unwrap_or(0.0);
            let from_ns = (t * columns.t_unit_ns).round() as i64;
            if steps.is_empty() {
                zero_ns = from_ns;
            }
            let from_ns = from_ns - zero_ns;
            if steps.last().is_some_and(|before| from_ns <= before.from_ns) {
                return Err(self.error(line, "its time is not after that of the line above"));
            }
            let delay_ms = within(columns.delay, "delay", 0.0..=LONGEST_MS)?.unwrap_or(0.0);
            let loss = within(columns.loss, "loss", 0.0..=1.0)?.unwrap_or(0.0);
            let rate = match within(columns.rate, "rate", 0.0..=1e9)? {
                None => 0,
                Some(rate) => match (rate * columns.rate_unit_bytes_s) as u64 {
                    0 => return Err(self.error(line, "a rate of nothing: say loss 1 instead")),
                    rate => rate,
                },
            };
            steps.push(Step {
                from_ns,
                delay_ns: (delay_ms * 1e6).round() as i64,
                loss: Probability::of(loss),
                rate,
            });
        }
        let period_ns = match steps.as_slice() {
            [] => {
                return Err(TraceError::Empty {
                    path: self.path.to_owned(),
                });
            }
            [_] => i64::MAX,
            // The last row lasts as long as the one before it.
            [.., a, b] => b.from_ns + (b.from_ns - a.from_ns),
        };
        Ok(Recording::Steps { steps, period_ns })
    }
}

fn starlink(direction: usize) -> Columns {
    Columns {
        count: 7,
        t: 6,
        t_unit_ns: 1e6,
        delay: Some(2 + direction),
        loss: Some(4 + direction),
        rate: Some(direction),
        rate_unit_bytes_s: 125e3,
    }
}

/// How far a replay has got.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Cursor {
    /// Packets that have taken a delay, or opportunities that are over.
    count: u64,
    /// Bytes already taken of the opportunity `count`.
    taken: usize,
}

impl Cursor {
    /// The next packet's delay, ns.
    pub(super) fn delay(&mut self, delays: &[i64]) -> i64 {
        let delay = delays[(self.count % delays.len() as u64) as usize];
        self.count += 1;
        delay
    }

    /// When `len` bytes that are there at `from_ns` have left.
    pub(super) fn leave(&mut self, at_ns: &[i64], period_ns: i64, from_ns: i64, len: usize) -> i64 {
        let n = at_ns.len() as u64;
        let time = |count: u64| (count / n) as i64 * period_ns + at_ns[(count % n) as usize];
        if time(self.count) < from_ns {
            let (round, within) = (from_ns.div_euclid(period_ns), from_ns.rem_euclid(period_ns));
            let first = at_ns.partition_point(|&t| t < within) as u64;
            // At a seam two rounds may meet in one moment: the earlier one's opportunities are not over yet.
            let first = round as u64 * n + first;
            let seam = within == 0 && round > 0;
            let first = if seam {
                let last = at_ns.partition_point(|&t| t < period_ns) as u64;
                (round as u64 - 1) * n + last
            } else {
                first
            };
            *self = Self {
                count: first.max(self.count),
                taken: 0,
            };
        }
        let mut left = len;
        loop {
            let room = OPPORTUNITY_BYTES - self.taken;
            if left <= room {
                self.taken += left;
                let at = time(self.count);
                if self.taken == OPPORTUNITY_BYTES {
                    *self = Self {
                        count: self.count + 1,
                        taken: 0,
                    };
                }
                return at;
            }
            left -= room;
            *self = Self {
                count: self.count + 1,
                taken: 0,
            };
        }
    }
}

/// What holds `since_ns` after the beginning.
pub(super) fn step_at(steps: &[Step], period_ns: i64, since_ns: i64) -> Step {
    let within = since_ns.rem_euclid(period_ns);
    let after = steps.partition_point(|s| s.from_ns <= within);
    steps[after.max(1) - 1]
}
