//! Bytes a second over the largest error, both on doubling scales.

use std::path::Path;

use super::Study;
use super::coders::Coder;
use crate::figure::{
    BLACK, BLUE, Figure, FigureError, GREEN, GREY, Layer, ORANGE, Panel, SKY, Shape, VERMILLION,
};

/// Draws `study` into the file.
///
/// # Errors
/// [`FigureError`].
pub(super) fn write(study: &Study, path: &Path) -> Result<(), FigureError> {
    let mut layers = Vec::new();
    for (coder, colour) in [
        (Coder::DeadbandHold, GREY),
        (Coder::DeadbandLinear, BLACK),
        (Coder::RamerDouglasPeucker, ORANGE),
        (Coder::Uniform, VERMILLION),
        (Coder::PublicationInTime, SKY),
        (Coder::Live, GREEN),
        (Coder::Batch, BLUE),
    ] {
        let points: Vec<_> = study
            .sweep
            .iter()
            .filter_map(|(bound_m, rows)| {
                // Where some recordings are missing the sum is of something else.
                let row = rows
                    .iter()
                    .find(|r| r.coder == coder && r.recordings == study.recordings)?;
                Some(((bound_m * 1e3).log2(), row.bytes_per_s.log2()))
            })
            .collect();
        if points.is_empty() {
            continue;
        }
        layers.push(Layer::new(
            coder.name(),
            colour,
            Shape::Line(points.clone()),
        ));
        layers.push(Layer::new("", colour, Shape::Dots(points)));
    }
    let panel = Panel {
        title: String::new(),
        x_label: "largest error at any sample / mm".into(),
        y_label: "bytes a second".into(),
        doubling: true,
        layers,
        ..Panel::default()
    };
    Figure {
        title: format!("{}: what an error bound costs", study.name),
        note: format!(
            "{} recordings, {:.0} s, {} samples; the same entropy coding for all but the live knots",
            study.recordings, study.duration_s, study.samples
        ),
        columns: 1,
        panels: vec![panel],
    }
    .write(path)
}
