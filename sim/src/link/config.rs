//! What a link is set to, and how a person writes it.

/// Settings of one direction; the default is a perfect wire.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkConfig {
    /// Constant part of the delay, s.
    pub delay_s: f64,
    /// Half-width of the uniform spread around the delay, s (netem without a distribution table).
    pub jitter_s: f64,
    /// Probability that a packet is lost, independently of the others.
    pub loss: f64,
    /// Rate of the bottleneck, bit/s; `None` is unlimited.
    pub rate_bit_s: Option<f64>,
    /// Packets that may be queued; the next one is dropped (netem's default is 1000).
    pub limit: usize,
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            delay_s: 0.0,
            jitter_s: 0.0,
            loss: 0.0,
            rate_bit_s: None,
            limit: 1000,
        }
    }
}

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
}

fn number_with_unit(text: &str, units: &[(&str, f64)]) -> Option<f64> {
    let text = text.trim().to_ascii_lowercase();
    let (number, factor) = units
        .iter()
        .find_map(|(unit, factor)| Some((text.strip_suffix(unit)?.to_owned(), *factor)))?;
    let value = number.trim().parse::<f64>().ok()? * factor;
    (value.is_finite() && value >= 0.0).then_some(value)
}

/// Seconds from `100ms`, `0.1s`, `250us`; a bare number is milliseconds (tc's is microseconds, but nobody means that).
///
/// # Errors
/// [`ParseLinkError::Duration`] for anything else, negative and non-finite numbers included.
pub fn parse_duration_s(text: &str) -> Result<f64, ParseLinkError> {
    number_with_unit(
        text,
        &[
            ("us", 1e-6),
            ("µs", 1e-6),
            ("ms", 1e-3),
            ("s", 1.0),
            ("", 1e-3),
        ],
    )
    .filter(|&s| s <= 3600.0)
    .ok_or_else(|| ParseLinkError::Duration(text.to_owned()))
}

/// A probability from `1%` or `0.01`.
///
/// # Errors
/// [`ParseLinkError::Probability`] for anything outside 0 to 100 %.
pub fn parse_probability(text: &str) -> Result<f64, ParseLinkError> {
    number_with_unit(text, &[("%", 0.01), ("", 1.0)])
        .filter(|&p| p <= 1.0)
        .ok_or_else(|| ParseLinkError::Probability(text.to_owned()))
}

/// Bits per second from `64kbit`, `1mbit`, `2gbit` or a bare number.
///
/// # Errors
/// [`ParseLinkError::Rate`] for anything else, and for zero.
pub fn parse_rate_bit_s(text: &str) -> Result<f64, ParseLinkError> {
    number_with_unit(
        text,
        &[
            ("kbit", 1e3),
            ("mbit", 1e6),
            ("gbit", 1e9),
            ("bit", 1.0),
            ("", 1.0),
        ],
    )
    .filter(|&r| r > 0.0)
    .ok_or_else(|| ParseLinkError::Rate(text.to_owned()))
}
