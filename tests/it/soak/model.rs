//! What must hold in every tick, told from what the servo was given and what it did, without asking it why.

use std::collections::{BTreeMap, VecDeque};

use telemime::ground::Told;
use telemime_endpoint::Mono;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::rig::Rig;
use telemime_robot::servo::{Lease, Report, Ticket};

/// From whatever it did, the arm gets this long to come to rest, s.
const STOP_S: f64 = 0.6;

/// What every operator here grants, s.
pub(super) const LEASE_S: f64 = 0.65;

/// A sample older than this authorises nothing beyond, s (the robot's default).
const MAX_DELAY_S: f64 = 0.5;

/// A stop typed at the robot acts within so many ticks, and orders reach the servo.
const PROMPT_TICKS: f64 = 2.0;

/// Events kept to be shown when something breaks.
const KEPT: usize = 80;

/// What has been seen, to show that something was.
#[derive(Debug, Default, Clone, PartialEq)]
pub(super) struct Seen {
    pub(super) ticks: u64,
    pub(super) following: u64,
    pub(super) engagements: u32,
    pub(super) news: u64,
    /// News of an engagement that is not the current one.
    pub(super) foreign: u32,
    /// How often following ended, by cause.
    pub(super) ends: BTreeMap<String, u32>,
    /// How far the tip went, m: a fingerprint of the whole run.
    pub(super) way_m: f64,
}

/// An engagement as the servo was asked for it.
#[derive(Clone, Copy)]
struct Grant {
    ticket: Ticket,
    /// Until when motion is authorised.
    until: Mono,
    /// When the newest sample was valid, if a hand is followed.
    valid_at: Option<Mono>,
    /// None has come since the request, and the first may be of the same sample.
    fresh: bool,
}

/// The model of one robot, through its restarts.
pub(super) struct Model {
    rig: Rig,
    /// Of the tip's speed, acceleration and jerk.
    limits: [f64; 3],
    granted: Option<Grant>,
    /// The newest engagement the servo was asked for.
    asked: (u32, u32),
    present: bool,
    before: Option<Report>,
    last: Option<Report>,
    followed_at: Option<Mono>,
    /// A stop typed at the robot and not taken back there.
    stopped_here: Option<Mono>,
    reset_here: bool,
    events: VecDeque<String>,
    pub(super) seen: Seen,
    broken: Option<String>,
}

pub(super) fn follows(state: RobotState) -> bool {
    matches!(state, RobotState::Engaged | RobotState::Coasting)
}

impl Model {
    pub(super) fn new(rig: &Rig) -> Self {
        let (controller, _) = rig.parts();
        let limits = controller.limits();
        Self {
            rig: rig.clone(),
            limits: [limits.v_max, limits.a_max, limits.j_max],
            granted: None,
            asked: (0, 0),
            present: false,
            before: None,
            last: None,
            followed_at: None,
            stopped_here: None,
            reset_here: false,
            events: VecDeque::new(),
            seen: Seen::default(),
            broken: None,
        }
    }

    /// The robot's process begins anew.
    pub(super) fn restart(&mut self) {
        let fresh = Self::new(&self.rig);
        let old = std::mem::replace(self, fresh);
        (self.seen, self.events, self.broken) = (old.seen, old.events, old.broken);
    }

    /// Somebody types `stop` at the robot.
    pub(super) fn stop_here(&mut self, now: Mono) {
        self.stopped_here.get_or_insert(now);
    }

    /// Somebody types `reset` there.
    pub(super) fn reset_here(&mut self) {
        self.stopped_here = None;
        self.reset_here = true;
    }

    /// The newest tick.
    pub(super) fn newest(&self) -> Option<&Report> {
        self.last.as_ref()
    }

    /// What happened last, oldest first.
    pub(super) fn story(&self) -> String {
        let lines: Vec<_> = self.events.iter().map(String::as_str).collect();
        lines.join("\n  ")
    }

    /// The first thing that did not hold.
    pub(super) fn broken(&self) -> Option<&str> {
        self.broken.as_deref()
    }

    pub(super) fn note(&mut self, at: Mono, what: impl AsRef<str>) {
        if self.events.len() == KEPT {
            self.events.pop_front();
        }
        let at_s = at.0 as f64 * 1e-9;
        let event = format!("{at_s:10.3} s  {}", what.as_ref());
        self.events.push_back(event);
    }

    fn must(&mut self, holds: bool, at: Mono, what: impl FnOnce() -> String) {
        if !holds && self.broken.is_none() {
            let what = what();
            self.note(at, format!("BROKEN: {what}"));
            self.broken = Some(what);
        }
    }

    /// A tick: what the servo was told before it, and what it then reports.
    pub(super) fn tick(&mut self, told: &[Told], report: &Report) {
        let at = report.at;
        let (mut asked, mut news, mut resets) = (None, false, Vec::new());
        for order in told {
            match *order {
                Told::Operator(present) => {
                    self.present = present;
                    self.note(at, format!("operator {present}"));
                }
                Told::Engage(ticket, lease, valid_at) => {
                    self.note(at, format!("engage {}/{}", ticket.epoch, ticket.number));
                    let (before, key) = (self.asked, (ticket.epoch, ticket.number));
                    let may = self.present && key > before;
                    self.must(may, at, || {
                        format!("{key:?} asked for after {before:?}, or by nobody")
                    });
                    self.lease(at, lease, valid_at);
                    self.asked = key;
                    let until = lease.until;
                    asked = Some(Grant {
                        ticket,
                        until,
                        valid_at,
                        fresh: true,
                    });
                }
                Told::News(ticket, lease, valid_at) => {
                    self.seen.news += 1;
                    self.lease(at, lease, valid_at);
                    let grant = asked.as_mut().or(self.granted.as_mut());
                    let Some(grant) = grant.filter(|grant| grant.ticket == ticket) else {
                        self.seen.foreign += 1;
                        continue;
                    };
                    news = true;
                    let old = grant.valid_at;
                    grant.until = grant.until.max(lease.until);
                    grant.valid_at = valid_at;
                    let fresh = std::mem::replace(&mut grant.fresh, false);
                    let newer = valid_at
                        .zip(old)
                        .is_none_or(|(new, old)| new > old || fresh && new == old);
                    self.must(newer, at, || {
                        format!("a sample of {valid_at:?} after {old:?}")
                    });
                }
                Told::Release(ticket) => {
                    self.note(at, format!("release {}/{}", ticket.epoch, ticket.number));
                }
                Told::Reset(stop) => {
                    self.note(at, format!("reset {stop:?}"));
                    resets.push(stop);
                }
            }
        }
        let was = self.last.map_or(RobotState::Idle, |r| r.state);
        let asked = asked.filter(|grant| report.engagement == grant.ticket);
        if let Some(grant) = asked {
            self.seen.engagements += 1;
            let rested = self.last.is_none_or(|r| !r.moving);
            let may =
                rested && matches!(was, RobotState::Ready | RobotState::Holding) || told.len() > 1;
            self.must(may, at, || format!("engaged in {was:?}, at rest: {rested}"));
            self.granted = Some(grant);
        }
        self.state(report, was, asked.is_some(), news, &resets);
        self.motion(report, asked.is_some());
        self.seen.ticks += 1;
        (self.before, self.last) = (self.last, Some(*report));
    }

    /// A lease is fixed when its message arrives, and no longer than what is granted for a sample of that age.
    fn lease(&mut self, at: Mono, lease: Lease, valid_at: Option<Mono>) {
        let waited_s = at.secs_since(lease.from);
        let most_s = PROMPT_TICKS * self.rig.tick_s();
        self.must((0.0..=most_s).contains(&waited_s), at, || {
            format!("an order waited {waited_s} s")
        });
        let span_s = lease.until.secs_since(lease.from);
        self.must(span_s <= LEASE_S + 1e-9, at, || {
            format!("a lease of {span_s} s")
        });
        let after_s = valid_at.map_or(0.0, |t| lease.until.secs_since(t));
        self.must(after_s <= MAX_DELAY_S + LEASE_S + 1e-6, at, || {
            format!("motion authorised until {after_s} s after its sample")
        });
    }

    /// What the state may have become.
    fn state(
        &mut self,
        report: &Report,
        was: RobotState,
        engaged: bool,
        news: bool,
        resets: &[Option<u32>],
    ) {
        let (at, is, cause) = (report.at, report.state, report.cause);
        if is != was {
            self.note(at, format!("{was:?} → {is:?} ({cause:?})"));
        }
        if follows(is) {
            self.seen.following += 1;
            let grant = self
                .granted
                .filter(|grant| grant.ticket == report.engagement);
            let in_time = grant.is_some_and(|grant| at < grant.until);
            self.must(in_time && self.present, at, || {
                format!("follows {:?} without a lease", report.engagement)
            });
            let fresh = report.age_s <= MAX_DELAY_S + LEASE_S + 0.02 || report.plan_s.is_some();
            self.must(fresh, at, || {
                format!("follows a sample {} s old", report.age_s)
            });
            self.must(follows(was) || engaged, at, || {
                format!("{was:?} → {is:?} without a request")
            });
            let revived = was == RobotState::Coasting && is == RobotState::Engaged;
            self.must(!revived || news || engaged, at, || {
                "revived without news".into()
            });
        } else if follows(was) {
            *self.seen.ends.entry(format!("{cause:?}")).or_default() += 1;
        }
        if let Some(last) = self.last {
            let left = was == RobotState::Stopped && is != RobotState::Stopped;
            let named = last.cause != Cause::LocalStop && resets.contains(&Some(last.transitions));
            let here = self.reset_here && resets.contains(&None);
            self.must(!left || named || here, at, || {
                format!("stop {} left by {resets:?}", last.transitions)
            });
            let changed = (last.state, last.cause) != (is, cause);
            self.must(
                !changed || report.transitions != last.transitions,
                at,
                || "a change that is not counted".into(),
            );
        }
        let most_s = PROMPT_TICKS * self.rig.tick_s();
        let due = self
            .stopped_here
            .is_some_and(|since| at.secs_since(since) > most_s);
        let stopped = is == RobotState::Stopped && cause == Cause::LocalStop;
        self.must(!due || stopped, at, || {
            format!("{is:?} ({cause:?}) after a stop at the robot")
        });
    }

    /// Where the arm may be, and how fast it may get there.
    fn motion(&mut self, report: &Report, engaged: bool) {
        let at = report.at;
        if follows(report.state) {
            self.followed_at = Some(at);
        }
        let workspace = self.rig.workspace;
        let out_m = (report.tip_m - workspace.home_m).norm() - workspace.radius_m;
        self.must(out_m <= 5e-3, at, || {
            format!("{out_m} m outside the workspace")
        });
        let Some(last) = self.last else { return };
        let dt_s = at.secs_since(last.at);
        let moved_m = (report.tip_m - last.tip_m).norm();
        self.seen.way_m += moved_m;
        let arm = self.rig.arm.clone();
        for (i, joint) in arm.joints().iter().enumerate() {
            let (q, rate) = (report.q[i], (report.q[i] - last.q[i]).abs() / dt_s);
            let within = rate <= joint.velocity * 1.001 && (joint.lower..=joint.upper).contains(&q);
            self.must(within, at, || {
                format!("{} at {q}, {rate} a second", joint.name)
            });
        }
        let still_s = self.followed_at.map_or(f64::MAX, |t| at.secs_since(t));
        let rests = moved_m < 1e-6 && !report.moving;
        self.must(still_s <= STOP_S || rests, at, || {
            format!("moves {still_s} s after it followed: {moved_m} m in a tick")
        });
        let [v_max, a_max, j_max] = self.limits;
        // An engage takes the reference to where the arm is.
        let reset = |r: &Report| r.engaged_at == r.at;
        if engaged || reset(&last) {
            return;
        }
        self.must(report.jerk_m_s3 <= j_max * 1.001, at, || {
            format!("{} m/s³", report.jerk_m_s3)
        });
        let v = (report.reference_m - last.reference_m) / dt_s;
        self.must(v.norm() <= v_max * 1.001, at, || {
            format!("{} m/s", v.norm())
        });
        if let Some(before) = self.before.filter(|before| !reset(before)) {
            let u = (last.reference_m - before.reference_m) / last.at.secs_since(before.at);
            let a = (v - u).norm() / dt_s;
            self.must(a <= a_max * 1.001, at, || format!("{a} m/s²"));
        }
    }
}
