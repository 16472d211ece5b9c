//! The predictor both ends run: where the hand will be, from the newest state alone.
//!
//! [`HandState`] is all that is known of the hand, [`Model`] what was learned, [`Params`] what the
//! operator adapts; [`Model::forecast`] is a pure function of the three, and keeps nothing.
//! [`Bend`] is what a hand makes of a plan that is played. [`TurnState`], [`TurnModel`] and [`TurnForecast`] are the same for its orientation.

mod ahead;
mod bend;
mod experts;
mod forecast;
mod model;
mod params;
mod standard;
mod state;
mod turn;

pub use ahead::{Ahead, Knot, Way};
pub use bend::{Bend, Held, LET_GO_TAU_S, MAX_RATE, PUSH_REACH_S};
pub use experts::{Experts, Generic};
pub use forecast::{Forecast, Prediction};
pub use model::{BLOCK, Calibration, Model, ModelError, Posterior, Regression, TARGETS, TEMPER};
pub use params::{BAND_KNOTS, Params, ParamsError, WEIGHTED};
pub use standard::{BENT, Standardisation};
pub use state::{FEATURES, HandState, MEMORY_TAU_S};
pub use turn::{TurnForecast, TurnModel, TurnPrediction, TurnState, checksum};

/// The most knots a forecast may have beyond the present.
pub const MAX_KNOTS: usize = 24;

/// Time between knots, s: one frame of a Kinect.
pub const KNOT_SPACING_S: f64 = 1.0 / 30.0;

#[cfg(test)]
mod tests;
