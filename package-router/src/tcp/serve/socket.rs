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

/// A TLS session has begun; with the proof that its client has to give, if any.
pub(super) struct Begun(pub Option<Proof>);

impl Socket {
    /// Nothing has come by it, nor left.
    pub fn new(stream: Stream, keys: Option<RouterKeys>) -> Self {
        Self { stream, keys, is_readable: false, is_ended: false, is_in_flight: false }
    }

    /// Begins its TLS session, as far as that goes without waiting.
    pub fn begin(&mut self) -> io::Result<Option<Begun>> {
        let Some(keys) = &self.keys else { return Ok(Some(Begun(None))) };
        if !self.stream.begin()? {
            return Ok(None);
        }
        let proof = self.stream.tls().map(|session| keys.proof(session)).transpose();
        let proof = proof.map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))?;
        self.keys = None;
        Ok(Some(Begun(proof.flatten())))
    }
}
