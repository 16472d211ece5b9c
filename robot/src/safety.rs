//! The state machine of DESIGN §5, on the robot's own clock. It runs inside the servo tick: no thread,
//! socket or estimate stands between it and the arm.

use serde::{Deserialize, Serialize};
use telemime_endpoint::Mono;
use telemime_protocol::wire::v1::{Cause, RobotState};

use crate::servo::Lease;

/// What the state machine is set to.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SafetyConfig {
    /// Without news for this long the arm coasts, s. Above the operator's largest silence plus jitter.
    pub coast_after_s: f64,
    /// No lease runs longer than this, whatever the operator asks, s.
    pub max_lease_s: f64,
}

impl Default for SafetyConfig {
    fn default() -> Self {
        Self {
            coast_after_s: 0.26,
            max_lease_s: 1.0,
        }
    }
}

/// State, cause and the two deadlines.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Safety {
    config: SafetyConfig,
    state: RobotState,
    cause: Cause,
    transitions: u32,
    lease_until: Mono,
    last_news: Mono,
}

impl Safety {
    /// Idle.
    pub fn new(config: SafetyConfig) -> Self {
        Self {
            config,
            state: RobotState::Idle,
            cause: Cause::Requested,
            transitions: 0,
            lease_until: Mono(i64::MIN),
            last_news: Mono(i64::MIN),
        }
    }

    /// The state.
    pub fn state(&self) -> RobotState {
        self.state
    }

    /// Why it is the state.
    pub fn cause(&self) -> Cause {
        self.cause
    }

    /// Counts every change.
    pub fn transitions(&self) -> u32 {
        self.transitions
    }

    /// Whether motion is authorised.
    pub fn is_following(&self) -> bool {
        matches!(self.state, RobotState::Engaged | RobotState::Coasting)
    }

    /// An operator has, or loses, authority.
    pub fn set_operator(&mut self, present: bool) {
        match (present, self.state) {
            (true, RobotState::Idle) => self.enter(RobotState::Ready, Cause::Requested),
            (false, RobotState::Ready) => self.enter(RobotState::Idle, Cause::ConnectionLost),
            (false, RobotState::Engaged | RobotState::Coasting) => {
                self.enter(RobotState::Holding, Cause::ConnectionLost);
            }
            _ => {}
        }
    }

    /// Engages, from `Ready` or `Holding` only; says whether.
    pub fn engage(&mut self, now: Mono, lease: Lease) -> bool {
        let may = matches!(self.state, RobotState::Ready | RobotState::Holding);
        if !may || self.bounded(lease) <= now {
            return false;
        }
        self.enter(RobotState::Engaged, Cause::Requested);
        self.news(lease);
        true
    }

    /// News arrived and authorises motion until its lease ends, and no longer than the longest lease.
    pub fn news(&mut self, lease: Lease) {
        if !self.is_following() {
            return;
        }
        self.last_news = self.last_news.max(lease.from);
        self.lease_until = self.lease_until.max(self.bounded(lease));
        if self.state == RobotState::Coasting {
            self.enter(RobotState::Engaged, Cause::NewsArrived);
        }
    }

    fn bounded(&self, lease: Lease) -> Mono {
        let longest = lease.from.offset_by_secs(self.config.max_lease_s);
        lease.until.min(longest)
    }

    /// The clutch is let go, or the motion is over.
    pub fn release(&mut self, cause: Cause) {
        if self.is_following() {
            self.enter(RobotState::Ready, cause);
        }
    }

    /// Stops and holds until a fresh engage.
    pub fn hold(&mut self, cause: Cause) {
        if self.is_following() {
            self.enter(RobotState::Holding, cause);
        }
    }

    /// Emergency stop, from any state, latched.
    /// A stop at the robot takes over from one of the operator's: it asks for more. The arm's own takes over from either, and nothing from it.
    pub fn stop(&mut self, cause: Cause) {
        let takes_over = match cause {
            Cause::ArmFault => self.cause != Cause::ArmFault,
            Cause::LocalStop => self.cause == Cause::OperatorStop,
            _ => false,
        };
        if self.state != RobotState::Stopped || takes_over {
            self.enter(RobotState::Stopped, cause);
        }
    }

    /// Leaves the latched stop, on purpose. `stop` names it by [`Safety::transitions`], so that a stop nobody
    /// has seen is not left; a stop made at the robot is left at the robot only (`None`).
    pub fn reset(&mut self, operator_present: bool, stop: Option<u32>) {
        let meant = match stop {
            None => true,
            Some(stop) => stop == self.transitions && self.cause == Cause::OperatorStop,
        };
        if self.state == RobotState::Stopped && meant {
            let next = if operator_present {
                RobotState::Ready
            } else {
                RobotState::Idle
            };
            self.enter(next, Cause::Requested);
        }
    }

    /// Checks the deadlines; to be called first and last in every tick.
    pub fn tick(&mut self, now: Mono) {
        if !self.is_following() {
            return;
        }
        if now >= self.lease_until {
            self.enter(RobotState::Holding, Cause::LeaseExpired);
        } else if self.state == RobotState::Engaged && now >= self.coast_from() {
            self.enter(RobotState::Coasting, Cause::NewsLate);
        }
    }

    /// Factor on the speed limit, in [0, 1]: 1 while engaged, fading to 0 at the end of the lease.
    pub fn speed_scale(&self, now: Mono) -> f64 {
        match self.state {
            RobotState::Engaged => 1.0,
            RobotState::Coasting => {
                let span_s = self.lease_until.secs_since(self.coast_from());
                (self.lease_until.secs_since(now) / span_s.max(1e-3)).clamp(0.0, 1.0)
            }
            _ => 0.0,
        }
    }

    fn coast_from(&self) -> Mono {
        self.last_news.offset_by_secs(self.config.coast_after_s)
    }

    fn enter(&mut self, state: RobotState, cause: Cause) {
        if !self.is_following() {
            self.lease_until = Mono(i64::MIN);
            self.last_news = Mono(i64::MIN);
        }
        self.state = state;
        self.cause = cause;
        self.transitions = self.transitions.wrapping_add(1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn lease(from_ms: i64, lease_s: f64) -> Lease {
        let from = Mono(from_ms * MS);
        Lease {
            from,
            until: from.offset_by_secs(lease_s),
        }
    }

    fn engaged() -> Safety {
        let mut safety = Safety::new(SafetyConfig::default());
        safety.set_operator(true);
        assert!(safety.engage(Mono(0), lease(0, 0.45)));
        safety
    }

    #[test]
    fn silence_coasts_fades_and_holds_for_good() {
        let mut safety = engaged();
        safety.tick(Mono(259 * MS));
        assert_eq!(safety.state(), RobotState::Engaged);
        safety.tick(Mono(260 * MS));
        assert_eq!(
            (safety.state(), safety.speed_scale(Mono(260 * MS))),
            (RobotState::Coasting, 1.0)
        );
        assert!((safety.speed_scale(Mono(355 * MS)) - 0.5).abs() < 1e-9);
        safety.tick(Mono(450 * MS));
        assert_eq!(
            (safety.state(), safety.cause()),
            (RobotState::Holding, Cause::LeaseExpired)
        );
        safety.news(lease(451, 0.45));
        safety.tick(Mono(451 * MS));
        assert_eq!(
            safety.state(),
            RobotState::Holding,
            "never re-engages by itself"
        );
        assert!(safety.engage(Mono(500 * MS), lease(500, 0.45)));
    }

    #[test]
    fn news_while_coasting_resumes() {
        let mut safety = engaged();
        safety.tick(Mono(300 * MS));
        assert_eq!(safety.state(), RobotState::Coasting);
        safety.news(lease(301, 0.45));
        assert_eq!(
            (safety.state(), safety.speed_scale(Mono(302 * MS))),
            (RobotState::Engaged, 1.0)
        );
    }

    #[test]
    fn the_stop_is_latched_and_every_lease_is_bounded() {
        let mut safety = engaged();
        safety.news(lease(0, 1e9));
        safety.tick(Mono(1001 * MS));
        assert_eq!(safety.state(), RobotState::Holding);
        safety.stop(Cause::LocalStop);
        assert!(!safety.engage(Mono(0), lease(0, 0.45)));
        safety.set_operator(false);
        safety.set_operator(true);
        assert_eq!(safety.state(), RobotState::Stopped);
        safety.reset(true, Some(safety.transitions()));
        assert_eq!(
            safety.state(),
            RobotState::Stopped,
            "a local stop is left at the robot"
        );
        safety.reset(true, None);
        assert_eq!(safety.state(), RobotState::Ready);
    }

    #[test]
    fn the_arms_own_stop_takes_over_from_every_other_and_none_from_it() {
        use Cause::{ArmFault, LocalStop, OperatorStop};
        for (first, then, stays) in [
            (OperatorStop, LocalStop, LocalStop),
            (OperatorStop, ArmFault, ArmFault),
            (LocalStop, ArmFault, ArmFault),
            (LocalStop, OperatorStop, LocalStop),
            (ArmFault, LocalStop, ArmFault),
            (ArmFault, OperatorStop, ArmFault),
        ] {
            let mut safety = engaged();
            safety.stop(first);
            let before = safety.transitions();
            for _ in 0..3 {
                safety.stop(then);
            }
            assert_eq!(
                (safety.state(), safety.cause()),
                (RobotState::Stopped, stays),
                "{first:?}, then {then:?}"
            );
            let told = safety.transitions() - before;
            assert_eq!(told, u32::from(stays != first), "told once, or not at all");
        }
    }

    #[test]
    fn a_lost_connection_holds_and_a_new_operator_does_not_move_the_arm() {
        let mut safety = engaged();
        safety.set_operator(false);
        assert_eq!(
            (safety.state(), safety.cause()),
            (RobotState::Holding, Cause::ConnectionLost)
        );
        safety.set_operator(true);
        assert!(!safety.is_following());
    }
}
