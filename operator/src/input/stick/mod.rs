//! A gamepad or a SpaceMouse as a hand: how far it is deflected is how fast the hand goes. Sans-IO: what the device reports
//! comes in with its time, frames of a hand go out at [`RATE_HZ`].
//!
//! Codes and directions are those of Linux: `Documentation/input/gamepad.rst` for a gamepad, and for a SpaceMouse its USB reports
//! as the kernel hands them on (x to the right, y towards the person, z down).

mod layout;
#[cfg(test)]
mod tests;

use std::io;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_protocol::time::Stamp;

use super::frame::{FARTHEST_M, Frame, Place};
use super::read::Outlet;
use super::{What, watch};

use layout::Axis;
pub use layout::{Abilities, Control, Layout, Make, Range};

/// Frames a second.
pub const RATE_HZ: f64 = 100.0;

/// Speed of the hand at full deflection unless said otherwise, m/s.
pub const SPEED_M_S: f64 = 0.25;

/// No speed below this, and none above, can be asked for, m/s.
pub const SPEEDS_M_S: (f64, f64) = (0.01, 2.0);

/// Of the way from rest to full deflection, this much is none: sticks do not come back to the middle exactly.
const DEAD_ZONE: f64 = 0.12;

/// The hand goes no farther in one step than in this time, s: a thread that was held up makes no leap.
const LONGEST_STEP_S: f64 = 0.03;

/// A relative axis that says nothing for so long is at rest, s: the kernel does not hand on a report of zero. The device speaks
/// of each axis at least every 32 ms while it is deflected.
const RELATIVE_STANDS_S: f64 = 0.06;

/// How a deflection becomes a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Manner {
    /// Speed of the hand at full deflection, m/s.
    pub speed_m_s: f64,
    /// From the hand's axes to those of the robot's base (x forward, y left, z up), in which the device's directions are meant.
    pub rotation: UnitQuaternion<f64>,
}

impl Default for Manner {
    fn default() -> Self {
        Self {
            speed_m_s: SPEED_M_S,
            rotation: UnitQuaternion::identity(),
        }
    }
}

/// Something that the device reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Change {
    /// Of what kind of control.
    pub control: Control,
    /// Which one, by the kernel's number.
    pub code: u16,
    /// What it is now; of a button, 0 is not pressed.
    pub value: i32,
    /// When it was read, on the session clock.
    pub t: Stamp,
}

/// A device and the hand it moves.
///
/// The hand moves only while the button to hold is held, and that button is the clutch: what it was at a tick is in every
/// frame; one that was held before the first tick counts once it has been let go. A second button opens and closes the gripper by turns, while the first is held; until it was pressed for the first
/// time nothing is said of the gripper, so that an arm which holds something goes on holding it.
#[derive(Debug, Clone)]
pub struct Stick {
    /// Forward, left, up.
    axes: [Axis; 3],
    hold: u16,
    grip: u16,
    manner: Manner,
    held: bool,
    /// It was held when the device was opened: nobody pressed it for this.
    stuck: bool,
    /// It was let go since the last tick.
    let_go: bool,
    grip_down: bool,
    closed: Option<bool>,
    /// m, in the hand's axes.
    place: Vector3<f64>,
    ticked: Option<Stamp>,
}

impl Stick {
    /// A device laid out like that, at rest until it says otherwise.
    pub fn new(layout: &Layout, manner: Manner) -> Self {
        Self {
            axes: layout.axes(),
            hold: layout.hold,
            grip: layout.grip,
            manner,
            held: false,
            stuck: false,
            let_go: false,
            grip_down: false,
            closed: None,
            place: Vector3::zeros(),
            ticked: None,
        }
    }

    /// Takes what the device reports.
    pub fn handle(&mut self, change: Change) {
        let down = change.value != 0;
        match change.control {
            Control::Key if change.code == self.hold => {
                self.stuck = down && (self.stuck || self.ticked.is_none());
                self.let_go |= self.held && !down;
                self.held = down && !self.stuck;
            }
            Control::Key if change.code == self.grip => {
                if down && !self.grip_down && self.held {
                    self.closed = Some(self.closed != Some(true));
                }
                self.grip_down = down;
            }
            Control::Key => {}
            Control::Absolute | Control::Relative => {
                for axis in &mut self.axes {
                    axis.take(&change);
                }
            }
        }
    }

    /// The speed of the hand at `now`, m/s in its own axes; never more than was asked for.
    fn velocity(&self, now: Stamp) -> Vector3<f64> {
        let base = Vector3::from(self.axes.map(|axis| {
            let deflected = axis.deflection(now);
            let beyond = (deflected.abs() - DEAD_ZONE).max(0.0) / (1.0 - DEAD_ZONE);
            beyond.copysign(deflected)
        }));
        let whole = base / base.norm().max(1.0);
        self.manner.rotation.inverse() * whole * self.manner.speed_m_s
    }

    /// The frames that are due at `now`: first, where the clutch was let go and pressed since the last tick, that it was let go;
    /// then where the hand is.
    pub fn tick(&mut self, now: Stamp) -> (Option<Frame>, Frame) {
        let since_s = self
            .ticked
            .replace(now)
            .map_or(0.0, |before| now.secs_since(before));
        if self.held {
            let moved = self.place + self.velocity(now) * since_s.clamp(0.0, LONGEST_STEP_S);
            self.place = moved.map(|m| m.clamp(-FARTHEST_M, FARTHEST_M));
        }
        let let_go = std::mem::take(&mut self.let_go) && self.held;
        let frame = Frame {
            t_s: None,
            hand: Some(Place {
                position: self.place,
                orientation: None,
                grip: self.closed.map(|closed| if closed { 0.0 } else { 1.0 }),
            }),
            engage: Some(self.held),
        };
        let released = Frame {
            engage: Some(false),
            ..Frame::default()
        };
        (let_go.then_some(released), frame)
    }
}

/// Hands over `stick`'s frames until nobody takes them any more, or `read` fails: then the device is gone, which is the end of
/// the source. `read` takes what has been reported so far, at the time it is given, without waiting for more.
pub fn follow(
    mut stick: Stick,
    mut read: impl FnMut(&mut Stick, Stamp) -> io::Result<()>,
    to: Outlet,
) {
    let mut due = to.now();
    loop {
        let now = to.now();
        if let Err(e) = read(&mut stick, now) {
            return to.end(format!("the device is gone ({e})"));
        }
        let (released, frame) = stick.tick(now);
        let mut frames = released.into_iter().chain([frame]);
        if !frames.all(|frame| to.put(now, What::Frame(frame))) {
            return;
        }
        // Ticks that were missed are not made up for.
        let next = due.offset_by_secs(1.0 / RATE_HZ);
        due = if next > now {
            next
        } else {
            now.offset_by_secs(1.0 / RATE_HZ)
        };
        watch::wait(&to, due);
    }
}
