//! What stands between session and servo and sees everything that passes, tick by tick.

use std::cell::RefCell;
use std::rc::Rc;

use telemime_endpoint::{HostClock, Mono};
use telemime_robot::servo::{self, Handle, Lease, Order, Report, Rings, Source, Station, Ticket};

/// An order as the servo is given it, without what it weighs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Told {
    /// An operator has, or loses, authority.
    Operator(bool),
    /// Follow; what is followed was valid then, if it is a hand.
    Engage(Ticket, Lease, Option<Mono>),
    /// News of what is followed.
    News(Ticket, Lease, Option<Mono>),
    /// The clutch is let go.
    Release(Ticket),
    /// Leave the latched stop, that which is named or (at the robot) whichever.
    Reset(Option<u32>),
}

impl From<&Order> for Told {
    fn from(order: &Order) -> Self {
        match order {
            Order::Operator(present) => Self::Operator(*present),
            Order::Engage(engagement) => {
                let valid_at = match &engagement.source {
                    Source::Mirror { valid_at, .. } => Some(*valid_at),
                    Source::Play(_) => None,
                };
                Self::Engage(engagement.ticket, engagement.lease, valid_at)
            }
            Order::Track {
                ticket,
                lease,
                valid_at,
                ..
            } => Self::News(*ticket, *lease, Some(*valid_at)),
            Order::Extend { ticket, lease, .. } => Self::News(*ticket, *lease, None),
            Order::Release(ticket) => Self::Release(*ticket),
            Order::Reset { stop, .. } => Self::Reset(*stop),
        }
    }
}

/// Sees what the servo was told before a tick, and what it then did.
pub type Watcher = Rc<RefCell<dyn FnMut(&[Told], &Report)>>;

/// A servo whose orders pass by a [`Watcher`]; without one they go straight to it.
pub(super) struct Watched {
    core: Station,
    clock: HostClock,
    tap: Option<Tap>,
}

struct Tap {
    orders: rtrb::Consumer<Order>,
    onward: rtrb::Producer<Order>,
    told: Vec<Told>,
    watcher: Watcher,
}

impl Watched {
    /// The servo that `make` makes of its ends of the rings, and the session's ends.
    pub(super) fn new(
        make: impl FnOnce(Rings) -> Station,
        clock: HostClock,
        watcher: Option<Watcher>,
    ) -> (Self, Handle) {
        let (rings, handle) = servo::rings();
        let core = make(rings);
        let Some(watcher) = watcher else {
            let tap = None;
            return (Self { core, clock, tap }, handle);
        };
        let (before, session) = servo::rings();
        let tap = Some(Tap {
            orders: before.orders,
            onward: handle.orders,
            told: Vec::new(),
            watcher,
        });
        let handle = Handle {
            orders: session.orders,
            ..handle
        };
        (Self { core, clock, tap }, handle)
    }

    /// The period, s.
    pub(super) fn tick_s(&self) -> f64 {
        self.core.tick_s()
    }

    /// One tick, now.
    pub(super) fn tick(&mut self) -> Report {
        let now = self.clock.now();
        let Some(tap) = &mut self.tap else {
            return self.core.tick(now);
        };
        tap.told.clear();
        while let Ok(order) = tap.orders.pop() {
            tap.told.push(Told::from(&order));
            // As long as the ring before it, and emptied in every tick.
            let _ = tap.onward.push(order);
        }
        let report = self.core.tick(now);
        (tap.watcher.borrow_mut())(&tap.told, &report);
        report
    }
}
