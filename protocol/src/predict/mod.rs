//! The predictor both ends run: where the hand will be, from the newest state alone.
//!
//! [`HandState`] is all that is known of the hand, [`Model`] what was learned, [`Params`] what the
//! operator adapts; [`Model::forecast`] is a pure function of the three, and keeps nothing.

mod forecast;
mod model;
mod state;

pub use forecast::{Forecast, Knot, Params, ParamsError, Prediction};
pub use model::{
    BLOCK, Calibration, Model, ModelError, Posterior, Regression, Standardisation, TARGETS, TEMPER,
};
pub use state::{FEATURES, HandState, MEMORY_TAU_S};

/// The most knots a forecast may have beyond the present.
pub const MAX_KNOTS: usize = 24;

/// Time between knots, s: one frame of a Kinect.
pub const KNOT_SPACING_S: f64 = 1.0 / 30.0;

#[cfg(test)]
mod tests;
