//! The figures of a run: what each is called, and how it is written.

macro_rules! figures {
    ($($(#[doc = $doc:literal])+ $name:ident)*) => {
        /// What a run is judged by; `docs/experiments.md` has the formulas. Blank where a figure has no meaning.
        #[derive(Debug, Clone, Copy, Default, PartialEq)]
        pub(super) struct Figures { $($(#[doc = $doc])+ pub(super) $name: Option<f64>,)* }

        impl Figures {
            /// The columns.
            pub(super) const NAMES: &'static [&'static str] = &[$(stringify!($name)),*];

            /// In the order of the columns.
            pub(super) fn values(&self) -> Vec<Option<f64>> {
                vec![$(self.$name),*]
            }

            /// From values in that order; missing ones are blank.
            pub(super) fn from_values(values: impl IntoIterator<Item = Option<f64>>) -> Self {
                let mut values = values.into_iter();
                Self { $($name: values.next().flatten(),)* }
            }

            /// The figure of this name.
            pub(super) fn get(&self, name: &str) -> Option<f64> {
                match name {
                    $(stringify!($name) => self.$name,)*
                    _ => None,
                }
            }
        }
    };
}

figures! {
    /// Tip metres per hand metre.
    scale
    /// Length of what was judged, s.
    judged_s
    /// Share of it for which the arm followed.
    followed
    /// RMS distance of tip and hand at the same wall time, hand metres.
    rmse_m
    /// 99th percentile of it.
    error_p99_m
    /// Largest of it.
    error_max_m
    /// RMS angle of tip and hand at the same wall time, rad.
    turn_rmse_rad
    /// 99th percentile of it.
    turn_p99_rad
    /// Largest of it.
    turn_max_rad
    /// The shift of least squared error.
    lag_s
    /// The RMS error that remains at that shift.
    value_rmse_m
    /// Mean distance of the tip from the hand's path, whenever.
    spatial_mean_m
    /// 95th percentile of it.
    spatial_p95_m
    /// Size of the tip's motion over the hand's.
    amplitude_gain
    /// Mean way beyond the hand's reversals.
    overshoot_m
    /// RMS jerk of what moves the arm, at the tip.
    jerk_m_s3
    /// The same over the scaled hand's, filtered.
    jerk_ratio
    /// Milliseconds on which a limit acted.
    clamps
    /// Age of what the arm follows.
    age_p50_s
    /// Age of what the arm follows.
    age_p95_s
    /// Age of what the arm follows.
    age_p99_s
    /// One-way delay of the packets, operator to robot.
    delay_p50_s
    /// Its 99th percentile.
    delay_p99_s
    /// Its 99th percentile less its least.
    variation_s
    /// Share of the packets lost, operator to robot.
    loss
    /// Share of the packets overtaken, operator to robot.
    reordered
    /// Bytes on the wire from operator to robot, all headers included.
    up_bytes_per_s
    /// Packets.
    up_packets_per_s
    /// From robot to operator.
    down_bytes_per_s
    /// Packets.
    down_packets_per_s
    /// Motion messages.
    messages_per_s
    /// Checkpoints of the path.
    knots_per_s
    /// RMS error of the operator's prediction 33 ms ahead.
    predicted_33ms_m
    /// 100 ms ahead.
    predicted_100ms_m
    /// 200 ms ahead.
    predicted_200ms_m
    /// 300 ms ahead.
    predicted_300ms_m
    /// Share of what came within the predicted 90 % region, 33 ms ahead.
    held_33ms
    /// 100 ms ahead.
    held_100ms
    /// 200 ms ahead.
    held_200ms
    /// 300 ms ahead.
    held_300ms
    /// From the outage's beginning until the arm is at rest.
    stop_s
    /// How far the tip goes meanwhile, hand metres.
    stop_m
    /// From the outage's end until the operator hears from the robot.
    reconnect_s
    /// CPU time of the operator's process per second of wall time.
    operator_cpu
    /// Of the robot's.
    robot_cpu
}

/// The horizons of prediction, s, in the order of the columns.
pub(super) const HORIZONS_S: [f64; 4] = [1.0 / 30.0, 0.1, 0.2, 0.3];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::factor::FACTORS;

    #[test]
    fn every_figure_and_every_factor_is_defined_in_the_document() {
        let text = include_str!("../../docs/experiments.md");
        let factors = FACTORS.iter().map(|f| f.name);
        for name in Figures::NAMES.iter().copied().chain(factors) {
            assert!(text.contains(&format!("`{name}`")), "{name}");
        }
    }
}
