//! The core once more, on what it was told: every tick compared with what was recorded.

use telemime_endpoint::Mono;
use telemime_protocol::wire::codec;
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_sim::arm::Joints;

use super::file::BlackBox;
use super::recorder::Chunk;
use super::ticks::{Outcome, joints, read, state_of, unpack, width};
use crate::control::ForeignState;
use crate::rig::RigError;
use crate::servo::{ArmFault, ArmState, Core, Order, Pulled, Report, Setpoint, Source, Ticket};

/// Why a record cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The arm cannot be made again.
    #[error("the recorded arm: {0}")]
    Rig(#[from] RigError),
    /// The record's state is not that of its arm.
    #[error("the record does not fit its own arm: {0}")]
    State(#[from] ForeignState),
    /// What a caller does with the ticks failed.
    #[error(transparent)]
    Out(#[from] std::io::Error),
}

/// A replayed tick, for a table.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    /// When it was, on the robot's clock.
    pub now: Mono,
    /// Orders it took.
    pub orders: usize,
    /// What the brake said.
    pub pulled: Pulled,
    /// The arm as it was known.
    pub arm: ArmState,
    /// What was asked of it.
    pub setpoint: Setpoint,
    /// What was reported.
    pub report: Report,
}

/// Where a replay first differs.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Difference {
    /// The tick, counted since the robot began.
    pub tick: u64,
    /// Seconds since the record's beginning.
    pub t_s: f64,
    /// What differs.
    pub what: String,
    /// As recorded.
    pub recorded: String,
    /// As replayed.
    pub replayed: String,
}

/// Something to tell.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Moment {
    /// Seconds since the record's beginning.
    pub t_s: f64,
    /// What happened.
    pub what: String,
}

/// What a replay showed.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Replay {
    /// Ticks replayed.
    pub ticks: u64,
    /// From the first to the last, s.
    pub span_s: f64,
    /// Orders among them.
    pub orders: u64,
    /// Stretches of ticks that are missing: the recorder could not keep up.
    pub gaps: u64,
    /// Ticks with more or less than a difference, up to the first of which everything is identical to the bit.
    pub differing: u64,
    /// The first of them.
    pub difference: Option<Difference>,
    /// The story.
    pub moments: Vec<Moment>,
}

/// Replays a record; `each` sees every tick.
///
/// # Errors
/// [`ReplayError`].
pub fn replay(
    record: &BlackBox,
    mut each: impl FnMut(&Row) -> std::io::Result<()>,
) -> Result<Replay, ReplayError> {
    let rig = record.rig()?;
    // Nothing is freed elsewhere here: what the core lets go of is taken out after every tick.
    let (spent, mut spent_out) = rtrb::RingBuffer::new(64);
    let mut core = rig.core(None, spent);
    let dof = rig.arm.dof();
    let mut telling = Telling::default();
    let mut done = Replay {
        ticks: 0,
        span_s: 0.0,
        orders: 0,
        gaps: 0,
        differing: 0,
        difference: None,
        moments: Vec::new(),
    };
    let mut state = core.room();
    for (n, chunk) in record.chunks.iter().enumerate() {
        if n == 0 || chunk.gap {
            core.restore(&chunk.state)?;
            done.gaps += u64::from(n > 0);
        } else {
            core.save(&mut state);
            if codec::encode(&state) != codec::encode(&chunk.state) {
                let t_s = telling.since(telling.last);
                done.differs(core.ticks(), t_s, "the core's state", ("", ""));
                core.restore(&chunk.state)?;
            }
        }
        run_chunk(&mut core, chunk, dof, &mut telling, &mut done, &mut each)?;
        while spent_out.pop().is_ok() {}
    }
    done.span_s = telling.since(telling.last);
    telling.end();
    done.moments = telling.moments;
    Ok(done)
}

fn run_chunk(
    core: &mut Core,
    chunk: &Chunk,
    dof: usize,
    telling: &mut Telling,
    done: &mut Replay,
    each: &mut impl FnMut(&Row) -> std::io::Result<()>,
) -> Result<(), ReplayError> {
    let mut last = vec![0; width(dof)];
    let mut fault = None;
    let mut orders = chunk.orders.iter().peekable();
    let mut faults = chunk.faults.iter().peekable();
    for (i, packed) in chunk.words.chunks_exact(width(dof)).enumerate() {
        let mut words = packed.to_vec();
        unpack(&mut words, &last, dof);
        let (told, outcome, _) = read(&words, dof);
        last = words;
        core.begin(told.now);
        let mut taken = 0;
        while let Some((_, order)) = orders.next_if(|(at, _)| *at as usize == i) {
            telling.order(told.now, order);
            core.obey(order.clone(), told.now, &told.before);
            taken += 1;
        }
        if let Some((_, found)) = faults.next_if(|(at, _)| *at as usize == i) {
            fault = Some(*found);
        }
        let setpoint = core.decide(told.now, told.pulled, &told.before, fault);
        let report = core.conclude(told.now, &told.strain, &told.after);
        let again = Outcome::of(&setpoint, &report);
        telling.tick(told.now, told.pulled, &report, fault);
        if again != outcome {
            let t_s = telling.since(told.now);
            let (what, recorded, replayed) = first_difference(&outcome, &again);
            done.differs(report.tick - 1, t_s, what, (&recorded, &replayed));
        }
        done.ticks += 1;
        done.orders += taken as u64;
        each(&Row {
            now: told.now,
            orders: taken,
            pulled: told.pulled,
            arm: told.before,
            setpoint,
            report,
        })?;
    }
    Ok(())
}

impl Replay {
    fn differs(&mut self, tick: u64, t_s: f64, what: &str, (recorded, replayed): (&str, &str)) {
        self.differing += 1;
        self.difference.get_or_insert_with(|| Difference {
            tick,
            t_s,
            what: what.to_owned(),
            recorded: recorded.to_owned(),
            replayed: replayed.to_owned(),
        });
    }
}

fn first_difference(recorded: &Outcome, replayed: &Outcome) -> (&'static str, String, String) {
    let named = |word| match state_of(word) {
        Some((state, cause)) => format!("{state:?} ({cause:?}), change {}", word >> 16),
        None => format!("{word:#x}"),
    };
    let place = |words: &[u64]| {
        let told: Vec<_> = words
            .iter()
            .map(|w| f64::from_bits(*w).to_string())
            .collect();
        told.join(" ")
    };
    let posture = |words: &[u64]| {
        let q: Joints = joints(words);
        q.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
    };
    let (a, b) = (recorded, replayed);
    if a.state != b.state {
        ("the state", named(a.state), named(b.state))
    } else if a.target_m != b.target_m {
        ("the target", place(&a.target_m), place(&b.target_m))
    } else if a.reference_m != b.reference_m {
        (
            "the reference",
            place(&a.reference_m),
            place(&b.reference_m),
        )
    } else if a.setpoint != b.setpoint {
        ("the setpoint", posture(&a.setpoint), posture(&b.setpoint))
    } else if a.clamps != b.clamps {
        ("the clamps", a.clamps.to_string(), b.clamps.to_string())
    } else {
        let hex = |outcome: &Outcome| format!("digest {:016x}", outcome.digest);
        ("a torque, a speed or the like", hex(a), hex(b))
    }
}

/// Makes a story of ticks.
#[derive(Debug)]
struct Telling {
    first: Option<Mono>,
    last: Mono,
    state: Option<(RobotState, Cause, u32)>,
    engagement: Ticket,
    clamps: u32,
    late: usize,
    model: Option<[u8; 16]>,
    faulty: bool,
    moments: Vec<Moment>,
}

impl Default for Telling {
    fn default() -> Self {
        Self {
            first: None,
            last: Mono(0),
            state: None,
            engagement: Ticket::default(),
            clamps: 0,
            late: 0,
            model: None,
            faulty: false,
            moments: Vec::new(),
        }
    }
}

/// A story is short: engagements beyond this many state changes are only counted.
const MAX_MOMENTS: usize = 200;

impl Telling {
    fn since(&self, now: Mono) -> f64 {
        self.first.map_or(0.0, |first| now.secs_since(first))
    }

    fn say(&mut self, now: Mono, what: String) {
        if self.moments.len() >= MAX_MOMENTS {
            self.late += 1;
            return;
        }
        let t_s = self.since(now);
        self.moments.push(Moment { t_s, what });
    }

    fn order(&mut self, now: Mono, order: &Order) {
        self.first.get_or_insert(now);
        match order {
            Order::Engage(engagement) => {
                self.model = engagement.model;
                let what = match engagement.source {
                    Source::Mirror { .. } => "mirror",
                    Source::Play(_) => "play",
                };
                let skill = engagement.model.map_or_else(
                    || "no skill".to_owned(),
                    |id| {
                        let short: String = id[..6].iter().map(|b| format!("{b:02x}")).collect();
                        format!("skill {short}")
                    },
                );
                let (number, scale) = (engagement.ticket.number, engagement.scale);
                self.say(
                    now,
                    format!("asked to engage #{number}: {what} at scale {scale:.3}, {skill}"),
                );
            }
            Order::Operator(true) => self.say(now, "an operator has authority".to_owned()),
            Order::Operator(false) => self.say(now, "the operator is gone".to_owned()),
            Order::Reset { .. } => self.say(now, "asked to leave the stop".to_owned()),
            Order::Release(_) => self.say(now, "the operator let go".to_owned()),
            Order::Track { .. } | Order::Extend { .. } => {}
        }
    }

    fn tick(&mut self, now: Mono, pulled: Pulled, report: &Report, fault: Option<ArmFault>) {
        self.first.get_or_insert(now);
        self.last = now;
        if let Some(cause) = pulled.stop().or(pulled.hold()) {
            let known = self.state.is_some_and(|(_, known, _)| known == cause);
            if !known {
                self.say(now, format!("the brake was pulled: {cause:?}"));
            }
        }
        if let Some(fault) = fault.filter(|_| !self.faulty) {
            self.faulty = true;
            self.say(now, format!("the arm: {fault}"));
        }
        if report.engagement != self.engagement {
            self.engagement = report.engagement;
            self.clamps = 0;
        }
        let state = (report.state, report.cause, report.transitions);
        if self.state != Some(state) {
            let began = self.state.is_none();
            self.state = Some(state);
            let age = if matches!(report.state, RobotState::Coasting | RobotState::Holding) {
                format!(
                    ", {:.0} ms after the newest the hand was known",
                    report.age_s * 1e3
                )
            } else {
                String::new()
            };
            let begins = if began { "the record begins: " } else { "" };
            self.say(
                now,
                format!("{begins}{:?} ({:?}){age}", report.state, report.cause),
            );
            let over = !matches!(report.state, RobotState::Engaged | RobotState::Coasting);
            if over && report.clamps > self.clamps {
                let ticks = report.clamps;
                self.say(
                    now,
                    format!(
                        "a limit acted on {ticks} ticks of engagement #{}",
                        report.engagement.number
                    ),
                );
                self.clamps = report.clamps;
            }
        }
    }

    fn end(&mut self) {
        if self.late > 0 {
            let what = format!("and {} more moments", self.late);
            let t_s = self.since(self.last);
            self.moments.push(Moment { t_s, what });
        }
    }
}
