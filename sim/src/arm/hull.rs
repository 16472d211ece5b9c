//! From a URDF's collision shapes to capsules, and capsules where there are none.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use urdf_rs::Geometry;

use super::capsule::{Capsule, CapsuleSource, MAX_CAPSULES};
use super::payload::moments;
use super::{ArmModel, Body};

/// Sizes beyond this are no shape, m.
const MAX_SIZE_M: f64 = 100.0;

/// No flat box is enclosed by more capsules.
const STRIPS: f64 = 8.0;

/// Shapes as they are met, body by body.
#[derive(Default)]
pub(super) struct Hulls {
    shapes: Vec<Capsule>,
    /// Bodies of which a part is a mesh, which is not read.
    meshed: Vec<usize>,
    /// The first link of each body, base first.
    links: Vec<String>,
}

impl Hulls {
    /// Begins the next body with its first link, base first.
    pub(super) fn begin(&mut self, link: &str) {
        self.links.push(link.to_owned());
    }

    /// Adds the smallest capsule about a shape's own axis, given in the frame of the body begun last; false if the shape has no usable size.
    pub(super) fn add(&mut self, link: &str, pose: &Isometry3<f64>, geometry: &Geometry) -> bool {
        let body = self.links.len() - 1;
        let (half, radius) = match geometry {
            Geometry::Mesh { .. } => {
                self.meshed.push(body);
                return true;
            }
            Geometry::Sphere { radius } => (0.0, *radius),
            Geometry::Capsule { radius, length } | Geometry::Cylinder { radius, length } => {
                (0.5 * length, *radius)
            }
            Geometry::Box { size } => return self.add_box(link, pose, size.0),
        };
        if !is_usable(half, radius) {
            return false;
        }
        self.shapes
            .push(Capsule::around(body, link, pose, half, radius));
        true
    }

    /// A capsule along the longest side of a box; along one on the base as many beside each other as keep what is flat, a table, flat.
    fn add_box(&mut self, link: &str, pose: &Isometry3<f64>, size: [f64; 3]) -> bool {
        let body = self.links.len() - 1;
        let [x, y, z] = size;
        let (long, [a, b]) = if z >= x && z >= y {
            (2, [0, 1])
        } else if x >= y {
            (0, [1, 2])
        } else {
            (1, [0, 2])
        };
        let (wide, flat) = if size[a] >= size[b] { (a, b) } else { (b, a) };
        if !(size[flat] > 0.0) {
            return false;
        }
        let strips = match body {
            0 => (size[wide] / size[flat]).floor().min(STRIPS),
            _ => 1.0,
        };
        let (half, radius) = (
            0.5 * size[long],
            0.5 * (size[wide] / strips).hypot(size[flat]),
        );
        if !is_usable(half, radius) {
            return false;
        }
        let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
        let turn = UnitQuaternion::rotation_between(&Vector3::z(), &axes[long]);
        for i in 0..strips as usize {
            let aside = axes[wide] * ((i as f64 + 0.5) / strips - 0.5) * size[wide];
            let pose = pose * Translation3::from(aside) * turn.unwrap_or_default();
            self.shapes
                .push(Capsule::around(body, link, &pose, half, radius));
        }
        true
    }

    /// All capsules of `arm`, base first: its shapes, less those inside another of the same body, and where a body has none, or a mesh, a derived one.
    /// The base has none where no link of its own has one, on the way to the tip (`chain`): what stands beside it does not stand for it.
    pub(super) fn capsules(self, arm: &ArmModel, chain: &[&str]) -> Vec<Capsule> {
        let mut bodies: Vec<Vec<Capsule>> = vec![Vec::new(); arm.dof() + 1];
        let mut free = MAX_CAPSULES;
        // The base last: what stands beside the arm must not take the places of its links.
        for (i, body) in (1..=arm.dof()).chain([0]).enumerate() {
            let mut own: Vec<Capsule> = self
                .shapes
                .iter()
                .filter(|c| c.body == body)
                .cloned()
                .collect();
            let stands = |c: &Capsule| body > 0 || chain.contains(&c.link.as_str());
            if !own.iter().any(stands) || self.meshed.contains(&body) {
                own.push(derived(arm, body, &self.links[body]));
            }
            own.sort_by(|a, b| b.radius_m.total_cmp(&a.radius_m));
            let mut kept: Vec<Capsule> = Vec::new();
            for capsule in own {
                if !kept.iter().any(|k| k.contains(&capsule)) {
                    kept.push(capsule);
                }
            }
            // Every later body has room for one.
            kept.truncate(free - (arm.dof() - i));
            free -= kept.len();
            bodies[body] = kept;
        }
        bodies.concat()
    }
}

fn is_usable(half_length_m: f64, radius_m: f64) -> bool {
    radius_m > 0.0 && radius_m <= MAX_SIZE_M && (0.0..=MAX_SIZE_M).contains(&half_length_m)
}

/// See [`CapsuleSource::Derived`].
fn derived(arm: &ArmModel, body: usize, link: &str) -> Capsule {
    let joints = arm.joints();
    let chain_m = arm.chain_length_m();
    let b = match joints.get(body) {
        Some(next) => next.placement.translation.vector,
        None => arm.tip_offset().translation.vector,
    };
    let radius_m = match body.checked_sub(1) {
        None => 0.05 * chain_m,
        Some(i) => radius(&joints[i].body, chain_m),
    };
    Capsule {
        body,
        link: link.to_owned(),
        a: Vector3::zeros(),
        b,
        radius_m,
        source: CapsuleSource::Derived,
    }
}

fn radius(body: &Body, chain_m: f64) -> f64 {
    let [least, ..] = moments(&body.inertia_kg_m2);
    let solid = (2.0 * least / body.mass_kg).sqrt();
    if solid > 0.0 && solid.is_finite() {
        solid.clamp(0.02 * chain_m, 0.1 * chain_m)
    } else {
        0.05 * chain_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arm::{ArmError, LoadOptions, Notice};

    fn load(collisions: &str) -> ArmModel {
        let urdf = format!(
            r#"<robot name="r"><link name="b"/><link name="l"><inertial><mass value="1"/><inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial>{collisions}</link><link name="tcp"/>
            <joint name="j" type="continuous"><parent link="b"/><child link="l"/><origin xyz="0 0 .5"/><axis xyz="0 0 1"/></joint>
            <joint name="t" type="fixed"><parent link="l"/><child link="tcp"/><origin xyz="1 0 0"/></joint></robot>"#
        );
        ArmModel::from_urdf(&urdf, &LoadOptions::default()).unwrap()
    }

    fn shape(geometry: &str, xyz: &str) -> String {
        format!(
            r#"<collision><origin xyz="{xyz}" rpy="0 1.5707963267948966 0"/><geometry>{geometry}</geometry></collision>"#
        )
    }

    #[test]
    fn shapes_are_enclosed_and_what_lies_inside_another_is_left_out() {
        let cylinder = shape(r#"<cylinder radius=".1" length=".8"/>"#, ".4 0 0");
        let inside = shape(r#"<sphere radius=".1"/>"#, ".8 0 0");
        let arm = load(&(cylinder + &inside));
        let own: Vec<_> = arm.capsules().iter().filter(|c| c.body == 1).collect();
        assert_eq!(own.len(), 1);
        assert_eq!(own[0].source, CapsuleSource::Geometry);
        assert!((own[0].a.x.min(own[0].b.x)).abs() < 1e-12);
        assert!((own[0].a.x.max(own[0].b.x) - 0.8).abs() < 1e-12);
        assert_eq!(own[0].radius_m, 0.1);

        for size in [".6 .03 .04", ".03 .6 .04", ".03 .04 .6"] {
            let arm = load(&shape(&format!(r#"<box size="{size}"/>"#), "0 0 0"));
            let own = arm.capsules().iter().find(|c| c.body == 1).unwrap();
            assert!((own.radius_m - 0.025).abs() < 1e-12, "{size}");
            assert!(((own.a - own.b).norm() - 0.6).abs() < 1e-12, "{size}");
        }
    }

    #[test]
    fn meshes_add_a_derived_capsule_and_shapes_without_size_are_named() {
        let mesh = shape(r#"<mesh filename="x.stl"/>"#, "0 0 0");
        let ball = shape(r#"<sphere radius=".5"/>"#, "0 0 2");
        let arm = load(&(mesh + &ball));
        let own: Vec<_> = arm.capsules().iter().filter(|c| c.body == 1).collect();
        let derived = own
            .iter()
            .find(|c| c.source == CapsuleSource::Derived)
            .unwrap();
        assert_eq!((own.len(), derived.b), (2, Vector3::new(1.0, 0.0, 0.0)));
        let flat = load(&shape(r#"<box size="1 1 0"/>"#, "0 0 0"));
        assert!(
            flat.notices()
                .contains(&Notice::ShapeIgnored { link: "l".into() })
        );
        let base = &arm.capsules()[0];
        assert_eq!((base.body, base.b), (0, Vector3::new(0.0, 0.0, 0.5)));
    }

    #[test]
    fn no_arm_has_more_capsules_than_there_is_room_for() {
        let many: String = (0..60)
            .map(|i| shape(r#"<sphere radius=".01"/>"#, &format!("{i} 0 0")))
            .collect();
        assert_eq!(load(&many).capsules().len(), MAX_CAPSULES);
    }

    /// An arm of one joint on a column, beside which stand `collisions` on a lift.
    fn beside(collisions: &str, own: &str, options: &LoadOptions) -> Result<ArmModel, ArmError> {
        let urdf = format!(
            r#"<robot name="r"><link name="b"/><link name="table"><inertial><mass value="80"/><inertia ixx="9" ixy="0" ixz="0" iyy="9" iyz="0" izz="9"/></inertial>{collisions}</link>
            <link name="l"><inertial><mass value="1"/><inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/></inertial>{own}</link><link name="tcp"/>
            <joint name="lift" type="prismatic"><parent link="b"/><child link="table"/><origin xyz="0 2 0"/><axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
            <joint name="j" type="continuous"><parent link="b"/><child link="l"/><origin xyz="0 0 .5"/><axis xyz="0 0 1"/></joint>
            <joint name="t" type="fixed"><parent link="l"/><child link="tcp"/><origin xyz="1 0 0"/></joint></robot>"#
        );
        let options = LoadOptions {
            tip: Some("tcp".to_owned()),
            ..options.clone()
        };
        ArmModel::from_urdf(&urdf, &options)
    }

    #[test]
    fn what_stands_on_the_base_beside_the_arm_is_part_of_its_hull_where_it_is_fixed() {
        let ball = shape(r#"<sphere radius=".1"/>"#, "0 0 .2");
        for height_m in [0.0, 0.7] {
            let mut options = LoadOptions::default();
            options.fixed.insert("lift".to_owned(), height_m);
            let arm = beside(&ball, "", &options).unwrap();
            let table = arm.capsules().iter().find(|c| c.link == "table").unwrap();
            assert_eq!(table.body, 0);
            let column = arm.capsules().iter().find(|c| c.link == "b").unwrap();
            assert_eq!((column.body, column.source), (0, CapsuleSource::Derived));
            assert!((table.a - Vector3::new(0.0, 2.0, 0.2 + height_m)).norm() < 1e-12);
            assert!(arm.notices().contains(&Notice::JointFixed {
                joint: "lift".into(),
                value: height_m
            }));
            assert_eq!(arm.moving_mass_kg(), 1.0, "the base does not move");
        }
        let mut options = LoadOptions::default();
        options.fixed.insert("lift".to_owned(), 1.2);
        let outside = beside(&ball, "", &options);
        assert!(matches!(outside, Err(ArmError::FixedOutside { .. })));
    }

    #[test]
    fn a_table_is_enclosed_and_stays_flat() {
        let table = r#"<collision><geometry><box size="0.8 1.2 .04"/></geometry></collision>"#;
        let arm = beside(table, "", &LoadOptions::default()).unwrap();
        let of: Vec<_> = arm
            .capsules()
            .iter()
            .filter(|c| c.link == "table")
            .collect();
        assert_eq!(of.len(), 8);
        assert!(of.iter().all(|c| c.radius_m < 0.06), "{of:?}");
        for i in 0..=40 {
            for j in 0..=60 {
                let at = |n: i32| f64::from(n) * 0.02;
                let p = Vector3::new(at(i) - 0.4, 2.0 + at(j) - 0.6, 0.02);
                let inside = |c: &&Capsule| {
                    let along = c.b - c.a;
                    let u = ((p - c.a).dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
                    (p - c.a - along * u).norm() <= c.radius_m + 1e-9
                };
                assert!(of.iter().any(inside), "{p}");
            }
        }
    }

    #[test]
    fn what_stands_beside_the_arm_takes_no_place_of_its_links() {
        let balls = |n: i32, radius: &str| -> String {
            let ball = format!(r#"<sphere radius="{radius}"/>"#);
            (0..n).map(|i| shape(&ball, &format!("{i} 0 0"))).collect()
        };
        let (table, own) = (balls(40, ".2"), balls(5, ".1"));
        let arm = beside(&table, &own, &LoadOptions::default()).unwrap();
        let of = |body| arm.capsules().iter().filter(|c| c.body == body).count();
        assert_eq!((of(0), of(1)), (MAX_CAPSULES - 5, 5));
        assert!(arm.capsules().is_sorted_by_key(|c| c.body), "base first");
    }
}
