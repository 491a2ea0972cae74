//! Captures of real networks: classic pcap files in `vectors/`.

use std::path::Path;

use pcap_file::pcap::PcapReader;
use rtnet::time::Instant;

/// One captured frame.
#[derive(Clone, Debug)]
pub struct Captured {
    /// As Wireshark counts them, from 1.
    pub number: usize,
    /// When the capturing host saw it, nanoseconds since 1970.
    pub at: Instant,
    /// From the destination address on.
    pub bytes: Vec<u8>,
}

/// Every frame of `vectors/NAME`, in order.
pub fn read(name: &str) -> Vec<Captured> {
    // Also the tests of the command, which are another package's, read them.
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/vectors").join(name);
    let file = std::fs::File::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let mut reader = PcapReader::new(file).expect("a pcap file");
    let mut frames = Vec::new();
    while let Some(packet) = reader.next_packet() {
        let packet = packet.expect("a whole record");
        let at = Instant::from_nanos(packet.timestamp().as_nanos() as u64);
        frames.push(Captured { number: frames.len() + 1, at, bytes: packet.data().to_vec() });
    }
    frames
}
