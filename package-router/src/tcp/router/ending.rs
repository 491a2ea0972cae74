//! Why a connection was closed.

use std::io;

use super::LIFESIGN_EVERY;
use crate::wire::HeadError;

/// Why a connection was closed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Ending {
    /// The other end has closed it.
    #[error("closed at the other end")]
    Left,
    /// The client did not answer for a whole round.
    #[error("no sign of life for {} s", LIFESIGN_EVERY / 1_000)]
    Silent,
    /// It did not prove that it knows the secret: its first package was another, or the proof was wrong.
    #[error("it has no certificate, and did not prove that it knows the secret")]
    Stranger,
    /// The router at the other end of a link is of the same system, or does not take links.
    #[error(
        "the router there takes no link of this system: it has the same number (`system`), or is of another make"
    )]
    SameSystem,
    /// Its certificate is not valid here, or it has none where one is needed.
    #[error("TLS: {0}")]
    Certificate(String),
    /// Its TLS session did not begin, or broke.
    #[error("TLS: {0}")]
    Tls(String),
    /// A newer connection took its place among those that have not proved yet that they may come.
    #[error("it had not proved yet that it may come, and a newer connection took its place")]
    Crowded,
    /// As many connections were open as may be.
    #[error("as many connections are open here as may be (limits.connections)")]
    TooMany,
    /// It held the most memory when the router had none left.
    #[error("it held the most bytes when the router held as many as it may (limits.memory)")]
    NoMemory,
    /// It sent bytes that are no package.
    #[error("{0}")]
    NoPackage(#[from] HeadError),
    /// The kernel's error number.
    #[error("{}", io::Error::from_raw_os_error(*.0))]
    Broken(i32),
}

impl Ending {
    /// All reasons by which connections that were closed are counted.
    pub const REASONS: [&'static str; 12] = [
        "left",
        "silent",
        "stranger",
        "same_system",
        "certificate",
        "tls",
        "crowded",
        "too_many",
        "no_memory",
        "too_short",
        "too_long",
        "broken",
    ];

    /// The one of [`REASONS`](Self::REASONS) by which it is counted.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Left => "left",
            Self::Silent => "silent",
            Self::Stranger => "stranger",
            Self::SameSystem => "same_system",
            Self::Certificate(_) => "certificate",
            Self::Tls(_) => "tls",
            Self::Crowded => "crowded",
            Self::TooMany => "too_many",
            Self::NoMemory => "no_memory",
            Self::NoPackage(HeadError::LenAboveMost { .. }) => "too_long",
            Self::NoPackage(HeadError::LenBelowHead { .. } | HeadError::TooShort { .. }) => "too_short",
            Self::Broken(_) => "broken",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn each_ending_is_counted_by_a_reason_of_its_own() {
        let too_long = HeadError::LenAboveMost { len: 1 << 20 };
        let endings = [
            Ending::Left,
            Ending::Silent,
            Ending::Stranger,
            Ending::SameSystem,
            Ending::Certificate("of another".into()),
            Ending::Tls("an alert".into()),
            Ending::Crowded,
            Ending::TooMany,
            Ending::NoMemory,
            HeadError::LenBelowHead { len: 3 }.into(),
            too_long.into(),
            Ending::Broken(5),
        ];
        let reasons: BTreeSet<_> = endings.iter().map(Ending::reason).collect();
        assert_eq!(reasons, Ending::REASONS.into());
    }
}
