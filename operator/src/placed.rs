//! A skill's motion, as demonstrated or with its frames placed anew.

use std::str::FromStr;

use nalgebra::{SVector, UnitQuaternion, Vector3};
use telemime_protocol::skill::{Gmr, GmrError, Placement, Regressed, Skill, TaskModel};

use crate::demonstration::frames;

/// A frame placed by the user: `NAME=x,y,z[,qw,qx,qy,qz]`, m in the recordings' axes.
#[derive(Debug, Clone, PartialEq)]
pub struct Placed {
    /// The frame.
    pub name: String,
    /// Its origin, m.
    pub origin: Vector3<f64>,
    /// Its axes; as usual in the demonstrations if not said.
    pub turn: Option<UnitQuaternion<f64>>,
}

/// Why a skill's frames cannot be placed so.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlacedError {
    /// The text is no placement.
    #[error(
        "`{text}`: {why}; write NAME=x,y,z or NAME=x,y,z,qw,qx,qy,qz (m), for example goal=0.3,0.1,2"
    )]
    Text {
        /// What was given.
        text: String,
        /// What is wrong with it.
        why: String,
    },
    /// A frame is placed twice.
    #[error("the frame `{name}` is placed twice")]
    Twice {
        /// Its name.
        name: String,
    },
    /// The skill was learned without frames.
    #[error(
        "{skill} was learned without frames: learn it again with `telemime learn DIR --frames start,goal`"
    )]
    NoFrames {
        /// The skill.
        skill: String,
    },
    /// The skill has no frame of that name.
    #[error("{skill} has no frame `{name}`; it has {known}")]
    Unknown {
        /// The skill.
        skill: String,
        /// The name.
        name: String,
        /// The names there are.
        known: String,
    },
    /// The skill's mixture has no regression over time.
    #[error(transparent)]
    Gmr(#[from] GmrError),
}

impl FromStr for Placed {
    type Err = PlacedError;

    fn from_str(text: &str) -> Result<Self, PlacedError> {
        let fault = |why: String| PlacedError::Text {
            text: text.to_owned(),
            why,
        };
        let (name, numbers) = text
            .split_once('=')
            .ok_or_else(|| fault("no `=`".to_owned()))?;
        let numbers = numbers
            .split(',')
            .map(|n| n.trim().parse::<f64>().map_err(|_| n))
            .collect::<Result<Vec<_>, _>>()
            .map_err(|n| fault(format!("{n:?} is not a number")))?;
        Self::new(name.trim(), &numbers)
    }
}

impl Placed {
    /// From x, y, z (m) and, if there are seven numbers, a quaternion, scalar first.
    ///
    /// # Errors
    /// [`PlacedError::Text`].
    pub fn new(name: &str, numbers: &[f64]) -> Result<Self, PlacedError> {
        let fault = |why: String| PlacedError::Text {
            text: format!("{name}={numbers:?}"),
            why,
        };
        if name.is_empty() {
            return Err(fault("the name is missing".to_owned()));
        }
        let Placement { origin, turn } = frames::placement(numbers).map_err(fault)?;
        Ok(Self {
            name: name.to_owned(),
            origin,
            turn: (numbers.len() > 3).then_some(turn),
        })
    }
}

/// The motion of a skill over time.
pub struct Motion<'a> {
    skill: &'a Skill,
    plain: Gmr<1, 3>,
    task: Option<(&'a TaskModel, Vec<Placement>)>,
}

impl<'a> Motion<'a> {
    /// The motion with these frames placed; the others are where they usually were in the demonstrations. With none
    /// placed it is the motion as demonstrated.
    ///
    /// # Errors
    /// [`PlacedError`], one variant a cause.
    pub fn new(skill: &'a Skill, placed: &[Placed]) -> Result<Self, PlacedError> {
        let plain = Gmr::new(skill.motion())?;
        if placed.is_empty() {
            return Ok(Self {
                skill,
                plain,
                task: None,
            });
        }
        let Some(task) = skill.task() else {
            return Err(PlacedError::NoFrames {
                skill: skill.name().to_owned(),
            });
        };
        let mut placements: Vec<_> = task.frames().iter().map(|f| f.usual).collect();
        for (i, new) in placed.iter().enumerate() {
            if placed[..i].iter().any(|p| p.name == new.name) {
                return Err(PlacedError::Twice {
                    name: new.name.clone(),
                });
            }
            let found = task.frames().iter().position(|f| f.name == new.name);
            let at = found.ok_or_else(|| PlacedError::Unknown {
                skill: skill.name().to_owned(),
                name: new.name.clone(),
                known: names(task),
            })?;
            placements[at].origin = new.origin;
            placements[at].turn = new.turn.unwrap_or(placements[at].turn);
        }
        Ok(Self {
            skill,
            plain,
            task: Some((task, placements)),
        })
    }

    /// Whether a frame was placed: the motion is then not that of the skill's own mixture.
    pub fn is_moved(&self) -> bool {
        self.task.is_some()
    }

    /// Position (m) and its covariance (m²) at `t_s`.
    pub fn at(&self, t_s: f64) -> Regressed<3> {
        let plain = || self.plain.query(&SVector::from([t_s]));
        match &self.task {
            // There is one placement for every frame.
            Some((task, at)) => task.at(t_s, at).unwrap_or_else(|_| plain()),
            None => plain(),
        }
    }

    /// Orientation at `t_s`, where the skill has it: as demonstrated, turned as the frames are, each frame in proportion
    /// to its say on the place ([`TaskModel::turned_at`]).
    pub fn turn_at(&self, t_s: f64) -> Option<UnitQuaternion<f64>> {
        let shown = self.skill.turn()?.motion.query(t_s).mean;
        Some(match &self.task {
            Some((task, at)) => task.turned_at(t_s, at).map_or(shown, |by| by * shown),
            None => shown,
        })
    }
}

/// The names of a motion's frames, for people.
fn names(task: &TaskModel) -> String {
    let names: Vec<_> = task.frames().iter().map(|f| f.name.as_str()).collect();
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use telemime_protocol::skill::{example, posed_example};

    use super::*;

    #[test]
    fn placements_are_read() {
        let p: Placed = "goal=0.5,-1,2".parse().unwrap();
        assert_eq!((p.name.as_str(), p.turn), ("goal", None));
        assert_eq!(p.origin, Vector3::new(0.5, -1.0, 2.0));
        let p: Placed = "cup = 1,2,3, 1,0,0,0".parse().unwrap();
        assert_eq!(
            (p.name.as_str(), p.turn),
            ("cup", Some(UnitQuaternion::identity()))
        );
        for bad in [
            "goal",
            "=1,2,3",
            "goal=1,2",
            "goal=1,2,x",
            "goal=1,2,nan",
            "goal=1,2,3,1,1,1,1",
        ] {
            let error = bad.parse::<Placed>().unwrap_err().to_string();
            assert!(error.contains("write NAME=x,y,z"), "{bad}: {error}");
        }
    }

    #[test]
    fn only_frames_the_skill_has_can_be_placed_and_once() {
        let goal = || "goal=0,0,0".parse::<Placed>().unwrap();
        let plain = example(3, 1);
        assert!(matches!(
            Motion::new(&plain, &[goal()]),
            Err(PlacedError::NoFrames { .. })
        ));
        assert!(Motion::new(&plain, &[]).unwrap().turn_at(0.1).is_none());
        let posed = posed_example(4, 2);
        let Some(task) = posed.task() else {
            panic!("the example has frames")
        };
        let known = task.frames()[0].name.clone();
        let at = |name: &str| Placed {
            name: name.to_owned(),
            ..goal()
        };
        let refused = |placed: &[Placed]| match Motion::new(&posed, placed) {
            Err(e) => e.to_string(),
            Ok(_) => panic!("{placed:?} is accepted"),
        };
        assert!(refused(&[at("nowhere")]).contains(&known));
        assert!(refused(&[at(&known), at(&known)]).contains("twice"));
    }
}
