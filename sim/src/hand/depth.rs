//! What a depth camera sees of a person whose hand is known: a body, an arm, noise and holes.

use nalgebra::Vector3;
use rand::RngExt;
use rand_xoshiro::Xoshiro256PlusPlus;

use super::{normal, stream};

/// A stream of its own.
const DEPTH_STREAM: u64 = 0x0064_6570_7468;

/// Focal length of a Kinect's depth camera, in widths of its frame.
const FOCAL: f64 = 285.6 / 320.0;

/// The right shoulder from the middle of the chest, m; the left one is its mirror image.
const SHOULDER_M: [f64; 3] = [0.19, 0.2, 0.0];

/// Upper arm, and from the elbow to the middle of the hand, m.
const ARM_M: (f64, f64) = (0.3, 0.34);

/// The hand: from its middle to either end, and half its thickness, m.
const HAND_M: (f64, f64) = (0.055, 0.035);

/// A person in front of a depth camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scene {
    /// Columns of a frame.
    pub width: usize,
    /// Rows of a frame.
    pub height: usize,
    /// The middle of the chest, m: x right, y up, z away from the camera, as the hand.
    pub chest_m: [f64; 3],
    /// How far behind the chest a wall is, m; none, nothing is measured there.
    pub wall_m: Option<f64>,
    /// Whether the camera errs: noise that grows with the square of the depth, steps, holes along edges and on their own, specks in
    /// front of everything.
    pub errs: bool,
}

/// A ball that was moved along a line.
#[derive(Debug, Clone, Copy)]
struct Capsule {
    a: Vector3<f64>,
    b: Vector3<f64>,
    r: f64,
}

impl Scene {
    /// Frame `index` of a hand whose middle is at `hand` (m): depths in mm, row by row from the top, 0 where nothing is measured. The
    /// same arguments give the same frame on one platform.
    ///
    /// ```
    /// use telemime_sim::hand::Scene;
    /// let scene = Scene { width: 160, height: 120, chest_m: [0.0, 0.0, 2.6], wall_m: None, errs: false };
    /// let frame = scene.frame(1, 0, [0.2, 0.1, 2.1]);
    /// let nearest = frame.iter().filter(|d| **d > 0).min().unwrap();
    /// // The fingers are nearer than the hand's middle, by 9 cm at most.
    /// assert!((2010..2070).contains(nearest), "{nearest}");
    /// ```
    pub fn frame(&self, seed: u64, index: u32, hand: [f64; 3]) -> Vec<u16> {
        let parts = self.person(hand.into());
        let focal = FOCAL * self.width as f64;
        let (cx, cy) = (self.width as f64 / 2.0, self.height as f64 / 2.0);
        let mut depths = vec![0.0; self.width * self.height];
        for part in &parts {
            for (v, row) in part.rows(focal, cy, self.height) {
                for u in part.columns(focal, cx, self.width) {
                    let ray = Vector3::new((u as f64 - cx) / focal, row / focal, 1.0);
                    if let Some(z) = part.hit(&ray) {
                        let depth: &mut f64 = &mut depths[v * self.width + u];
                        if *depth == 0.0 || z < *depth {
                            *depth = z;
                        }
                    }
                }
            }
        }
        if let Some(behind_m) = self.wall_m {
            let wall_m = self.chest_m[2] + behind_m;
            depths
                .iter_mut()
                .filter(|d| **d == 0.0)
                .for_each(|d| *d = wall_m);
        }
        if self.errs {
            self.err(&mut depths, &mut stream(seed ^ DEPTH_STREAM, index.into()));
        }
        depths.iter().map(|d| (d * 1e3).round() as u16).collect()
    }

    fn person(&self, hand: Vector3<f64>) -> Vec<Capsule> {
        let chest = Vector3::from(self.chest_m);
        let at = |x: f64, y: f64, z: f64| chest + Vector3::new(x, y, z);
        let part = |a, b, r| Capsule { a, b, r };
        let mut parts = vec![part(at(0.0, 0.43, 0.0), at(0.0, 0.5, 0.0), 0.1)];
        for x in [-0.1, 0.0, 0.1] {
            parts.push(part(at(x, 0.13, 0.0), at(x, -0.35, 0.0), 0.12));
        }
        for x in [-0.1, 0.1] {
            parts.push(part(at(x, -0.4, 0.0), at(x, -1.15, 0.05), 0.085));
        }
        let [x, y, z] = SHOULDER_M;
        let left = at(-x, y, z);
        let wrist = left + Vector3::new(-0.06, -0.55, -0.02);
        parts.push(part(left, wrist, 0.05));
        parts.push(part(wrist, wrist + Vector3::new(0.0, -0.12, 0.0), 0.04));
        let shoulder = at(x, y, z);
        let elbow = elbow(&shoulder, &hand);
        let along = (hand - elbow).normalize();
        parts.push(part(shoulder, elbow, 0.05));
        parts.push(part(elbow, hand - along * 0.09, 0.035));
        let (half, thick) = HAND_M;
        parts.push(part(hand - along * half, hand + along * half, thick));
        parts
    }

    /// Noise of a Kinect (Khoshelham and Oude Elberink 2012: 1.425 mm/m² z², standard deviation), its steps, and what it does not see.
    fn err(&self, depths: &mut [f64], rng: &mut Xoshiro256PlusPlus) {
        const NOISE_M: f64 = 1.425e-3;
        const STEP_M: f64 = 2.85e-3;
        let seen = depths.to_vec();
        let at = |u: usize, v: usize| seen[v * self.width + u];
        for v in 0..self.height {
            for u in 0..self.width {
                let z = at(u, v);
                let (error, chance) = (normal(rng), rng.random_range(0.0..1.0));
                let depth = &mut depths[v * self.width + u];
                if z > 0.0 {
                    let step = STEP_M * z * z;
                    *depth = ((z + error * NOISE_M * z * z) / step).round() * step;
                }
                let inside = (1..self.width - 1).contains(&u) && (1..self.height - 1).contains(&v);
                let edge = inside
                    && [(u - 1, v), (u + 1, v), (u, v - 1), (u, v + 1)]
                        .iter()
                        .any(|&(u, v)| (at(u, v) - z).abs() > 0.1);
                if chance < if edge { 0.3 } else { 0.01 } {
                    *depth = 0.0;
                } else if chance > 0.9995 {
                    // Dust, or light of a second camera.
                    *depth = rng.random_range(0.5..2.0);
                }
            }
        }
        for _ in 0..12 {
            let (u, v) = (
                rng.random_range(0..self.width),
                rng.random_range(0..self.height),
            );
            let side = rng.random_range(1..=3 + self.width / 160);
            for v in v..(v + side).min(self.height) {
                let from = v * self.width + u;
                let to = v * self.width + (u + side).min(self.width);
                depths[from..to].fill(0.0);
            }
        }
    }
}

/// Below the line from shoulder to hand, and to the side; a hand out of reach stretches the arm.
fn elbow(shoulder: &Vector3<f64>, hand: &Vector3<f64>) -> Vector3<f64> {
    let (upper, fore) = ARM_M;
    let way = hand - shoulder;
    let far = way.norm().max(1e-6);
    let along = (upper * upper - fore * fore + far * far) / (2.0 * far);
    let down = Vector3::new(0.4, -1.0, 0.1);
    let down = down - way * (down.dot(&way) / (far * far));
    let off = (upper * upper - along * along).max(0.0).sqrt();
    shoulder + way * (along / far) + down.normalize() * off
}

impl Capsule {
    /// The rows it may be seen in, each with its height above the middle, pixels.
    fn rows(
        &self,
        focal: f64,
        cy: f64,
        height: usize,
    ) -> impl Iterator<Item = (usize, f64)> + use<> {
        let (low, high) = self.seen(1, focal);
        let from = (cy - high).clamp(0.0, height as f64) as usize;
        let to = (cy - low + 1.0).clamp(0.0, height as f64) as usize;
        (from..to).map(move |v| (v, cy - v as f64))
    }

    fn columns(&self, focal: f64, cx: f64, width: usize) -> core::ops::Range<usize> {
        let (low, high) = self.seen(0, focal);
        let from = (cx + low).clamp(0.0, width as f64) as usize;
        from..(cx + high + 1.0).clamp(0.0, width as f64) as usize
    }

    /// The range it may be seen in along an axis, pixels from the middle.
    fn seen(&self, axis: usize, focal: f64) -> (f64, f64) {
        let near = (self.a.z.min(self.b.z) - self.r).max(0.05);
        let far = self.a.z.max(self.b.z) + self.r;
        let low = self.a[axis].min(self.b[axis]) - self.r;
        let high = self.a[axis].max(self.b[axis]) + self.r;
        let of = |x: f64| (focal * x / near, focal * x / far);
        let ((a, b), (c, d)) = (of(low), of(high));
        (a.min(b), c.max(d))
    }

    /// The depth at which `ray` (z is 1) from the camera meets it first.
    fn hit(&self, ray: &Vector3<f64>) -> Option<f64> {
        let (axis, from) = (self.b - self.a, -self.a);
        let (bb, bd, bo) = (axis.norm_squared(), axis.dot(ray), axis.dot(&from));
        let (dd, od, oo) = (ray.norm_squared(), from.dot(ray), from.norm_squared());
        let (a, b) = (bb * dd - bd * bd, bb * od - bo * bd);
        let c = bb * oo - bo * bo - self.r * self.r * bb;
        let h = b * b - a * c;
        if a > 1e-12 && h >= 0.0 {
            let t = (-b - h.sqrt()) / a;
            let y = bo + t * bd;
            if (0.0..=bb).contains(&y) {
                return Some(t);
            }
        }
        let ball = |centre: &Vector3<f64>| {
            let b = ray.dot(centre);
            let h = b * b - dd * (centre.norm_squared() - self.r * self.r);
            (h >= 0.0).then(|| (b - h.sqrt()) / dd)
        };
        let ends = [ball(&self.a), ball(&self.b)].into_iter().flatten();
        ends.min_by(f64::total_cmp)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ball_and_a_rod_are_met_where_geometry_says() {
        let rod = Capsule {
            a: Vector3::new(-0.3, 0.0, 2.0),
            b: Vector3::new(0.3, 0.0, 2.0),
            r: 0.1,
        };
        let hit = |x: f64, y: f64| rod.hit(&Vector3::new(x, y, 1.0));
        assert!((hit(0.0, 0.0).unwrap() - 1.9).abs() < 1e-12);
        assert!((hit(0.1, 0.0).unwrap() - 1.9).abs() < 1e-12);
        assert_eq!(hit(0.0, 0.06), None);
        assert_eq!(hit(0.25, 0.0), None);
        // Every surface point of a hit lies on the capsule.
        for i in 0..200 {
            let ray = Vector3::new(-0.2 + 0.002 * f64::from(i), 0.03, 1.0);
            if let Some(z) = rod.hit(&ray) {
                let p = ray * z;
                let nearest = Vector3::new(p.x.clamp(-0.3, 0.3), 0.0, 2.0);
                assert!(((p - nearest).norm() - 0.1).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn frames_repeat_and_their_errors_are_of_the_size_that_was_meant() {
        let clean = Scene {
            width: 320,
            height: 240,
            chest_m: [0.0, 0.0, 2.7],
            wall_m: Some(1.5),
            errs: false,
        };
        let noisy = Scene {
            errs: true,
            ..clean
        };
        let hand = [0.25, 0.15, 2.2];
        let (a, b) = (noisy.frame(3, 7, hand), noisy.frame(3, 7, hand));
        assert_eq!(a, b);
        assert_ne!(a, noisy.frame(3, 8, hand));
        let truth = clean.frame(3, 7, hand);
        assert!(truth.iter().all(|d| *d > 0), "the wall is seen");
        let holes = a.iter().filter(|d| **d == 0).count() as f64 / a.len() as f64;
        assert!((0.005..0.08).contains(&holes), "{holes}");
        let off: Vec<f64> = a
            .iter()
            .zip(&truth)
            .filter(|(a, b)| **a > 0 && a.abs_diff(**b) < 200)
            .map(|(a, b)| f64::from(*a) - f64::from(*b))
            .collect();
        let deviation = (off.iter().map(|d| d * d).sum::<f64>() / off.len() as f64).sqrt();
        // On the wall 4.2 m away: 25 mm of noise, 50 mm of steps.
        assert!((20.0..40.0).contains(&deviation), "{deviation}");
    }
}
