//! `telemime list`, `telemime recognise` and `telemime confusion`: the dictionary of skills.

mod confusion;
mod list;
mod watch;

use telemime_operator::recognise::RecogniseOptions;

pub(crate) use confusion::{ConfusionArgs, confusion};
pub(crate) use list::{ListArgs, list};
pub(crate) use watch::{RecogniseArgs, recognise};

/// What decides between a known skill and none.
#[derive(clap::Args, Debug, Clone)]
pub(crate) struct Tuning {
    /// Tolerated standard deviation of the place, m: how far from where it was learned a skill may be performed.
    #[arg(long, value_name = "M", default_value_t = RecogniseOptions::default().place_sd_m)]
    place: f64,
    /// Recognise a skill wherever it is performed, by its course alone.
    #[arg(long, conflicts_with = "place")]
    anywhere: bool,
    /// Novelty above which a motion is none of the known skills; lower refuses more.
    #[arg(long, value_name = "N", default_value_t = RecogniseOptions::default().reject_above)]
    reject_above: f64,
}

impl Tuning {
    fn options(&self) -> RecogniseOptions {
        RecogniseOptions {
            place_sd_m: if self.anywhere {
                f64::INFINITY
            } else {
                self.place
            },
            reject_above: self.reject_above,
            ..RecogniseOptions::default()
        }
    }
}
