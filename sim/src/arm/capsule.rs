//! Capsules around the links, and how near they come to each other.

use nalgebra::{Isometry3, Vector3};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};

use super::{ArmModel, JointKind, Joints, Kinematics, MAX_JOINTS};

/// The most capsules an arm has; a body with more shapes keeps the thickest.
pub const MAX_CAPSULES: usize = 32;

/// Postures that are looked at to find which pairs are always close.
const SAMPLES: usize = 2000;

/// A pair that is nearer than the stop distance in this share of them says nothing about a collision.
const ALWAYS: f64 = 0.95;

/// Where a capsule's size comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CapsuleSource {
    /// A box, cylinder, capsule or sphere of the URDF, which it encloses.
    Geometry,
    /// The line from one joint's origin to the next (the last: to the tip), as thick as a solid cylinder of the body's mass and smallest
    /// principal moment, √(2·I/m), within 0.02 to 0.1 of the chain's length (0.05 where there is no inertia to go by): meshes are not read.
    Derived,
}

/// All points within `radius_m` of the line from `a` to `b`.
#[derive(Clone, Debug, PartialEq)]
pub struct Capsule {
    /// The body it moves with: 0 is the base, `i` what joint `i − 1` moves.
    pub body: usize,
    /// A link of that body.
    pub link: String,
    /// One end of the line, in the frame of the joint that moves the body (of the base), m.
    pub a: Vector3<f64>,
    /// The other end, m.
    pub b: Vector3<f64>,
    /// Radius, m.
    pub radius_m: f64,
    /// Where its size comes from.
    pub source: CapsuleSource,
}

impl Capsule {
    /// Whether `other` lies inside, both being of one body.
    pub(super) fn contains(&self, other: &Self) -> bool {
        let inside = |p: &Vector3<f64>| {
            let (on, _) = closest_on_segments(&self.a, &self.b, p, p);
            (on - p).norm() + other.radius_m <= self.radius_m + 1e-9
        };
        self.body == other.body && inside(&other.a) && inside(&other.b)
    }

    /// The farthest any point of it is from its frame's origin, m.
    pub fn extent_m(&self) -> f64 {
        self.a.norm().max(self.b.norm()) + self.radius_m
    }

    pub(super) fn around(
        body: usize,
        link: &str,
        pose: &Isometry3<f64>,
        half_length_m: f64,
        radius_m: f64,
    ) -> Self {
        let end = |z: f64| {
            pose.transform_point(&Vector3::new(0.0, 0.0, z).into())
                .coords
        };
        Self {
            body,
            link: link.to_owned(),
            a: end(-half_length_m),
            b: end(half_length_m),
            radius_m,
            source: CapsuleSource::Geometry,
        }
    }
}

/// Two capsules at their nearest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Proximity {
    /// Between their surfaces, m; negative if they overlap.
    pub distance_m: f64,
    /// The point of the first capsule's line that is nearest to the second's, base axes, m.
    pub on_a: Vector3<f64>,
    /// And of the second's.
    pub on_b: Vector3<f64>,
}

impl Proximity {
    /// The unit direction from the first to the second; `None` where their lines meet.
    pub fn normal(&self) -> Option<Vector3<f64>> {
        (self.on_b - self.on_a).try_normalize(1e-9)
    }
}

/// The pair of capsules that is nearest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Nearest {
    /// Indices into [`ArmModel::capsules`].
    pub pair: (usize, usize),
    /// How near.
    pub proximity: Proximity,
}

/// Why a pair of capsules is not looked at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Unguarded {
    /// Closer than the stop distance in nearly all postures: neighbours in all but name, or a wrist's links around one point.
    AlwaysClose {
        /// Share of the sampled postures.
        share: f64,
    },
    /// Closer than the stop distance in the start posture already: the capsules must be too thick there.
    AtStart {
        /// Their distance there, m.
        distance_m: f64,
    },
}

/// The pairs of an arm's capsules that must not meet, and where the capsules are.
///
/// Capsules of one body and of bodies that share a joint are no pair. Nothing here allocates after [`new`](Self::new).
#[derive(Clone, Debug)]
pub struct SelfCollision {
    pairs: Vec<(usize, usize)>,
    unguarded: Vec<((usize, usize), Unguarded)>,
    bodies: Vec<usize>,
    local: Vec<(Vector3<f64>, Vector3<f64>, f64)>,
    placed: [(Vector3<f64>, Vector3<f64>); MAX_CAPSULES],
}

impl SelfCollision {
    /// The pairs of `arm` that are farther apart than `stop_m` at `start` and in at least a twentieth of 2000 sampled postures: the same for the same arm.
    pub fn new(arm: &ArmModel, start: &Joints, stop_m: f64) -> Self {
        let capsules = arm.capsules();
        let mut pairs = Vec::new();
        for (i, a) in capsules.iter().enumerate() {
            for (j, b) in capsules.iter().enumerate().skip(i + 1) {
                if a.body.abs_diff(b.body) > 1 {
                    pairs.push((i, j));
                }
            }
        }
        let mut all = Self {
            pairs,
            unguarded: Vec::new(),
            bodies: capsules.iter().map(|c| c.body).collect(),
            local: capsules.iter().map(|c| (c.a, c.b, c.radius_m)).collect(),
            placed: [(Vector3::zeros(), Vector3::zeros()); MAX_CAPSULES],
        };
        let mut kinematics = Kinematics::new();
        kinematics.update(arm, start);
        all.place(&kinematics);
        let at_start: Vec<f64> = all
            .pairs
            .iter()
            .map(|p| all.proximity(*p).distance_m)
            .collect();
        let mut close = vec![0_usize; all.pairs.len()];
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(0x0ca9_5c1e);
        for _ in 0..SAMPLES {
            kinematics.update(arm, &random_posture(arm, &mut rng));
            all.place(&kinematics);
            for (count, pair) in close.iter_mut().zip(&all.pairs) {
                *count += usize::from(all.proximity(*pair).distance_m < stop_m);
            }
        }
        let found = std::mem::take(&mut all.pairs);
        for ((pair, close), distance_m) in found.into_iter().zip(close).zip(at_start) {
            let share = close as f64 / SAMPLES as f64;
            if share > ALWAYS {
                all.unguarded.push((pair, Unguarded::AlwaysClose { share }));
            } else if distance_m < stop_m {
                all.unguarded
                    .push((pair, Unguarded::AtStart { distance_m }));
            } else {
                all.pairs.push(pair);
            }
        }
        all
    }

    /// The pairs that are looked at: indices into [`ArmModel::capsules`], the first nearer to the base.
    pub fn pairs(&self) -> &[(usize, usize)] {
        &self.pairs
    }

    /// The pairs that are not, beside those that share a body or a joint, and why.
    pub fn unguarded(&self) -> &[((usize, usize), Unguarded)] {
        &self.unguarded
    }

    /// Puts the capsules where `kinematics` has the links.
    pub fn place(&mut self, kinematics: &Kinematics) {
        for ((placed, (a, b, _)), body) in self.placed.iter_mut().zip(&self.local).zip(&self.bodies)
        {
            *placed = match body.checked_sub(1) {
                None => (*a, *b),
                Some(i) => {
                    let (rotation, origin) = (&kinematics.rotations[i], &kinematics.origins[i]);
                    (rotation * a + origin, rotation * b + origin)
                }
            };
        }
    }

    /// The body that capsule `i` moves with: 0 is the base.
    pub fn body(&self, i: usize) -> usize {
        self.bodies[i]
    }

    /// The ends of capsule `i`'s line in base axes, m, and its radius, m.
    pub fn placed(&self, i: usize) -> (Vector3<f64>, Vector3<f64>, f64) {
        let (a, b) = self.placed[i];
        (a, b, self.local[i].2)
    }

    /// How near the capsules `i` and `j` are.
    pub fn proximity(&self, (i, j): (usize, usize)) -> Proximity {
        let ((a0, a1), (b0, b1)) = (self.placed[i], self.placed[j]);
        let (on_a, on_b) = closest_on_segments(&a0, &a1, &b0, &b1);
        Proximity {
            distance_m: (on_b - on_a).norm() - self.local[i].2 - self.local[j].2,
            on_a,
            on_b,
        }
    }

    /// The nearest of all pairs; `None` if there is no pair.
    pub fn nearest(&self) -> Option<Nearest> {
        let mut nearest: Option<Nearest> = None;
        for &pair in &self.pairs {
            let proximity = self.proximity(pair);
            if nearest.is_none_or(|n| proximity.distance_m < n.proximity.distance_m) {
                nearest = Some(Nearest { pair, proximity });
            }
        }
        nearest
    }
}

/// The nearest points of the segments p0 p1 and q0 q1 (Ericson 2005, §5.1.9), either of which may be a point.
fn closest_on_segments(
    p0: &Vector3<f64>,
    p1: &Vector3<f64>,
    q0: &Vector3<f64>,
    q1: &Vector3<f64>,
) -> (Vector3<f64>, Vector3<f64>) {
    const POINT_M2: f64 = 1e-18;
    let (u, v, r) = (p1 - p0, q1 - q0, p0 - q0);
    let (a, e, f) = (u.norm_squared(), v.norm_squared(), v.dot(&r));
    let (s, t) = if a <= POINT_M2 {
        (
            0.0,
            if e <= POINT_M2 {
                0.0
            } else {
                (f / e).clamp(0.0, 1.0)
            },
        )
    } else {
        let c = u.dot(&r);
        if e <= POINT_M2 {
            ((-c / a).clamp(0.0, 1.0), 0.0)
        } else {
            let b = u.dot(&v);
            let parallel = a * e - b * b;
            let s = if parallel > 1e-12 * a * e {
                ((b * f - c * e) / parallel).clamp(0.0, 1.0)
            } else {
                0.0
            };
            let t = (b * s + f) / e;
            if t < 0.0 {
                ((-c / a).clamp(0.0, 1.0), 0.0)
            } else if t > 1.0 {
                (((b - c) / a).clamp(0.0, 1.0), 1.0)
            } else {
                (s, t)
            }
        }
    };
    (p0 + u * s, q0 + v * t)
}

/// Joint values uniform in their ranges: a turn where there is no end, a metre where a slide has none.
pub(super) fn random_posture(arm: &ArmModel, rng: &mut Xoshiro256PlusPlus) -> Joints {
    let mut q = Joints::zeros();
    for (q, joint) in q.iter_mut().zip(arm.joints()).take(MAX_JOINTS) {
        let free = match joint.kind {
            JointKind::Revolute => core::f64::consts::PI,
            JointKind::Prismatic => 0.5,
        };
        let (lower, upper) = match (joint.lower.is_finite(), joint.upper.is_finite()) {
            (true, true) => (joint.lower, joint.upper),
            (true, false) => (joint.lower, joint.lower + 2.0 * free),
            (false, true) => (joint.upper - 2.0 * free, joint.upper),
            (false, false) => (-free, free),
        };
        let unit = (rng.next_u64() >> 11) as f64 * (1.0 / (1_u64 << 53) as f64);
        *q = lower + (upper - lower) * unit;
    }
    q
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::arm::{LoadOptions, default_urdf};

    fn vector() -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-1.0..1.0_f64).prop_map(Vector3::from)
    }

    proptest! {
        #[test]
        fn no_two_points_of_the_segments_are_nearer(
            p0 in vector(), along in vector(), q0 in vector(), beside in vector(), kind in 0..4,
        ) {
            // Points and parallels too.
            let p1 = if kind == 1 { p0 } else { p0 + along };
            let q1 = match kind { 2 => q0, 3 => q0 + along * 0.7, _ => q0 + beside };
            let (on_p, on_q) = closest_on_segments(&p0, &p1, &q0, &q1);
            let found = (on_p - on_q).norm();
            let off = |x: &Vector3<f64>, a: &Vector3<f64>, b: &Vector3<f64>| {
                ((x - a).norm() + (x - b).norm() - (a - b).norm()).abs()
            };
            prop_assert!(off(&on_p, &p0, &p1) < 1e-9 && off(&on_q, &q0, &q1) < 1e-9);
            let steps = 60;
            for i in 0..=steps {
                for j in 0..=steps {
                    let at = |n: i32| f64::from(n) / f64::from(steps);
                    let d = (p0.lerp(&p1, at(i)) - q0.lerp(&q1, at(j))).norm();
                    prop_assert!(d >= found - 1e-9, "{d} < {found}");
                }
            }
            let (back_q, back_p) = closest_on_segments(&q0, &q1, &p0, &p1);
            prop_assert!(((back_q - back_p).norm() - found).abs() < 1e-9);
        }
    }

    fn default_arm() -> ArmModel {
        ArmModel::from_urdf(default_urdf(), &LoadOptions::default()).unwrap()
    }

    #[test]
    fn a_body_without_shapes_is_as_thick_as_its_inertia_says() {
        let arm = default_arm();
        let upper_arm = arm.capsules().iter().find(|c| c.body == 2).unwrap();
        assert_eq!(upper_arm.source, CapsuleSource::Derived);
        // Drawn as a cylinder of 3.2 kg and 58 mm.
        assert!(
            (upper_arm.radius_m - 0.058).abs() < 1e-4,
            "{}",
            upper_arm.radius_m
        );
        let all: Vec<_> = (0..=arm.dof()).collect();
        let bodies: std::collections::BTreeSet<_> = arm.capsules().iter().map(|c| c.body).collect();
        assert_eq!(bodies.into_iter().collect::<Vec<_>>(), all);
    }

    #[test]
    fn pairs_are_the_same_for_the_same_arm_and_none_shares_a_joint() {
        let arm = default_arm();
        let start = arm.per_joint(crate::arm::Joint::mid);
        let a = SelfCollision::new(&arm, &start, 0.02);
        let b = SelfCollision::new(&arm, &start, 0.02);
        assert_eq!(a.pairs(), b.pairs());
        assert!(a.pairs().len() > 5, "{:?}", a.pairs());
        for &(i, j) in a.pairs() {
            assert!(a.body(i) + 1 < a.body(j));
        }
    }

    /// The hulls' points, moved and compared one by one.
    #[test]
    fn nearest_is_what_points_on_the_hulls_say() {
        let arm = default_arm();
        let start = arm.per_joint(crate::arm::Joint::mid);
        let mut model = SelfCollision::new(&arm, &start, 0.02);
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(5);
        let mut kinematics = Kinematics::new();
        for _ in 0..50 {
            kinematics.update(&arm, &random_posture(&arm, &mut rng));
            model.place(&kinematics);
            let mut least = f64::INFINITY;
            for &(i, j) in model.pairs() {
                let ((a0, a1, ra), (b0, b1, rb)) = (model.placed(i), model.placed(j));
                for s in 0..=80 {
                    for t in 0..=80 {
                        let (s, t) = (f64::from(s) / 80.0, f64::from(t) / 80.0);
                        let d = (a0.lerp(&a1, s) - b0.lerp(&b1, t)).norm() - ra - rb;
                        least = least.min(d);
                    }
                }
            }
            let found = model.nearest().unwrap().proximity.distance_m;
            assert!(
                found <= least + 1e-12 && found > least - 5e-3,
                "{found} {least}"
            );
        }
    }
}
