//! Which devices there are, and what their axes and buttons mean.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use telemime_protocol::time::Stamp;

use super::{Change, RELATIVE_STANDS_S};

/// `ABS_X`, `ABS_Y`, `ABS_Z`, `ABS_RX`, `ABS_RY`, `ABS_RZ`; the relative axes of a SpaceMouse have the same numbers.
const X: u16 = 0;
const Y: u16 = 1;
const Z: u16 = 2;
const RX: u16 = 3;
const RY: u16 = 4;
const RZ: u16 = 5;

/// `BTN_0` and `BTN_1`: a SpaceMouse's left and right.
const BTN_0: u16 = 0x100;
const BTN_1: u16 = 0x101;

/// `BTN_SOUTH`, by which a gamepad is known, and its shoulders, `BTN_TL` and `BTN_TR`.
const BTN_SOUTH: u16 = 0x130;
const BTN_TL: u16 = 0x136;
const BTN_TR: u16 = 0x137;

/// A SpaceMouse pushed as far as it goes reports about this much, where the kernel states no range.
const RELATIVE_FULL: f64 = 350.0;

/// What kind of control a report is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Control {
    /// A button.
    Key,
    /// An axis whose place is reported when it changes: in between it stands.
    Absolute,
    /// An axis whose deflection is reported over and over, as long as there is any.
    Relative,
}

/// From where to where an axis goes, in its own counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Range {
    /// The least.
    pub low: i32,
    /// The most.
    pub high: i32,
}

/// What a device says it has, by the kernel's numbers.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Abilities {
    /// Buttons.
    pub keys: BTreeSet<u16>,
    /// Axes with a place.
    pub absolute: BTreeMap<u16, Range>,
    /// Axes without.
    pub relative: BTreeSet<u16>,
}

/// What a device is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Make {
    /// Two sticks and shoulder buttons.
    Gamepad,
    /// A cap that is pushed and turned along six axes.
    SpaceMouse,
}

impl fmt::Display for Make {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Gamepad => "gamepad",
            Self::SpaceMouse => "SpaceMouse",
        })
    }
}

/// What the controls of a device mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layout {
    /// What the device is.
    pub make: Make,
    /// The button that is held to run.
    pub(super) hold: u16,
    /// The button of the gripper.
    pub(super) grip: u16,
    axes: [Axis; 3],
}

impl Layout {
    /// Of a device that has these; `None` if it is neither a gamepad nor a SpaceMouse.
    ///
    /// A gamepad's left stick moves the hand forward and to the side, its right stick up and down; the left shoulder is held, the
    /// right one is the gripper's. A SpaceMouse's cap is the hand, its left button is held, its right one is the gripper's.
    pub fn of(has: &Abilities) -> Option<Self> {
        let keys = |keys: [u16; 2]| keys.iter().all(|key| has.keys.contains(key));
        let absolute = |codes: &[u16]| codes.iter().all(|code| has.absolute.contains_key(code));
        let gamepad = has.keys.contains(&BTN_SOUTH) && keys([BTN_TL, BTN_TR]);
        // Where there is no second pair by that name, a pad of a plain description has it in Z and RZ.
        let up = if absolute(&[RX, RY]) { RY } else { RZ };
        if gamepad && absolute(&[X, Y, up]) && (up == RY || absolute(&[Z])) {
            let axis = |code: u16| Axis::absolute(code, has.absolute[&code]);
            return Some(Self {
                make: Make::Gamepad,
                hold: BTN_TL,
                grip: BTN_TR,
                axes: [axis(Y), axis(X), axis(up)],
            });
        }
        let six = [X, Y, Z, RX, RY, RZ];
        let axes = if absolute(&six) {
            [Y, X, Z].map(|code| Axis::absolute(code, has.absolute[&code]))
        } else if six.iter().all(|code| has.relative.contains(code)) {
            [Y, X, Z].map(Axis::relative)
        } else {
            return None;
        };
        (!has.keys.contains(&BTN_SOUTH) && keys([BTN_0, BTN_1])).then_some(Self {
            make: Make::SpaceMouse,
            hold: BTN_0,
            grip: BTN_1,
            axes,
        })
    }

    /// Forward, left and up, all of which the devices count the other way round.
    pub(super) fn axes(&self) -> [Axis; 3] {
        self.axes
    }
}

/// One axis of a device, and where it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axis {
    control: Control,
    code: u16,
    middle: f64,
    /// From the middle to an end; 0 for an axis that has no range, and no deflection then.
    half: f64,
    value: f64,
    at: Stamp,
}

impl Axis {
    fn absolute(code: u16, range: Range) -> Self {
        let (low, high) = (f64::from(range.low), f64::from(range.high));
        let middle = (low + high) / 2.0;
        Self {
            control: Control::Absolute,
            code,
            middle,
            half: ((high - low) / 2.0).max(0.0),
            value: middle,
            at: Stamp(0),
        }
    }

    fn relative(code: u16) -> Self {
        Self {
            control: Control::Relative,
            code,
            middle: 0.0,
            half: RELATIVE_FULL,
            value: 0.0,
            at: Stamp(0),
        }
    }

    pub(super) fn take(&mut self, change: &Change) {
        if (change.control, change.code) == (self.control, self.code) {
            (self.value, self.at) = (f64::from(change.value), change.t);
        }
    }

    /// How far it is deflected at `now` in the direction it stands for, −1 to 1.
    pub(super) fn deflection(&self, now: Stamp) -> f64 {
        let stale = now.secs_since(self.at) > RELATIVE_STANDS_S;
        if self.half == 0.0 || (self.control == Control::Relative && stale) {
            return 0.0;
        }
        -((self.value - self.middle) / self.half).clamp(-1.0, 1.0)
    }
}
