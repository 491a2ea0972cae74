//! Floods from Linux: the tunnel loses its own, real-time loses nothing.

use super::{MODES, Running, TUNNEL, assert_answers, done, lab, program, said, status, vnic};
use crate::cell::{Cell, STATIONS, json, wait_until};
use crate::host::{figure, network};
use crate::rtnet;

/// Ten times what the slots take, and more, of the largest datagrams.
const FLOOD: &str = "\
    exec 3<>/dev/udp/$0/9; printf -v datagram '%01467d' 0; \
    while :; do echo \"$datagram\"; done >&3 2>/dev/null";
/// A socket waits while so much of its own is in the queue as it may have there: only several are more than that takes.
const SOCKETS: usize = 3;
const SECONDS: u64 = 3;

fn flood(cell: &Cell, from: &str, ip: &str) -> [Running; SOCKETS] {
    [(); SOCKETS].map(|()| Running::start(program(cell, from, &["bash", "-c", FLOOD, ip])))
}

/// Bytes that Linux wanted to send by the device: those passed on, and those dropped before.
fn offered(cell: &Cell, station: &str) -> u64 {
    let shown = status(cell, station);
    let filter = |what: &str| shown["filter"][what].as_u64().unwrap();
    filter("packets") + filter("dropped")
}

#[test]
fn linux_floods_the_tunnel_and_real_time_loses_nothing() {
    let test = "linux_floods_the_tunnel_and_real_time_loses_nothing";
    network(test, || {
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
            let before = offered(&cell, "slave1");
            let received = |station| status(&cell, station)["counters"]["received"].as_u64().unwrap();
            let down = received("slave3");
            let floods =
                [("slave1", "10.1.0.4"), ("slave2", "10.1.0.1")].map(|(from, to)| flood(&cell, from, to));
            let cycles =
                || json(rtnet().args(["lab", "status", &cell.name, "--json"]))["cycles"].as_u64().unwrap();
            let until = cycles() + SECONDS * 1_000;
            wait_until("it goes on", || cycles() >= until);
            let (wanted, took) = (offered(&cell, "slave1") - before, received("slave3") - down);
            drop(floods);
            let shown = status(&cell, "slave3");
            let lost = shown["lost"]["device_down"].as_u64().unwrap_or(0);
            assert!(took > SECONDS * 500 && lost >= took, "what nobody reads is counted: {shown:#}");
            assert!(wanted > 10 * took, "a flood: {wanted} frames, of which {took} came");
            // It comes up again, and all is as before.
            done(vnic(&cell, "slave3", &["up"]));
            for (from, to) in [("slave2", "10.1.0.1"), ("slave3", "10.1.0.1")] {
                assert_answers(&cell, from, to);
            }
            let lab = cell.status();
            assert_eq!((&lab["unexplained"], &lab["overlaps"]), (&0.into(), &0.into()), "{lab:#}");
            let stations = lab["stations"].as_array().unwrap();
            assert_eq!(stations.len(), STATIONS.len());
            for station in stations {
                let [bad, lost] = ["payload_errors", "frames_lost"].map(|what| &station[what]);
                assert_eq!((bad, lost), (&0.into(), &0.into()), "{station:#}");
            }
            figure(
                test,
                &format!(
                    "{mode}: {wanted} frames for {took} turns; of {} real-time frames {} missed their slots, none is lost",
                    lab["frames_expected"], lab["slots_missed"]
                ),
            );
            cell.down();
        }
    });
}
