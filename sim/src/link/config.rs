//! What a link is set to.

use super::trace::Trace;

/// Settings of one direction; the default is a perfect wire.
///
/// A person writes them in netem's own words, and so they are parsed ([`std::str::FromStr`]), printed
/// ([`std::fmt::Display`]) and (de)serialised: `delay 100ms 10ms distribution normal loss gemodel 1% 10%`.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkConfig {
    /// Constant part of the delay, s; the trace's comes on top.
    pub delay_s: f64,
    /// Spread of the delay, s: half-width if uniform, else the table's unit (one standard deviation). At most 2.147 s count.
    pub jitter_s: f64,
    /// Correlation of the jitter's draws.
    pub delay_correlation: Probability,
    /// Shape of the jitter.
    pub distribution: Distribution,
    /// Which packets are lost.
    pub loss: Loss,
    /// A packet is sent twice.
    pub duplicate: Chance,
    /// One bit of a packet is flipped.
    pub corrupt: Chance,
    /// A packet is sent at once, before those that wait.
    pub reorder: Chance,
    /// Of so many packets all but the last are delayed before one may be sent at once; 0: no reordering.
    pub gap: u32,
    /// Bottleneck; `None` is unlimited.
    pub rate: Option<Rate>,
    /// Packets that may be queued; the next one is dropped (netem's default is 1000).
    pub limit: usize,
    /// When what is due may leave; `None` is always.
    pub slot: Option<Slot>,
    /// When nothing gets in, since the link began.
    pub outages: Vec<Outage>,
    /// A recorded link.
    pub trace: Option<Trace>,
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            delay_s: 0.0,
            jitter_s: 0.0,
            delay_correlation: Probability::NEVER,
            distribution: Distribution::Uniform,
            loss: Loss::Random(Chance::NEVER),
            duplicate: Chance::NEVER,
            corrupt: Chance::NEVER,
            reorder: Chance::NEVER,
            gap: 0,
            rate: None,
            limit: 1000,
            slot: None,
            outages: Vec::new(),
            trace: None,
        }
    }
}

/// A probability as `tc` hands it to the kernel: parts of 2³² − 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Probability(pub u32);

impl Probability {
    /// 0.
    pub const NEVER: Self = Self(0);
    /// 1.
    pub const ALWAYS: Self = Self(u32::MAX);

    /// The nearest to `p`, which is cut to 0 to 1 (not a number is 0).
    pub fn of(p: f64) -> Self {
        Self((p.clamp(0.0, 1.0) * f64::from(u32::MAX)).round_ties_even() as u32)
    }

    /// As a fraction.
    pub fn fraction(self) -> f64 {
        f64::from(self.0) / f64::from(u32::MAX)
    }
}

/// Something that happens to a packet now and then.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chance {
    /// How often.
    pub p: Probability,
    /// How much one draw resembles the one before it (`get_crandom` of the kernel).
    pub correlation: Probability,
}

impl Chance {
    /// Never.
    pub const NEVER: Self = Self {
        p: Probability::NEVER,
        correlation: Probability::NEVER,
    };

    /// With probability `p`, independently.
    pub fn of(p: f64) -> Self {
        Self {
            p: Probability::of(p),
            correlation: Probability::NEVER,
        }
    }
}

/// Shape of a spread. The tables are iproute2's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Distribution {
    /// Between mean − σ and mean + σ.
    Uniform,
    /// Normal, cut at four standard deviations.
    Normal,
    /// Pareto with a = 3, mean 0, cut at four.
    Pareto,
    /// A quarter normal, three quarters Pareto, at the same quantile.
    ParetoNormal,
}

impl Distribution {
    /// All there are.
    pub const ALL: [Self; 4] = [
        Self::Uniform,
        Self::Normal,
        Self::Pareto,
        Self::ParetoNormal,
    ];

    /// As `tc` calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Uniform => "uniform",
            Self::Normal => "normal",
            Self::Pareto => "pareto",
            Self::ParetoNormal => "paretonormal",
        }
    }
}

/// Which packets are lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Loss {
    /// Each by itself (or as much like the one before as its correlation says).
    Random(Chance),
    /// Four states: 1 received, 2 received within a burst, 3 lost within a burst, 4 lost alone (Salsano, Ludovici, Ordine 2009).
    State {
        /// A burst begins.
        p13: Probability,
        /// A burst ends.
        p31: Probability,
        /// Within a burst, something is received.
        p32: Probability,
        /// Within a burst, something is lost again.
        p23: Probability,
        /// One is lost alone.
        p14: Probability,
    },
    /// Gilbert and Elliott's two states.
    Gemodel {
        /// From good to bad.
        p: Probability,
        /// From bad to good.
        r: Probability,
        /// Loss in the bad state (tc's 1−h).
        lost_bad: Probability,
        /// Loss in the good state (tc's 1−k).
        lost_good: Probability,
    },
}

impl Loss {
    /// Lost independently with probability `p`.
    pub fn random(p: f64) -> Self {
        Self::Random(Chance::of(p))
    }

    /// Share of packets lost in the long run; `None` where the draws are correlated, which leaves no closed form.
    ///
    /// Gilbert–Elliott: (r·(1−k) + p·(1−h)) / (p + r). Four states: (π₃ + π₄) of the chain's stationary distribution.
    pub fn share(self) -> Option<f64> {
        match self {
            Self::Random(chance) => {
                (chance.correlation == Probability::NEVER).then(|| chance.p.fraction())
            }
            Self::Gemodel {
                p,
                r,
                lost_bad,
                lost_good,
            } => {
                let (p, r) = (p.fraction(), r.fraction());
                let bad = if p > 0.0 { p / (p + r) } else { 0.0 };
                Some((1.0 - bad) * lost_good.fraction() + bad * lost_bad.fraction())
            }
            Self::State {
                p13,
                p31,
                p32,
                p23,
                p14,
            } => {
                let [p13, p31, p32, p23, p14] =
                    [p13, p31, p32, p23, p14].map(Probability::fraction);
                if p13 == 0.0 {
                    return Some(p14 / (1.0 + p14));
                }
                // Balance: π₁p₁₃ = π₃p₃₁, π₂p₂₃ = π₃p₃₂, π₄ = π₁p₁₄; here without the divisions.
                let (one, two, three) = (p31 * p23, p13 * p32, p13 * p23);
                let four = one * p14;
                let all = one + two + three + four;
                Some(if all > 0.0 { (three + four) / all } else { 1.0 })
            }
        }
    }
}

/// A bottleneck.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rate {
    /// Bit/s, counted as the kernel does: in whole bytes a second.
    pub bit_s: u64,
    /// Added to every packet's length, bytes; may be negative.
    pub overhead: i32,
    /// Bytes a cell carries; 0: there are no cells.
    pub cell: u32,
    /// Added to every cell, bytes; may be negative.
    pub cell_overhead: i32,
}

impl Rate {
    /// Without overhead and cells.
    pub fn bits(bit_s: u64) -> Self {
        Self {
            bit_s,
            overhead: 0,
            cell: 0,
            cell_overhead: 0,
        }
    }
}

/// How long until the next slot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SlotWait {
    /// Uniform between the two, s.
    Between {
        /// At least.
        min_s: f64,
        /// At most.
        max_s: f64,
    },
    /// About a mean, s.
    Around {
        /// Shape of the spread.
        distribution: Distribution,
        /// Mean.
        delay_s: f64,
        /// Spread.
        jitter_s: f64,
    },
}

/// What is due leaves in slots, as on a shared medium.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slot {
    /// From one slot to the next.
    pub wait: SlotWait,
    /// Packets a slot takes; `None` is all.
    pub packets: Option<u32>,
    /// Bytes after which a slot is over; `None` is never.
    pub bytes: Option<u32>,
}

/// A time in which everything that is sent is lost; what is on its way arrives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outage {
    /// Beginning, s since the link began.
    pub from_s: f64,
    /// End, s.
    pub to_s: f64,
    /// From one beginning to the next, s, if it comes back.
    pub every_s: Option<f64>,
}

impl Outage {
    /// Whether it covers `t_s`, s since the link began.
    pub fn covers(&self, t_s: f64) -> bool {
        let since = t_s - self.from_s;
        let since = match self.every_s {
            Some(period) if since >= 0.0 && period > 0.0 => since % period,
            _ => since,
        };
        (0.0..self.to_s - self.from_s).contains(&since)
    }
}
