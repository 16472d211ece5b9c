//! Colours, sizes and the font.

use std::sync::OnceLock;

use plotters::style::{FontStyle, RGBColor, register_font};

// Okabe and Ito's palette: told apart with every common form of colour blindness.
pub(crate) const BLACK: RGBColor = RGBColor(32, 32, 36);
pub(crate) const ORANGE: RGBColor = RGBColor(230, 159, 0);
pub(crate) const SKY: RGBColor = RGBColor(86, 180, 233);
pub(crate) const GREEN: RGBColor = RGBColor(0, 158, 115);
pub(crate) const BLUE: RGBColor = RGBColor(0, 114, 178);
pub(crate) const VERMILLION: RGBColor = RGBColor(213, 94, 0);
pub(crate) const PURPLE: RGBColor = RGBColor(204, 121, 167);
pub(crate) const GREY: RGBColor = RGBColor(128, 128, 134);
pub(crate) const SILVER: RGBColor = RGBColor(178, 179, 185);

pub(super) const INK: RGBColor = RGBColor(40, 40, 46);
pub(super) const SOFT_INK: RGBColor = RGBColor(98, 98, 106);
pub(super) const GRID: RGBColor = RGBColor(228, 229, 233);
pub(super) const AXIS: RGBColor = RGBColor(150, 151, 158);

/// The family's name: what viewers of an SVG fall back to is of much the same width.
pub(super) const FONT: &str = "sans-serif";

// Sizes in units: pixels of an SVG, two pixels of a PNG each way.
pub(super) const PANEL: (u32, u32) = (440, 330);
pub(super) const MARGIN: i32 = 18;
pub(super) const TITLE: f64 = 21.0;
pub(super) const NOTE: f64 = 13.0;
pub(super) const PANEL_TITLE: f64 = 15.0;
pub(super) const LABEL: f64 = 13.0;
pub(super) const TICK: f64 = 12.0;
pub(super) const LINE: f64 = 1.9;
pub(super) const THIN: f64 = 1.0;
pub(super) const DOT: f64 = 3.6;

/// `colour` mixed with white: opaque, so that overlapping parts of one shape do not show.
pub(super) fn pale(colour: RGBColor) -> RGBColor {
    let mix = |c: u8| (f64::from(c) * 0.28 + 255.0 * 0.72).round() as u8;
    RGBColor(mix(colour.0), mix(colour.1), mix(colour.2))
}

/// Makes the embedded font known, once a process. False if it cannot be read.
pub(super) fn load_font() -> bool {
    static LOADED: OnceLock<bool> = OnceLock::new();
    let bytes = include_bytes!("roboto-regular-subset.ttf");
    *LOADED.get_or_init(|| register_font(FONT, FontStyle::Normal, bytes).is_ok())
}
