//! The figures by which a run is judged; `docs/experiments.md` defines them.

mod follow;
mod jerk;
mod passage;
mod shape;
mod track;
mod turns;

pub use follow::{Follow, Hand, follow};
pub use jerk::{rms, smooth_jerk_m_s3};
pub use passage::Passing;
pub use shape::{Spread, amplitude_gain, off_path, overshoots, principal_axis, quantile, shift};
pub use track::{Track, TrackError, is_edge, rmse_m, sample_and_hold};
pub use turns::Turns;
