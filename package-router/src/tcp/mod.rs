//! The TCP layer (paper 3.2): one router that clients of any language join by, with nothing but the bytes of packages.
//!
//! ```text
//! connection ─► frames ─► control: names, lifesigns      (to 0 from 0)
//!                   └───► table: name ─► connection ─► outgoing ─► connection
//! ```
//!
//! [`router`] has all rules and no socket: bytes go in, bytes are to be written. [`serve`] is its loop over sockets. [`client`] is the
//! other end, for the mailboxes of a broker.

pub mod address;
pub mod client;
pub mod config;
pub mod control;
mod dial;
pub mod frames;
pub mod keys;
pub mod outgoing;
mod requests;
pub mod router;
pub mod rules;
pub mod serve;
pub mod stream;
