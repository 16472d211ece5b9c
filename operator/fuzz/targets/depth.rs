//! Depth frames, as PNG or as raw counts: any bytes are refused for a reason, or are a picture in which a hand is found at a place
//! the camera can see, or none.
//!
//! The input is a kind, and then a PNG, or the counts of a small camera's frames, one after another.

#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use telemime_operator::depth::{Camera, Finder, Size, decode};

/// No camera says more, counts being 1 mm.
const FARTHEST_M: f64 = 65.536;
const RAW: Size = Size {
    width: 40,
    height: 32,
};

fn look(finder: &mut Finder, t_s: f64, pixels: &[u16]) {
    if let Some(found) = finder.find(t_s, pixels) {
        assert!(found.position.iter().all(|v| v.is_finite()));
        assert!((0.0..=FARTHEST_M).contains(&found.position.z));
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((&kind, bytes)) = data.split_first() else {
        return;
    };
    let camera = |size| Camera::new(size, None, 1e-3, kind & 2 != 0).map(Finder::new);
    if kind & 1 == 0 {
        let Ok((size, pixels)) = decode(Path::new("fuzz.png"), bytes) else {
            return;
        };
        assert_eq!(pixels.len(), size.width * size.height);
        // Large ones take long and show nothing else.
        if let Ok(mut finder) = camera(size)
            && pixels.len() < 100_000
        {
            look(&mut finder, 0.0, &pixels);
        }
    } else {
        let mut finder = camera(RAW).expect("a usable size");
        for (i, frame) in bytes.chunks(2 * RAW.width * RAW.height).enumerate() {
            let pixels: Vec<_> = frame
                .chunks_exact(2)
                .map(|pair| u16::from_le_bytes([pair[0], pair[1]]))
                .collect();
            look(&mut finder, i as f64 / 30.0, &pixels);
        }
    }
});
