//! Samples in order of time, one at a time, parted where the hand was away.

use nalgebra::Vector3;

use super::read::Raw;
use super::{Axes, Fault, Pose, Report};

/// Two samples nearer in time than this are of one moment, s.
const SAME_S: f64 = 1e-6;

/// A quaternion shorter than this is no rotation.
const LEAST_NORM: f64 = 1e-3;

/// In what units and axes a file's numbers are to be taken.
pub(super) struct Scale {
    pub(super) seconds: f64,
    pub(super) metres: f64,
    pub(super) axes: Axes,
    pub(super) grip_range: (f64, f64),
    pub(super) max_gap_s: f64,
}

/// Seen samples in our units, ordered and without two of one time. `t` of every raw sample is set.
///
/// Reordered packets are put back in order; a step back of more than `max_gap_s` is another recording or a set clock, and sorting
/// would weave two motions into one: refused.
pub(super) fn ordered(raw: &[Raw], scale: &Scale, report: &mut Report) -> Result<Vec<Pose>, Fault> {
    let zero = raw.first().and_then(|r| r.t).unwrap_or(0.0);
    let mut latest_s = f64::NEG_INFINITY;
    let mut poses: Vec<Pose> = Vec::with_capacity(raw.len());
    for sample in raw {
        let t_s = (sample.t.unwrap_or(zero) - zero) * scale.seconds;
        if latest_s - t_s > scale.max_gap_s {
            return Err(Fault::Backwards {
                line: sample.line,
                t_s,
                previous_s: latest_s,
            });
        }
        if t_s < latest_s {
            report.reordered += 1;
        }
        latest_s = latest_s.max(t_s);
        let Some(position) = sample.position else {
            report.untracked += 1;
            continue;
        };
        report.inferred += usize::from(sample.inferred);
        let orientation = match sample.orientation {
            None => None,
            Some(q) => {
                let norm = norm(&q);
                if norm < LEAST_NORM {
                    return Err(Fault::Quaternion {
                        line: sample.line,
                        norm,
                    });
                }
                report.normalised += usize::from((norm - 1.0).abs() > 1e-3);
                Some(scale.axes.orientation(q.map(|c| c / norm)))
            }
        };
        let (closed, open) = scale.grip_range;
        let grip = sample.grip.map(|g| (g - closed) / (open - closed));
        if let (Some(grip), Some(value)) = (grip, sample.grip)
            && !(0.0..=1.0).contains(&grip)
        {
            return Err(Fault::Grip {
                line: sample.line,
                value,
                closed,
                open,
            });
        }
        poses.push(Pose {
            t_s,
            position: scale.axes.position(position * scale.metres),
            orientation,
            grip,
        });
    }
    poses.sort_by(|a, b| a.t_s.total_cmp(&b.t_s));
    continuous_sign(&mut poses, report);
    Ok(one_each(&poses, report))
}

fn norm(q: &[f64; 4]) -> f64 {
    q.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// Turns signs so that each quaternion is on its predecessor's side; q and −q are the same rotation.
fn continuous_sign(poses: &mut [Pose], report: &mut Report) {
    let mut before: Option<[f64; 4]> = None;
    for q in poses.iter_mut().filter_map(|p| p.orientation.as_mut()) {
        let dot = before.map_or(0.0, |b| b.iter().zip(q.iter()).map(|(b, q)| b * q).sum());
        if dot < 0.0 {
            *q = q.map(|c| -c);
            report.flipped += 1;
        }
        before = Some(*q);
    }
}

/// The average of what was said of one moment.
fn one_each(poses: &[Pose], report: &mut Report) -> Vec<Pose> {
    let mut out: Vec<Pose> = Vec::with_capacity(poses.len());
    let mut rest = poses;
    while let [first, ..] = rest {
        let same = rest.partition_point(|p| p.t_s - first.t_s < SAME_S);
        let (group, after) = rest.split_at(same);
        rest = after;
        let n = group.len() as f64;
        let repeats = |p: &&Pose| {
            p.position == first.position
                && p.orientation == first.orientation
                && p.grip == first.grip
        };
        let repeated = group.iter().filter(repeats).count() - 1;
        report.repeated += repeated;
        report.merged += group.len() - 1 - repeated;
        if repeated + 1 == group.len() {
            out.push(first.clone());
            continue;
        }
        let orientation = first.orientation.map(|_| {
            let mut sum = [0.0; 4];
            for q in group.iter().filter_map(|p| p.orientation) {
                sum.iter_mut().zip(q).for_each(|(s, q)| *s += q);
            }
            let norm = norm(&sum);
            sum.map(|c| c / norm)
        });
        out.push(Pose {
            t_s: first.t_s,
            position: group.iter().map(|p| p.position).sum::<Vector3<f64>>() / n,
            orientation,
            grip: first
                .grip
                .map(|_| group.iter().filter_map(|p| p.grip).sum::<f64>() / n),
        });
    }
    out
}

/// Parts the samples at every hole longer than `max_gap_s`; shorter ones are uneven sampling, which all that follows takes.
pub(super) fn split(poses: Vec<Pose>, max_gap_s: f64, report: &mut Report) -> Vec<Vec<Pose>> {
    let mut parts: Vec<Vec<Pose>> = Vec::new();
    for pose in poses {
        match parts.last_mut() {
            Some(part) if part.last().is_some_and(|p| pose.t_s - p.t_s <= max_gap_s) => {
                part.push(pose);
            }
            last => {
                if let Some(before) = last.and_then(|part| part.last()) {
                    report.holes_s.push((before.t_s, pose.t_s));
                }
                parts.push(vec![pose]);
            }
        }
    }
    parts
}
