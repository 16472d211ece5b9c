//! A link in a person's words.

mod quantity;

use std::path::Path;
use std::str::FromStr;

use super::config::{
    Chance, Distribution, LinkConfig, Loss, Outage, Probability, Rate, Slot, SlotWait,
};
use super::trace::{Trace, TraceError, TraceFormat};
use quantity::{LONGEST_JITTER_S, share, time, value, whole};

pub use quantity::{parse_duration_s, parse_probability, parse_rate_bit_s};

/// Why a text is not a link setting.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ParseLinkError {
    /// Not a duration.
    #[error("`{0}` is not a duration: write for example 100ms, 0.1s or 250us")]
    Duration(String),
    /// Not a probability.
    #[error("`{0}` is not a probability: write for example 1% or 0.01")]
    Probability(String),
    /// Not a rate.
    #[error("`{0}` is not a rate: write for example 64kbit, 1mbit or 500000")]
    Rate(String),
    /// Nothing was said.
    #[error(
        "an empty text is no link: write for example `delay 100ms 10ms loss 1%`, or `delay 0ms` for a perfect wire"
    )]
    Empty,
    /// A quotation mark without its partner.
    #[error("`{0}`: the quotation mark is not closed")]
    Quote(String),
    /// A word that stands for nothing.
    #[error("`{0}` is no word of a link: {WORDS}")]
    Word(String),
    /// A word of netem's that means nothing here.
    #[error("`{word}` has no meaning here: {why}")]
    Foreign {
        /// Which word.
        word: &'static str,
        /// Why not.
        why: &'static str,
    },
    /// An option said twice.
    #[error("`{0}` is said twice")]
    Twice(&'static str),
    /// An option without its value.
    #[error("`{option}` needs {what}")]
    Missing {
        /// The option.
        option: &'static str,
        /// What comes after it.
        what: &'static str,
    },
    /// A value of the wrong kind.
    #[error("`{option} {word}`: {what}")]
    Value {
        /// The option.
        option: &'static str,
        /// The word after it.
        word: String,
        /// What belongs there.
        what: &'static str,
    },
    /// An option that does nothing without another.
    #[error("`{option}` needs {other}")]
    Needs {
        /// The option.
        option: &'static str,
        /// What it needs.
        other: &'static str,
    },
    /// A trace that cannot be played.
    #[error("trace: {0}")]
    Trace(#[from] TraceError),
}

const WORDS: &str = "limit, delay (latency), distribution, loss (drop), duplicate, corrupt, reorder, gap, rate, slot as in tc-netem(8), and outage, trace";

impl FromStr for LinkConfig {
    type Err = ParseLinkError;

    /// Reads netem's options and ours; a trace is looked for from the folder the process runs in.
    fn from_str(text: &str) -> Result<Self, ParseLinkError> {
        Self::parse_in(text, Path::new(""))
    }
}

impl LinkConfig {
    /// As [`str::parse`], with traces looked for from the folder `base`.
    ///
    /// # Errors
    /// [`ParseLinkError`], naming the word.
    pub fn parse_in(text: &str, base: &Path) -> Result<Self, ParseLinkError> {
        let words = split(text)?;
        if words.is_empty() {
            return Err(ParseLinkError::Empty);
        }
        let mut parser = Parser {
            words: &words,
            base,
            said: Vec::new(),
            config: Self::default(),
        };
        while let Some(word) = parser.word() {
            parser.option(word)?;
        }
        parser.check()
    }
}

/// Words, of which those in quotation marks may hold spaces.
fn split(text: &str) -> Result<Vec<String>, ParseLinkError> {
    let (mut words, mut rest) = (Vec::new(), text.trim_start());
    while let Some(first) = rest.chars().next() {
        let (word, after) = if first == '"' {
            rest[1..]
                .split_once('"')
                .ok_or_else(|| ParseLinkError::Quote(rest.to_owned()))?
        } else {
            rest.split_once(char::is_whitespace).unwrap_or((rest, ""))
        };
        words.push(word.to_owned());
        rest = after.trim_start();
    }
    Ok(words)
}

struct Parser<'a> {
    words: &'a [String],
    base: &'a Path,
    said: Vec<&'static str>,
    config: LinkConfig,
}

/// What an option's name may be cut to, as tc allows.
const SHORTEST: usize = 3;

/// The option a word stands for.
fn option_of(word: &str) -> Option<&'static str> {
    const NAMES: [(&str, &str); 16] = [
        ("limit", "limit"),
        ("delay", "delay"),
        ("latency", "delay"),
        ("distribution", "distribution"),
        ("loss", "loss"),
        ("drop", "loss"),
        ("duplicate", "duplicate"),
        ("corrupt", "corrupt"),
        ("reorder", "reorder"),
        ("gap", "gap"),
        ("rate", "rate"),
        ("slot", "slot"),
        ("outage", "outage"),
        ("trace", "trace"),
        ("ecn", "ecn"),
        ("seed", "seed"),
    ];
    let means = |name: &str| name.starts_with(word) && word.len() >= SHORTEST.min(name.len());
    NAMES
        .iter()
        .find(|(name, _)| means(name))
        .map(|(_, option)| *option)
}

impl<'a> Parser<'a> {
    fn word(&mut self) -> Option<&'a str> {
        let (first, rest) = self.words.split_first()?;
        self.words = rest;
        Some(first)
    }

    /// The next word, if it begins as a number does (as tc decides whether a value is left out).
    fn number(&mut self, signed: bool) -> Option<&'a str> {
        let begins = |c: char| c.is_ascii_digit() || c == '.' || (signed && c == '-');
        let first = self.words.first()?;
        if !first.starts_with(begins) || first.contains("..") {
            return None;
        }
        self.word()
    }

    fn value(
        &mut self,
        option: &'static str,
        what: &'static str,
    ) -> Result<&'a str, ParseLinkError> {
        self.word().ok_or(ParseLinkError::Missing { option, what })
    }

    fn time(&mut self, option: &'static str) -> Result<f64, ParseLinkError> {
        let word = self.value(option, "a time: 100ms")?;
        time(option, word)
    }

    fn chance(&mut self, option: &'static str) -> Result<Chance, ParseLinkError> {
        let word = self.value(option, "a share: 1%")?;
        Ok(Chance {
            p: share(option, word)?,
            correlation: self.share_or(option, Probability::NEVER)?,
        })
    }

    fn share_or(
        &mut self,
        option: &'static str,
        otherwise: Probability,
    ) -> Result<Probability, ParseLinkError> {
        self.number(false)
            .map_or(Ok(otherwise), |word| share(option, word))
    }

    fn option(&mut self, word: &str) -> Result<(), ParseLinkError> {
        let option = option_of(word).ok_or_else(|| ParseLinkError::Word(word.to_owned()))?;
        if option != "outage" && self.said.contains(&option) {
            return Err(ParseLinkError::Twice(option));
        }
        self.said.push(option);
        match option {
            "limit" => {
                let word = self.value(option, "a number of packets")?;
                self.config.limit = whole(option, word)?;
            }
            "delay" => {
                self.config.delay_s = self.time(option)?;
                if let Some(word) = self.number(false) {
                    self.config.jitter_s = time(option, word)?;
                    if self.config.jitter_s > LONGEST_JITTER_S {
                        let what = "the kernel's jitter ends at 2.147s";
                        return Err(value(option, word, what));
                    }
                    self.config.delay_correlation = self.share_or(option, Probability::NEVER)?;
                }
            }
            "distribution" => self.config.distribution = self.distribution(option)?,
            "loss" => self.config.loss = self.loss()?,
            "duplicate" => self.config.duplicate = self.chance(option)?,
            "corrupt" => self.config.corrupt = self.chance(option)?,
            "reorder" => self.config.reorder = self.chance(option)?,
            "gap" => {
                let word = self.value(option, "a number of packets")?;
                self.config.gap = whole(option, word)?;
            }
            "rate" => self.config.rate = Some(self.rate()?),
            "slot" => self.config.slot = Some(self.slot()?),
            "outage" => {
                let outage = self.outage()?;
                self.config.outages.push(outage);
            }
            "trace" => {
                let path = Path::new(self.value(option, "a file")?);
                let format = self
                    .words
                    .first()
                    .and_then(|word| TraceFormat::ALL.into_iter().find(|f| f.name() == word));
                if format.is_some() {
                    self.word();
                }
                self.config.trace = Some(Trace::open_in(self.base, path, format)?);
            }
            "ecn" => {
                return Err(ParseLinkError::Foreign {
                    word: "ecn",
                    why: "nothing here marks packets instead of losing them",
                });
            }
            _ => {
                return Err(ParseLinkError::Foreign {
                    word: "seed",
                    why: "the seed belongs to a run and not to a link (--link-seed)",
                });
            }
        }
        Ok(())
    }

    fn distribution(&mut self, option: &'static str) -> Result<Distribution, ParseLinkError> {
        let what = "one of uniform, normal, pareto, paretonormal";
        let word = self.value(option, what)?;
        let found = Distribution::ALL.into_iter().find(|d| d.name() == word);
        found.ok_or_else(|| value(option, word, what))
    }

    fn loss(&mut self) -> Result<Loss, ParseLinkError> {
        let option = "loss";
        let what = "a share (1%), or random, state or gemodel and their numbers";
        let first = self
            .words
            .first()
            .ok_or(ParseLinkError::Missing { option, what })?;
        match first.as_str() {
            "random" => {
                self.word();
                Ok(Loss::Random(self.chance("loss random")?))
            }
            "state" => {
                let option = "loss state";
                self.word();
                let first = self.chance_alone(option)?;
                let rest = Probability(u32::MAX - first.0);
                let p31 = self.share_or(option, rest)?;
                let p32 = self.share_or(option, Probability::NEVER)?;
                let p23 = self.share_or(option, Probability::ALWAYS)?;
                let p14 = self.share_or(option, Probability::NEVER)?;
                let leaves = |a: Probability, b: Probability| a.0.checked_add(b.0).is_none();
                if leaves(first, p14) || leaves(p31, p32) {
                    return Err(ParseLinkError::Needs {
                        option,
                        other: "p13 + p14 and p31 + p32 of at most 100%",
                    });
                }
                Ok(Loss::State {
                    p13: first,
                    p31,
                    p32,
                    p23,
                    p14,
                })
            }
            "gemodel" => {
                let option = "loss gemodel";
                self.word();
                let p = self.chance_alone(option)?;
                Ok(Loss::Gemodel {
                    p,
                    r: self.share_or(option, Probability(u32::MAX - p.0))?,
                    lost_bad: self.share_or(option, Probability::ALWAYS)?,
                    lost_good: self.share_or(option, Probability::NEVER)?,
                })
            }
            word if word.starts_with(|c: char| c.is_ascii_digit() || c == '.') => {
                Ok(Loss::Random(self.chance(option)?))
            }
            word => Err(value(option, word, what)),
        }
    }

    fn chance_alone(&mut self, option: &'static str) -> Result<Probability, ParseLinkError> {
        let word = self.value(option, "a share: 1%")?;
        share(option, word)
    }

    fn rate(&mut self) -> Result<Rate, ParseLinkError> {
        let option = "rate";
        let word = self.value(option, "a rate: 1mbit")?;
        let what = "not a rate of at least 8bit: write for example 64kbit or 1mbit";
        let bit_s = parse_rate_bit_s(word).map_err(|_| value(option, word, what))?;
        let mut rate = Rate::bits(bit_s);
        if let Some(word) = self.number(true) {
            rate.overhead = whole(option, word)?;
        }
        if let Some(word) = self.number(false) {
            rate.cell = whole(option, word)?;
        }
        if let Some(word) = self.number(true) {
            rate.cell_overhead = whole(option, word)?;
        }
        Ok(rate)
    }

    fn slot(&mut self) -> Result<Slot, ParseLinkError> {
        let option = "slot";
        let wait = if self.words.first().is_some_and(|w| w == "distribution") {
            self.word();
            let option = "slot distribution";
            let distribution = self.distribution(option)?;
            let delay_s = self.time(option)?;
            let word = self.value(option, "a delay and a jitter")?;
            let jitter_s = time(option, word)?;
            if !(jitter_s > 0.0 && jitter_s <= LONGEST_JITTER_S) {
                return Err(value(
                    option,
                    word,
                    "the jitter lies above 0 and up to 2.147s",
                ));
            }
            SlotWait::Around {
                distribution,
                delay_s,
                jitter_s,
            }
        } else {
            let min_s = self.time(option)?;
            let max_s = match self.number(false) {
                None => min_s,
                Some(word) => {
                    let max_s = time(option, word)?;
                    if max_s < min_s {
                        return Err(value(option, word, "is less than the least wait before it"));
                    }
                    max_s
                }
            };
            if max_s == 0.0 {
                return Err(value(option, "0", "a slot that is always there is none"));
            }
            SlotWait::Between { min_s, max_s }
        };
        let mut count = |name: &'static str| -> Result<Option<u32>, ParseLinkError> {
            if self.words.first().is_none_or(|w| w != name) {
                return Ok(None);
            }
            self.word();
            let what = "a whole number above 0";
            let word = self.value(name, what)?;
            match word.parse::<u32>() {
                Ok(n) if n > 0 && n <= i32::MAX as u32 => Ok(Some(n)),
                _ => Err(value(name, word, what)),
            }
        };
        Ok(Slot {
            wait,
            packets: count("packets")?,
            bytes: count("bytes")?,
        })
    }

    fn outage(&mut self) -> Result<Outage, ParseLinkError> {
        let option = "outage";
        let what = "from and to since the link began: 5s..7s";
        let word = self.value(option, what)?;
        let (from, to) = word
            .split_once("..")
            .ok_or_else(|| value(option, word, what))?;
        let (from_s, to_s) = (time(option, from)?, time(option, to)?);
        if to_s <= from_s {
            return Err(value(option, word, "ends before it begins"));
        }
        let every_s = if self.words.first().is_some_and(|w| w == "every") {
            self.word();
            let word = self.value("outage … every", "a time: 15s")?;
            let every_s = time("outage … every", word)?;
            if every_s <= to_s - from_s {
                return Err(value("every", word, "is no longer than the outage itself"));
            }
            Some(every_s)
        } else {
            None
        };
        Ok(Outage {
            from_s,
            to_s,
            every_s,
        })
    }

    fn check(mut self) -> Result<LinkConfig, ParseLinkError> {
        let config = &mut self.config;
        let said = |option: &str| self.said.contains(&option);
        let needs = |option, other| Err(ParseLinkError::Needs { option, other });
        if said("distribution") && config.jitter_s == 0.0 {
            return needs("distribution", "a delay with a jitter: delay 100ms 10ms");
        }
        if config.reorder.p > Probability::NEVER {
            if config.delay_s == 0.0 && config.trace.is_none() {
                return needs(
                    "reorder",
                    "a delay, or nothing waits that could be overtaken",
                );
            }
            config.gap = config.gap.max(1);
        } else if config.gap > 0 {
            return needs("gap", "reorder: reorder 25% gap 5");
        }
        if config.rate.is_some() && config.trace.as_ref().is_some_and(Trace::has_rate) {
            return needs("rate", "a trace without a bottleneck of its own");
        }
        Ok(self.config)
    }
}
