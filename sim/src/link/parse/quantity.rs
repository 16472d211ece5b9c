//! Times, shares and rates as words.

use std::str::FromStr;

use super::super::config::Probability;
use super::ParseLinkError;

/// Longest time there is, s.
const LONGEST_S: f64 = 3600.0;

/// Longest jitter, s: the kernel has 31 bits for it.
pub(super) const LONGEST_JITTER_S: f64 = i32::MAX as f64 * 1e-9;

const TIME: [(&str, f64); 13] = [
    ("nsecs", 1.0),
    ("nsec", 1.0),
    ("ns", 1.0),
    ("usecs", 1e3),
    ("usec", 1e3),
    ("us", 1e3),
    ("µs", 1e3),
    ("msecs", 1e6),
    ("msec", 1e6),
    ("ms", 1e6),
    ("secs", 1e9),
    ("sec", 1e9),
    ("s", 1e9),
];

/// tc's units of a rate, bit/s; those in `bps` count bytes.
const RATE: [(&str, f64); 16] = [
    ("kibit", 1024.0),
    ("mibit", 1048576.0),
    ("gibit", 1073741824.0),
    ("kbit", 1e3),
    ("mbit", 1e6),
    ("gbit", 1e9),
    ("tbit", 1e12),
    ("bit", 1.0),
    ("kibps", 8.0 * 1024.0),
    ("mibps", 8.0 * 1048576.0),
    ("gibps", 8.0 * 1073741824.0),
    ("kbps", 8e3),
    ("mbps", 8e6),
    ("gbps", 8e9),
    ("tbps", 8e12),
    ("bps", 8.0),
];

fn number_with_unit(text: &str, units: &[(&str, f64)]) -> Option<f64> {
    let text = text.trim().to_ascii_lowercase();
    let (number, factor) = units
        .iter()
        .find_map(|(unit, factor)| Some((text.strip_suffix(unit)?.to_owned(), *factor)))?;
    let value = number.trim().parse::<f64>().ok()? * factor;
    (value.is_finite() && value >= 0.0).then_some(value)
}

/// Seconds, to the nanosecond, of a time with its unit.
fn time_s(text: &str) -> Option<f64> {
    let s = number_with_unit(text, &TIME)?.round() / 1e9;
    (s <= LONGEST_S).then_some(s)
}

/// Seconds from `100ms`, `0.1s`, `250us`; a bare number is milliseconds (tc's is microseconds, but nobody means that).
///
/// # Errors
/// [`ParseLinkError::Duration`] for anything else, negative and non-finite numbers included.
pub fn parse_duration_s(text: &str) -> Result<f64, ParseLinkError> {
    let bare = || number_with_unit(text, &[("", 1e-3)]);
    number_with_unit(text, &TIME)
        .map(|ns| ns / 1e9)
        .or_else(bare)
        .filter(|&s| s <= LONGEST_S)
        .ok_or_else(|| ParseLinkError::Duration(text.to_owned()))
}

/// A probability from `1%` or `0.01`.
///
/// # Errors
/// [`ParseLinkError::Probability`] for anything outside 0 to 100 %.
pub fn parse_probability(text: &str) -> Result<f64, ParseLinkError> {
    let percent = number_with_unit(text, &[("%", 1.0)]).map(|p| p / 100.0);
    percent
        .or_else(|| number_with_unit(text, &[("", 1.0)]))
        .filter(|&p| p <= 1.0)
        .ok_or_else(|| ParseLinkError::Probability(text.to_owned()))
}

/// Bits per second from `64kbit`, `1mbit`, `2gbit` or a bare number.
///
/// # Errors
/// [`ParseLinkError::Rate`] for anything else, and below the kernel's least, 8 bit/s.
pub fn parse_rate_bit_s(text: &str) -> Result<u64, ParseLinkError> {
    number_with_unit(text, &RATE)
        .or_else(|| number_with_unit(text, &[("", 1.0)]))
        .filter(|r| (8.0..=1e15).contains(r))
        .map(|r| r.round() as u64)
        .ok_or_else(|| ParseLinkError::Rate(text.to_owned()))
}

pub(super) fn value(option: &'static str, word: &str, what: &'static str) -> ParseLinkError {
    ParseLinkError::Value {
        option,
        word: word.to_owned(),
        what,
    }
}

pub(super) fn time(option: &'static str, word: &str) -> Result<f64, ParseLinkError> {
    time_s(word).ok_or_else(|| {
        let bare = word.parse::<f64>().is_ok();
        value(
            option,
            word,
            if bare {
                "a time needs its unit (tc alone would read microseconds): write for example 100ms, 0.1s or 250us"
            } else {
                "not a time of at most an hour: write for example 100ms, 0.1s or 250us"
            },
        )
    })
}

/// A share: a number with its per cent sign, or, as tc reads it, without; below 1 that may have been meant for a fraction, and
/// is refused.
pub(super) fn share(option: &'static str, word: &str) -> Result<Probability, ParseLinkError> {
    let bare = word.parse::<f64>().ok();
    let percent = bare.filter(|p| *p >= 1.0 || *p == 0.0);
    let percent = percent.or_else(|| number_with_unit(word, &[("%", 1.0)]));
    let percent = percent.filter(|p| (0.0..=100.0).contains(p));
    percent.map(|p| Probability::of(p / 100.0)).ok_or_else(|| {
        value(
            option,
            word,
            if bare.is_some_and(|p| p < 1.0) {
                "is it a fraction, or per cent as tc would read it? write 1%, or 0.01%"
            } else {
                "not a share from 0% to 100%: write for example 1%"
            },
        )
    })
}

pub(super) fn whole<T: FromStr>(option: &'static str, word: &str) -> Result<T, ParseLinkError> {
    word.parse()
        .map_err(|_| value(option, word, "not a whole number in its range"))
}
