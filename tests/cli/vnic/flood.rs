//! Floods from Linux: the tunnel loses its own, real-time loses nothing.
//!
//! Live, whoever does not read is Linux: a program that never reads the sockets that are flooded, and a device that was set
//! down. That the thread between device and tunnel stands still itself cannot be had live without stopping its station; in
//! virtual time it does (`tunnel_never_delays_rt.rs`: a Linux that never reads), where no real-time frame moves by a
//! nanosecond. Live real-time frames are held against as long a while without a flood, by what no host decides.

use std::collections::BTreeMap;
use std::net::UdpSocket;
use std::path::PathBuf;

use rtnet::live::interface::Interface;
use serde_json::Value;
use tools::lab::enter::enter;

use super::{
    CYCLES_A_SECOND, EVERY, MODES, Running, TUNNEL, alone, assert_answers, done, lab, program, said, status,
    vnic,
};
use crate::bare::Bare;
use crate::cell::{Cell, STATIONS, wait_until};
use crate::host::figure;

/// Many times what the slots take, of the largest datagrams.
const FLOOD: &str = "\
    exec 3<>/dev/udp/$0/9; printf -v datagram '%01467d' 0; \
    while :; do echo \"$datagram\"; done >&3 2>/dev/null";
/// Where it goes.
const PORT: u16 = 9;
/// A socket waits while so much of its own is in the queue as it may have there: only several are more than that takes.
const SOCKETS: usize = 3;
const SECONDS: u64 = 2;
/// Those of four stations in each cycle.
const SLOTS: u64 = 8;
/// What stations refuse of their own calibration, which they do anew after a host that stood still.
const OF_THE_HOST: [&str; 4] = ["unexpected_reply", "implausible_reply", "reply_overdue", "not_master"];

fn flood(cell: &Cell, from: &str, ip: &str) -> [Running; SOCKETS] {
    [(); SOCKETS].map(|()| Running::start(program(cell, from, &["bash", "-c", FLOOD, ip])))
}

/// What Linux wanted to send by the device: packets passed on, and those dropped before.
fn offered(cell: &Cell, station: &str) -> [u64; 2] {
    let shown = status(cell, station);
    ["packets", "dropped"].map(|what| shown["filter"][what].as_u64().unwrap())
}

/// Sockets of a program in a station's namespace, which are never read: one that is flooded, and one for each frame of an
/// Ethernet device.
fn never_read(cell: &Cell, station: &str, ip: &str) -> (UdpSocket, Option<Bare>) {
    let pid = of(&cell.status(), station)["pid"].as_u64().unwrap() as u32;
    let open = || {
        enter(pid, &PathBuf::from(format!("/proc/{pid}/ns/net"))).unwrap();
        // Of IP only, it is none.
        let device = Interface::find("vnic0").ok();
        (UdpSocket::bind((ip, PORT)).unwrap(), device.map(|device| Bare::hearing(&device, EVERY).unwrap()))
    };
    // The thread that has moved there ends there.
    std::thread::scope(|scope| scope.spawn(open).join().unwrap())
}

/// Datagrams that found the socket full.
fn dropped_by_socket(cell: &Cell, station: &str) -> u64 {
    let all = said(cell, station, &["cat", "/proc/net/udp"]);
    let line =
        all.lines().find(|line| line.contains(&format!(":{PORT:04X} 00000000:0000"))).expect("it is there");
    line.split_whitespace().last().unwrap().parse().unwrap()
}

fn of<'a>(lab: &'a Value, station: &str) -> &'a Value {
    lab["stations"].as_array().unwrap().iter().find(|one| one["name"] == station).unwrap()
}

/// Slots of a station that had no frame.
fn missed(cell: &Cell, station: &str) -> u64 {
    of(&cell.status(), station)["slots_missed"].as_u64().unwrap()
}

/// What is told of real-time frames.
struct Told {
    cycles: u64,
    slots: u64,
    missed: u64,
    /// What no host causes.
    faults: BTreeMap<String, u64>,
}

impl Told {
    fn of(lab: &Value) -> Self {
        let count = |of: &Value| of.as_u64().unwrap();
        let all = ["unexplained", "overlaps"].map(|what| (what.to_owned(), count(&lab[what])));
        let mut faults = BTreeMap::from(all);
        let stations = lab["stations"].as_array().unwrap();
        assert_eq!(stations.len(), STATIONS.len());
        for station in stations {
            let name = station["name"].as_str().unwrap();
            for what in ["payload_errors", "frames_lost"] {
                faults.insert(format!("{name}: {what}"), count(&station[what]));
            }
            let refused = station["refusals"].as_object().unwrap();
            for (why, n) in refused.iter().filter(|(why, _)| !OF_THE_HOST.contains(&why.as_str())) {
                faults.insert(format!("{name}: refused, {why}"), count(n));
            }
        }
        let [cycles, slots, missed] =
            ["cycles", "frames_expected", "slots_missed"].map(|what| count(&lab[what]));
        Self { cycles, slots, missed, faults }
    }

    /// What became of real-time frames while this was done: no fault, and each slot of each cycle had its frame, or was
    /// missed.
    fn meanwhile(cell: &Cell, body: impl FnOnce()) -> Self {
        let before = Self::of(&cell.status());
        body();
        let after = Self::of(&cell.status());
        assert_eq!(before.faults, after.faults);
        let [cycles, slots, missed] =
            [after.cycles - before.cycles, after.slots - before.slots, after.missed - before.missed];
        // The cycle that runs is told of in part.
        assert!(slots.abs_diff(cycles * SLOTS) <= 2 * SLOTS, "{slots} slots in {cycles} cycles");
        Self { cycles, slots, missed, faults: after.faults }
    }
}

/// Waits for as many cycles as a flood lasts.
fn for_a_while(cell: &Cell) {
    let cycles = || cell.status()["cycles"].as_u64().unwrap();
    let until = cycles() + SECONDS * CYCLES_A_SECOND;
    wait_until("it goes on", || cycles() >= until);
}

#[test]
fn linux_floods_the_tunnel_and_real_time_loses_nothing() {
    let test = "linux_floods_the_tunnel_and_real_time_loses_nothing";
    alone(test, || {
        for mode in MODES {
            let cell = lab("flood", TUNNEL, mode);
            assert_answers(&cell, "slave1", "10.1.0.4");
            assert_answers(&cell, "slave2", "10.1.0.1");
            if mode == "tap" {
                // Nobody answers there when it is asked.
                let words = "ip neigh replace 10.1.0.4 lladdr 02:00:00:00:00:04 dev vnic0 nud permanent";
                said(&cell, "slave1", &words.split(' ').collect::<Vec<_>>());
            }
            done(vnic(&cell, "slave3", &["down"]));
            let unread_sockets = never_read(&cell, "master", "10.1.0.1");
            assert_eq!(unread_sockets.1.is_some(), mode == "tap");
            let idle = Told::meanwhile(&cell, || for_a_while(&cell));
            let before = offered(&cell, "slave1");
            let received = |station| status(&cell, station)["counters"]["received"].as_u64().unwrap();
            let [down, unread] = ["slave3", "master"].map(received);
            let mut turns = [0; 2];
            let flooded = Told::meanwhile(&cell, || {
                let _floods =
                    [("slave1", "10.1.0.4"), ("slave2", "10.1.0.1")].map(|(from, to)| flood(&cell, from, to));
                wait_until("both come", || {
                    received("slave3") > down + 10 && received("master") > unread + 10
                });
                let missed = || ["slave1", "slave2"].map(|from| missed(&cell, from));
                let (begun, before) = (["slave3", "master"].map(received), missed());
                for_a_while(&cell);
                // Each cycle had a turn for each of them, which carried a frame or was missed.
                let (came, after) = (["slave3", "master"].map(received), missed());
                turns = [0, 1].map(|n| came[n] - begun[n] + after[n] - before[n]);
            });
            let [passed, dropped] = [0, 1].map(|n| offered(&cell, "slave1")[n] - before[n]);
            let (wanted, took) = (passed + dropped, received("slave3") - down);
            let shown = status(&cell, "slave3");
            let lost = shown["lost"]["device_down"].as_u64().unwrap_or(0);
            assert!(
                turns[0] >= SECONDS * CYCLES_A_SECOND && lost >= took,
                "what a device that is down gets is counted: {shown:#}"
            );
            assert!(dropped > 0 && wanted > took, "a flood: {wanted} frames, {dropped} dropped, {took} came");
            // Its tunnel goes on: Linux drops what finds no room where nobody reads.
            let (came, full) = (received("master") - unread, dropped_by_socket(&cell, "master"));
            assert!(turns[1] >= SECONDS * CYCLES_A_SECOND && full > 0, "{came} came, {full} found no room");
            drop(unread_sockets);
            // It comes up again, and all is as before.
            done(vnic(&cell, "slave3", &["up"]));
            for (from, to) in [("slave2", "10.1.0.1"), ("slave3", "10.1.0.1")] {
                assert_answers(&cell, from, to);
            }
            // Whether all reached their receivers, before and meanwhile, is judged at the end.
            let account = Told::of(&cell.down());
            assert!(account.faults.values().all(|&n| n == 0), "{:?}", account.faults);
            figure(
                test,
                &format!(
                    "{mode}: {wanted} frames, {:.1} for each of {took} turns; {came} to who never reads, {full} of \
                     them found no room; real-time frames that missed their slots: {} of {} with, {} of {} without; \
                     none is lost",
                    wanted as f64 / took as f64,
                    flooded.missed,
                    flooded.slots,
                    idle.missed,
                    idle.slots
                ),
            );
        }
    });
}
