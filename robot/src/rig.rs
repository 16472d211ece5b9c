//! An arm, ready to be driven: model, start posture, limits, controller and plant.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::Isometry3;
use telemime_protocol::wire::arm::{
    MAX_CAPSULES, WireArm, WireCapsule, WireJoint, WireJointKind, WirePlace,
};
use telemime_protocol::wire::v1::{Info, RobotState};
use telemime_sim::arm::{
    ArmError, ArmModel, ContactPlane, Gripper, JointKind, Joints, LoadOptions, Plant, PlantError,
    default_urdf,
};

use crate::control::{
    CloseAtStart, ControlConfig, ControlError, Controller, home_posture, workspace_radius,
};
use crate::safety::SafetyConfig;
use crate::servo::{
    Core, CoreConfig, Manipulator, Rings, SimulatedArm, Station, Trajectory, Workspace,
};

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
    /// The arm is behind a driver: its dead time is its own and not simulated, and an engage begins at the setpoint it holds.
    pub driver: bool,
    /// A surface that the simulated tip may touch.
    pub contact: Option<ContactPlane>,
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
    made_of: Arc<(String, String, RigOptions)>,
}

impl Rig {
    /// Loads and checks everything.
    ///
    /// # Errors
    /// [`RigError`].
    pub fn load(options: &RigOptions) -> Result<Self, RigError> {
        let (urdf, text) = Self::text(options.urdf.as_deref())?;
        Self::read(urdf, &text, options)
    }

    /// What an URDF is called, and its text; that of the built-in arm without a path.
    ///
    /// # Errors
    /// [`RigError::Io`].
    pub fn text(urdf: Option<&Path>) -> Result<(String, String), RigError> {
        let Some(path) = urdf else {
            return Ok(("the built-in arm".to_owned(), default_urdf().to_owned()));
        };
        let text = std::fs::read_to_string(path).map_err(|source| RigError::Io {
            path: path.to_owned(),
            source,
        })?;
        Ok((path.display().to_string(), text))
    }

    /// The arm alone, of the `text` of an URDF that is called `urdf`.
    ///
    /// # Errors
    /// [`RigError::Arm`].
    pub fn arm(urdf: &str, text: &str, options: &RigOptions) -> Result<ArmModel, RigError> {
        ArmModel::from_urdf(text, &options.load).map_err(|source| RigError::Arm {
            urdf: urdf.to_owned(),
            source,
        })
    }

    /// As [`Rig::load`], from the `text` of an URDF that is called `urdf`; `options.urdf` is not looked at.
    ///
    /// # Errors
    /// [`RigError`].
    pub fn read(urdf: String, text: &str, options: &RigOptions) -> Result<Self, RigError> {
        let arm = Self::arm(&urdf, text, options)?;
        let home = match &options.start {
            None => home_posture(&arm),
            Some(q) => arm.posture(q).ok_or_else(|| RigError::Start {
                given: q.len(),
                dof: arm.dof(),
            })?,
        };
        let arm = Arc::new(arm);
        let mut control = options.control;
        if options.driver {
            control.dead_time_s = 0.0;
        }
        let controller =
            Controller::new(arm.clone(), &control, &home).map_err(|source| RigError::Control {
                urdf: urdf.clone(),
                source,
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
            lag_s: controller.lag_s() + options.control.dead_time_s - control.dead_time_s,
            workspace,
            from_setpoint: options.driver,
        };
        Ok(Self {
            plant: Plant::new(arm.clone(), &home)?.beside(options.contact),
            arm,
            home,
            workspace,
            controller,
            config,
            made_of: Arc::new((urdf, text.to_owned(), options.clone())),
        })
    }

    /// What it was made of: what the URDF is called, its text, and the options.
    pub fn made_of(&self) -> (&str, &str, &RigOptions) {
        let (urdf, text, options) = &*self.made_of;
        (urdf, text, options)
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
        let capsule = |capsule: &telemime_sim::arm::Capsule| WireCapsule {
            link: capsule.body as u8,
            from: capsule.a.cast::<f32>().into(),
            to: capsule.b.cast::<f32>().into(),
            radius_m: capsule.radius_m as f32,
        };
        WireArm {
            joints: self.arm.joints().iter().map(joint).collect(),
            tip: place(self.arm.tip_offset()),
            capsules: self
                .arm
                .capsules()
                .iter()
                .take(MAX_CAPSULES)
                .map(capsule)
                .collect(),
        }
    }

    /// A controller and a plant at the start posture, for a run without a session.
    pub fn parts(&self) -> (Controller, Plant) {
        (self.controller.clone(), self.plant.clone())
    }

    /// The links that are not kept apart from each other because they begin too near: somebody should be told.
    pub fn close_at_start(&self) -> Vec<CloseAtStart> {
        self.controller.close_at_start()
    }

    /// The servo's period, s.
    pub fn tick_s(&self) -> f64 {
        self.config.tick_s
    }

    /// From predicted target to tip, s.
    pub fn lag_s(&self) -> f64 {
        self.config.lag_s
    }

    /// A core at rest at the start posture, the gripper open as far as `opening` if that is known; what it no longer needs goes into `spent`.
    pub fn core(&self, opening: Option<f64>, spent: rtrb::Producer<Arc<Trajectory>>) -> Core {
        Core::new(self.config, self.controller.clone(), opening, spent)
    }

    /// A servo at rest at the start posture, before the simulated arm.
    pub fn servo(&self, rings: Rings) -> Station {
        let gripper = Gripper::default();
        let opening = gripper.opening();
        let arm = SimulatedArm::new(self.plant.clone(), gripper);
        self.servo_before(Box::new(arm), Some(opening), rings)
    }

    /// A servo at rest before `arm`, which is in the start posture and whose gripper is open as far as `opening`, if that is known.
    pub fn servo_before(
        &self,
        arm: Box<dyn Manipulator>,
        opening: Option<f64>,
        rings: Rings,
    ) -> Station {
        let Rings {
            orders,
            reports,
            spent,
            brake,
        } = rings;
        Station::new(self.core(opening, spent), arm, orders, reports, brake)
    }
}

fn place(at: &Isometry3<f64>) -> WirePlace {
    let q = at.rotation.cast::<f32>();
    WirePlace {
        m: at.translation.vector.cast::<f32>().into(),
        q: [q.w, q.i, q.j, q.k],
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Quaternion, Translation3, Unit, UnitQuaternion, Vector3};
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

    #[test]
    fn what_begins_too_near_itself_is_named_and_what_keeps_nothing_apart_names_nothing() {
        assert_eq!(
            Rig::load(&RigOptions::default()).unwrap().close_at_start(),
            []
        );
        // Folded onto itself, within every joint's range.
        let mut folded = RigOptions {
            start: Some(vec![0.4, 0.5, 0.2, -2.85, 0.3, 0.6, 0.0]),
            ..RigOptions::default()
        };
        let close = Rig::load(&folded).unwrap().close_at_start();
        let told: Vec<_> = close.iter().map(ToString::to_string).collect();
        println!("{told:#?}");
        assert!(!close.is_empty());
        for (pair, told) in close.iter().zip(&told) {
            assert!(pair.distance_m < 0.03);
            assert!(pair.links.iter().all(|link| told.contains(link.as_str())));
        }
        folded.control.barrier.self_collision = false;
        assert_eq!(Rig::load(&folded).unwrap().close_at_start(), []);
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
