//! Durations and rates as people write them: `250us`, `1.5ms`, `10s`; `100M`, `1G`.

use std::str::FromStr;

use rtmac::tdma::schedule::Rate;
use rtnet::time::Span;
use serde::{Deserialize, Deserializer};

/// A text that is no duration or no rate.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UnitError {
    /// No number in front of the unit.
    #[error("'{0}' does not begin with a number: write for example {1}")]
    NoNumber(String, &'static str),
    /// No unit, or none that is known.
    #[error("'{0}' has no unit that is known here: write {1}")]
    Unit(String, &'static str),
    /// What keeps slots is told by another key.
    #[error(
        "'{0}' is no guard band, which is a time, as in 20us: what keeps the slots is slot_guard = \"{0}\""
    )]
    GuardBand(String),
    /// No share of a whole.
    #[error("'{0}' is no share: write for example 1% or 50ppm, at most 100%")]
    Share(String),
    /// Digits are set apart, or the decimals are.
    #[error(
        "'{0}' is not read as one number: write digits with a point before the decimals, and no ',' or '_', as in {1}"
    )]
    Digits(String, &'static str),
    /// The unit is known, in other letters.
    #[error("'{0}' has its unit in capitals: write {1}")]
    Capitals(String, &'static str),
    /// More than can be counted, or less than nothing where that makes no sense.
    #[error("'{0}' is out of range: {1}")]
    Range(String, &'static str),
    /// Not nothing, but none that is counted.
    #[error("'{0}' is less than 1ppm, the least there is: write 0% or 1ppm")]
    TooSmall(String),
}

const SPAN_EXAMPLE: &str = "250us";
const SPAN_UNITS: &str = "ns, us, ms, s or min, as in 250us";
const RATE_EXAMPLE: &str = "100M";
/// What a duration can be, in words.
const SPANS: &str = "it must be from -1000000000s to 1000000000s";
const POSITIVE: &str = "it must be more than 0s, and at most 1000000000s";
const NONNEGATIVE: &str = "it must be 0s or more, and at most 1000000000s";
const RATES: &str = "it must be at least 1 bit per second, and at most 1000000G";
const SHARE_EXAMPLE: &str = "1%";
const RATE_UNITS: &str = "k, M or G (bits per second), as in 100M";

/// A duration, `250us`; a leading minus is allowed.
pub fn parse_span(text: &str) -> Result<Span, UnitError> {
    parse_span_of(text, SPANS, |_| true)
}

/// A duration longer than nothing.
pub fn parse_positive_span(text: &str) -> Result<Span, UnitError> {
    parse_span_of(text, POSITIVE, |span| span > Span::ZERO)
}

/// A duration of any length but not before zero.
pub fn parse_nonnegative_span(text: &str) -> Result<Span, UnitError> {
    parse_span_of(text, NONNEGATIVE, |span| span >= Span::ZERO)
}

fn parse_span_of(
    text: &str,
    range: &'static str,
    is_in_range: impl Fn(Span) -> bool,
) -> Result<Span, UnitError> {
    let (number, unit) = split(text, SPAN_EXAMPLE)?;
    let scale = match (span_unit(unit), span_unit(&unit.to_lowercase())) {
        (Some(scale), _) => scale,
        (None, Some(_)) => return Err(UnitError::Capitals(text.into(), SPAN_UNITS)),
        (None, None) => return Err(UnitError::Unit(text.into(), SPAN_UNITS)),
    };
    let nanos = (number * scale).round();
    let span = Span::from_nanos(nanos as i64);
    let refuse = || UnitError::Range(text.into(), range);
    (nanos.abs() <= 1e18 && is_in_range(span)).then_some(span).ok_or_else(refuse)
}

/// Nanoseconds of a unit. Unicode has two letters for micro, the sign U+00B5 and the Greek U+03BC, which look the same.
fn span_unit(unit: &str) -> Option<f64> {
    match unit {
        "ns" => Some(1.0),
        "us" | "\u{b5}s" | "\u{3bc}s" => Some(1e3),
        "ms" => Some(1e6),
        "s" => Some(1e9),
        "min" => Some(60e9),
        _ => None,
    }
}

/// A guard band, `20us`: not what keeps slots, which others call so, too.
pub fn parse_guard_band(text: &str) -> Result<Span, UnitError> {
    match text {
        "auto" | "kernel" | "user" => Err(UnitError::GuardBand(text.into())),
        _ => parse_nonnegative_span(text),
    }
}

/// A rate, `100M`.
pub fn parse_rate(text: &str) -> Result<Rate, UnitError> {
    let (number, unit) = split(text, RATE_EXAMPLE)?;
    let scale = match unit {
        "k" => 1e3,
        "M" => 1e6,
        "G" => 1e9,
        _ => return Err(UnitError::Unit(text.into(), RATE_UNITS)),
    };
    let bits = (number * scale).round();
    if (1.0..=1e15).contains(&bits) {
        Ok(Rate::from_bits_per_second(bits as u64))
    } else {
        Err(UnitError::Range(text.into(), RATES))
    }
}

/// A share of a whole in parts per million: `1%`, `50ppm`.
pub fn parse_share(text: &str) -> Result<u32, UnitError> {
    let (number, unit) = split(text, SHARE_EXAMPLE)?;
    let scale = match unit {
        "%" => 1e4,
        "ppm" => 1.0,
        _ => return Err(UnitError::Share(text.into())),
    };
    let ppm = (number * scale).round();
    if number > 0.0 && ppm == 0.0 {
        return Err(UnitError::TooSmall(text.into()));
    }
    if (0.0..=1e6).contains(&ppm) { Ok(ppm as u32) } else { Err(UnitError::Share(text.into())) }
}

fn split<'a>(text: &'a str, example: &'static str) -> Result<(f64, &'a str), UnitError> {
    let text = text.trim();
    let end = text.find(|c: char| !(c.is_ascii_digit() || c == '.' || c == '-')).unwrap_or(text.len());
    let number = text[..end].parse().map_err(|_| UnitError::NoNumber(text.into(), example))?;
    if text[end..].starts_with([',', '_']) {
        return Err(UnitError::Digits(text.into(), example));
    }
    Ok((number, text[end..].trim_start()))
}

macro_rules! in_files {
    ($(#[doc = $doc:literal] $name:ident($inner:ty) by $parse:ident;)+) => {$(
        #[doc = $doc]
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub struct $name(pub $inner);

        impl FromStr for $name {
            type Err = UnitError;
            fn from_str(text: &str) -> Result<Self, UnitError> {
                $parse(text).map(Self)
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let text = String::deserialize(deserializer)?;
                text.parse().map_err(serde::de::Error::custom)
            }
        }
    )+};
}

in_files! {
    /// A duration in a file, possibly negative.
    AnySpan(Span) by parse_span;
    /// A duration in a file, longer than nothing.
    PositiveSpan(Span) by parse_positive_span;
    /// A duration in a file, not before zero.
    NonNegativeSpan(Span) by parse_nonnegative_span;
    /// A guard band in a file.
    GuardBand(Span) by parse_guard_band;
    /// A rate in a file.
    FileRate(Rate) by parse_rate;
    /// A share in a file, in parts per million.
    Share(u32) by parse_share;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_read_as_they_are_written() {
        for (text, nanos) in [
            ("250us", 250_000),
            ("1ms", 1_000_000),
            ("1.5ms", 1_500_000),
            ("10s", 10_000_000_000),
            ("-3 ns", -3),
            ("100 us", 100_000),
            ("100\u{b5}s", 100_000),
            ("100\u{3bc}s", 100_000),
            ("1.5 \u{3bc}s", 1_500),
        ] {
            assert_eq!(parse_span(text), Ok(Span::from_nanos(nanos)), "{text}");
        }
        assert_eq!(parse_span(&Span::from_micros(250).to_string()), Ok(Span::from_micros(250)));
    }

    #[test]
    fn what_is_no_duration_says_what_to_write() {
        let error = |text| parse_positive_span(text).unwrap_err().to_string();
        assert_eq!(
            error("10"),
            "'10' has no unit that is known here: write ns, us, ms, s or min, as in 250us"
        );
        assert_eq!(error("fast"), "'fast' does not begin with a number: write for example 250us");
        assert_eq!(
            error("1parsec"),
            "'1parsec' has no unit that is known here: write ns, us, ms, s or min, as in 250us"
        );
        assert_eq!(error("-1ms"), "'-1ms' is out of range: it must be more than 0s, and at most 1000000000s");
        let kernel = parse_guard_band("kernel").unwrap_err().to_string();
        assert!(kernel.ends_with("what keeps the slots is slot_guard = \"kernel\""), "{kernel}");
        assert_eq!(
            error("1e99s"),
            "'1e99s' has no unit that is known here: write ns, us, ms, s or min, as in 250us"
        );
    }

    #[test]
    fn units_in_capitals_and_commas_are_refused_with_the_remedy() {
        let error = |text| parse_span(text).unwrap_err().to_string();
        for text in ["100US", "1Ms", "2S", "100\u{b5}S", "100\u{39c}s"] {
            assert_eq!(
                error(text),
                format!("'{text}' has its unit in capitals: write ns, us, ms, s or min, as in 250us")
            );
        }
        for text in ["1,5ms", "1_000us", "1.000,5us"] {
            let expected = "is not read as one number: write digits with a point before the decimals, and no";
            assert!(error(text).contains(expected), "{}", error(text));
        }
        assert!(parse_rate("1,5G").unwrap_err().to_string().ends_with("as in 100M"));
    }

    #[test]
    fn shares_are_in_parts_per_million() {
        for (text, ppm) in [("1%", 10_000), ("0.5 %", 5_000), ("50ppm", 50), ("100%", 1_000_000), ("0%", 0)] {
            assert_eq!(parse_share(text), Ok(ppm), "{text}");
        }
        for text in ["101%", "-1%", "1", "0.1"] {
            let error = parse_share(text).unwrap_err().to_string();
            assert_eq!(error, format!("'{text}' is no share: write for example 1% or 50ppm, at most 100%"));
        }
        assert!(parse_share("some").unwrap_err().to_string().ends_with("write for example 1%"));
    }

    #[test]
    fn rates_are_in_bits_per_second() {
        assert_eq!(parse_rate("100M"), Ok(Rate::from_bits_per_second(100_000_000)));
        assert_eq!(parse_rate("2.5G"), Ok(Rate::from_bits_per_second(2_500_000_000)));
        assert!(parse_rate("0M").is_err() && parse_rate("100").is_err());
    }
}
