//! Figures: pages of line charts in one style, as SVG or PNG by the file's ending.
//!
//! Nothing is taken from the system: the font is embedded, and the same figure is the same bytes
//! everywhere.

mod draw;
mod theme;

use std::path::{Path, PathBuf};
pub(crate) use theme::{BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SILVER, SKY, VERMILLION};

use plotters::style::RGBColor;

/// The names of the three axes.
pub(crate) const AXES: [&str; 3] = ["x", "y", "z"];

/// A page of panels, filled row by row.
#[derive(Clone, Debug)]
pub(crate) struct Figure {
    /// One line over the page.
    pub(crate) title: String,
    /// A smaller line under it: what was measured, on what.
    pub(crate) note: String,
    /// Panels in a row.
    pub(crate) columns: usize,
    /// What is shown.
    pub(crate) panels: Vec<Panel>,
}

/// One pair of axes; layers are drawn in order, later ones on top.
#[derive(Clone, Debug, Default)]
pub(crate) struct Panel {
    /// A line over the axes; may be empty.
    pub(crate) title: String,
    /// Quantity and unit across.
    pub(crate) x_label: String,
    /// Quantity and unit upwards.
    pub(crate) y_label: String,
    /// A metre across is as long as a metre upwards: for paths.
    pub(crate) equal_axes: bool,
    /// Both coordinates are logarithms to base 2; the axes show what they are of.
    pub(crate) doubling: bool,
    /// What is drawn.
    pub(crate) layers: Vec<Layer>,
}

/// Something drawn in a panel. The legend, between title and axes, names every layer with a label;
/// points that are not finite are left out.
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    /// Its name in the legend; empty keeps it out.
    pub(crate) label: String,
    /// Its colour, of the palette in this module.
    pub(crate) colour: RGBColor,
    /// Its form.
    pub(crate) shape: Shape,
}

/// The forms a layer takes, all in data units.
#[derive(Clone, Debug)]
pub(crate) enum Shape {
    /// Points joined by a line.
    Line(Vec<(f64, f64)>),
    /// The same, thinner: for many alike.
    Thin(Vec<(f64, f64)>),
    /// The same, dashed.
    Dashed(Vec<(f64, f64)>),
    /// The area between two curves over the same abscissa: (x, low, high).
    Band(Vec<(f64, f64, f64)>),
    /// The union of convex polygons, given by their corners in order.
    Patches(Vec<Vec<(f64, f64)>>),
    /// Everything within a radius of a path, for equal axes.
    Tube(Vec<(f64, f64)>, f64),
    /// A dot at each point.
    Dots(Vec<(f64, f64)>),
    /// A ring at each point.
    Rings(Vec<(f64, f64)>),
}

impl Layer {
    /// A layer of `shape`, named `label` in the legend.
    pub(crate) fn new(label: impl Into<String>, colour: RGBColor, shape: Shape) -> Self {
        Self {
            label: label.into(),
            colour,
            shape,
        }
    }
}

/// Why there is no figure.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FigureError {
    /// The ending names no format.
    #[error("{}: a figure ends in .svg or .png", .0.display())]
    Ending(PathBuf),
    /// A panel has no finite point, or the page no panel.
    #[error("nothing to draw in panel {0:?}")]
    Empty(String),
    /// The drawing library failed.
    #[error("drawing failed: {0}")]
    Draw(Box<dyn std::error::Error + Send + Sync>),
    /// The file could not be written.
    #[error("{}: {source}", .path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
}

impl Figure {
    /// The page as SVG.
    ///
    /// # Errors
    /// [`FigureError`].
    pub(crate) fn svg(&self) -> Result<String, FigureError> {
        draw::svg(self)
    }

    /// Draws the page into the file, SVG or PNG (at two pixels per unit) by its ending.
    ///
    /// # Errors
    /// [`FigureError`]; nothing half-drawn is left behind.
    pub(crate) fn write(&self, path: &Path) -> Result<(), FigureError> {
        match format(path)? {
            Format::Svg => {
                let text = draw::svg(self)?;
                std::fs::write(path, text).map_err(|source| FigureError::Write {
                    path: path.to_owned(),
                    source,
                })
            }
            Format::Png => draw::png(self, path),
        }
    }
}

/// Whether a figure may go there, to be asked before the work that it shows.
///
/// # Errors
/// [`FigureError::Ending`], or [`FigureError::Write`] if there is no such folder.
pub(crate) fn check(path: &Path) -> Result<(), FigureError> {
    format(path).map(|_| ())
}

enum Format {
    Svg,
    Png,
}

fn format(path: &Path) -> Result<Format, FigureError> {
    if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty())
        && !folder.is_dir()
    {
        return Err(FigureError::Write {
            path: path.to_owned(),
            source: std::io::Error::new(
                std::io::ErrorKind::NotFound,
                "its folder does not exist; make it first",
            ),
        });
    }
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    match ending.to_ascii_lowercase().as_str() {
        "svg" => Ok(Format::Svg),
        "png" => Ok(Format::Png),
        _ => Err(FigureError::Ending(path.to_owned())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn figure() -> Figure {
        let wave: Vec<_> = (0..100)
            .map(|i| (f64::from(i) * 0.01, (f64::from(i) * 0.1).sin() * 0.2))
            .collect();
        let band = wave.iter().map(|&(x, y)| (x, y - 0.05, y + 0.05)).collect();
        let dots: Vec<_> = wave.iter().copied().step_by(9).collect();
        let panel = |equal_axes, first| Panel {
            title: "Hand and tip".into(),
            x_label: "time / s".into(),
            y_label: "x / m".into(),
            equal_axes,
            doubling: false,
            layers: vec![
                Layer::new("within 5 cm", SKY, first),
                Layer::new("hand", BLACK, Shape::Line(wave.clone())),
                Layer::new("delayed", VERMILLION, Shape::Dashed(wave.clone())),
                Layer::new("checkpoints", BLUE, Shape::Dots(dots.clone())),
                Layer::new("received", GREEN, Shape::Rings(dots.clone())),
            ],
        };
        Figure {
            title: "A figure".into(),
            note: "σ = 5 mm, Δ ≤ 1 ms".into(),
            columns: 2,
            panels: vec![
                panel(false, Shape::Band(band)),
                panel(true, Shape::Tube(wave.clone(), 0.05)),
            ],
        }
    }

    #[test]
    fn both_formats_are_written_and_repeat_to_the_byte() {
        let dir = tempfile::tempdir().unwrap();
        for (name, magic) in [("a.svg", &b"<svg"[..]), ("a.PNG", &b"\x89PNG"[..])] {
            let path = dir.path().join(name);
            figure().write(&path).unwrap();
            let first = std::fs::read(&path).unwrap();
            assert!(first.starts_with(magic));
            figure().write(&path).unwrap();
            assert_eq!(std::fs::read(&path).unwrap(), first);
        }
        let svg = std::fs::read_to_string(dir.path().join("a.svg")).unwrap();
        assert!(svg.starts_with("<svg width=\"916\" height=\"414\" viewBox=\"0 0 7328 3312\""));
        for text in ["A figure", "within 5 cm", "time / s", "received"] {
            assert!(svg.contains(text), "{text}");
        }
    }

    #[test]
    fn what_cannot_be_drawn_is_named() {
        let dir = tempfile::tempdir().unwrap();
        assert!(matches!(
            figure().write(Path::new("figure.jpg")),
            Err(FigureError::Ending(_))
        ));
        let nowhere = dir.path().join("missing").join("a.svg");
        assert!(matches!(
            figure().write(&nowhere),
            Err(FigureError::Write { .. })
        ));
        let mut empty = figure();
        empty.panels[1].layers = vec![Layer::new(
            "",
            BLUE,
            Shape::Line(vec![(f64::NAN, 0.0), (0.0, f64::INFINITY)]),
        )];
        let path = dir.path().join("empty.png");
        assert!(matches!(empty.write(&path), Err(FigureError::Empty(_))));
        assert!(!path.exists());
    }
}
