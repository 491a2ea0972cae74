//! Frames that somebody forges on a lab's medium: no figure grows by more than what was sent.

use std::fs::File;
use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use nix::sched::{CloneFlags, setns};
use rtnet::live::interface::Interface;
use rtnet::wire::ethernet::EtherType;
use serde_json::Value;
use tools::lab::netlink::Netlink;

use crate::bare::Bare;
use crate::cell::{Cell, wait_until};
use crate::host::shared;
use crate::rtnet;

/// A sync's bytes: version 2.1 of TDMA, message 0.
const SYNC: (std::ops::Range<usize>, [u8; 4]) = (18..22, [2, 1, 0, 0]);
const SENDER: std::ops::Range<usize> = 6..12;
const CYCLE: std::ops::Range<usize> = 22..26;
/// A station that the network does not have.
const STRANGER: [u8; 6] = [2, 0, 0, 0, 0, 0x66];
/// Copies of each kind.
const COPIES: u64 = 5;

/// What is changed in a sync's copy.
type Change = fn(&mut [u8]);

/// The kinds of forged syncs, as the lab calls them.
const KINDS: [(&str, Change); 3] = [
    ("cycle_ahead", |sync| shift_cycle(sync, 1 << 30)),
    ("cycle_behind", |sync| shift_cycle(sync, 1_000u32.wrapping_neg())),
    ("stranger", |sync| sync[SENDER].copy_from_slice(&STRANGER)),
];

fn shift_cycle(sync: &mut [u8], by: u32) {
    let number: [u8; 4] = sync[CYCLE].try_into().unwrap();
    sync[CYCLE].copy_from_slice(&u32::from_be_bytes(number).wrapping_add(by).to_be_bytes());
}

/// Sends changed copies of true syncs to all stations, from a port of the bridge.
fn forge(cell: &Cell) {
    let namespace = cell.status()["bridge_namespace"].as_str().unwrap().to_owned();
    let send = || {
        let namespace = File::open(namespace).unwrap();
        setns(&namespace, CloneFlags::CLONE_NEWNET).unwrap();
        let mut netlink = Netlink::open().unwrap();
        let bridge = netlink.link_index("br0").unwrap();
        netlink.add_veth("forger", bridge, "forge", STRANGER, namespace.as_fd()).unwrap();
        let port = netlink.link_index("forger").unwrap();
        netlink.disable_learning(port).unwrap();
        for end in [port, netlink.link_index("forge").unwrap()] {
            netlink.set_up(end).unwrap();
        }
        let wire = Bare::hearing(&Interface::find("forge").unwrap(), EtherType::RTMAC).unwrap();
        for _ in 0..COPIES {
            for (_, change) in KINDS {
                let mut sync = next_sync(&wire);
                change(&mut sync);
                assert!(wire.send(&sync));
            }
        }
    };
    // The thread that has moved there ends there.
    std::thread::scope(|scope| scope.spawn(send).join().unwrap());
}

/// The next sync of the network, not one that was forged before.
fn next_sync(bridge: &Bare) -> Vec<u8> {
    let mut frame = [0; 1_600];
    while bridge.receive(&mut frame).is_some() {}
    let deadline = Instant::now() + Duration::from_secs(60);
    loop {
        assert!(Instant::now() < deadline, "no sync comes");
        match bridge.receive(&mut frame) {
            Some(length) if length >= 60 && frame[SYNC.0] == SYNC.1 => return frame[..length].to_vec(),
            Some(_) => {}
            None => std::thread::sleep(Duration::from_micros(200)),
        }
    }
}

#[test]
fn forged_syncs_add_no_more_to_any_figure_than_was_sent() {
    shared("forged_syncs_add_no_more_to_any_figure_than_was_sent", || {
        let cell = Cell::up("forged");
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(100));
        forge(&cell);
        let doubted = |status: &Value, kind: &str| status["implausible_syncs"][kind].as_u64();
        wait_until("all of them were seen", || {
            let status = cell.status();
            KINDS.iter().all(|(kind, _)| doubted(&status, kind) >= Some(COPIES))
        });
        let status = cell.status();
        KINDS.iter().for_each(|(kind, _)| assert_eq!(doubted(&status, kind), Some(COPIES), "{status:#}"));
        let count = |of: &Value, what: &str| of[what].as_u64().unwrap();
        // A cycle takes 4 ms; the lab was up for less than a second more than it says.
        let cycles = (count(&status, "up_seconds") + 1) * 250;
        assert!(count(&status, "cycles") <= cycles, "{status:#}");
        let forged = COPIES * KINDS.len() as u64;
        for what in ["unexplained", "overlaps", "out_of_slot"] {
            assert!(count(&status, what) <= forged, "{what}: {status:#}");
        }
        for station in status["stations"].as_array().unwrap() {
            assert!(count(station, "frames_seen") + count(station, "slots_missed") <= cycles, "{station:#}");
            assert_eq!(station["state"], "locked", "{station:#}");
        }
        let output = rtnet().args(["lab", "down", &cell.name]).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "frames out of slot that nobody can explain: NOT OK");
    });
}
