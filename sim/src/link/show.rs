//! A link, written as it is read.

use std::fmt::{self, Display, Formatter};

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::config::{
    Chance, Distribution, LinkConfig, Loss, Outage, Probability, Rate, Slot, SlotWait,
};

impl Display for LinkConfig {
    /// netem's options and ours, in a fixed order, without those that are off; reading it gives the same link.
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let delayed = *self == Self::default() || self.delay_s > 0.0 || self.jitter_s > 0.0;
        if delayed {
            write!(f, "delay {}", Time(self.delay_s))?;
        }
        if self.jitter_s > 0.0 {
            write!(f, " {}", Time(self.jitter_s))?;
            correlation(f, self.delay_correlation)?;
            if self.distribution != Distribution::Uniform {
                write!(f, " distribution {}", self.distribution.name())?;
            }
        }
        let mut gap = if delayed { " " } else { "" };
        let mut word = |f: &mut Formatter<'_>, said: &dyn Display| {
            let result = write!(f, "{gap}{said}");
            gap = " ";
            result
        };
        if self.loss != Loss::random(0.0) {
            word(f, &self.loss)?;
        }
        for (name, chance) in [
            ("duplicate", self.duplicate),
            ("corrupt", self.corrupt),
            ("reorder", self.reorder),
        ] {
            if chance != Chance::NEVER {
                word(f, &format_args!("{name} {chance}"))?;
            }
        }
        if self.gap > 1 {
            word(f, &format_args!("gap {}", self.gap))?;
        }
        if let Some(rate) = &self.rate {
            word(f, rate)?;
        }
        if let Some(slot) = &self.slot {
            word(f, slot)?;
        }
        for outage in &self.outages {
            word(f, outage)?;
        }
        if let Some(trace) = &self.trace {
            let path = trace.path().display().to_string();
            let quote = if path.contains(char::is_whitespace) {
                "\""
            } else {
                ""
            };
            word(f, &format_args!("trace {quote}{path}{quote}"))?;
            if let Some(format) = trace.format() {
                word(f, &format.name())?;
            }
        }
        if self.limit != Self::default().limit {
            word(f, &format_args!("limit {}", self.limit))?;
        }
        Ok(())
    }
}

impl Serialize for LinkConfig {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for LinkConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

/// s, in the largest unit that needs no fraction.
struct Time(f64);

impl Display for Time {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let ns = (self.0 * 1e9).round() as i64;
        let units = [("s", 1_000_000_000), ("ms", 1_000_000), ("us", 1000)];
        if ns == 0 {
            return write!(f, "0ms");
        }
        match units.iter().find(|(_, unit)| ns % unit == 0) {
            Some((name, unit)) => write!(f, "{}{name}", ns / unit),
            None => write!(f, "{ns}ns"),
        }
    }
}

impl Display for Probability {
    /// Per cent, in as few digits as tell it from its neighbours.
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let percent = self.fraction() * 100.0;
        for digits in 0..10 {
            let text = format!("{percent:.digits$}");
            if text
                .parse::<f64>()
                .is_ok_and(|p| Self::of(p / 100.0) == *self)
            {
                return write!(f, "{text}%");
            }
        }
        write!(f, "{percent}%")
    }
}

fn correlation(f: &mut Formatter<'_>, rho: Probability) -> fmt::Result {
    if rho == Probability::NEVER {
        return Ok(());
    }
    write!(f, " {rho}")
}

impl Display for Chance {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.p)?;
        correlation(f, self.correlation)
    }
}

impl Display for Loss {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Random(chance) => write!(f, "loss {chance}"),
            Self::State {
                p13,
                p31,
                p32,
                p23,
                p14,
            } => write!(f, "loss state {p13} {p31} {p32} {p23} {p14}"),
            Self::Gemodel {
                p,
                r,
                lost_bad,
                lost_good,
            } => write!(f, "loss gemodel {p} {r} {lost_bad} {lost_good}"),
        }
    }
}

impl Display for Rate {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let units = [("gbit", 1_000_000_000), ("mbit", 1_000_000), ("kbit", 1000)];
        let (name, unit) = units
            .into_iter()
            .find(|(_, unit)| self.bit_s.is_multiple_of(*unit))
            .unwrap_or(("bit", 1));
        write!(f, "rate {}{name}", self.bit_s / unit)?;
        let parts = [
            i64::from(self.overhead),
            i64::from(self.cell),
            i64::from(self.cell_overhead),
        ];
        let said = parts.iter().rposition(|p| *p != 0).map_or(0, |i| i + 1);
        parts[..said]
            .iter()
            .try_for_each(|part| write!(f, " {part}"))
    }
}

impl Display for Slot {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.wait {
            SlotWait::Between { min_s, max_s } if min_s == max_s => {
                write!(f, "slot {}", Time(min_s))?;
            }
            SlotWait::Between { min_s, max_s } => {
                write!(f, "slot {} {}", Time(min_s), Time(max_s))?;
            }
            SlotWait::Around {
                distribution,
                delay_s,
                jitter_s,
            } => write!(
                f,
                "slot distribution {} {} {}",
                distribution.name(),
                Time(delay_s),
                Time(jitter_s)
            )?,
        }
        if let Some(packets) = self.packets {
            write!(f, " packets {packets}")?;
        }
        if let Some(bytes) = self.bytes {
            write!(f, " bytes {bytes}")?;
        }
        Ok(())
    }
}

impl Display for Outage {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "outage {}..{}", Time(self.from_s), Time(self.to_s))?;
        self.every_s
            .map_or(Ok(()), |every| write!(f, " every {}", Time(every)))
    }
}
