//! Fitting takes memory as the data does, however many components there are.
#![allow(
    clippy::unwrap_used,
    reason = "clippy.toml allows it in tests, but does not know these helpers for tests"
)]

use allocation_counter::measure;
use nalgebra::Vector3;
use telemime_operator::learn::em::{self, EmOptions};

/// Most bytes held at a time by a fit beside its data.
fn peak(rows: u32, components: usize) -> u64 {
    let data: Vec<_> = (0..rows)
        .map(|i| {
            let t = f64::from(i) / f64::from(rows);
            Vector3::new(t, (9.0 * t).sin(), (f64::from(i) * 0.7).cos())
        })
        .collect();
    let begin = EmOptions {
        components,
        max_iterations: 1,
        ..EmOptions::default()
    };
    let start = em::fit(&data, &begin).unwrap().gmm;
    let options = EmOptions {
        max_iterations: 3,
        ..EmOptions::default()
    };
    // Up to 4096 rows are one task, on this thread, where the counter looks.
    measure(|| {
        em::from_start(&data, &start, &options).unwrap();
    })
    .bytes_max
}

#[test]
fn responsibilities_are_not_kept() {
    const ROWS: u32 = 4000;
    let data = u64::from(ROWS) * 24;
    // The transposed copy, and a block's responsibilities and sums for each component.
    let few = peak(ROWS, 2);
    let many = peak(ROWS, 60);
    assert!(few < data + 20_000, "{few}");
    assert!(many < data + 60 * 5_000, "{many}");
    // Twice the rows: twice the copy and nothing else. (All responsibilities would be 0.96 MB more.)
    let half = peak(ROWS / 2, 60);
    assert!(many - half < data / 2 + 10_000, "{half} {many}");
}
