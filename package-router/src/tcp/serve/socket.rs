//! The socket of a connection.

use std::io;

use crate::tcp::control::Proof;
use crate::tcp::keys::RouterKeys;
use crate::tcp::stream::Stream;

/// The socket of a connection.
pub(super) struct Socket {
    pub stream: Stream,
    /// The keys of the router, as long as its TLS session has not begun.
    pub keys: Option<RouterKeys>,
    pub is_readable: bool,
    /// The peer has ended its side: reads go on until they say so.
    pub is_ended: bool,
    /// Packages may be in flight to it.
    pub is_in_flight: bool,
}

/// Whether a TLS session has begun.
pub(super) enum Begun {
    NotYet,
    /// Just now; with the proof that its client has to give, if any.
    Now(Option<Proof>),
    Before,
}

impl Socket {
    /// Nothing has come by it, nor left.
    pub fn new(stream: Stream, keys: Option<RouterKeys>) -> Self {
        Self { stream, keys, is_readable: false, is_ended: false, is_in_flight: false }
    }

    /// Begins its TLS session, if it has one, as far as that goes without waiting.
    pub fn begin(&mut self) -> io::Result<Begun> {
        let Some(keys) = &self.keys else { return Ok(Begun::Before) };
        if !self.stream.begin()? {
            return Ok(Begun::NotYet);
        }
        let proof = self.stream.tls().map(|session| keys.proof(session)).transpose();
        let proof = proof.map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))?;
        self.keys = None;
        Ok(Begun::Now(proof.flatten()))
    }
}
