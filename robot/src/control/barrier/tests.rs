use super::*;

#[test]
fn braking_tick_by_tick_goes_as_far_as_it_says() {
    for (v, a) in [
        (1.0, 30.0),
        (0.03, 30.0),
        (0.01, 30.0),
        (2.0, 7.3),
        (1e-4, 5.0),
    ] {
        let h = 1e-3;
        let (mut speed, mut gone) = (v, 0.0);
        for tick in 0..2000 {
            let t = f64::from(tick) * h;
            assert!((braked(v, a, t, h) - gone).abs() < 1e-12, "{v} {a} {t}");
            let next = speed - f64::min(speed, a * h);
            gone += 0.5 * (speed + next) * h;
            speed = next;
        }
        assert!((braking(v, a, h) - gone).abs() < 1e-12);
    }
}

#[test]
fn a_target_behind_oblique_planes_is_moved_before_all_of_them() {
    let arm = crate::rig::Rig::load(&crate::rig::RigOptions::default()).unwrap();
    // A wedge of 60°: what is moved over one of its sides comes to lie behind the other.
    let side = |y: f64| Plane::new(Vector3::new(0.0, y, 0.5), 0.05).unwrap();
    let config = BarrierConfig::default()
        .with_plane(side(0.75_f64.sqrt()))
        .and_then(|config| config.with_plane(side(-(0.75_f64.sqrt()))))
        .unwrap();
    let barrier = |config: &BarrierConfig| {
        let (model, home) = (arm.arm.clone(), arm.home);
        Barrier::new(model, config, Joints::repeat(10.0), &home, 1e-3)
    };
    let Ok(wedge) = barrier(&config) else {
        panic!("the tip starts within");
    };
    for y in [-0.5, -0.1, 0.0, 0.03, 0.4] {
        let (at, moved) = wedge.clip(Vector3::new(0.3, y, -0.3));
        assert!(moved);
        for plane in config.planes.iter().flatten() {
            let height_m = plane.height_m(&at);
            assert!(height_m >= SOFT_M - 2.0 * CLIPPED_M, "{y}: {height_m}");
        }
    }
    let within = Vector3::new(0.3, 0.0, 1.0);
    assert_eq!(wedge.clip(within), (within, false));
    // Planes that leave no room are no endless loop.
    let up = Plane::new(Vector3::z(), 0.1).unwrap();
    let mut walls = barrier(&BarrierConfig::default().with_plane(up).unwrap()).unwrap();
    walls.config = walls
        .config
        .with_plane(Plane::new(-Vector3::z(), 0.1).unwrap())
        .unwrap();
    assert!(walls.clip(Vector3::zeros()).0.z.is_finite());
}

#[test]
fn planes_and_distances_that_are_none_are_refused() {
    assert!(matches!(
        Plane::new(Vector3::zeros(), 0.0),
        Err(BarrierError::Plane { .. })
    ));
    assert!(matches!(
        Plane::new(Vector3::z(), f64::NAN),
        Err(BarrierError::Plane { .. })
    ));
    let plane = Plane::new(Vector3::z() * 2.0, 0.5).unwrap();
    assert_eq!(plane.height_m(&Vector3::new(9.0, 9.0, 0.75)), 0.25);
    let mut config = BarrierConfig::default();
    for _ in 0..MAX_PLANES {
        config = config.with_plane(plane).unwrap();
    }
    assert_eq!(config.with_plane(plane), Err(BarrierError::TooManyPlanes));
}
