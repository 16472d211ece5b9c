//! The operator's own session without network and arm: what it would have sent, and what the robot would
//! predict from it.

use std::sync::Arc;

use telemime_operator::demonstration::Sample;
use telemime_operator::session::{HandSample, Output, Session, SessionConfig};
use telemime_protocol::predict::{Forecast, TurnForecast};
use telemime_protocol::skill::Skill;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{
    Info, MAX_TAIL_KNOTS, Message, Motion, OperatorDatagram, RobotControl, RobotDatagram,
    RobotState, Telemetry,
};
use telemime_protocol::wire::{frame::Frame, v1::model_tag};

/// Where a recording's zero lies on the session clock.
const ZERO: Stamp = Stamp(10_000_000_000);

/// The hand rests this long before the recording begins, s: the engage needs a sample.
const REST_S: f64 = 1.0 / 30.0;

const EPOCH: u32 = 1;

/// A session that mirrors one performance.
pub(crate) struct Live {
    session: Session,
    skill: Arc<Skill>,
    delay_s: f64,
    begun: bool,
    acknowledged: u32,
}

/// One motion message.
pub(crate) struct Said {
    /// When, s of the recording.
    pub(crate) at_s: f64,
    /// The datagram's length, bytes.
    pub(crate) bytes: usize,
    /// Numbers of the knots it carries.
    pub(crate) knots: std::ops::Range<u32>,
    /// What the robot predicts from it.
    pub(crate) place: Forecast,
    /// The same of the orientation, where the recording has it.
    pub(crate) turn: Option<TurnForecast>,
}

impl Live {
    /// A session with a robot `delay_s` away, whose arm adds no lag.
    pub(crate) fn new(skill: &Arc<Skill>, config: SessionConfig, delay_s: f64) -> Self {
        let mut live = Self {
            session: Session::new(config, Some(Arc::clone(skill)), EPOCH),
            skill: Arc::clone(skill),
            delay_s,
            begun: false,
            acknowledged: 0,
        };
        live.hears(&RobotControl::Info(Info {
            name: "none".into(),
            joints: 7,
            speed_m_s: 1.7,
            accel_m_s2: 13.0,
            radius_m: 0.5,
            lag_s: 0.0,
            model: Some(skill.id().0),
            state: RobotState::Ready,
        }));
        live
    }

    /// The same, but every sample is said, whatever the robot predicts: what [`Live::take`] gives last is of that sample.
    pub(crate) fn of_every_sample(skill: &Arc<Skill>, config: SessionConfig, delay_s: f64) -> Self {
        let config = SessionConfig {
            max_silence_s: 0.0,
            min_interval_s: 0.0,
            ..config
        };
        Self::new(skill, config, delay_s)
    }

    fn hears(&mut self, message: &RobotControl) {
        let frame = Frame {
            ignorable: false,
            payload: message.encode(),
        };
        self.session
            .handle_control(ZERO, &frame)
            .expect("what this program encodes it decodes");
    }

    /// The robot's news: how long messages take, and the knots it has.
    pub(crate) fn telemetry(&mut self, at_s: f64, path_frontier: u32) {
        self.acknowledged += 1;
        let telemetry = RobotDatagram::Telemetry(Telemetry {
            epoch: EPOCH,
            seq: self.acknowledged,
            state: RobotState::Engaged,
            engagement: 1,
            delay_ms: (self.delay_s * 1e3).round() as u16,
            path_frontier,
            ..Telemetry::default()
        });
        self.session
            .handle_datagram(on_session_clock(at_s), &telemetry.encode());
    }

    /// Takes a sample the moment it is valid; what the session then says, in order.
    pub(crate) fn take(&mut self, sample: &Sample) -> Vec<Said> {
        if !self.begun {
            self.begun = true;
            let rest = Sample {
                t_s: sample.t_s - REST_S,
                ..*sample
            };
            self.give(&rest, true);
            self.session.engage(on_session_clock(rest.t_s));
            self.telemetry(rest.t_s, 0);
            // Requests and whatever else this brought about are no motion.
            while self.session.poll_output().is_some() {}
        }
        self.give(sample, false);
        self.said(sample.t_s)
    }

    fn give(&mut self, sample: &Sample, resting: bool) {
        let t = on_session_clock(sample.t_s);
        self.session.handle_sample(
            t,
            HandSample {
                t,
                x: sample.position,
                orientation: sample.orientation,
                grip: sample.grip,
                resting,
            },
        );
    }

    /// What the session has to say before `until_s` though no sample comes.
    pub(crate) fn wait(&mut self, until_s: f64) -> Vec<Said> {
        let mut all = Vec::new();
        while let Some((due, _)) = self.session.poll_timeout() {
            let due_s = due.secs_since(ZERO);
            if due_s >= until_s {
                break;
            }
            self.session.handle_timeout(due);
            all.extend(self.said(due_s));
        }
        all
    }

    fn said(&mut self, at_s: f64) -> Vec<Said> {
        let mut all = Vec::new();
        while let Some(output) = self.session.poll_output() {
            let Output::Datagram { bytes, motion } = output else {
                continue;
            };
            if let (true, Ok(OperatorDatagram::Motion(motion))) =
                (motion, OperatorDatagram::decode(&bytes))
            {
                all.push(self.predicted(at_s, bytes.len(), &motion));
            }
        }
        while self.session.poll_event().is_some() {}
        all
    }

    fn predicted(&self, at_s: f64, bytes: usize, motion: &Motion) -> Said {
        let known = motion.model == model_tag(&self.skill.id().0);
        let skill = known.then_some(&*self.skill);
        let (state, params) = (motion.state.dequantise(), motion.params.dequantise());
        let knots = motion.knots.count(MAX_TAIL_KNOTS);
        let knots = knots.expect("a decoded message was checked") as u32;
        Said {
            at_s,
            bytes,
            knots: motion.first_knot..motion.first_knot + knots,
            place: match skill {
                Some(skill) => skill.predictor().forecast(&state, &params),
                None => Forecast::constant_velocity(&state, &params),
            },
            turn: motion.pose.turn.map(|turn| turn.forecast(state.t, skill)),
        }
    }
}

/// The session's time of a recording's.
pub(crate) fn on_session_clock(t_s: f64) -> Stamp {
    ZERO.offset_by_secs(t_s)
}
