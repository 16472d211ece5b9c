//! Looking for the hand in one depth frame: a person with an arm held out, before a wall.

use divan::Bencher;
use telemime_operator::depth::{Camera, Finder, Size};

fn main() {
    divan::main();
}

/// A torso 2.7 m away, an arm that comes 0.5 m nearer, a wall at 4 m, mm.
fn frame(size: Size) -> Vec<u16> {
    let at = |i: usize| {
        let u = (i % size.width) as f64 / size.width as f64 - 0.5;
        let v = (i / size.width) as f64 / size.height as f64 - 0.5;
        let arm = (v - 0.02).abs() < 0.03 && (0.0..0.3).contains(&u);
        let torso = u.abs() < 0.1 && v > -0.3;
        match (arm, torso) {
            (true, _) => 2600 - (1600.0 * u) as u16,
            (false, true) => 2700,
            (false, false) => 4000,
        }
    };
    (0..size.width * size.height).map(at).collect()
}

#[divan::bench(args = ["320x240", "640x480"])]
fn a_frame(bencher: Bencher<'_, '_>, size: &str) {
    let size = size.parse().expect("a size");
    let camera = Camera::new(size, None, 1e-3, false).expect("a camera");
    let frame = frame(size);
    let mut finder = Finder::new(camera);
    assert!(finder.find(0.0, &frame).is_some(), "there is a hand");
    bencher.bench_local(|| finder.find(0.0, &frame));
}
