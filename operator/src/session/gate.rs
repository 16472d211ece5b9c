//! A live glitch gate: what a tracker gets wrong for a frame or two never reaches the robot (driving.md §8).
//!
//! There is no low-pass and no limit on speed: fast motion is real. A sample is held for a glitch if it lies
//! where the predictor, which knows what this hand does, all but rules it out.

use telemime_protocol::predict::{Forecast, Params, TurnForecast};
use telemime_protocol::skill::Skill;

use super::HandSample;
use super::hand::Hand;

/// So many samples running are replaced at most: what lasts longer is what the hand does.
const MOST_RUNNING: usize = 2;

/// A sample farther from its prediction than this many times √(tr V + floor²) is a glitch.
const SIGMAS: f64 = 3.0;

/// What a sensor is good for at its worst, m, and rad: the floor.
const SENSOR_M: f64 = 0.01;
const SENSOR_RAD: f64 = 0.1;

/// Nor is what the demonstrated speed (95 % of the time not exceeded) covers this many times between two samples: a hand may begin, or turn back.
const SPEED: f64 = 1.5;

/// The speed of a hand of which nothing was demonstrated, m/s: 95 % of a wave's are below.
const UNKNOWN_M_S: f64 = 4.0;

/// After a hole this long nothing is foretold well enough to judge by, s.
const HOLE_S: f64 = 0.25;

/// What became of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Taken {
    /// It is what the hand does.
    Real,
    /// Its prediction stands for it, until what follows shows whether that was right.
    Replaced,
    /// It is what the hand does, and so are those replaced before it.
    Rewritten,
}

/// Stands between the samples and the [`Hand`].
#[derive(Debug, Clone, Default)]
pub(super) struct Gate {
    /// The samples replaced last, as they came, with the hand before the first.
    suspects: Vec<HandSample>,
    before: Option<Hand>,
}

impl Gate {
    /// How many samples are replaced for the time being.
    pub(super) fn suspects(&self) -> usize {
        self.suspects.len()
    }

    /// Advances `hand` by `sample`, or by what `skill` and `params` foretell for its moment; `None` if the
    /// sample is out of order or not finite, and nothing has changed.
    pub(super) fn take(
        &mut self,
        hand: &mut Hand,
        sample: &HandSample,
        skill: Option<&Skill>,
        params: (&Params, &Params),
    ) -> Option<Taken> {
        let foretold = foretold(hand, sample, skill, params);
        let Some(foretold) = foretold else {
            return hand.advance(sample).then(|| self.believe());
        };
        let before = *hand;
        if self.suspects.len() < MOST_RUNNING {
            if !hand.advance(&foretold) {
                return None;
            }
            self.before.get_or_insert(before);
            self.suspects.push(*sample);
            return Some(Taken::Replaced);
        }
        let mut rewritten = self.before.unwrap_or(before);
        for suspect in &self.suspects {
            rewritten.advance(suspect);
        }
        if !rewritten.advance(sample) {
            return None;
        }
        *hand = rewritten;
        self.believe();
        Some(Taken::Rewritten)
    }

    fn believe(&mut self) -> Taken {
        self.suspects.clear();
        self.before = None;
        Taken::Real
    }
}

/// `sample` as it should have been; `None` if it is as it should be, or cannot be judged.
fn foretold(
    hand: &Hand,
    sample: &HandSample,
    skill: Option<&Skill>,
    (place, turn): (&Params, &Params),
) -> Option<HandSample> {
    let ahead_s = sample.t.secs_since(hand.place.t);
    if !(0.0..HOLE_S).contains(&ahead_s) || !sample.x.iter().all(|v| v.is_finite()) {
        return None;
    }
    let forecast = match skill {
        Some(skill) => skill.predictor().forecast(&hand.place, place),
        None => Forecast::constant_velocity(&hand.place, place),
    };
    let there = forecast.at(ahead_s);
    let most = |sigma: f64, floor: f64| SIGMAS * (3.0 * sigma * sigma + floor * floor).sqrt();
    let usual_m_s = skill.map_or(UNKNOWN_M_S, |skill| skill.stats().speed95_m_s);
    let usual_m = SPEED * usual_m_s * ahead_s;
    let strayed = (sample.x - there.position).norm() > most(there.sigma_m, SENSOR_M).max(usual_m);
    let turned = hand.turn.zip(sample.orientation).map(|(state, seen)| {
        let forecast = match skill.and_then(Skill::turn) {
            Some(turned) => turned.predictor.forecast(&state, turn),
            None => TurnForecast::constant_velocity(&state, turn),
        };
        let there = forecast.at(ahead_s);
        let away_rad = there.orientation.angle_to(&seen);
        (
            there.orientation,
            away_rad > most(there.sigma_rad, SENSOR_RAD),
        )
    });
    if !strayed && !turned.is_some_and(|(_, away)| away) {
        return None;
    }
    Some(HandSample {
        x: there.position,
        orientation: turned.map(|(q, _)| q),
        grip: None,
        ..*sample
    })
}
