//! The hand as the session knows it: position, and what else the input has.

use nalgebra::UnitQuaternion;
use telemime_protocol::predict::{Forecast, HandState, Params, TurnForecast, TurnState};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::{WirePose, WireTurn, quantise_grip};
use telemime_protocol::wire::v1::{MAX_SAMPLE_US, WireParams};

use super::HandSample;

/// The newest of the hand, and what it remembers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hand {
    /// When its first sample was valid.
    pub(super) since: Stamp,
    pub(super) place: HandState,
    pub(super) turn: Option<TurnState>,
    pub(super) grip: Option<f64>,
}

impl Hand {
    /// The hand after its first sample; `None` if that is not finite.
    pub(super) fn first(sample: &HandSample) -> Option<Self> {
        let finite = sample.x.iter().all(|v| v.is_finite());
        let turn = rotation(sample);
        finite.then(|| Self {
            since: sample.t,
            place: HandState::first(sample.t, sample.x),
            turn: turn.map(|q| TurnState::first(sample.t, q)),
            grip: grip(sample),
        })
    }

    /// Takes a sample; says whether it was taken. Where it lacks orientation or gripper, the last is kept: a
    /// tracker that loses the wrist for a moment does not let the tool go.
    pub(super) fn advance(&mut self, sample: &HandSample) -> bool {
        if !self.place.advance(sample.t, sample.x) {
            return false;
        }
        let seen = rotation(sample);
        match &mut self.turn {
            Some(turn) => {
                turn.advance(sample.t, seen.unwrap_or(turn.q));
            }
            None => self.turn = seen.map(|q| TurnState::first(sample.t, q)),
        }
        self.grip = grip(sample).or(self.grip);
        true
    }
}

/// How often the hand is sampled: the median of the last intervals, so that a pause or a hole says nothing.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Interval {
    recent_us: [u32; 15],
    count: usize,
}

impl Interval {
    /// A sample came this long after the one before.
    pub(super) fn take(&mut self, interval_s: f64) {
        self.recent_us[self.count % self.recent_us.len()] = (interval_s * 1e6).round() as u32;
        self.count += 1;
    }

    /// In µs, within what an `Engage` allows; 10 ms before there is one.
    pub(super) fn us(&self) -> u32 {
        let mut known = self.recent_us;
        let known = &mut known[..self.count.min(self.recent_us.len())];
        known.sort_unstable();
        let median = known.get(known.len() / 2);
        median.map_or(10_000, |us| (*us).clamp(1, MAX_SAMPLE_US))
    }
}

/// The sample's orientation, if it is one.
pub(super) fn rotation(sample: &HandSample) -> Option<UnitQuaternion<f64>> {
    // Written so that NaN fails too.
    let is_one = |q: &UnitQuaternion<f64>| (q.coords.norm_squared() - 1.0).abs() < 1e-3;
    sample.orientation.filter(is_one)
}

fn grip(sample: &HandSample) -> Option<f64> {
    sample
        .grip
        .filter(|g| g.is_finite())
        .map(|g| g.clamp(0.0, 1.0))
}

/// The hand and the parameters it is to be predicted by, as they travel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Travelling {
    pub(super) state: WireState,
    pub(super) params: WireParams,
    pub(super) pose: WirePose,
}

impl Travelling {
    /// `None` if the hand is nowhere that can be sent.
    pub(super) fn new(hand: &Hand, place: &Params, turn: &Params) -> Option<Self> {
        let turn = hand
            .turn
            .map(|state| WireTurn::quantise(&state, WireParams::quantise(turn)));
        Some(Self {
            state: WireState::quantise(&hand.place)?,
            params: WireParams::quantise(place),
            pose: WirePose {
                turn,
                grip: hand.grip.map(quantise_grip),
            },
        })
    }

    /// What the robot will predict from it.
    pub(super) fn known(&self, skill: Option<&Skill>) -> Known {
        let state = self.state.dequantise();
        let params = self.params.dequantise();
        Known {
            place: match skill {
                Some(skill) => skill.predictor().forecast(&state, &params),
                None => Forecast::constant_velocity(&state, &params),
            },
            turn: self.pose.turn.map(|turn| turn.forecast(state.t, skill)),
            grip: self.pose.grip,
        }
    }
}

/// What the robot predicts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Known {
    pub(super) place: Forecast,
    pub(super) turn: Option<TurnForecast>,
    pub(super) grip: Option<u8>,
}
