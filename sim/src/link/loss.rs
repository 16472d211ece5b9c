//! Which packets are lost: `loss_event` of the kernel and its two chains.

use super::config::{Loss, Probability};
use super::draw::{Correlated, Draws, What};

#[derive(Debug, Clone)]
pub(super) struct Losses {
    model: Loss,
    draws: Correlated,
    state: State,
}

#[derive(Debug, Clone, Copy)]
enum State {
    /// Gilbert–Elliott's good state; of the four, received in a gap.
    Good,
    /// Gilbert–Elliott's bad state; of the four, lost in a burst.
    Bad,
    /// Received in a burst.
    BadReceived,
    /// Lost in a gap.
    GoodLost,
}

impl Losses {
    pub(super) fn new(model: Loss, first: Draws) -> Self {
        let rho = match model {
            Loss::Random(chance) => chance.correlation,
            Loss::State { .. } | Loss::Gemodel { .. } => Probability::NEVER,
        };
        Self {
            model,
            draws: Correlated::new(first.u32(What::Loss), rho),
            state: State::Good,
        }
    }

    /// Whether the next packet is lost.
    pub(super) fn next(&mut self, draws: Draws) -> bool {
        let rnd = draws.u32(What::Loss);
        match self.model {
            Loss::Random(chance) => chance.p.0 > 0 && chance.p.0 >= self.draws.next(rnd),
            Loss::Gemodel {
                p,
                r,
                lost_bad,
                lost_good,
            } => {
                // The transition first, then loss by the state it was in.
                let too = draws.u32(What::LossToo);
                if let State::Good = self.state {
                    if rnd < p.0 {
                        self.state = State::Bad;
                    }
                    too < lost_good.0
                } else {
                    if rnd < r.0 {
                        self.state = State::Good;
                    }
                    too > u32::MAX - lost_bad.0
                }
            }
            Loss::State {
                p13,
                p31,
                p32,
                p23,
                p14,
            } => {
                let (next, lost) = match self.state {
                    State::Good if rnd < p14.0 => (State::GoodLost, true),
                    State::Good if rnd < p13.0.saturating_add(p14.0) => (State::Bad, true),
                    State::Good => (State::Good, false),
                    State::BadReceived if rnd < p23.0 => (State::Bad, true),
                    State::BadReceived => (State::BadReceived, false),
                    State::Bad if rnd < p32.0 => (State::BadReceived, false),
                    State::Bad if rnd < p31.0.saturating_add(p32.0) => (State::Good, false),
                    State::Bad => (State::Bad, true),
                    State::GoodLost => (State::Good, false),
                };
                self.state = next;
                lost
            }
        }
    }
}
