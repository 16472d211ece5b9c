//! An arm, ready to be driven: model, start posture, limits, controller and plant.

use std::path::PathBuf;
use std::sync::Arc;

use nalgebra::{Isometry3, Vector3};
use telemime_protocol::wire::arm::{WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace};
use telemime_protocol::wire::v1::{Info, RobotState};
use telemime_sim::arm::{
    ArmError, ArmModel, Gripper, JointKind, Joints, LoadOptions, Plant, PlantError, default_urdf,
};

use crate::control::{ControlConfig, ControlError, Controller, home_posture, workspace_radius};
use crate::safety::SafetyConfig;
use crate::servo::{Core, CoreConfig, Rings, Workspace};

/// A workspace with a smaller radius is refused, m.
const LEAST_RADIUS_M: f64 = 0.01;

/// Which arm, and how it starts.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RigOptions {
    /// URDF file; the built-in arm by default.
    pub urdf: Option<PathBuf>,
    /// Tip link and the values of joints off the chain.
    pub load: LoadOptions,
    /// Start posture, rad or m; a well-conditioned one is searched by default.
    pub start: Option<Vec<f64>>,
    /// Bandwidth, limits and tick.
    pub control: ControlConfig,
    /// The state machine's settings.
    pub safety: SafetyConfig,
}

/// Why there is no rig.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The URDF cannot be read.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The URDF gives no arm.
    #[error("{urdf}: {source}")]
    Arm {
        /// The file.
        urdf: String,
        /// Why.
        source: ArmError,
    },
    /// The start posture does not fit the arm.
    #[error("start posture: {given} values for {dof} joints, or one outside its limits")]
    Start {
        /// Values given.
        given: usize,
        /// Joints of the arm.
        dof: usize,
    },
    /// The controller cannot drive it.
    #[error("{urdf}: {source}")]
    Control {
        /// The file.
        urdf: String,
        /// Why.
        source: ControlError,
    },
    /// The tip has no room around the start posture.
    #[error(
        "{urdf}: from the start posture the tip can go only {radius_m:.3} m in some direction before a joint's end, a singular posture or the floor; \
         choose another start posture or tip link"
    )]
    NoRoom {
        /// The file.
        urdf: String,
        /// How far, m.
        radius_m: f64,
    },
    /// The plant cannot start there.
    #[error(transparent)]
    Plant(#[from] PlantError),
}

/// An arm, ready to be driven.
#[derive(Debug, Clone)]
pub struct Rig {
    /// Its model.
    pub arm: Arc<ArmModel>,
    /// Where it starts, rad or m.
    pub home: Joints,
    /// Where the tip may be.
    pub workspace: Workspace,
    controller: Controller,
    plant: Plant,
    config: CoreConfig,
}

impl Rig {
    /// Loads and checks everything.
    ///
    /// # Errors
    /// [`RigError`].
    pub fn load(options: &RigOptions) -> Result<Self, RigError> {
        let (urdf, text) = match &options.urdf {
            None => ("the built-in arm".to_owned(), default_urdf().to_owned()),
            Some(path) => {
                let text = std::fs::read_to_string(path).map_err(|source| RigError::Io {
                    path: path.clone(),
                    source,
                })?;
                (path.display().to_string(), text)
            }
        };
        let arm = ArmModel::from_urdf(&text, &options.load).map_err(|source| RigError::Arm {
            urdf: urdf.clone(),
            source,
        })?;
        let home = match &options.start {
            None => home_posture(&arm),
            Some(q) => arm.posture(q).ok_or_else(|| RigError::Start {
                given: q.len(),
                dof: arm.dof(),
            })?,
        };
        let arm = Arc::new(arm);
        let controller =
            Controller::new(arm.clone(), &options.control, &home).map_err(|source| {
                RigError::Control {
                    urdf: urdf.clone(),
                    source,
                }
            })?;
        let radius_m = workspace_radius(&arm, &home);
        if radius_m < LEAST_RADIUS_M {
            return Err(RigError::NoRoom { urdf, radius_m });
        }
        let workspace = Workspace {
            home_m: controller.reference().p,
            radius_m,
        };
        let config = CoreConfig {
            safety: options.safety,
            tick_s: options.control.dt_s,
            lag_s: controller.lag_s(),
            workspace,
        };
        Ok(Self {
            plant: Plant::new(arm.clone(), &home)?,
            arm,
            home,
            workspace,
            controller,
            config,
        })
    }

    /// What the operator is told.
    pub fn info(&self) -> Info {
        let limits = self.controller.limits();
        let mut name = self.arm.name().to_owned();
        while name.len() > 64 {
            name.pop();
        }
        Info {
            name,
            joints: self.arm.dof() as u8,
            speed_m_s: limits.v_max as f32,
            accel_m_s2: limits.a_max as f32,
            radius_m: self.workspace.radius_m as f32,
            lag_s: self.config.lag_s as f32,
            model: None,
            state: RobotState::Idle,
        }
    }

    /// How the arm is built, for whoever draws it.
    pub fn described(&self) -> WireArm {
        let joint = |joint: &telemime_sim::arm::Joint| WireJoint {
            place: place(&joint.placement),
            axis: joint.axis.cast::<f32>().into(),
            kind: match joint.kind {
                JointKind::Revolute => WireJointKind::Revolute,
                JointKind::Prismatic => WireJointKind::Prismatic,
            },
            limits: joint
                .is_limited()
                .then_some([joint.lower as f32, joint.upper as f32]),
        };
        WireArm {
            joints: self.arm.joints().iter().map(joint).collect(),
            tip: place(self.arm.tip_offset()),
            capsules: capsules(&self.arm),
        }
    }

    /// A controller and a plant at the start posture, for a run without a session.
    pub fn parts(&self) -> (Controller, Plant) {
        (self.controller.clone(), self.plant.clone())
    }

    /// The servo's period, s.
    pub fn tick_s(&self) -> f64 {
        self.config.tick_s
    }

    /// From predicted target to tip, s.
    pub fn lag_s(&self) -> f64 {
        self.config.lag_s
    }

    /// A servo at rest at the start posture.
    pub fn servo(&self, rings: Rings) -> Core {
        Core::new(
            self.config,
            self.controller.clone(),
            self.plant.clone(),
            Gripper::default(),
            rings,
        )
    }
}

/// The first link is drawn this thick for an arm of a metre, m …
const BASE_RADIUS: f64 = 0.05;

/// … and the last one this much of it.
const TAPER: f64 = 0.4;

fn place(at: &Isometry3<f64>) -> WirePlace {
    let q = at.rotation.cast::<f32>();
    WirePlace {
        m: at.translation.vector.cast::<f32>().into(),
        q: [q.w, q.i, q.j, q.k],
    }
}

/// A capsule from every joint to the next, thinner towards the tip. The last ends short of the tip, so that it is seen.
fn capsules(arm: &ArmModel) -> Vec<WireCapsule> {
    let ways = arm.joints().iter().map(|joint| &joint.placement);
    let ways: Vec<Vector3<f64>> = ways
        .chain([arm.tip_offset()])
        .map(|at| at.translation.vector)
        .collect();
    let last = ways.len() - 1;
    let thickest = BASE_RADIUS * ways.iter().map(Vector3::norm).sum::<f64>().clamp(0.1, 3.0);
    let link = |(i, way): (usize, &Vector3<f64>)| {
        let radius = thickest * (1.0 - (1.0 - TAPER) * i as f64 / last.max(1) as f64);
        let short = if i == last { radius + 0.015 } else { 0.0 };
        let to = way * (1.0 - short / way.norm().max(1e-9)).max(0.0);
        (to.norm() > 0.1 * radius).then(|| WireCapsule {
            link: i as u8,
            // The lowest stands on the floor, not in it.
            from: if i == 0 {
                (way * (radius / way.norm()).min(0.5)).cast::<f32>().into()
            } else {
                [0.0; 3]
            },
            to: to.cast::<f32>().into(),
            radius_m: radius as f32,
        })
    };
    ways.iter().enumerate().filter_map(link).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Quaternion, Translation3, Unit, UnitQuaternion};
    use telemime_protocol::wire::v1::{Message, RobotControl};
    use telemime_sim::arm::Kinematics;

    use super::*;

    #[test]
    fn a_start_without_room_is_refused() {
        let options = RigOptions {
            start: Some(vec![0.0, 0.0, 0.0, -0.1, 0.0, 0.1, 0.0]),
            ..RigOptions::default()
        };
        let error = Rig::load(&options).unwrap_err();
        assert!(
            matches!(error, RigError::NoRoom { radius_m, .. } if radius_m < LEAST_RADIUS_M),
            "{error}"
        );
    }

    /// As the document says it is to be read.
    fn pose(at: &WirePlace) -> Isometry3<f64> {
        let [w, x, y, z] = at.q.map(f64::from);
        let [a, b, c] = at.m.map(f64::from);
        let q = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        Isometry3::from_parts(Translation3::new(a, b, c), q)
    }

    #[test]
    fn what_is_described_has_its_tip_where_the_arm_has() {
        let rig = Rig::load(&RigOptions::default()).unwrap();
        let arm = rig.described();
        let described = RobotControl::Arm(arm.clone());
        let heard = RobotControl::decode(&described.encode());
        assert_eq!(heard.as_ref(), Ok(&described));
        for turned in [0.0, 0.3, -0.2] {
            let q = rig.home.map(|q| q + turned);
            let mut at = Isometry3::identity();
            for (joint, q) in arm.joints.iter().zip(q.iter()) {
                let axis = Unit::new_normalize(Vector3::from(joint.axis.map(f64::from)));
                assert_eq!(joint.kind, WireJointKind::Revolute);
                at = at * pose(&joint.place) * UnitQuaternion::from_axis_angle(&axis, *q);
            }
            at *= pose(&arm.tip);
            let mut kinematics = Kinematics::new();
            kinematics.update(&rig.arm, &q);
            assert!((at.translation.vector - kinematics.tip()).norm() < 1e-5);
        }
        assert!(
            arm.capsules.len() >= 4,
            "a picture of an arm: {:?}",
            arm.capsules
        );
    }
}
