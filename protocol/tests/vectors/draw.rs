//! Seeded random messages: every width an integer can have on the wire is as likely as any other.

use rand::{Rng, RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use telemime_protocol::wire::bend::{WireBend, WireHeld};
use telemime_protocol::wire::memory::WireMemory;
use telemime_protocol::wire::state::WireState;
use telemime_protocol::wire::turn::{WirePose, WireRotation, WireTurn};
use telemime_protocol::wire::v1::WireParams;

/// A source of values.
pub(crate) struct Draw(Xoshiro256PlusPlus);

impl Draw {
    pub(crate) fn new(seed: u64) -> Self {
        Self(Xoshiro256PlusPlus::seed_from_u64(seed))
    }

    /// An unsigned number of 0 to `bits` bits.
    pub(crate) fn bits(&mut self, bits: u32) -> u64 {
        let n = self.0.random_range(0..=bits);
        self.0.next_u64().checked_shr(64 - n).unwrap_or(0)
    }

    pub(crate) fn u8(&mut self) -> u8 {
        self.bits(8) as u8
    }

    pub(crate) fn u16(&mut self) -> u16 {
        self.bits(16) as u16
    }

    pub(crate) fn u32(&mut self) -> u32 {
        self.bits(32) as u32
    }

    /// Within ± 2^`bits`.
    pub(crate) fn signed(&mut self, bits: u32) -> i64 {
        let n = self.bits(bits) as i64;
        if self.0.random() { n } else { -n }
    }

    /// A short binary fraction: the same as f32 and f64, and short in decimal.
    pub(crate) fn fraction(&mut self) -> f32 {
        self.signed(12) as f32 / 256.0
    }

    pub(crate) fn below(&mut self, n: usize) -> usize {
        self.0.random_range(0..n)
    }

    pub(crate) fn maybe<T>(&mut self, some: impl FnOnce(&mut Self) -> T) -> Option<T> {
        self.0.random::<bool>().then(|| some(self))
    }

    pub(crate) fn state(&mut self) -> WireState {
        WireState {
            t_us: 10 * self.signed(49),
            x: std::array::from_fn(|_| self.signed(19) as i32),
            memory: self.memory(16),
        }
    }

    fn memory(&mut self, exponents: usize) -> WireMemory {
        let mut exponent = || self.below(exponents) as u8;
        WireMemory {
            exponents: std::array::from_fn(|_| exponent() << 4 | exponent()),
            offsets: std::array::from_fn(|_| std::array::from_fn(|_| self.u8() as i8)),
        }
    }

    pub(crate) fn rotation(&mut self) -> WireRotation {
        WireRotation(std::array::from_fn(|_| self.signed(14) as i16))
    }

    pub(crate) fn params(&mut self) -> WireParams {
        WireParams {
            gain: self.u8(),
            inflation: self.u8(),
            weights: std::array::from_fn(|_| {
                let first = self.below(16) as u8;
                let second = (self.below(16) as u8).min(15 - first);
                [first, second, (15 - first - second) / 2]
            }),
        }
    }

    pub(crate) fn bend(&mut self) -> WireBend {
        WireBend {
            plan_us: self.signed(40),
            rate: self.below(193) as u8,
            left: std::array::from_fn(|_| self.signed(16) as i32),
            held: self.maybe(|d| WireHeld {
                state: d.state(),
                gain: d.u8(),
                straight: d.u8(),
                weight: std::array::from_fn(|i| match i {
                    0 | 2 | 5 => d.below(128) as i8,
                    _ => d.signed(6) as i8,
                }),
            }),
        }
    }

    pub(crate) fn pose(&mut self) -> WirePose {
        WirePose {
            turn: self.maybe(|d| WireTurn {
                q: d.rotation(),
                memory: d.memory(11),
                params: d.params(),
            }),
            grip: self.maybe(Self::u8),
        }
    }
}
