//! Raw recordings in, demonstrations out: read, clean, split, cut. Every change is counted; nothing is invented.
//!
//! ```
//! use telemime_operator::ingest::{Cut, Options, import};
//! let raw: String = (0..40).map(|i| format!("{};{};0;1200\n", 33 * i, 10 * i)).collect();
//! let options = Options { length: Some("mm".parse()?), ..Options::default() };
//! let imported = import(raw.as_bytes(), &options)?;
//! assert_eq!(imported.takes.len(), 1);
//! assert_eq!(imported.takes[0].samples[39].position.x, 0.39);
//! assert_eq!(imported.report.accounted(), 40);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod columns;
mod error;
mod glitch;
mod order;
mod read;
mod report;
pub mod segment;
pub mod skeleton;
mod smooth;
mod units;

#[cfg(test)]
mod tests;

use std::path::Path;

use nalgebra::Vector3;

pub use columns::Columns;
pub use error::{Fault, IngestError};
pub use report::{Cuts, Report, TakeReport};
pub use units::{Axes, Format, LengthUnit, TimeUnit, grip_range};

use crate::demonstration::{LARGEST_EXTENT_M, LEAST_SAMPLES};
use crate::depth::{Camera, Finder, Folder, Intrinsics};
use order::Scale;
use read::{Raw, Raws};

/// Frame rate of skeletons that state no times, Hz.
pub const FPS: f64 = 30.0;

/// A hole longer than this splits a recording, s, unless said otherwise.
pub const MAX_GAP_S: f64 = 0.5;

/// The hand at one moment.
#[derive(Debug, Clone, PartialEq)]
pub struct Pose {
    /// Time since the recording's first sample, s.
    pub t_s: f64,
    /// Position, m.
    pub position: Vector3<f64>,
    /// Unit quaternion w, x, y, z.
    pub orientation: Option<[f64; 4]>,
    /// How far the gripper is open, from 0 to 1.
    pub grip: Option<f64>,
}

/// How a recording becomes demonstrations.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Cut {
    /// Each stretch between holes is one.
    #[default]
    Whole,
    /// Each repetition is one: [`segment::repetitions`].
    Repetitions,
    /// Cut at these times, s since the first sample, in any order.
    At(Vec<f64>),
}

/// What is to be read, and how it is to be cleaned.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The file's format; none, by its first line.
    pub format: Option<Format>,
    /// The joint of a skeleton.
    pub joint: String,
    /// Columns of a table; empty, by their names.
    pub columns: Columns,
    /// A frame rate in place of times, Hz; none, the file's times, or [`FPS`] for skeletons without.
    pub fps: Option<f64>,
    /// The unit of times; none, by the usual step.
    pub time: Option<TimeUnit>,
    /// The unit of lengths; none, mm for KARD, else m, and checked against what a hand can do.
    pub length: Option<LengthUnit>,
    /// The source's axes.
    pub axes: Axes,
    /// The gripper's readings when closed and when open.
    pub grip_range: (f64, f64),
    /// The camera of depth frames; none, a Kinect.
    pub camera: Option<Intrinsics>,
    /// In depth frames, the person's right hand is on the left.
    pub mirror: bool,
    /// A hole longer than this splits, s.
    pub max_gap_s: f64,
    /// Whether glitches stay.
    pub keep_glitches: bool,
    /// Cut-off of zero-phase smoothing, Hz; none, no smoothing.
    pub smooth_hz: Option<f64>,
    /// How to cut.
    pub cut: Cut,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            format: None,
            joint: "right_hand".to_owned(),
            columns: Columns::default(),
            fps: None,
            time: None,
            length: None,
            axes: Axes::default(),
            grip_range: (0.0, 1.0),
            camera: None,
            mirror: false,
            max_gap_s: MAX_GAP_S,
            keep_glitches: false,
            smooth_hz: None,
            cut: Cut::default(),
        }
    }
}

/// One demonstration: at least [`LEAST_SAMPLES`] samples, time strictly ascending from where it was in the recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Take {
    /// Its samples.
    pub samples: Vec<Pose>,
}

impl Take {
    /// As a demonstration file: `t,x,y,z[,qw,qx,qy,qz][,grip]`, time from 0. Reading it back gives the same numbers.
    pub fn to_csv(&self) -> String {
        let first = self.samples.first();
        let mut text = String::from("t,x,y,z");
        if first.is_some_and(|s| s.orientation.is_some()) {
            text += ",qw,qx,qy,qz";
        }
        if first.is_some_and(|s| s.grip.is_some()) {
            text += ",grip";
        }
        text.push('\n');
        let zero_s = first.map_or(0.0, |s| s.t_s);
        for s in &self.samples {
            let p = &s.position;
            text += &format!("{},{},{},{}", s.t_s - zero_s, p.x, p.y, p.z);
            let more = s.orientation.iter().flatten().chain(&s.grip);
            more.for_each(|v| text += &format!(",{v}"));
            text.push('\n');
        }
        text
    }
}

/// What became of one recording.
#[derive(Debug, Clone, PartialEq)]
pub struct Imported {
    /// The demonstrations, in order; at least one.
    pub takes: Vec<Take>,
    /// What was done.
    pub report: Report,
    /// The cleaned stretches between holes before they were cut.
    pub stretches: Vec<Vec<Pose>>,
}

/// Reads a raw recording and makes demonstrations of it.
///
/// # Errors
/// [`Fault`], one variant a cause.
pub fn import(bytes: &[u8], options: &Options) -> Result<Imported, Fault> {
    let raws = read::read(bytes, options.format, &options.joint, &options.columns)?;
    imported(raws, options)
}

/// The same of a folder of depth frames, in which the hand is looked for.
///
/// # Errors
/// [`Fault`], one variant a cause.
pub fn import_depth(folder: &Path, options: &Options) -> Result<Imported, Fault> {
    let folder = Folder::open(folder)?;
    let unit = options.length.unwrap_or(LengthUnit::Mm);
    let camera = Camera::new(folder.size(), options.camera, unit.metres(), options.mirror)?;
    let fps = options.fps.unwrap_or(FPS);
    let mut finder = Finder::new(camera);
    let mut samples = Vec::with_capacity(folder.len());
    for index in 0..folder.len() {
        let found = finder.find(index as f64 / fps, &folder.frame(index)?);
        samples.push(Raw {
            line: index as u64 + 1,
            t: None,
            position: found.map(|found| found.position),
            orientation: None,
            grip: None,
            inferred: false,
        });
    }
    let raws = Raws {
        format: Format::Depth,
        samples,
    };
    // What was found is in metres already.
    let options = Options {
        length: Some(LengthUnit::M),
        ..options.clone()
    };
    imported(raws, &options)
}

fn imported(mut raws: Raws, options: &Options) -> Result<Imported, Fault> {
    let mut report = opening(&raws, options)?;
    if let Some(fps) = report.fps {
        // Frames without the hand count as well: time goes on.
        for (i, raw) in raws.samples.iter_mut().enumerate() {
            raw.t = Some(i as f64);
        }
        report.time_unit = None;
        report.fps = Some(fps);
    }
    let seconds = match (report.fps, report.time_unit) {
        (Some(fps), _) => 1.0 / fps,
        (None, unit) => unit.map_or(1.0, TimeUnit::seconds),
    };
    let scale = Scale {
        seconds,
        metres: report.length_unit.metres(),
        axes: options.axes,
        grip_range: options.grip_range,
        max_gap_s: options.max_gap_s,
    };
    let poses = order::ordered(&raws.samples, &scale, &mut report)?;
    let mut stretches = order::split(poses, options.max_gap_s, &mut report);
    let longest = stretches.iter().map(Vec::len).max().unwrap_or(0);
    for stretch in &mut stretches {
        if !options.keep_glitches {
            remove_glitches(stretch, &mut report);
        }
        if let Some(hz) = options.smooth_hz {
            smooth_poses(stretch, hz, &mut report);
        }
        for w in stretch.windows(2) {
            let v = (w[1].position - w[0].position).norm() / (w[1].t_s - w[0].t_s);
            report.fastest_kept_m_s = report.fastest_kept_m_s.max(v);
        }
    }
    let takes = cut(&stretches, options, &mut report)?;
    if takes.is_empty() {
        return Err(Fault::NothingUsable {
            frames: report.frames,
            untracked: report.untracked,
            longest,
            max_gap_s: options.max_gap_s,
        });
    }
    Ok(Imported {
        takes,
        report,
        stretches,
    })
}

/// Settles units; nothing is changed yet.
fn opening(raws: &Raws, options: &Options) -> Result<Report, Fault> {
    let first = raws.samples.first();
    let timed = first.is_some_and(|r| r.t.is_some());
    let fps = match (options.fps, raws.format) {
        (Some(fps), _) => Some(fps),
        (None, Format::Kard | Format::Depth) => Some(FPS),
        (None, _) if !timed => return Err(Fault::NoTime),
        (None, _) => None,
    };
    let time_unit = match (fps, options.time) {
        (Some(_), _) => None,
        (None, Some(unit)) => Some(unit),
        (None, None) => Some(unit_of_time(&raws.samples)?),
    };
    let length_unit = match (options.length, raws.format) {
        (Some(unit), _) => unit,
        (None, Format::Kard) => LengthUnit::Mm,
        (None, _) => LengthUnit::M,
    };
    let extent = extent(&raws.samples);
    if options.length.is_none() && extent * length_unit.metres() > LARGEST_EXTENT_M {
        return Err(Fault::LengthUnit {
            extent,
            unit: length_unit,
        });
    }
    Ok(Report {
        format: raws.format,
        joint: matches!(raws.format, Format::Kard | Format::Kinect).then(|| options.joint.clone()),
        time_unit,
        fps,
        length_unit,
        orientation: raws.samples.iter().any(|r| r.orientation.is_some()),
        grip: raws.samples.iter().any(|r| r.grip.is_some()),
        frames: raws.samples.len(),
        untracked: 0,
        inferred: 0,
        reordered: 0,
        repeated: 0,
        merged: 0,
        glitches_s: Vec::new(),
        fastest_glitch_m_s: 0.0,
        fastest_kept_m_s: 0.0,
        normalised: 0,
        flipped: 0,
        smoothed: None,
        holes_s: Vec::new(),
        too_short: 0,
        outside: 0,
        cuts: Vec::new(),
        takes: Vec::new(),
    })
}

fn unit_of_time(samples: &[Raw]) -> Result<TimeUnit, Fault> {
    let times: Vec<f64> = samples.iter().filter_map(|r| r.t).collect();
    let mut steps: Vec<f64> = times
        .windows(2)
        .map(|w| w[1] - w[0])
        .filter(|d| *d > 0.0)
        .collect();
    steps.sort_by(f64::total_cmp);
    // One sample has no step, and will be refused for being alone.
    let Some(step) = steps.get(steps.len() / 2) else {
        return Ok(TimeUnit::S);
    };
    TimeUnit::of_step(*step).ok_or(Fault::TimeUnit { step: *step })
}

/// The range of the most moved coordinate without its outermost samples, in the file's unit.
fn extent(samples: &[Raw]) -> f64 {
    let range = |d: usize| {
        let mut x: Vec<f64> = samples
            .iter()
            .filter_map(|r| r.position)
            .map(|p| p[d])
            .collect();
        x.sort_by(f64::total_cmp);
        let rim = x.len() / 20;
        match (x.get(rim), x.get(x.len().saturating_sub(1 + rim))) {
            (Some(low), Some(high)) => high - low,
            _ => 0.0,
        }
    };
    (0..3).map(range).fold(0.0, f64::max)
}

fn remove_glitches(stretch: &mut Vec<Pose>, report: &mut Report) {
    let glitches = glitch::find(stretch);
    for &i in &glitches {
        let (a, b) = (&stretch[i - 1], &stretch[i]);
        let v = (b.position - a.position).norm() / (b.t_s - a.t_s);
        report.fastest_glitch_m_s = report.fastest_glitch_m_s.max(v);
        report.glitches_s.push(b.t_s);
    }
    let mut i = 0;
    stretch.retain(|_| {
        i += 1;
        glitches.binary_search(&(i - 1)).is_err()
    });
}

/// Smooths position, orientation (component by component, normalised again: samples are near each other) and grip.
fn smooth_poses(stretch: &mut [Pose], hz: f64, report: &mut Report) {
    let t: Vec<f64> = stretch.iter().map(|p| p.t_s).collect();
    let x: Vec<[f64; 8]> = stretch
        .iter()
        .map(|p| {
            let [w, i, j, k] = p.orientation.unwrap_or([1.0, 0.0, 0.0, 0.0]);
            let at = &p.position;
            [at.x, at.y, at.z, w, i, j, k, p.grip.unwrap_or(0.0)]
        })
        .collect();
    let mut moved_m = report.smoothed.map_or(0.0, |(_, moved)| moved);
    for (pose, [x, y, z, w, i, j, k, grip]) in stretch.iter_mut().zip(smooth::smooth(&t, &x, hz)) {
        let place = Vector3::new(x, y, z);
        moved_m = (place - pose.position).norm().max(moved_m);
        pose.position = place;
        let norm = (w * w + i * i + j * j + k * k).sqrt();
        pose.orientation = pose.orientation.map(|_| [w, i, j, k].map(|c| c / norm));
        pose.grip = pose.grip.map(|_| grip.clamp(0.0, 1.0));
    }
    report.smoothed = Some((hz, moved_m));
}

/// Demonstrations of the stretches, and what is left over.
fn cut(
    stretches: &[Vec<Pose>],
    options: &Options,
    report: &mut Report,
) -> Result<Vec<Take>, Fault> {
    if let Cut::At(times) = &options.cut {
        for &t_s in times {
            let inside = |s: &Vec<Pose>| {
                s.first().is_some_and(|p| p.t_s < t_s) && s.last().is_some_and(|p| t_s <= p.t_s)
            };
            if !stretches.iter().any(inside) {
                let parts: Vec<_> = stretches
                    .iter()
                    .filter_map(|s| s.first().zip(s.last()))
                    .map(|(a, b)| format!("{:.3} s to {:.3} s", a.t_s, b.t_s))
                    .collect();
                return Err(Fault::CutOutside {
                    t_s,
                    parts: parts.join(", "),
                });
            }
        }
    }
    let mut takes = Vec::new();
    for stretch in stretches {
        let found = match &options.cut {
            Cut::Whole => segment::whole(stretch),
            Cut::At(times) => segment::by_hand(stretch, times),
            Cut::Repetitions => segment::repetitions(stretch),
        };
        let Some((first, last)) = stretch.first().zip(stretch.last()) else {
            continue;
        };
        let mut used = 0;
        for range in found.ranges {
            used += range.len();
            let samples = &stretch[range];
            let (Some(a), Some(b)) = (samples.first(), samples.last()) else {
                continue;
            };
            if samples.len() < LEAST_SAMPLES {
                if matches!(options.cut, Cut::At(_)) && stretch.len() >= LEAST_SAMPLES {
                    return Err(Fault::CutShort {
                        from_s: a.t_s,
                        to_s: b.t_s,
                        found: samples.len(),
                    });
                }
                report.too_short += samples.len();
                continue;
            }
            report.takes.push(TakeReport {
                from_s: a.t_s,
                to_s: b.t_s,
                samples: samples.len(),
            });
            takes.push(Take {
                samples: samples.to_vec(),
            });
        }
        report.outside += stretch.len() - used;
        if options.cut != Cut::Whole && stretch.len() >= LEAST_SAMPLES {
            report.cuts.push(Cuts {
                stretch_s: (first.t_s, last.t_s),
                method: found.method,
                at_s: found.at_s,
                period_s: found.period_s,
            });
        }
    }
    Ok(takes)
}
