//! Captures of virtual time: classic pcap with nanoseconds, which every Wireshark reads.

use crate::clock::True;

const MAGIC_NANOSECONDS: u32 = 0xa1b2_3c4d;
const ETHERNET: u32 = 1;
const SNAP_LEN: u32 = 65_535;

/// A capture file in memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Capture {
    bytes: Vec<u8>,
}

impl Capture {
    /// An empty capture.
    pub fn new() -> Self {
        let mut bytes = Vec::new();
        bytes.extend(MAGIC_NANOSECONDS.to_le_bytes());
        // Version 2.4, time zone 0, accuracy 0.
        bytes.extend([2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        bytes.extend(SNAP_LEN.to_le_bytes());
        bytes.extend(ETHERNET.to_le_bytes());
        Self { bytes }
    }

    /// Appends a frame.
    pub fn frame(&mut self, at: True, frame: &[u8]) {
        let len = frame.len() as u32;
        for word in [(at / 1_000_000_000) as u32, (at % 1_000_000_000) as u32, len, len] {
            self.bytes.extend(word.to_le_bytes());
        }
        self.bytes.extend_from_slice(frame);
    }

    /// The file.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }
}

impl Default for Capture {
    fn default() -> Self {
        Self::new()
    }
}
