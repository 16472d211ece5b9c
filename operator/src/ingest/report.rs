//! What was read, what was changed, and what became of it.

use serde::Serialize;

use super::segment::Method;
use super::{Format, LengthUnit, TimeUnit};

/// Everything that was done to one recording. Every frame is accounted for: [`Report::accounted`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// What the file was read as.
    pub format: Format,
    /// The joint taken, of a skeleton.
    pub joint: Option<String>,
    /// The unit of its times; none where a frame rate stands for them.
    pub time_unit: Option<TimeUnit>,
    /// The frame rate that stands for times, Hz.
    pub fps: Option<f64>,
    /// The unit of its lengths.
    pub length_unit: LengthUnit,
    /// Whether orientation came along.
    pub orientation: bool,
    /// Whether a gripper came along.
    pub grip: bool,
    /// Frames in the file.
    pub frames: usize,
    /// Frames without the hand: not tracked, or no numbers there. They are holes.
    pub untracked: usize,
    /// Samples kept that the tracker only inferred.
    pub inferred: usize,
    /// Samples that came late and were put in order.
    pub reordered: usize,
    /// Samples that said again what another of the same time said, and were removed.
    pub repeated: usize,
    /// Samples of the same time as another that said something else: averaged into that.
    pub merged: usize,
    /// Samples far off the path of their neighbours, removed: their times, s.
    pub glitches_s: Vec<f64>,
    /// The largest step a removed glitch had made, as a speed, m/s.
    pub fastest_glitch_m_s: f64,
    /// The fastest step that was kept, m/s.
    pub fastest_kept_m_s: f64,
    /// Quaternions whose length was off by more than 1e-3.
    pub normalised: usize,
    /// Quaternions whose sign was turned, so that neighbours are near.
    pub flipped: usize,
    /// Cut-off of the smoothing, Hz, and the furthest it moved a sample, m.
    pub smoothed: Option<(f64, f64)>,
    /// Holes longer than the limit, at each of which the recording was split: from, to (s).
    pub holes_s: Vec<(f64, f64)>,
    /// Samples of stretches too short to use.
    pub too_short: usize,
    /// Samples outside the repetitions: long rests, the way to the first and from the last.
    pub outside: usize,
    /// How each stretch was cut.
    pub cuts: Vec<Cuts>,
    /// What came out, in order.
    pub takes: Vec<TakeReport>,
}

/// How one stretch between holes was cut.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cuts {
    /// The stretch: from, to (s).
    pub stretch_s: (f64, f64),
    /// What the cuts follow.
    pub method: Method,
    /// When, s.
    pub at_s: Vec<f64>,
    /// Time of one repetition where the motion is periodic, s.
    pub period_s: Option<f64>,
}

/// One demonstration that came out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TakeReport {
    /// Its first sample in the recording, s.
    pub from_s: f64,
    /// Its last, s.
    pub to_s: f64,
    /// Samples in it.
    pub samples: usize,
}

impl Report {
    /// Frames whose fate is told; the same as [`Report::frames`].
    pub fn accounted(&self) -> usize {
        self.untracked
            + self.repeated
            + self.merged
            + self.glitches_s.len()
            + self.too_short
            + self.outside
            + self.takes.iter().map(|t| t.samples).sum::<usize>()
    }

    /// What was changed or left out, in words; nothing if nothing was.
    pub fn changes(&self) -> Vec<String> {
        let mut out = Vec::new();
        let mut count = |n: usize, one: &str, many: &str| {
            if n > 0 {
                out.push(format!("{n} {}", if n == 1 { one } else { many }));
            }
        };
        count(
            self.untracked,
            "frame without the hand",
            "frames without the hand",
        );
        count(
            self.inferred,
            "inferred sample kept",
            "inferred samples kept",
        );
        count(
            self.reordered,
            "sample put in order",
            "samples put in order",
        );
        count(
            self.repeated,
            "repeated sample removed",
            "repeated samples removed",
        );
        count(
            self.merged,
            "sample of a time already taken averaged in",
            "samples of a time already taken averaged in",
        );
        count(self.glitches_s.len(), "glitch removed", "glitches removed");
        count(
            self.normalised,
            "quaternion normalised",
            "quaternions normalised",
        );
        count(
            self.flipped,
            "quaternion's sign turned",
            "quaternions' signs turned",
        );
        count(
            self.too_short,
            "sample in stretches too short to use",
            "samples in stretches too short to use",
        );
        count(
            self.outside,
            "sample outside the repetitions",
            "samples outside the repetitions",
        );
        if let Some((hz, moved_m)) = self.smoothed {
            out.push(format!(
                "smoothed at {hz} Hz, by {:.1} mm at most",
                moved_m * 1e3
            ));
        }
        for (from, to) in &self.holes_s {
            out.push(format!(
                "split at a hole of {:.2} s at {from:.2} s",
                to - from
            ));
        }
        out
    }
}
