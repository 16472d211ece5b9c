//! What a tick was kept from doing.

/// What a tick was kept from doing; joints as bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clamps {
    /// The filter was at a limit of speed, acceleration or jerk.
    pub filter: bool,
    /// The orientation's filter was at a limit of angular speed, acceleration or jerk, or the joints' step that turns the tip was slowed to theirs.
    pub turning: bool,
    /// The joints' step was slowed to the speed or acceleration limits of the joints or the tip.
    pub slowed: bool,
    /// The arm is near a singular posture.
    pub singular: bool,
    /// The filter's reference was held back because the arm cannot follow.
    pub held_back: bool,
    /// The same for its orientation.
    pub turn_held_back: bool,
    /// The demand or the measured state was not finite, or its orientation not a unit quaternion: stopped, or controlled by the reference.
    pub invalid: bool,
    /// The joints' step was slowed, or led aside, to keep the links apart.
    pub near_itself: bool,
    /// The same to keep the tip and the links inside of a plane, or the target was moved there.
    pub near_plane: bool,
    /// Joints held back by their end of range.
    pub at_limit: u16,
    /// Joints whose torque was cut.
    pub torque: u16,
}

/// Ticks, and ticks on which each clamp acted, since the controller was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClampCounts {
    /// All ticks.
    pub ticks: u64,
    /// See [`Clamps::filter`].
    pub filter: u64,
    /// See [`Clamps::turning`].
    pub turning: u64,
    /// See [`Clamps::slowed`].
    pub slowed: u64,
    /// See [`Clamps::singular`].
    pub singular: u64,
    /// See [`Clamps::held_back`].
    pub held_back: u64,
    /// See [`Clamps::turn_held_back`].
    pub turn_held_back: u64,
    /// See [`Clamps::invalid`].
    pub invalid: u64,
    /// See [`Clamps::near_itself`].
    pub near_itself: u64,
    /// See [`Clamps::near_plane`].
    pub near_plane: u64,
    /// Ticks with any joint of [`Clamps::at_limit`].
    pub at_limit: u64,
    /// Ticks with any joint of [`Clamps::torque`].
    pub torque: u64,
}

impl ClampCounts {
    pub(super) fn add(&mut self, clamps: &Clamps) {
        self.ticks += 1;
        self.filter += u64::from(clamps.filter);
        self.turning += u64::from(clamps.turning);
        self.slowed += u64::from(clamps.slowed);
        self.singular += u64::from(clamps.singular);
        self.held_back += u64::from(clamps.held_back);
        self.turn_held_back += u64::from(clamps.turn_held_back);
        self.invalid += u64::from(clamps.invalid);
        self.near_itself += u64::from(clamps.near_itself);
        self.near_plane += u64::from(clamps.near_plane);
        self.at_limit += u64::from(clamps.at_limit != 0);
        self.torque += u64::from(clamps.torque != 0);
    }
}
