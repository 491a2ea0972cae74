//! What Wireshark makes of tunnelled frames.

use std::process::Command;

use super::{MODES, TUNNEL, are_there, assert_answers, done, lab, said, shared};
use crate::cell::text;
use crate::host::figure;
use crate::rtnet;

const PINGS: usize = 5;

#[test]
fn tshark_decodes_tunnelled_frames_with_the_packet_inside() {
    let test = "tshark_decodes_tunnelled_frames_with_the_packet_inside";
    shared(test, || {
        if !are_there(test, &[("tshark", "tshark")]) {
            return;
        }
        for mode in MODES {
            let (cell, dir) = (lab("seen", TUNNEL, mode), tempfile::tempdir().unwrap());
            let pcap = dir.path().join("frames.pcapng");
            assert_answers(&cell, "slave1", "10.1.0.1");
            let mut dump = rtnet();
            dump.args(["dump", "--lab", &cell.name, "--duration", "2s", "--write"]).arg(&pcap);
            std::thread::scope(|scope| {
                let dump = scope.spawn(move || dump.output().unwrap());
                while !dump.is_finished() {
                    let count = PINGS.to_string();
                    said(&cell, "slave1", &["ping", "-c", &count, "-i", "0.1", "-W", "1", "10.1.0.1"]);
                }
                done(dump.join().unwrap());
            });
            let count = |filter: &str| {
                let output =
                    Command::new("tshark").arg("-r").arg(&pcap).args(["-Y", filter]).output().unwrap();
                text(&output.stdout).lines().count()
            };
            let [requests, replies] =
                ["icmp.type == 8", "icmp.type == 0"].map(|of| count(&format!("rtmac && {of}")));
            let malformed = count("_ws.malformed");
            figure(
                test,
                &format!(
                    "{mode}: {requests} echo requests and {replies} replies in RTmac frames, {malformed} malformed"
                ),
            );
            assert!(requests >= PINGS && replies >= PINGS, "{requests} {replies}");
            assert_eq!((malformed, count("icmp && !rtmac")), (0, 0));
            cell.down();
        }
    });
}
