//! The end of the record that is on the tick: copies into rings, nothing else.

use telemime_endpoint::Mono;
use telemime_sim::arm::PlantReport;

use crate::servo::{ArmFault, ArmState, CoreState, Order, Pulled, Report, Setpoint};

/// The core's state is recorded every so many ticks: there a record may begin.
pub(super) const CHUNK_TICKS: u64 = 1000;

/// States on their way to the recorder and back.
const STATES: usize = 4;

/// One tick: what came in, and what came of it.
#[derive(Debug, Clone, Copy)]
pub struct Ticked {
    /// When it began.
    pub now: Mono,
    /// How many orders it took.
    pub orders: u32,
    /// What the brake said.
    pub pulled: Pulled,
    /// The arm as it was known.
    pub before: ArmState,
    /// What was wrong with it.
    pub fault: Option<ArmFault>,
    /// What was asked of it.
    pub setpoint: Setpoint,
    /// What that ran into.
    pub strain: PlantReport,
    /// The arm as it was known then.
    pub after: ArmState,
    /// What was reported.
    pub report: Report,
}

/// The tick's ends of a record's rings.
#[derive(Debug)]
pub struct Tap {
    ticks: rtrb::Producer<Ticked>,
    orders: rtrb::Producer<(u64, Order)>,
    states: rtrb::Producer<Box<CoreState>>,
    spare: rtrb::Consumer<Box<CoreState>>,
    due: u64,
    lost: bool,
}

/// The recorder's ends.
#[derive(Debug)]
pub(super) struct Taps {
    pub(super) ticks: rtrb::Consumer<Ticked>,
    pub(super) orders: rtrb::Consumer<(u64, Order)>,
    pub(super) states: rtrb::Consumer<Box<CoreState>>,
    pub(super) spare: rtrb::Producer<Box<CoreState>>,
}

/// Both ends, for a core with states like `room` ([`Core::room`](crate::servo::Core::room)): four seconds of ticks, 256 orders.
pub fn taps(room: &CoreState) -> (Tap, super::recorder::Feed) {
    let (ticks, ticks_out) = rtrb::RingBuffer::new(4096);
    let (orders, orders_out) = rtrb::RingBuffer::new(256);
    let (states, states_out) = rtrb::RingBuffer::new(STATES);
    let (mut spare_in, spare) = rtrb::RingBuffer::new(STATES);
    for _ in 0..STATES {
        // As many as there is room for.
        let _ = spare_in.push(Box::new(room.roomy_clone()));
    }
    let tap = Tap {
        ticks,
        orders,
        states,
        spare,
        due: 0,
        lost: false,
    };
    let taps = Taps {
        ticks: ticks_out,
        orders: orders_out,
        states: states_out,
        spare: spare_in,
    };
    (tap, super::recorder::Feed(taps))
}

impl Tap {
    /// Before a tick: records the core's state if it is time.
    pub(crate) fn before(&mut self, core: &crate::servo::Core) {
        if core.ticks() < self.due {
            return;
        }
        // None is left while the recorder stalls; the next tick asks again.
        if let Ok(mut state) = self.spare.pop() {
            core.save(&mut state);
            self.due = core.ticks() + CHUNK_TICKS;
            // There are no more states than places.
            let _ = self.states.push(state);
        }
    }

    /// An order that the tick takes, which is number `tick` from 0.
    pub(crate) fn order(&mut self, tick: u64, order: &Order) {
        // A copy of a trajectory is one more reference: dropping it here frees nothing.
        self.lost |= self.orders.push((tick, order.clone())).is_err();
    }

    /// The tick is over.
    pub(crate) fn ticked(&mut self, ticked: Ticked) {
        self.lost = self.lost || self.ticks.push(ticked).is_err();
        if std::mem::take(&mut self.lost) {
            // What is missing cannot be replayed across: begin again as soon as possible.
            self.due = 0;
        }
    }
}
