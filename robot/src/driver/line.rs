//! The lines of a driver: what they may be, and what they are refused for.

use serde::{Deserialize, Serialize};
use telemime_sim::arm::{Joints, MAX_JOINTS};

use super::Sent;
use crate::servo::ArmState;

/// The version of the lines.
pub const VERSION: u32 = 1;

/// The first line of a driver.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hello {
    /// [`VERSION`].
    pub telemime_driver: u32,
    /// The joints in order, named as in the URDF.
    pub joints: Vec<String>,
    /// States it tells, and setpoints it takes, a second.
    pub rate_hz: f64,
}

/// Every other line.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    q: Vec<f64>,
    qd: Vec<f64>,
    #[serde(default)]
    opening: Option<f64>,
    #[serde(default)]
    seq: u64,
}

/// A line that says what is wrong.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Fault {
    fault: String,
}

/// What a line after the first says.
#[derive(Debug, Clone, PartialEq)]
pub enum Said {
    /// The joints' state, and the setpoint that is obeyed.
    State(ArmState, u64),
    /// Something is wrong, in the driver's own words.
    Fault(String),
}

/// Why a line is none.
#[derive(Debug, thiserror::Error)]
pub enum LineError {
    /// No JSON object of the kind.
    #[error("{0}")]
    Json(#[from] serde_json::Error),
    /// Another version.
    #[error("it speaks version {found} of the driver's lines, this program {VERSION}")]
    Version {
        /// Its version.
        found: u32,
    },
    /// A rate that is none.
    #[error("rate_hz is {value}: write one from 10 to 1000")]
    Rate {
        /// The value.
        value: f64,
    },
    /// Another number of joints.
    #[error("{what} has {given} values for {joints} joints")]
    Count {
        /// `q`, `qd` or `joints`.
        what: &'static str,
        /// Values given.
        given: usize,
        /// Joints of the arm.
        joints: usize,
    },
}

/// The first line.
///
/// # Errors
/// [`LineError`].
pub fn hello(line: &[u8]) -> Result<Hello, LineError> {
    let hello: Hello = serde_json::from_slice(line)?;
    if hello.telemime_driver != VERSION {
        return Err(LineError::Version {
            found: hello.telemime_driver,
        });
    }
    if !(hello.rate_hz >= 10.0 && hello.rate_hz <= super::FASTEST_HZ) {
        return Err(LineError::Rate {
            value: hello.rate_hz,
        });
    }
    let given = hello.joints.len();
    if given == 0 || given > MAX_JOINTS {
        return Err(LineError::Count {
            what: "joints",
            given,
            joints: MAX_JOINTS,
        });
    }
    Ok(hello)
}

/// Any other line, of an arm with `dof` joints.
///
/// # Errors
/// [`LineError`].
pub fn said(line: &[u8], dof: usize) -> Result<Said, LineError> {
    if let Ok(Fault { fault }) = serde_json::from_slice(line) {
        return Ok(Said::Fault(fault));
    }
    let State {
        q,
        qd,
        opening,
        seq,
    } = serde_json::from_slice(line)?;
    let joints = |what, values: &[f64]| {
        let mut joints = Joints::zeros();
        if values.len() != dof {
            return Err(LineError::Count {
                what,
                given: values.len(),
                joints: dof,
            });
        }
        joints.as_mut_slice()[..dof].copy_from_slice(values);
        Ok(joints)
    };
    let state = ArmState {
        q: joints("q", &q)?,
        qd: joints("qd", &qd)?,
        opening: opening.map(|opening| opening.clamp(0.0, 1.0)),
    };
    Ok(Said::State(state, seq))
}

#[derive(Serialize)]
struct Line<'a> {
    seq: u64,
    t_ns: i64,
    q: &'a [f64],
    qd: &'a [f64],
    qdd: &'a [f64],
    tau: &'a [f64],
    #[serde(skip_serializing_if = "Option::is_none")]
    opening: Option<f64>,
}

/// A setpoint as a line, with its end, for an arm with `dof` joints; into `line` in place of what that holds.
pub fn setpoint(sent: &Sent, dof: usize, line: &mut Vec<u8>) {
    let reference = &sent.setpoint.reference;
    line.clear();
    let told = Line {
        seq: sent.seq,
        t_ns: sent.at.0,
        q: &reference.q.as_slice()[..dof],
        qd: &reference.qd.as_slice()[..dof],
        qdd: &reference.qdd.as_slice()[..dof],
        tau: &sent.setpoint.tau.as_slice()[..dof],
        opening: sent.setpoint.opening,
    };
    // Numbers and their names always encode, and a vector always has room.
    let _ = serde_json::to_writer(&mut *line, &told);
    line.push(b'\n');
}
