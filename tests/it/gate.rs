//! What the live glitch gate saves, and what it costs: the session fed with a tracker's errors, and the robot's prediction from what it says.

use std::sync::Arc;

use nalgebra::Vector3;
use telemime::measure::Track;
use telemime_operator::demonstration::{Demonstration, Sample};
use telemime_operator::learn::{LearnOptions, learn_skill};
use telemime_operator::session::{FutureBound, HandSample, Output, Session, SessionConfig};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::frame::Frame;
use telemime_protocol::wire::turn::WireRotation;
use telemime_protocol::wire::v1::{
    Cause, Info, Message, OperatorDatagram, RobotControl, RobotState,
};
use telemime_sim::hand::{glitched, swing};

use crate::data::needs;

/// How far ahead is judged, s.
const AHEAD_S: f64 = 0.1;

type Seen = Vec<(f64, [f64; 3])>;

/// Summed squares: of the prediction, and of holding the true sample.
#[derive(Default)]
struct Errors {
    predicted: f64,
    held: f64,
    glitches: u32,
    samples: usize,
}

impl Errors {
    fn ratio(&self) -> f64 {
        (self.predicted / self.held).sqrt()
    }
}

/// Feeds `seen` to a session that speaks at every sample, and judges against `truth` what a robot predicts.
fn feed(skill: &Arc<Skill>, seen: &Seen, truth: &Seen, glitch_gate: bool, errors: &mut Errors) {
    let config = SessionConfig {
        future_bound: FutureBound::Absolute(0.0),
        min_interval_s: 0.0,
        glitch_gate,
        ..SessionConfig::default()
    };
    let mut session = Session::new(config, Some(Arc::clone(skill)), 1);
    let at = |t_s: f64| Stamp::from_secs_f64(10.0 + t_s);
    let hears = |session: &mut Session, message: &RobotControl| {
        let frame = Frame {
            ignorable: false,
            payload: message.encode(),
        };
        session.handle_control(at(0.0), &frame).unwrap();
    };
    hears(
        &mut session,
        &RobotControl::Info(Info {
            name: "bench".into(),
            joints: 7,
            speed_m_s: 1.7,
            accel_m_s2: 13.0,
            radius_m: 0.3,
            lag_s: 0.07,
            model: Some(skill.id().0),
            state: RobotState::Ready,
        }),
    );
    let hand = Track::new(truth.iter().map(|(t, x)| (*t, (*x).into())).collect()).unwrap();
    for (i, (t_s, x)) in seen.iter().enumerate() {
        session.handle_sample(at(*t_s), HandSample::at(at(*t_s), Vector3::from(*x)));
        if i == 0 {
            session.engage(at(*t_s));
            hears(
                &mut session,
                &RobotControl::Engaged {
                    engagement: 1,
                    t_us: 0,
                    hand_m: [0.0; 3],
                    tip_m: [0.0; 3],
                    hand_q: None,
                    tip_q: WireRotation::default(),
                },
            );
            hears(
                &mut session,
                &RobotControl::State {
                    state: RobotState::Engaged,
                    cause: Cause::Requested,
                    changes: 1,
                },
            );
        }
        session.handle_timeout(at(*t_s + 0.2));
        let mut newest = None;
        while let Some(output) = session.poll_output() {
            if let Output::Datagram {
                bytes,
                motion: true,
            } = output
                && let OperatorDatagram::Motion(motion) = OperatorDatagram::decode(&bytes).unwrap()
            {
                newest = Some(motion);
            }
        }
        let Some(motion) = newest.filter(|_| i > 0) else {
            continue;
        };
        let (state, params) = (motion.state.dequantise(), motion.params.dequantise());
        let forecast = skill.predictor().forecast(&state, &params);
        let due_s = t_s + AHEAD_S;
        if due_s > hand.span_s().1 {
            continue;
        }
        let there = forecast.at(at(due_s).secs_since(state.t)).position;
        errors.predicted += (there - hand.at(due_s)).norm_squared();
        errors.held += (hand.at(*t_s) - hand.at(due_s)).norm_squared();
    }
    errors.glitches += session.counters().glitches;
    errors.samples += seen.len();
}

/// Clean, 2 % single and 2 % double glitches: ratio to holding the true sample without the gate and with it, and what the gate replaced.
fn table(set: &str, cases: &[(Arc<Skill>, Seen)]) -> [[Errors; 2]; 3] {
    let kinds = [("clean", 0.0, 1), ("single", 0.02, 1), ("double", 0.02, 2)];
    kinds.map(|(name, share, running)| {
        let both = [false, true].map(|gate| {
            let mut errors = Errors::default();
            for (seed, (skill, truth)) in cases.iter().enumerate() {
                let (seen, _) = glitched(truth, share, running, seed as u64);
                feed(skill, &seen, truth, gate, &mut errors);
            }
            errors
        });
        println!(
            "{set}, {name}: {:.3} without the gate, {:.3} with; {} of {} samples replaced",
            both[0].ratio(),
            both[1].ratio(),
            both[1].glitches,
            both[1].samples
        );
        both
    })
}

fn learn(demonstrations: &[Demonstration]) -> Arc<Skill> {
    let options = LearnOptions {
        motion_components: 1..=1,
        ..LearnOptions::default()
    };
    Arc::new(learn_skill("gesture", demonstrations, &options, |_| {}).unwrap())
}

/// Clean data suffer by at most the factor `cost`; of the error with glitches at most the share `left` is left.
fn must_hold([clean, single, double]: &[[Errors; 2]; 3], cost: f64, left: f64) {
    let costs = clean[1].ratio() / clean[0].ratio();
    assert!(costs < cost, "clean data suffer: {costs}");
    let false_alarms = f64::from(clean[1].glitches) / clean[1].samples as f64;
    assert!(false_alarms < 0.005, "{false_alarms} of clean samples");
    for glitched in [single, double] {
        assert!(glitched[1].ratio() < left * glitched[0].ratio());
        assert!(glitched[1].ratio() < 1.15 * clean[0].ratio());
    }
}

#[test]
fn a_generated_hand_keeps_its_prediction_through_glitches() {
    let cases = [3, 9].map(|person| {
        let demonstrations: Vec<_> = (0..3)
            .map(|i| {
                let samples = swing(person, i).into_iter();
                let samples: Vec<_> = samples.map(|(t, x)| Sample::at(t, x.into())).collect();
                Demonstration::from_samples(format!("{i}"), &samples).unwrap()
            })
            .collect();
        let skill = learn(&demonstrations);
        (0..4).map(move |i| (Arc::clone(&skill), swing(person, 5 + i)))
    });
    let cases: Vec<_> = cases.into_iter().flatten().collect();
    must_hold(&table("generated", &cases), 1.01, 0.7);
}

#[test]
fn real_gestures_keep_their_prediction_through_glitches() {
    let mut cases = Vec::new();
    for gesture in [
        "a01_swipe_left",
        "a03_wave",
        "a09_circle_cw",
        "a15_tennis_swing",
    ] {
        let Some(folder) = needs(&format!("data/demos/utd_mhad/{gesture}")) else {
            return;
        };
        for person in crate::prediction::by_person(&folder).into_iter().take(4) {
            let [train @ .., test] = &person[..] else {
                panic!("{gesture}: a person without demonstrations")
            };
            let truth = test.samples().iter().map(|s| (s.t_s, s.position.into()));
            cases.push((learn(&train[..train.len().min(3)]), truth.collect()));
        }
    }
    // Real swings jump as glitches do: why the gate is off unless it is asked for.
    must_hold(&table("utd_mhad", &cases), 1.12, 0.98);
}
