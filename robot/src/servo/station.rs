//! One tick: orders in, the arm's state in, what the core decides out to the arm, report out.

use telemime_endpoint::Mono;

use super::arm::Manipulator;
use super::brake::Brake;
use super::core::{Core, CoreState};
use super::orders::{Order, Report};
use crate::blackbox::{Tap, Ticked};

/// A core before its arm, with the rings to its session and, if it is recorded, to its recorder.
pub struct Station {
    core: Core,
    arm: Box<dyn Manipulator>,
    orders: rtrb::Consumer<Order>,
    reports: rtrb::Producer<Report>,
    brake: Brake,
    tap: Option<Tap>,
}

impl Station {
    /// A core before `arm`, which does what comes through `orders` and `brake` and tells it through `reports`.
    pub fn new(
        core: Core,
        arm: Box<dyn Manipulator>,
        orders: rtrb::Consumer<Order>,
        reports: rtrb::Producer<Report>,
        brake: Brake,
    ) -> Self {
        Self {
            core,
            arm,
            orders,
            reports,
            brake,
            tap: None,
        }
    }

    /// The same with all that it is told and decides recorded through `tap`.
    #[must_use]
    pub fn recorded(mut self, tap: Tap) -> Self {
        self.tap = Some(tap);
        self
    }

    /// The period, s.
    pub fn tick_s(&self) -> f64 {
        self.core.config().tick_s
    }

    /// A state with room for every one of its core.
    pub fn room(&self) -> CoreState {
        self.core.room()
    }

    /// One period of work, at `now` on the robot's clock.
    pub fn tick(&mut self, now: Mono) -> Report {
        if let Some(tap) = &mut self.tap {
            tap.before(&self.core);
        }
        self.core.begin(now);
        let (before, fault) = self.arm.sense(now);
        let mut orders = 0;
        while let Ok(order) = self.orders.pop() {
            if let Some(tap) = &mut self.tap {
                tap.order(self.core.ticks(), &order);
            }
            orders += 1;
            self.core.obey(order, now, &before);
        }
        let pulled = self.brake.take();
        let setpoint = self.core.decide(now, pulled, &before, fault);
        let (strain, after) = self.arm.act(now, &setpoint, self.tick_s());
        let report = self.core.conclude(now, &strain, &after);
        if let Some(tap) = &mut self.tap {
            tap.ticked(Ticked {
                now,
                orders,
                pulled,
                before,
                fault,
                setpoint,
                strain,
                after,
                report,
            });
        }
        // A full ring means a stalled session; the servo does not wait for it.
        let _ = self.reports.push(report);
        report
    }
}
