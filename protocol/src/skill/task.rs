//! A motion learned relative to frames (start, goal, an object) and reproduced for new ones.
//! Calinon 2016, "A tutorial on task-parameterized movement learning and retrieval", eq. (5)–(7) and §5.1:
//! every frame has its own mixture and regression; where they are placed decides whose opinion counts.

use nalgebra::{Matrix3, SVector, UnitQuaternion, Vector3};

use super::gmr::{Gmr, GmrError, Regressed};
use super::{Gmm, MAX_NAME_BYTES};
use crate::pose;

/// The most frames a motion may be relative to.
pub const MAX_FRAMES: usize = 8;

/// Why mixtures are not a motion relative to frames.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TaskError {
    /// No frame, or more than [`MAX_FRAMES`].
    #[error("{found} frames, 1 to {MAX_FRAMES} are possible")]
    Count {
        /// Frames offered.
        found: usize,
    },
    /// A frame's name is empty, too long, or used twice.
    #[error("frame {name:?}: a name has 1 to {MAX_NAME_BYTES} bytes and is used once")]
    Name {
        /// The name.
        name: String,
    },
    /// A frame's mixture cannot be conditioned on time.
    #[error("frame {name:?}: {error}")]
    Gmr {
        /// The frame.
        name: String,
        /// Why.
        error: GmrError,
    },
    /// Not one placement for each frame.
    #[error("{found} placements for {expected} frames")]
    Placements {
        /// Placements given.
        found: usize,
        /// Frames.
        expected: usize,
    },
}

/// Where a frame is: what it is at, and how it is turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// Its origin, m.
    pub origin: Vector3<f64>,
    /// Its axes: takes vectors of the frame to vectors of the world.
    pub turn: UnitQuaternion<f64>,
}

/// The motion as one frame saw it: a mixture over (t s, x m, y m, z m) in that frame's axes.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskFrame {
    /// The frame's name.
    pub name: String,
    /// The mixture.
    pub motion: Gmm<4>,
    /// Where the frame was in the demonstrations, on average: where it is if nothing else is said.
    pub usual: Placement,
}

/// A motion relative to 1 to [`MAX_FRAMES`] frames.
#[derive(Debug, Clone)]
pub struct TaskModel {
    frames: Vec<TaskFrame>,
    regressions: Vec<Gmr<1, 3>>,
}

impl PartialEq for TaskModel {
    fn eq(&self, other: &Self) -> bool {
        self.frames == other.frames
    }
}

impl TaskModel {
    /// Checks the frames and conditions their mixtures on time.
    ///
    /// # Errors
    /// [`TaskError`], one variant a cause.
    pub fn new(frames: Vec<TaskFrame>) -> Result<Self, TaskError> {
        if !(1..=MAX_FRAMES).contains(&frames.len()) {
            return Err(TaskError::Count {
                found: frames.len(),
            });
        }
        let mut regressions = Vec::with_capacity(frames.len());
        for (i, frame) in frames.iter().enumerate() {
            let name = &frame.name;
            let twice = frames[..i].iter().any(|f| f.name == *name);
            if twice || !(1..=MAX_NAME_BYTES).contains(&name.len()) {
                return Err(TaskError::Name { name: name.clone() });
            }
            regressions.push(Gmr::new(&frame.motion).map_err(|error| TaskError::Gmr {
                name: name.clone(),
                error,
            })?);
        }
        Ok(Self {
            frames,
            regressions,
        })
    }

    /// The frames.
    pub fn frames(&self) -> &[TaskFrame] {
        &self.frames
    }

    /// The motion at `t_s` with the frames placed so, in order: the product of what each frame says. No allocation.
    ///
    /// `Λ = Σ_f (R_f Σ_f R_fᵀ)⁻¹; x̂ = Λ⁻¹ Σ_f (R_f Σ_f R_fᵀ)⁻¹ (R_f μ_f + o_f)`
    ///
    /// # Errors
    /// [`TaskError::Placements`].
    pub fn at(&self, t_s: f64, placements: &[Placement]) -> Result<Regressed<3>, TaskError> {
        let mut precision = Matrix3::zeros();
        let mut pull = Vector3::zeros();
        let mut about = None;
        self.says(t_s, placements, |placement, sure, mean| {
            // Positions are taken about one of the origins: a frame far from the tracker's origin loses no digits.
            let about = *about.get_or_insert(placement.origin);
            precision += sure;
            pull += sure * (mean + (placement.origin - about));
        })?;
        let covariance = precision.try_inverse().unwrap_or_else(Matrix3::zeros);
        Ok(Regressed {
            mean: about.unwrap_or_else(|| placements[0].origin) + covariance * pull,
            covariance: (covariance + covariance.transpose()) * 0.5,
        })
    }

    /// How the hand is turned at `t_s`, in the world, beyond what was demonstrated, with the frames placed so.
    ///
    /// Each frame asks for what turns its usual axes into those placed. They are heard in proportion to their
    /// say on the place then, `tr(Λ⁻¹Λ_f)/3`: at the end of a motion towards a goal that is turned, the hand
    /// is turned with it, at the start it is not. No allocation.
    ///
    /// # Errors
    /// [`TaskError::Placements`].
    pub fn turned_at(
        &self,
        t_s: f64,
        placements: &[Placement],
    ) -> Result<UnitQuaternion<f64>, TaskError> {
        let mut precision = Matrix3::zeros();
        self.says(t_s, placements, |_, sure, _| precision += sure)?;
        let all = precision.try_inverse().unwrap_or_else(Matrix3::zeros);
        let mut asked = [(0.0, UnitQuaternion::identity()); MAX_FRAMES];
        let mut frames = self.frames.iter().zip(&mut asked);
        self.says(t_s, placements, |placement, sure, _| {
            if let Some((frame, asked)) = frames.next() {
                let share = (all * sure).trace().max(0.0);
                *asked = (share, placement.turn * frame.usual.turn.inverse());
            }
        })?;
        Ok(pose::mean(asked.into_iter()).unwrap_or_else(UnitQuaternion::identity))
    }

    /// Calls `each(placement, precision, mean)` for every frame, in order: what it says in the world's axes,
    /// the mean relative to its origin. A frame whose covariance cannot be inverted has nothing to say: precision 0.
    fn says(
        &self,
        t_s: f64,
        placements: &[Placement],
        mut each: impl FnMut(&Placement, Matrix3<f64>, Vector3<f64>),
    ) -> Result<(), TaskError> {
        if placements.len() != self.frames.len() {
            return Err(TaskError::Placements {
                found: placements.len(),
                expected: self.frames.len(),
            });
        }
        for (gmr, placement) in self.regressions.iter().zip(placements) {
            let local = gmr.query(&SVector::from([t_s]));
            let axes = placement.turn.to_rotation_matrix().into_inner();
            let covariance = axes * local.covariance * axes.transpose();
            let sure = covariance.try_inverse().unwrap_or_else(Matrix3::zeros);
            each(placement, sure, axes * local.mean);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix4, Vector4};

    use super::*;

    /// A frame that is sure of itself near `when` and sees the motion pass through its origin then.
    fn frame(name: &str, when: f64) -> TaskFrame {
        let part = |t: f64, sure: bool| {
            let mut s = Matrix4::identity() * if sure { 1e-6 } else { 1.0 };
            s[(0, 0)] = 0.02;
            (0.5, Vector4::new(t, 0.0, 0.0, 0.0), s)
        };
        TaskFrame {
            name: name.to_owned(),
            motion: Gmm::new([part(when, true), part(1.0 - when, false)]).unwrap(),
            usual: Placement {
                origin: Vector3::zeros(),
                turn: UnitQuaternion::identity(),
            },
        }
    }

    fn at(origin: [f64; 3]) -> Placement {
        Placement {
            origin: origin.into(),
            turn: UnitQuaternion::identity(),
        }
    }

    #[test]
    fn who_is_sure_decides() {
        let task = TaskModel::new(vec![frame("start", 0.0), frame("goal", 1.0)]).unwrap();
        let placed = [at([0.1, 0.2, 0.3]), at([1.0, -1.0, 0.5])];
        let (first, last) = (
            task.at(0.0, &placed).unwrap(),
            task.at(1.0, &placed).unwrap(),
        );
        assert!((first.mean - placed[0].origin).norm() < 1e-4);
        assert!((last.mean - placed[1].origin).norm() < 1e-4);
        assert!(first.covariance.trace() < 1e-4);
    }

    #[test]
    fn moving_every_frame_alike_moves_the_motion_alike() {
        let mut goal = frame("goal", 1.0);
        goal.motion = Gmm::new(goal.motion.components().iter().map(|c| {
            let mean = c.mean() + Vector4::new(0.0, 0.3, -0.1, 0.2);
            let mut s = *c.covariance();
            s[(1, 1)] *= 3.0;
            (c.weight(), mean, s)
        }))
        .unwrap();
        let task = TaskModel::new(vec![frame("start", 0.0), goal]).unwrap();
        let placed = [at([0.1, 0.2, 0.3]), at([1.0, -1.0, 0.5])];
        let turn = UnitQuaternion::from_euler_angles(0.3, -1.0, 2.0);
        let shift = Vector3::new(10.0, 20.0, -30.0);
        let moved = placed.map(|p| Placement {
            origin: turn * p.origin + shift,
            turn: turn * p.turn,
        });
        for t_s in [0.0, 0.2, 0.5, 0.9] {
            let (a, b) = (
                task.at(t_s, &placed).unwrap(),
                task.at(t_s, &moved).unwrap(),
            );
            assert!((turn * a.mean + shift - b.mean).norm() < 1e-9);
            let axes = turn.to_rotation_matrix().into_inner();
            assert!((axes * a.covariance * axes.transpose() - b.covariance).norm() < 1e-9);
        }
    }

    #[test]
    fn the_hand_turns_with_the_frame_it_is_near() {
        let task = TaskModel::new(vec![frame("start", 0.0), frame("goal", 1.0)]).unwrap();
        let mut placed = [at([0.0; 3]), at([1.0, -1.0, 0.5])];
        let none = task.turned_at(0.5, &placed).unwrap();
        assert!(none.angle() < 1e-9);
        placed[1].turn = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.8);
        let turned = |t_s| task.turned_at(t_s, &placed).unwrap();
        assert!(turned(0.0).angle() < 1e-3);
        assert!(turned(1.0).angle_to(&placed[1].turn) < 1e-3);
        let half = turned(0.5);
        assert!((half.angle() - 0.4).abs() < 1e-6, "{}", half.angle());
    }

    #[test]
    fn what_is_no_task_is_refused() {
        assert_eq!(
            TaskModel::new(Vec::new()),
            Err(TaskError::Count { found: 0 })
        );
        let twice = vec![frame("goal", 0.0), frame("goal", 1.0)];
        assert!(matches!(TaskModel::new(twice), Err(TaskError::Name { .. })));
        let task = TaskModel::new(vec![frame("goal", 1.0)]).unwrap();
        assert!(matches!(
            task.at(0.0, &[]),
            Err(TaskError::Placements {
                found: 0,
                expected: 1
            })
        ));
    }
}
