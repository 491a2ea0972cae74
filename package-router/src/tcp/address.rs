//! The address of a TCP router.

use core::fmt;
use core::net::SocketAddr;
use core::str::FromStr;

use serde::{Deserialize, Deserializer};

use super::config::PORT;

/// A host, by name or number, and a port.
///
/// ```
/// use package_router::tcp::address::Address;
///
/// let address: Address = "robot.local".parse()?;
/// assert_eq!(address.to_string(), "robot.local:2000");
/// assert!("robot.local:http".parse::<Address>().is_err());
/// # Ok::<(), package_router::tcp::address::NoAddress>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Address {
    /// The host.
    pub host: String,
    /// The port.
    pub port: u16,
}

/// Text that is no address of a router.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is no address of a router: write HOST or HOST:PORT, as 10.0.0.9:2000 or [fd00::9]:2000")]
pub struct NoAddress(String);

impl FromStr for Address {
    type Err = NoAddress;

    fn from_str(text: &str) -> Result<Self, NoAddress> {
        if let Ok(address) = text.parse::<SocketAddr>() {
            return Ok(Self { host: address.ip().to_string(), port: address.port() });
        }
        let no_address = || NoAddress(text.to_owned());
        let (host, port) = match text.split_once(':') {
            Some((host, port)) => (host, port.parse().ok().filter(|port| *port != 0).ok_or_else(no_address)?),
            None => (text, PORT),
        };
        match is_host_name(host) {
            true => Ok(Self { host: host.to_owned(), port }),
            false => Err(no_address()),
        }
    }
}

/// Whether text may be the name of a host.
pub fn is_host_name(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || "-._".contains(c))
}

impl<'de> Deserialize<'de> for Address {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        String::deserialize(from)?.parse().map_err(serde::de::Error::custom)
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.host.contains(':') {
            true => write!(f, "[{}]:{}", self.host, self.port),
            false => write!(f, "{}:{}", self.host, self.port),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_a_host_and_perhaps_a_port() {
        for (text, shown) in [
            ("10.0.0.9", "10.0.0.9:2000"),
            ("10.0.0.9:2001", "10.0.0.9:2001"),
            ("[fd00::9]:2000", "[fd00::9]:2000"),
            ("lab-1.example", "lab-1.example:2000"),
        ] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), shown);
        }
        for text in ["", ":2000", "host:", "host:0", "host:65536", "a:b:c", "fd00::9", "tcp://host", "a b"] {
            let error = text.parse::<Address>().unwrap_err().to_string();
            assert!(error.starts_with(&format!("'{text}' is no address")), "{error}");
        }
    }
}
