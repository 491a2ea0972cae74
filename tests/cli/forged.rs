//! What somebody forges beside a lab's station makes no figure larger than time has passed.

use std::fs::File;
use std::os::fd::AsRawFd;
use std::time::Instant;

use nix::ifaddrs::getifaddrs;
use nix::sched::{CloneFlags, setns};
use nix::sys::socket::{MsgFlags, sendto};
use rtmac::wire::Message;
use rtnet::buf::Pool;
use rtnet::time::GlobalTime;
use rtnet::wire::ethernet::Address;
use serde_json::Value;
use socket2::{Domain, Socket, Type};

use crate::cell::{Cell, STATIONS, wait_until};
use crate::host::network;

/// Of the cell, in milliseconds.
const CYCLE_MS: u64 = 4;
const STRANGER: Address = Address([2, 0, 0, 0, 9, 9]);
/// How far ahead the numbers of forged Synchronisations are.
const AHEAD: [u32; 4] = [1 << 20, 1 << 25, 1 << 29, 1 << 30];

/// Sends Synchronisations of these cycles from beside a station.
fn forge(status: &Value, from: Address, cycles: impl Iterator<Item = u32> + Send) {
    let namespace = format!("/proc/{}/ns/net", status["stations"][1]["pid"]);
    std::thread::scope(|scope| {
        scope.spawn(move || {
            setns(File::open(namespace).unwrap(), CloneFlags::CLONE_NEWNET).unwrap();
            let socket = Socket::new(Domain::PACKET, Type::RAW, None).unwrap();
            let found = getifaddrs().unwrap().find(|found| found.interface_name == "rt0");
            let link = *found.unwrap().address.unwrap().as_link_addr().unwrap();
            for cycle in cycles {
                let (sched, mut frame) = (GlobalTime::from_nanos(7), Pool::new(1).take().unwrap());
                Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, from, &mut frame);
                sendto(socket.as_raw_fd(), &frame, &link, MsgFlags::empty()).unwrap();
            }
        });
    });
}

#[test]
fn forged_syncs_are_counted_and_miss_no_cycles() {
    network("forged_syncs_are_counted_and_miss_no_cycles", || {
        let begun = Instant::now();
        // The kernel guard would let nothing of that out.
        let cell = Cell::with("forged", |text| format!("slot_guard = \"user\"\n{text}"));
        let status = cell.status();
        let current = status["cycles"].as_u64().unwrap() as u32;
        let master: Address = status["stations"][0]["address"].as_str().unwrap().parse().unwrap();
        for from in [master, STRANGER] {
            // Wherever the count of cycles stands, one of two numbers that are 2^31 apart is ahead of it.
            let ahead = AHEAD.into_iter().map(|by| current.wrapping_add(by));
            forge(&status, from, ahead.flat_map(|cycle| [cycle, cycle.wrapping_add(1 << 31)]));
        }
        let forged = 2 * 2 * AHEAD.len() as u64;
        let counted = |status: &Value| {
            let reasons = status["implausible_syncs"].as_object().unwrap();
            reasons.values().map(|n| n.as_u64().unwrap()).sum::<u64>()
        };
        wait_until("they are counted", || counted(&cell.status()) >= forged);
        let status = cell.status();
        let passed = begun.elapsed().as_millis() as u64 / CYCLE_MS + 1;
        let of = |key: &str| status[key].as_u64().unwrap();
        assert!(of("cycles") <= passed, "{status:#}");
        assert!(of("syncs_missing") <= passed, "{status:#}");
        assert!(of("frames_expected") <= passed * STATIONS.len() as u64, "{status:#}");
        // Each is one frame out of its slot, and may overlap two; whatever the host does besides is missed once.
        assert!(of("unexplained") <= 3 * forged + passed * (STATIONS.len() as u64 + 1), "{status:#}");
    });
}
