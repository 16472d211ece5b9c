//! Ways to follow a hand over a link: ours, and what it is held against.

use std::fmt;
use std::str::FromStr;

use nalgebra::{UnitQuaternion, Vector3};
use telemime_operator::demonstration::Sample;
use telemime_protocol::pose;
use telemime_protocol::predict::{HandState, TurnState};
use telemime_protocol::time::Stamp;

use crate::evaluate::Kalman;
use crate::measure::Hand;

/// What QUIC, UDP and IP add to a datagram, bytes: as much as they add to ours (`tests/it/overhead.rs` counts it).
pub(super) const HEADERS: usize = 53;

/// Nothing is predicted farther than our predictor's last knot, s.
const FARTHEST_S: f64 = 0.8;

/// Below this speed a hand's velocity is noise, m/s.
const REST_M_S: f64 = 0.05;

/// The deadband's share unless another is asked for: what a hand can tell of velocity, about 10 %.
const SHARE: f64 = 0.1;

/// A way to follow a hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Method {
    /// Both daemons.
    Ours,
    /// Every raw sample is sent; the newest that has arrived is held.
    Hold,
    /// Weber's deadband on velocity: a sample is sent when the hand's velocity differs from the one sent last by more than
    /// this share of it; between messages the robot goes on at the velocity received, as late as the link is.
    Deadband(f64),
    /// Every sample with its velocity; the robot extrapolates by the sample's age and the arm's lag, at this share of it.
    Velocity(f64),
    /// The same with the state of a Kalman filter of constant acceleration.
    Kalman,
    /// The publication's: the skill's inferred motion, sent once as checkpoints and played.
    Playback,
    /// Perfect knowledge of the hand, through the same arm.
    Floor,
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Ours => "ours",
            Self::Hold => "hold",
            Self::Deadband(share) if *share == SHARE => "deadband",
            Self::Deadband(share) => return write!(f, "deadband {}%", percent(*share)),
            Self::Velocity(share) if *share == 1.0 => "velocity",
            Self::Velocity(share) => return write!(f, "velocity {}%", percent(*share)),
            Self::Kalman => "kalman",
            Self::Playback => "playback",
            Self::Floor => "floor",
        })
    }
}

/// As it was written: 7 % is no binary fraction.
fn percent(share: f64) -> f64 {
    (share * 1e11).round() / 1e9
}

impl FromStr for Method {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        for (name, method) in [
            ("deadband ", Self::Deadband as fn(f64) -> Self),
            ("velocity ", Self::Velocity),
        ] {
            if let Some(share) = text.strip_prefix(name) {
                let share = telemime_sim::link::parse_probability(share);
                return share.map(method).map_err(|e| e.to_string());
            }
        }
        Ok(match text {
            "ours" => Self::Ours,
            "hold" => Self::Hold,
            "deadband" => Self::Deadband(SHARE),
            "velocity" => Self::Velocity(1.0),
            "kalman" => Self::Kalman,
            "playback" => Self::Playback,
            "floor" => Self::Floor,
            _ => {
                return Err(
                    "write ours, hold, deadband [SHARE], velocity [SHARE], kalman, playback or floor"
                        .into(),
                );
            }
        })
    }
}

/// What a baseline sends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Message {
    /// When the sample was valid, s.
    pub(super) t_s: f64,
    place: Vector3<f64>,
    velocity: Vector3<f64>,
    acceleration: Vector3<f64>,
    orientation: Option<UnitQuaternion<f64>>,
    /// In the hand's own axes, rad/s.
    turning: Vector3<f64>,
    /// On the wire, headers included.
    pub(super) bytes: usize,
}

impl Message {
    /// Where the robot takes the hand to be, `age_s` after the sample was valid; `late_s` of that the message was under way,
    /// and `lag_s` is the arm's.
    pub(super) fn hand(&self, method: Method, age_s: f64, late_s: f64, lag_s: f64) -> Hand {
        let h_s = match method {
            Method::Deadband(_) => (age_s - late_s).clamp(0.0, FARTHEST_S),
            Method::Velocity(_) | Method::Kalman => (age_s + lag_s).clamp(0.0, FARTHEST_S),
            Method::Ours | Method::Hold | Method::Playback | Method::Floor => 0.0,
        };
        Hand {
            place: self.place + self.velocity * h_s + self.acceleration * (0.5 * h_s * h_s),
            turn: self
                .orientation
                .map(|q| pose::moved(&q, &(self.turning * h_s))),
        }
    }
}

/// The operator's side of a baseline.
pub(super) struct Sender {
    method: Method,
    kalman: Kalman,
    hand: Option<(HandState, Option<TurnState>)>,
    /// The velocity sent last.
    said: Option<Vector3<f64>>,
}

impl Sender {
    /// `kalman` is tuned on what the skill was learned from.
    pub(super) fn new(method: Method, kalman: &Kalman) -> Self {
        Self {
            method,
            kalman: kalman.clone(),
            hand: None,
            said: None,
        }
    }

    /// What is sent of the next sample; a deadband may send nothing.
    pub(super) fn take(&mut self, sample: &Sample) -> Option<Message> {
        let t = Stamp::from_secs_f64(sample.t_s);
        let (place, turn) = self.hand.get_or_insert_with(|| {
            let turn = sample.orientation.map(|q| TurnState::first(t, q));
            (HandState::first(t, sample.position), turn)
        });
        place.advance(t, sample.position);
        if let (Some(turn), Some(q)) = (turn, sample.orientation) {
            turn.advance(t, q);
        }
        let (velocity, turning) = self.rates();
        let zero = Vector3::zeros();
        // Four-byte numbers: time and position, then velocity, then acceleration; an orientation is three more.
        let (place, velocity, acceleration, turning, mut numbers) = match self.method {
            Method::Deadband(share) => {
                if let Some(said) = self.said
                    && (velocity - said).norm() <= share * said.norm().max(REST_M_S)
                {
                    return None;
                }
                self.said = Some(velocity);
                (sample.position, velocity, zero, turning, 7)
            }
            Method::Velocity(share) => {
                (sample.position, velocity * share, zero, turning * share, 7)
            }
            Method::Kalman => {
                let [x, v, a] = self.kalman.take_motion(sample);
                (x, v, a, turning, 10)
            }
            Method::Ours | Method::Hold | Method::Playback | Method::Floor => {
                (sample.position, zero, zero, zero, 4)
            }
        };
        if sample.orientation.is_some() {
            numbers += if turning == zero { 3 } else { 6 };
        }
        Some(Message {
            t_s: sample.t_s,
            place,
            velocity,
            acceleration,
            orientation: sample.orientation,
            turning,
            bytes: 4 * numbers + HEADERS,
        })
    }

    fn rates(&self) -> (Vector3<f64>, Vector3<f64>) {
        let zero = Vector3::zeros();
        self.hand.as_ref().map_or((zero, zero), |(place, turn)| {
            let turning = turn.as_ref().map(TurnState::angular_velocity);
            (place.motion().0, turning.unwrap_or(zero))
        })
    }
}

#[cfg(test)]
mod tests {
    use telemime_operator::demonstration::Demonstration;

    use super::*;

    fn samples(rate: f64) -> Vec<Sample> {
        let at = |i: i32| {
            let t_s = f64::from(i) * 0.02;
            Sample::at(t_s, Vector3::new(1.0 + rate * t_s, 0.0, 0.0))
        };
        (0..100).map(at).collect()
    }

    #[test]
    fn on_a_straight_line_the_predicting_ones_are_right_and_the_holding_ones_late() {
        let speed = 0.5;
        for (text, late_m) in [
            ("hold", 0.1 * speed),
            ("velocity", -0.05 * speed),
            ("velocity 50%", 0.025 * speed),
            ("kalman", -0.05 * speed),
            ("deadband", 0.1 * speed),
        ] {
            let method: Method = text.parse().unwrap();
            assert_eq!(method.to_string(), text);
            let line = Demonstration::from_samples("line", &samples(speed)).unwrap();
            let mut sender = Sender::new(method, &Kalman::tuned(&[line]));
            let sent: Vec<_> = samples(speed)
                .iter()
                .filter_map(|s| sender.take(s))
                .collect();
            let last = sent.last().unwrap();
            // A message 100 ms under way, taken the moment it comes; the arm lags 50 ms.
            let seen = last.hand(method, 0.1, 0.1, 0.05).place.x;
            let truth = 1.0 + speed * (last.t_s + 0.1);
            assert!(
                (truth - seen - late_m).abs() < 3e-3,
                "{text}: {}",
                truth - seen
            );
            if method == Method::Deadband(SHARE) {
                assert!(sent.len() < 40, "{} messages", sent.len());
            }
        }
    }

    #[test]
    fn nothing_is_predicted_beyond_the_last_knot() {
        let mut sender = Sender::new(Method::Velocity(1.0), &Kalman::tuned(&[]));
        let last = samples(1.0)
            .iter()
            .filter_map(|s| sender.take(s))
            .last()
            .unwrap();
        let [near, far] =
            [0.8, 60.0].map(|age| last.hand(Method::Velocity(1.0), age, 0.1, 0.0).place);
        assert_eq!(near, far);
    }
}
