//! Why a raw recording cannot be converted.

use std::io;
use std::path::PathBuf;

use super::{Format, LengthUnit};
use crate::demonstration::LEAST_SAMPLES;
use crate::depth::{CameraError, FolderError};

/// Why a raw recording cannot be converted: where, and what to do. The file stands in [`IngestError`].
#[derive(Debug, thiserror::Error)]
pub enum Fault {
    /// It cannot be read or its result cannot be written.
    #[error("{0}; check that it exists and may be used")]
    Io(#[from] io::Error),
    /// The content is no text.
    #[error("line {line}: not UTF-8 text; export the recording as text (UTF-8)")]
    NotText {
        /// The line, from 1.
        line: u64,
    },
    /// Nothing in it but, perhaps, a header and remarks.
    #[error("no frames; record it again or leave the file out")]
    Empty,
    /// The CSV reader gave up.
    #[error("line {line}: {why}; correct or remove the line")]
    Csv {
        /// The line, from 1.
        line: u64,
        /// What the reader said.
        why: String,
    },
    /// Depth frames are files in a folder.
    #[error("a depth recording is a folder of 16-bit PNG files; name the folder")]
    NoFolder,
    /// The depth frames cannot be read.
    #[error("{0}")]
    Depth(#[from] FolderError),
    /// Depth frames of a size that none can be.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A line with too many or too few fields.
    #[error(
        "line {line}: {found} fields where {format} has {expected}; correct the line, cut the file there if two \
         recordings were joined, or name the format (--format)"
    )]
    Fields {
        /// The line, from 1.
        line: u64,
        /// Fields found.
        found: usize,
        /// Fields of every line.
        expected: usize,
        /// The format it is read as.
        format: Format,
    },
    /// The last frame is not complete.
    #[error(
        "line {line}: the last frame has {found} of {expected} joints: the recording was cut off; remove the lines \
         from {line} on, or export it again"
    )]
    Truncated {
        /// The first line of the frame, from 1.
        line: u64,
        /// Joints in it.
        found: usize,
        /// Joints of a frame.
        expected: usize,
    },
    /// A field that is not a number.
    #[error("line {line}: {column} is {text:?}, not a number; correct or remove the line")]
    NotANumber {
        /// The line, from 1.
        line: u64,
        /// What the field holds.
        column: String,
        /// The field.
        text: String,
    },
    /// A number that is infinite, absurdly large, or a time that is not a number.
    #[error("line {line}: {column} is {value}; correct or remove the line")]
    NotFinite {
        /// The line, from 1.
        line: u64,
        /// What the field holds.
        column: String,
        /// The number.
        value: f64,
    },
    /// A tracking state nobody knows.
    #[error(
        "line {line}: tracking state {text:?} of {joint}; known are 0 NotTracked, 1 Inferred, 2 Tracked"
    )]
    State {
        /// The line, from 1.
        line: u64,
        /// The joint.
        joint: String,
        /// The field.
        text: String,
    },
    /// The skeleton has no such joint.
    #[error("{format} has no joint {joint:?}; --joint takes one of {known}")]
    UnknownJoint {
        /// The joint asked for.
        joint: String,
        /// The format.
        format: Format,
        /// All it has, comma-separated.
        known: String,
    },
    /// The table has no such column, or twice.
    #[error(
        "line {line}: {}column {column:?} for {what} in {found}; --columns names others, as {what}=NAME or {what}=NUMBER",
        if *twice { "second " } else { "no " }
    )]
    Column {
        /// The line of the header, from 1.
        line: u64,
        /// What was to be read from it.
        what: &'static str,
        /// The column's name or number.
        column: String,
        /// Whether it is there twice.
        twice: bool,
        /// The columns there are.
        found: String,
    },
    /// No header, and more or fewer columns than `t x y z`.
    #[error(
        "line {line}: no header and {found} columns; say which is which: --columns t=1,x=2,y=3,z=4 (from 1)"
    )]
    NoHeader {
        /// The first line with numbers, from 1.
        line: u64,
        /// Columns found.
        found: usize,
    },
    /// Neither a time column nor a frame rate.
    #[error("no time column; name it (--columns t=…), or say the frame rate (--fps)")]
    NoTime,
    /// The steps in time fit no unit.
    #[error(
        "the usual step between frames is {step}, as s, ms, us or ns no frame rate from 3 to 1000 Hz; say the unit \
         (--time-unit) or the frame rate (--fps)"
    )]
    TimeUnit {
        /// The median step, in the file's unit.
        step: f64,
    },
    /// A motion of this size is none of a hand.
    #[error(
        "the hand moves through {extent} units, read as {unit}; say the unit of length (--unit m, cm or mm)"
    )]
    LengthUnit {
        /// The range of the most moved coordinate, in the file's unit.
        extent: f64,
        /// What it was taken for.
        unit: LengthUnit,
    },
    /// Time runs back further than reordering explains.
    #[error(
        "line {line}: time falls from {previous_s} s to {t_s} s: two recordings in one file, or a clock that was set; \
         cut the file there (up to --max-gap, samples are put in order)"
    )]
    Backwards {
        /// The line, from 1.
        line: u64,
        /// Its time since the first sample, s.
        t_s: f64,
        /// The latest time before it, s.
        previous_s: f64,
    },
    /// No rotation.
    #[error("line {line}: quaternion of length {norm}; no rotation, correct or remove the line")]
    Quaternion {
        /// The line, from 1.
        line: u64,
        /// Its length.
        norm: f64,
    },
    /// A gripper's opening outside its range.
    #[error(
        "line {line}: grip is {value}, outside the range from {closed} (closed) to {open} (open); state it (--grip-range)"
    )]
    Grip {
        /// The line, from 1.
        line: u64,
        /// The value, in the file's unit.
        value: f64,
        /// What closed is in that unit.
        closed: f64,
        /// What open is.
        open: f64,
    },
    /// A cut by hand outside the recording.
    #[error("no samples around the cut at {t_s} s; the recording has {parts}")]
    CutOutside {
        /// The cut, s.
        t_s: f64,
        /// The stretches there are.
        parts: String,
    },
    /// A cut by hand that leaves too little.
    #[error(
        "the piece from {from_s:.3} s to {to_s:.3} s has {found} samples, at least {LEAST_SAMPLES} are needed; move the cuts"
    )]
    CutShort {
        /// Its first sample's time, s.
        from_s: f64,
        /// Its last sample's time, s.
        to_s: f64,
        /// Samples in it.
        found: usize,
    },
    /// Nothing is left to learn from.
    #[error(
        "no stretch of {LEAST_SAMPLES} samples: {frames} frames, {untracked} of them without the hand, longest stretch \
         {longest} between holes of more than {max_gap_s} s; record it again, or raise --max-gap"
    )]
    NothingUsable {
        /// Frames in the file.
        frames: usize,
        /// Frames without the hand.
        untracked: usize,
        /// Samples of the longest stretch.
        longest: usize,
        /// The hole that splits, s.
        max_gap_s: f64,
    },
}

/// A [`Fault`] and the file it is in.
#[derive(Debug, thiserror::Error)]
#[error("{}: {fault}", path.display())]
pub struct IngestError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub fault: Fault,
}
