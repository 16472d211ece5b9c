//! Keeps the joints' reference from taking the arm into itself or through a plane.
//!
//! *Room* is how much farther apart the nearest guarded things are than they have to be. Two stages act on the joint velocities of the next tick:
//!
//! - **slow down**: wherever room r is below the slow-down distance, its rate must be at least −γ·r (a barrier, Ames et al. 2019). What of the motion
//!   breaks that is taken out along the gradient, so that the arm slides along what it must not touch;
//! - **stop**: a velocity is taken only if the arm could still come to rest with room left, each joint braking by itself as hard as the joint-limit
//!   guard lets it. Otherwise the step is slowed halfway to braking, or it brakes. A stop that was possible stays possible, so that room never runs out.
//!
//! The second is checked along the whole way to the stop, by steps that no point of the arm can be faster than (conservative advancement, Mirtich 1996).

mod kept;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use nalgebra::Vector3;
use telemime_sim::arm::{ArmModel, JointKind, Joints, Kinematics, SelfCollision};

pub use kept::{BarrierConfig, BarrierError, CloseAtStart, MAX_PLANES, Plane};

/// Room that the second stage leaves, m: what a tick may take of it unseen.
const HARD_M: f64 = 0.004;

/// Room at which the first stage allows no approach, m.
const SOFT_M: f64 = HARD_M + 0.001;

/// So much behind a plane, m, a target counts as before it.
const CLIPPED_M: f64 = 1e-9;

/// Two planes at 20° to one another are come to terms with in as many rounds.
const CLIP_ROUNDS: u32 = 200;

/// A way to a stop that takes more looks than this is too long to take.
const LOOKS: usize = 16;

/// What a tick was slowed for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Hindered {
    pub(super) by_itself: bool,
    pub(super) by_plane: bool,
}

/// What is nearest.
#[derive(Clone, Copy)]
enum Nearest {
    Itself,
    Plane,
}

impl Hindered {
    fn add(&mut self, nearest: Nearest) {
        match nearest {
            Nearest::Itself => self.by_itself = true,
            Nearest::Plane => self.by_plane = true,
        }
    }
}

/// One thing that must keep its distance.
#[derive(Clone, Copy)]
enum Guarded {
    /// Two capsules, by indices.
    Pair((usize, usize)),
    /// The tip and a plane.
    Tip(Plane),
    /// A capsule and a plane.
    Link(Plane, usize),
}

impl Guarded {
    fn kind(&self) -> Nearest {
        match self {
            Self::Pair(_) => Nearest::Itself,
            Self::Tip(_) | Self::Link(..) => Nearest::Plane,
        }
    }
}

/// See the module.
#[derive(Clone, Debug)]
pub(super) struct Barrier {
    arm: Arc<ArmModel>,
    config: BarrierConfig,
    dt_s: f64,
    accelerations: Joints,
    /// No point moves faster per unit of speed of a joint, m/rad.
    reaches: Joints,
    hulls: SelfCollision,
    /// Capsules (bits) that each plane guards.
    links: [u32; MAX_PLANES],
    kinematics: Kinematics,
    /// A posture, and the room there.
    known: (Joints, f64),
}

impl Barrier {
    /// A barrier for an arm that starts at `start`, its joints braking at `accelerations` (rad/s², m/s²).
    pub(super) fn new(
        arm: Arc<ArmModel>,
        config: &BarrierConfig,
        accelerations: Joints,
        start: &Joints,
        dt_s: f64,
    ) -> Result<Self, BarrierError> {
        for (what, value, least, most) in [
            ("stop distance, m,", config.stop_m, 0.0, 1.0),
            ("slow-down distance, m,", config.slow_m, 0.01, 1.0),
            ("barrier's gain, 1/s,", config.gain, 0.1, 0.1 / dt_s),
        ] {
            if !(least..=most).contains(&value) {
                return Err(BarrierError::Range {
                    what,
                    value,
                    least,
                    most,
                });
            }
        }
        let mut kinematics = Kinematics::new();
        kinematics.update(&arm, start);
        let mut hulls = config.hulls(&arm, start);
        hulls.place(&kinematics);
        let mut links = [0_u32; MAX_PLANES];
        for (links, plane) in links.iter_mut().zip(&config.planes) {
            let Some(plane) = plane else { continue };
            let height_m = plane.height_m(&kinematics.tip());
            if height_m < SOFT_M {
                return Err(BarrierError::StartsOutside {
                    normal: plane.normal.into(),
                    offset_m: plane.offset_m,
                    height_m,
                });
            }
            for i in 0..arm.capsules().len() {
                // The last body is the tool: its tip is what a plane is about. The base does not move.
                let between = (1..arm.dof()).contains(&hulls.body(i));
                let inside = link_room(&hulls, plane, i).0 > 2.0 * SOFT_M;
                *links |= u32::from(between && inside) << i;
            }
        }
        Ok(Self {
            reaches: reaches(&arm),
            arm,
            config: *config,
            dt_s,
            accelerations,
            hulls,
            links,
            kinematics,
            known: (*start, f64::NEG_INFINITY),
        })
    }

    /// The links that it does not keep apart because they begin too near each other; none where no links are.
    pub(super) fn close_at_start(&self) -> Vec<CloseAtStart> {
        if self.config.self_collision {
            CloseAtStart::among(&self.arm, &self.hulls)
        } else {
            Vec::new()
        }
    }

    /// All that a later tick depends on: a posture, and the room there, m.
    pub(super) fn known(&self) -> &(Joints, f64) {
        &self.known
    }

    /// Goes on from what was once [known](Self::known).
    pub(super) fn restore(&mut self, known: (Joints, f64)) {
        self.known = known;
    }

    /// A place near `target` that no plane excludes, and whether that is another one: the nearest, where one plane is in the way or several at right
    /// angles. At oblique planes it is the limit of moving it back over one after the other; where planes leave no room it is behind some of them.
    pub(super) fn clip(&self, target: Vector3<f64>) -> (Vector3<f64>, bool) {
        let mut clipped = target;
        for _ in 0..CLIP_ROUNDS {
            let before = clipped;
            for plane in self.config.planes.iter().flatten() {
                let short = SOFT_M - plane.height_m(&clipped);
                if short > CLIPPED_M {
                    clipped += plane.normal * short;
                }
            }
            if clipped == before {
                break;
            }
        }
        (clipped, clipped != target)
    }

    /// The joint velocities for the next tick, as near to `wanted` as is safe, from `q` at `qd`. `wanted` is within the windows `lower` to `upper` and
    /// within `most` of `qd`, and so is what is returned.
    pub(super) fn guard(
        &mut self,
        (q, qd): (&Joints, &Joints),
        wanted: Joints,
        (lower, upper): (&Joints, &Joints),
        most: &Joints,
    ) -> (Joints, Hindered) {
        let mut hindered = Hindered::default();
        if self.far(q, &wanted) {
            return (wanted, hindered);
        }
        let (room, _) = self.room(q);
        self.known = (*q, room);
        if self.far(q, &wanted) {
            return (wanted, hindered);
        }
        let mut next = wanted;
        for _ in 0..2 {
            self.slow(&mut next, &mut hindered);
        }
        for i in 0..self.arm.dof() {
            next[i] = next[i].clamp(lower[i].max(-f64::MAX), upper[i].min(f64::MAX));
            next[i] = next[i].clamp(qd[i] - most[i], qd[i] + most[i]);
        }
        let brake = qd.zip_map(most, |qd, most| qd - qd.clamp(-most, most));
        let floor = room.min(HARD_M);
        for share in [1.0, 0.5] {
            let candidate = brake + (next - brake) * share;
            match self.stops(q, qd, &candidate, floor) {
                Ok(()) => return (candidate, hindered),
                Err(nearest) => hindered.add(nearest),
            }
        }
        (brake, hindered)
    }

    /// Whether all that is guarded is so far away that nothing has to be looked at before the arm is at rest again.
    fn far(&self, q: &Joints, next: &Joints) -> bool {
        let (known, room) = &self.known;
        let mut way = 0.0;
        for i in 0..self.arm.dof() {
            let ahead =
                next[i].abs() * self.dt_s + braking(next[i], self.accelerations[i], self.dt_s);
            way += self.reaches[i] * ((q[i] - known[i]).abs() + ahead);
        }
        room - way > self.config.slow_m + SOFT_M
    }

    fn guarded(&self) -> impl Iterator<Item = Guarded> + '_ {
        let pairs = if self.config.self_collision {
            self.hulls.pairs()
        } else {
            &[]
        };
        let planes = self.config.planes.iter().zip(&self.links);
        let planes = planes.filter_map(|(plane, links)| Some(((*plane)?, *links)));
        let of_planes = planes.flat_map(|(plane, links)| {
            let links = (0..32_usize).filter(move |i| links >> i & 1 == 1);
            let links = links.map(move |i| Guarded::Link(plane, i));
            std::iter::once(Guarded::Tip(plane)).chain(links)
        });
        pairs.iter().map(|p| Guarded::Pair(*p)).chain(of_planes)
    }

    /// Room at the posture that the capsules were placed in.
    fn room_of(&self, guarded: Guarded) -> f64 {
        match guarded {
            Guarded::Pair(pair) => self.hulls.proximity(pair).distance_m - self.config.stop_m,
            Guarded::Tip(plane) => plane.height_m(&self.kinematics.tip()),
            Guarded::Link(plane, i) => link_room(&self.hulls, &plane, i).0,
        }
    }

    /// Places the capsules for `q`; how much room there is, and where least.
    fn room(&mut self, q: &Joints) -> (f64, Nearest) {
        self.kinematics.update(&self.arm, q);
        self.hulls.place(&self.kinematics);
        let mut least = (f64::INFINITY, Nearest::Itself);
        for guarded in self.guarded() {
            let room = self.room_of(guarded);
            if room < least.0 {
                least = (room, guarded.kind());
            }
        }
        least
    }

    /// How room changes with the joints.
    fn gradient(&self, guarded: Guarded) -> Option<Joints> {
        let (normal, point, joints) = match guarded {
            Guarded::Pair((a, b)) => {
                let proximity = self.hulls.proximity((a, b));
                let joints = self.hulls.body(a)..self.hulls.body(b);
                (proximity.normal()?, proximity.on_b, joints)
            }
            Guarded::Tip(plane) => (plane.normal, self.kinematics.tip(), 0..self.arm.dof()),
            Guarded::Link(plane, i) => {
                let (_, lowest) = link_room(&self.hulls, &plane, i);
                (plane.normal, lowest, 0..self.hulls.body(i))
            }
        };
        let mut gradient = Joints::zeros();
        for j in joints {
            gradient[j] = normal.dot(&self.kinematics.point_rate(j, &point));
        }
        Some(gradient)
    }

    /// The first stage, at the posture that the capsules were placed in.
    fn slow(&self, next: &mut Joints, hindered: &mut Hindered) {
        for guarded in self.guarded() {
            let room = self.room_of(guarded) - SOFT_M;
            if room > self.config.slow_m {
                continue;
            }
            let Some(gradient) = self.gradient(guarded) else {
                continue;
            };
            let (rate, square) = (gradient.dot(next), gradient.norm_squared());
            let least = -self.config.gain * room;
            if rate < least && square > 1e-9 {
                *next += gradient * ((least - rate) / square);
                hindered.add(guarded.kind());
            }
        }
    }

    /// The second stage: whether the arm, at `next` after this tick, can come to rest with `floor` of room all the way; if not, what is in the way.
    fn stops(&mut self, q: &Joints, qd: &Joints, next: &Joints, floor: f64) -> Result<(), Nearest> {
        let from = q + (qd + next) * (0.5 * self.dt_s);
        let mut t = 0.0;
        for _ in 0..LOOKS {
            let mut at = from;
            let (mut fastest, mut left) = (0.0, 0.0);
            for i in 0..self.arm.dof() {
                let (v, a) = (next[i].abs(), self.accelerations[i]);
                let gone = braked(v, a, t, self.dt_s);
                at[i] += gone.copysign(next[i]);
                // The last tick's rest goes at half its speed.
                fastest += self.reaches[i] * (v - a * t).max(0.5 * v.min(a * self.dt_s));
                left += self.reaches[i] * (braking(v, a, self.dt_s) - gone);
            }
            let (room, nearest) = self.room(&at);
            if !(room >= floor) {
                return Err(nearest);
            }
            if left <= 1e-9 {
                return Ok(());
            }
            // An arm that begins too near may use up what is beyond where it began.
            let free = (room - floor.min(0.0)).max(1e-4);
            t = if left <= free {
                f64::INFINITY
            } else {
                t + free / fastest
            };
        }
        Err(Nearest::Itself)
    }
}

/// How far (m) a capsule's surface is inside a plane, and the end of its line that is nearest to it.
fn link_room(hulls: &SelfCollision, plane: &Plane, i: usize) -> (f64, Vector3<f64>) {
    let (a, b, radius) = hulls.placed(i);
    let (at_a, at_b) = (plane.height_m(&a), plane.height_m(&b));
    if at_a < at_b {
        (at_a - radius, a)
    } else {
        (at_b - radius, b)
    }
}

/// The way (rad, m) from speed `v` to rest, braking by `a` tick by tick, within the last of which the rest goes linearly.
fn braking(v: f64, a: f64, dt_s: f64) -> f64 {
    braked(v.abs(), a, f64::INFINITY, dt_s)
}

/// The part of that way that is gone after `t` seconds; `v` ≥ 0.
fn braked(v: f64, a: f64, t: f64, dt_s: f64) -> f64 {
    if v == 0.0 {
        return 0.0;
    }
    let whole = (v / (a * dt_s)).floor() * dt_s;
    let braking = t.min(whole);
    let gone = v * braking - 0.5 * a * braking * braking;
    let last = ((t - whole) / dt_s).clamp(0.0, 1.0);
    gone + 0.5 * (v - a * whole).max(0.0) * dt_s * last
}

/// For each joint, how far from its axis any point beyond it can be; 1 for a slide.
fn reaches(arm: &ArmModel) -> Joints {
    let joints = arm.joints();
    let mut out = Joints::zeros();
    let mut beyond = 0.0_f64;
    for i in (0..arm.dof()).rev() {
        let extent = arm.capsules().iter().filter(|c| c.body == i + 1);
        let extent = extent
            .map(telemime_sim::arm::Capsule::extent_m)
            .fold(0.0, f64::max);
        let tip = if i + 1 == arm.dof() {
            arm.tip_offset().translation.vector.norm()
        } else {
            0.0
        };
        beyond = beyond.max(extent).max(tip);
        let slide = joints[i].kind == JointKind::Prismatic;
        out[i] = if slide { 1.0 } else { beyond };
        let travel = joints[i].lower.abs().max(joints[i].upper.abs());
        beyond += joints[i].placement.translation.vector.norm();
        beyond += if !slide {
            0.0
        } else if travel.is_finite() {
            travel
        } else {
            1.0
        };
    }
    out
}
