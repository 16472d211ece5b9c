//! Hours of whatever can befall the two daemons and the network between them, drawn from a seed, and a model of what
//! must hold held against every tick.
//!
//! `TELEMIME_SOAK_HOURS=3` makes it longer; `TELEMIME_SOAK_SEED=17` repeats the shift that printed it.

mod befall;
mod model;
mod script;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime::ground::{Operator, Pair, run_virtual};
use telemime_endpoint::cli::Word;
use telemime_endpoint::control::Control;
use telemime_endpoint::{External, Identity, Mono};
use telemime_operator::daemon::Notice;
use telemime_operator::session::Event;
use telemime_operator::task::Task;
use telemime_protocol::spline::HermiteSpan;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::hello::{Answer, Hello};
use telemime_protocol::wire::v1::{RobotState, VERSION};
use telemime_robot::control::ControlConfig;
use telemime_robot::daemon::{Notice as RobotNotice, PathPoint};
use telemime_robot::door;
use telemime_robot::rig::{Rig, RigOptions};
use telemime_sim::link::LinkConfig;

use crate::play;
use crate::scene::{REST_S, Samples, recording, skill};
use model::{Model, Seen, follows};
use script::{Mischief, hand, is_clean, is_usable, link, spread};

/// A shift is one robot's (restarts aside), and repeats alone.
const SHIFT_S: f64 = 600.0;

/// The servo's period.
const TICK_S: f64 = 3e-3;

/// An operator that has a session and something to do has asked, and been granted or left, within this time, s.
const IDLE_S: f64 = 25.0;

/// What the suite takes.
const HOURS: f64 = 1.0 / 3.0;

/// After an outage: telemetry comes half a round trip and its interval after the greeting's answer, attempts are 0.25 s apart.
const NEWS_S: f64 = 0.25 + 0.05 + 0.02;

/// On links that lose little there is a session within this time, whatever happened before, s.
const PATIENCE_S: f64 = 30.0;

/// Packets on their way at once, floods aside.
const MOST_QUEUED: usize = 400;

/// Connections an endpoint keeps anything of: attempts that overlap, and those that QUIC drains.
const MOST_CONNECTIONS: usize = 64;

/// What the robot held of a path.
type Path = Vec<PathPoint>;

/// An operator at work, and what it has been heard to say.
struct Driver {
    name: String,
    operator: Operator,
    hands: Vec<Samples>,
    plays: bool,
    began_at: Mono,
    links: [LinkConfig; 2],
    path_bound_m: f64,
    /// Performances that are over, and when each recording's time was 0.
    zeros: Vec<Stamp>,
    /// Which performance was engaged last in a session, by its epoch.
    engaged: BTreeMap<u32, usize>,
    epoch: Option<u32>,
    granted: Vec<usize>,
    follows: bool,
    /// It has been stopped while it drove: nothing it does by itself may engage again.
    stopped: bool,
    heard_at: Mono,
    telemetry: u32,
    sessions: u32,
}

/// A shift under way.
struct Shift {
    seed: u64,
    rig: Rig,
    rng: Xoshiro256PlusPlus,
    pair: Pair,
    model: Rc<RefCell<Model>>,
    drivers: Vec<Driver>,
    started: u32,
    clocks: Option<Arc<AtomicI64>>,
    clocks_are_right: bool,
    /// When anything last happened that sessions may suffer from.
    disturbed_at: Mono,
    epoch: u32,
    /// The last session that has ended.
    ended: u32,
    path: Option<Path>,
    paths: BTreeMap<u32, Path>,
    tally: Tally,
}

/// What a shift has shown.
#[derive(Debug, Default, Clone, PartialEq)]
struct Tally {
    operators: u32,
    sessions: u32,
    promises: u32,
    slowest_share: f64,
    paths: u32,
    path_samples: u32,
    worst_path_share: f64,
    most_queued: usize,
    most_connections: usize,
    mischief: BTreeMap<String, u32>,
}

/// The arm's dynamics are most of what a tick costs, and not what is in question here: fewer ticks, more hours.
fn slow_rig() -> Rig {
    let control = ControlConfig {
        dt_s: TICK_S,
        ..ControlConfig::default()
    };
    let options = RigOptions {
        control,
        ..RigOptions::default()
    };
    Rig::load(&options).unwrap()
}

impl Shift {
    fn start(seed: u64) -> Self {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let rig = slow_rig();
        let model = Rc::new(RefCell::new(Model::new(&rig)));
        let watching = Rc::clone(&model);
        let watcher = Rc::new(RefCell::new(move |told: &[_], report: &_| {
            watching.borrow_mut().tick(told, report);
        }));
        let ahead = || Arc::new(AtomicI64::new(1_792_000_000_000_000_000));
        let clocks = rng.random_bool(0.4).then(ahead);
        let dispersion = Duration::from_micros(50);
        let external = clocks.as_ref().map(|theirs| {
            let robot = External::stated(ahead(), dispersion);
            (robot, External::stated(Arc::clone(theirs), dispersion))
        });
        let pair = Pair::start_watched(&rig, watcher, external).unwrap();
        let now = pair.now();
        Self {
            seed,
            rig,
            rng,
            pair,
            model,
            drivers: Vec::new(),
            started: 0,
            clocks,
            clocks_are_right: true,
            disturbed_at: now,
            epoch: 0,
            ended: 0,
            path: None,
            paths: BTreeMap::new(),
            tally: Tally::default(),
        }
    }

    fn note(&self, what: impl AsRef<str>) {
        self.model.borrow_mut().note(self.pair.now(), what);
    }

    fn fail(&self, what: &str) -> ! {
        let story = self.model.borrow().story();
        panic!(
            "shift {}: {what}\n  {story}\nTELEMIME_SOAK_SEED={} repeats it",
            self.seed, self.seed
        );
    }

    fn must(&self, holds: bool, what: impl FnOnce() -> String) {
        if !holds {
            self.fail(&what());
        }
    }

    /// Lets time pass, and looks at everything meanwhile.
    async fn pass(&mut self, span_s: f64) {
        let until = self.pair.now().offset_by_secs(span_s);
        while self.pair.now() < until {
            let step_s = until.secs_since(self.pair.now()).min(0.05);
            self.pair.run_for(step_s).await;
            self.look().await;
        }
    }

    async fn look(&mut self) {
        if let Some(what) = self.model.borrow().broken() {
            self.fail(what);
        }
        self.bounded();
        self.hear_robot();
        for i in 0..self.drivers.len() {
            self.hear(i);
        }
        let now = self.pair.now();
        let quiet_s = |d: &Driver| now.secs_since(d.heard_at.max(self.disturbed_at));
        for driver in &self.drivers {
            let idle_s = now.secs_since(driver.began_at.max(self.disturbed_at));
            let asks = !driver.plays || !driver.granted.is_empty() || idle_s < IDLE_S;
            self.must(asks || driver.epoch.is_none(), || {
                format!("{} has played nothing for {idle_s} s", driver.name)
            });
            let reached = quiet_s(driver) < PATIENCE_S || !driver.links.iter().all(is_usable);
            self.must(reached, || {
                format!("{} hears nothing for {} s", driver.name, quiet_s(driver))
            });
        }
        let (over, on): (Vec<_>, Vec<_>) = std::mem::take(&mut self.drivers)
            .into_iter()
            .partition(|d| d.operator.done.is_finished());
        self.drivers = on;
        for driver in over {
            self.leave(driver).await;
        }
    }

    /// Nothing piles up.
    fn bounded(&mut self) {
        let (under_way, unread) = self.pair.network.queued();
        let connections = self.pair.robot.connections();
        let most = self.drivers.iter().map(|d| d.operator.connections());
        let most = most.max().unwrap_or(0).max(connections);
        self.tally.most_queued = self.tally.most_queued.max(under_way + unread);
        self.tally.most_connections = self.tally.most_connections.max(most);
        self.must(under_way <= MOST_QUEUED && unread <= MOST_QUEUED, || {
            format!("{under_way} packets under way, {unread} unread")
        });
        self.must(most <= MOST_CONNECTIONS + door::PLACES, || {
            format!("{most} connections")
        });
        let told = self.pair.robot.reports().last().map(|r| r.tick);
        let done = self.model.borrow().newest().map(|r| r.tick);
        if let (Some(told), Some(done)) = (told, done) {
            self.must(done.saturating_sub(told) <= 16, || {
                format!("the session is {} ticks behind the servo", done - told)
            });
        }
    }

    fn hear_robot(&mut self) {
        for notice in self.pair.robot.forget() {
            match notice {
                RobotNotice::Connected { epoch, .. } => {
                    self.note(format!("the robot greets session {epoch}"));
                    self.must(epoch > self.epoch, || {
                        format!("epoch {epoch} after {}", self.epoch)
                    });
                    self.epoch = epoch;
                }
                RobotNotice::Path(path) => self.path = Some(path),
                RobotNotice::Disconnected { why, clock, .. } => {
                    self.note(format!("session {} ends: {why}", self.epoch));
                    self.ended = self.epoch;
                    if let Some(path) = self.path.take() {
                        self.paths.insert(self.epoch, path);
                    }
                    let truth_s = -(self.pair.to_mono(Stamp(0)).0 as f64) * 1e-9;
                    if let Some((offset_s, bound_s)) = clock.filter(|_| self.clocks_are_right) {
                        let error_s = (offset_s - truth_s).abs();
                        self.must(error_s <= bound_s, || {
                            format!("the clock is {error_s} s off, {bound_s} s promised")
                        });
                    }
                }
                _ => {}
            }
        }
    }

    fn hear(&mut self, i: usize) {
        let now = self.pair.now();
        let mut noted = Vec::new();
        let mut wrong = None;
        let driver = &mut self.drivers[i];
        while let Ok(notice) = driver.operator.notices.try_recv() {
            match notice {
                Notice::Connected { epoch, .. } => {
                    driver.epoch = Some(epoch);
                    driver.sessions += 1;
                    driver.heard_at = now;
                }
                Notice::Lost { why } => {
                    driver.stopped |= driver.follows;
                    driver.follows = false;
                    noted.push(format!("lost: {why}"));
                }
                Notice::Event(_, Event::Engaged { .. }) => {
                    let performance = driver.zeros.len();
                    if driver.stopped || driver.granted.contains(&performance) {
                        wrong = Some(format!("{} engages again by itself", driver.name));
                    }
                    driver.granted.push(performance);
                    driver
                        .engaged
                        .extend(driver.epoch.map(|e| (e, performance)));
                    driver.follows = true;
                }
                Notice::Event(_, Event::State(state, _)) => {
                    let stops = matches!(state, RobotState::Holding | RobotState::Stopped);
                    driver.stopped |= driver.follows && stops;
                    driver.follows &= follows(state);
                }
                Notice::Event(_, Event::Telemetry(_)) => {
                    driver.telemetry += 1;
                    driver.heard_at = now;
                }
                Notice::Event(_, Event::Refused(reason)) => {
                    noted.push(format!("is refused: {reason:?}"));
                }
                Notice::Performed { zero, .. } => {
                    driver.zeros.push(zero);
                    // Had it been stopped before the hand had done, it would not say so, and the next is another engagement.
                    (driver.follows, driver.stopped) = (false, false);
                }
                Notice::Mapping { path_bound_m, .. } => driver.path_bound_m = path_bound_m,
                _ => {}
            }
        }
        for what in noted {
            self.note(format!("{} {what}", self.drivers[i].name));
        }
        if let Some(what) = wrong {
            self.fail(&what);
        }
    }

    /// An operator has ended: what the robot held of its path is what the hand did.
    async fn leave(&mut self, mut driver: Driver) {
        self.tally.sessions += driver.sessions;
        // One that was killed takes what it knew with it.
        let Ok((result, task)) = (&mut driver.operator.done).await else {
            return;
        };
        let told = result.map(|s| format!("{:?}", s.outcome));
        self.note(format!("{} ends: {told:?}", driver.name));
        driver.zeros.extend(task.zero());
        self.pair.run_for(0.2).await;
        self.hear_robot();
        for (epoch, performance) in &driver.engaged {
            let zero = driver.zeros.get(*performance);
            let (Some(path), Some(zero)) = (self.paths.get(epoch), zero) else {
                continue;
            };
            let Some(hand) = driver.hands.get(*performance) else {
                continue;
            };
            let (count, worst_m) = deviation(path, hand, *zero);
            let share = worst_m / driver.path_bound_m;
            self.tally.paths += 1;
            self.tally.path_samples += count;
            self.tally.worst_path_share = self.tally.worst_path_share.max(share);
            // Stamps are rounded to 10 µs: at 10 m/s that is another 0.1 mm.
            self.must(worst_m <= driver.path_bound_m + 1e-4, || {
                format!(
                    "{} m off the hand's path, the bound is {} m ({}, session {epoch}, performance {performance})",
                    worst_m, driver.path_bound_m, driver.name
                )
            });
        }
        self.paths.clear();
    }

    fn join(&mut self, own_key: bool) {
        let rng = &mut self.rng;
        let (seed, links) = (rng.random(), [link(rng), link(rng)]);
        let hands: Vec<Samples> = (0..rng.random_range(1..5)).map(|_| hand(rng)).collect();
        let plays = rng.random_bool(0.15);
        let task = if plays {
            Task::play(play::inferred(&skill()).2)
        } else {
            let mut recordings = hands.iter().cloned().map(recording);
            let first = recordings.next().expect("one at least");
            recordings.fold(Task::replay(first), Task::and_then)
        };
        let (skill, config) = (Some(skill()), Default::default());
        let (pair, perfect) = (&mut self.pair, LinkConfig::default());
        let operator = if own_key {
            pair.operator(task, skill, config, &perfect, seed)
        } else {
            let other = Identity::ephemeral().unwrap();
            pair.operator_as(&other, task, skill, config, &perfect, seed)
        };
        self.started += 1;
        self.tally.operators += 1;
        let driver = Driver {
            name: format!("operator {}", self.started),
            operator: operator.unwrap(),
            hands: if plays { Vec::new() } else { hands },
            plays,
            began_at: self.pair.now(),
            links: links.clone(),
            path_bound_m: f64::INFINITY,
            zeros: Vec::new(),
            engaged: BTreeMap::new(),
            epoch: None,
            granted: Vec::new(),
            follows: false,
            stopped: false,
            heard_at: self.pair.now(),
            telemetry: 0,
            sessions: 0,
        };
        self.note(format!(
            "{} {}: up {}, down {}",
            driver.name,
            if plays { "plays" } else { "mirrors" },
            links[0],
            links[1],
        ));
        self.drivers.push(driver);
        self.wire(self.drivers.len() - 1, seed);
    }

    /// Sets the links of a driver to what they are to be.
    fn wire(&mut self, i: usize, seed: u64) {
        let driver = &self.drivers[i];
        let (own, robot) = (driver.operator.addr, self.pair.robot_addr());
        let [up, down] = driver.links.clone();
        self.pair.network.link(own, robot, up, seed);
        self.pair.network.link(robot, own, down, !seed);
        self.disturbed_at = self.pair.now();
    }

    /// Works for `span_s`, then goes home: nothing is left behind.
    async fn work(mut self, span_s: f64) -> (Seen, Tally) {
        let until = self.pair.now().offset_by_secs(span_s);
        while self.pair.now() < until && self.started < 240 {
            if self.drivers.is_empty() {
                if self
                    .model
                    .borrow()
                    .newest()
                    .is_some_and(|r| r.state == RobotState::Stopped)
                {
                    self.reset_here();
                }
                self.join(true);
            }
            let span_s = spread(&mut self.rng, 0.2, 8.0);
            self.pass(span_s).await;
            let mischief = Mischief::draw(&mut self.rng);
            self.befall(mischief).await;
        }
        self.note("the shift ends");
        self.drivers.iter().for_each(|d| d.operator.quit());
        self.pass(25.0).await;
        self.must(self.drivers.is_empty(), || {
            format!("{} does not quit", self.drivers[0].name)
        });
        self.must(self.pair.network.queued() == (0, 0), || {
            format!("{:?} packets left", self.pair.network.queued())
        });
        self.must(self.pair.robot.connections() == 0, || {
            format!("{} connections left", self.pair.robot.connections())
        });
        (self.model.borrow().seen.clone(), self.tally)
    }
}

/// How many of the hand's samples the path covers, and the farthest it is from one, m.
fn deviation(path: &Path, hand: &Samples, zero: Stamp) -> (u32, f64) {
    let zero_s = zero.as_secs_f64();
    let rest = (0..(REST_S * 30.0) as u32).map(|i| (f64::from(i) / 30.0 - REST_S, hand[0].1));
    let (mut count, mut worst_m) = (0, 0.0f64);
    for (t_s, x) in rest.chain(hand.iter().copied()) {
        let t_s = t_s + zero_s;
        let after = path.partition_point(|k| k.0 <= t_s);
        let Some([a, b]) = after.checked_sub(1).and_then(|i| path.get(i..i + 2)) else {
            continue;
        };
        // Not joined: the hand was out of sight.
        if b.3 {
            continue;
        }
        let jets = [a, b].map(|k| [Vector3::from(k.1), Vector3::from(k.2)]);
        let span = HermiteSpan::<3>::new(b.0 - a.0, jets[0], jets[1]).unwrap();
        let error_m = (span.eval(t_s - a.0).unwrap().x - x).norm();
        (count, worst_m) = (count + 1, worst_m.max(error_m));
    }
    (count, worst_m)
}

fn shift(seed: u64, span_s: f64) -> (Seen, Tally) {
    skill();
    run_virtual(async move { Shift::start(seed).work(span_s).await }).unwrap()
}

fn setting<T: std::str::FromStr>(name: &str) -> Option<T> {
    let text = std::env::var(name).ok()?;
    Some(
        text.parse()
            .unwrap_or_else(|_| panic!("{name}={text} is no number")),
    )
}

#[test]
fn whatever_befalls_them_what_must_hold_holds() {
    let one: Option<u64> = setting("TELEMIME_SOAK_SEED");
    let hours = setting("TELEMIME_SOAK_HOURS").unwrap_or(HOURS);
    let shifts = (hours * 3600.0 / SHIFT_S).ceil() as u64;
    let seeds = one.map_or(1..=shifts, |seed| seed..=seed);
    let (mut following, mut engagements, mut promises, mut paths) = (0, 0, 0, 0);
    for seed in seeds {
        let (seen, tally) = shift(seed, SHIFT_S);
        println!("shift {seed}: {seen:?}\n  {tally:?}");
        following += seen.following;
        engagements += seen.engagements;
        promises += tally.promises;
        paths += tally.paths;
    }
    if one.is_none() {
        let share = following as f64 * TICK_S / (hours * 3600.0);
        assert!(share > 0.1, "{share} of the time followed");
        let at_least = (hours * 50.0) as u32;
        assert!(engagements > at_least, "{engagements} engagements");
        assert!(promises > 0 && paths > 0, "{promises}, {paths}");
    }
}

#[test]
fn a_shift_repeats_to_the_bit() {
    let (a, b) = (shift(4, 60.0), shift(4, 60.0));
    assert_eq!(a, b);
    assert!(a.0.way_m > 0.0, "something moved");
}
