//! The TCP layer (paper 3.2): one router that clients of any language join by, with nothing but the bytes of packages.
//!
//! ```text
//! connection ─► frames ─► control: names, lifesigns      (to 0 from 0)
//!                   └───► table: name ─► connection ─► outgoing ─► connection
//! ```
//!
//! [`router`] has all rules and no socket: bytes go in, bytes are to be written. [`serve`] is its loop over sockets. [`client`] is the
//! other end, for the mailboxes of a broker.

pub mod account;
pub mod address;
pub mod client;
pub mod config;
pub mod control;
mod dial;
pub mod frames;
pub mod keys;
mod numbers;
pub mod outgoing;
mod requests;
pub mod router;
pub mod rules;
pub mod serve;
pub mod stream;

/// Bytes that are written as in the reference, for tests.
#[cfg(test)]
fn hex(text: &str) -> Vec<u8> {
    let digits: String = text.split_whitespace().collect();
    (0..digits.len()).step_by(2).map(|at| u8::from_str_radix(&digits[at..at + 2], 16).unwrap()).collect()
}
