//! What people do through it: connections at full speed, copies, downloads.

use std::fs::{self, File};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use super::{
    CYCLES_A_SECOND, MODES, MTU, PATIENCE, Running, TUNNEL, alone, are_there, assert_answers, bytes, lab,
    network, program, said, shared,
};
use crate::cell::{Cell, text};
use crate::host::{again, figure, skip};

/// Seven turns a cycle for who serves.
const DOWNLOAD: &str = include_str!("../download.toml");
const MASTER: &str = "10.1.0.1";
/// Bytes of a packet before what TCP carries, with its time stamps, and before what UDP carries.
const HEAD_OF_TCP: usize = 52;
const HEAD_OF_UDP: usize = 28;
/// Of a hundred datagrams that leave at half the speed of the slots. None is lost by the tunnel; the host may
/// stand still for longer than its queues hold.
const FEW: f64 = 5.0;
/// Who has many others on its cores waits for a turn there, not for one on the medium.
const TRIES: usize = 4;

fn iperf3(cell: &Cell, options: &[&str]) -> Value {
    let server = program(cell, "master", &["iperf3", "-s", "-1"]);
    let mut server = Running::server(cell, "master", 5201, quiet(server));
    let words = [&["iperf3", "-c", MASTER, "-t", "2", "-J"], options].concat();
    let report: Value = serde_json::from_str(&said(cell, "slave1", &words)).unwrap();
    server.ended(PATIENCE);
    report["end"].clone()
}

/// Goodput by TCP, and what the slots carried that the host did not let them miss meanwhile, in bits a second.
fn tcp(cell: &Cell, allowed: f64) -> (f64, f64) {
    let share_missed = |before: &Value, after: &Value| {
        let [expected, missed] = ["frames_expected", "slots_missed"]
            .map(|of| after[of].as_f64().unwrap() - before[of].as_f64().unwrap());
        missed / expected
    };
    let before = cell.status();
    let report = iperf3(cell, &[]);
    let missed = share_missed(&before, &cell.status());
    (report["sum_received"]["bits_per_second"].as_f64().unwrap(), allowed * (1.0 - missed))
}

fn quiet(mut command: Command) -> Command {
    command.stdout(Stdio::null());
    command
}

#[test]
fn iperf3_fills_the_slots_and_loses_nothing_below_them() {
    let test = "iperf3_fills_the_slots_and_loses_nothing_below_them";
    alone(test, || {
        if !are_there(test, &[("iperf3", "iperf3")]) {
            return;
        }
        for mode in MODES {
            let cell = lab("iperf", TUNNEL, mode);
            assert_answers(&cell, "slave1", MASTER);
            // A frame leaves in each cycle.
            let allowed = |head| (MTU - head) as f64 * 8.0 * CYCLES_A_SECOND as f64;
            let mut tries = Vec::new();
            while tries.last().is_none_or(|&(goodput, carried)| goodput * 2.0 < carried) {
                if let Some(last) = tries.last() {
                    again(test, &format!("{mode}: less than half of what slots carried: {last:?}"));
                }
                assert!(tries.len() < TRIES, "less than half of what slots carried, each time: {tries:?}");
                tries.push(tcp(&cell, allowed(HEAD_OF_TCP)));
            }
            let (goodput, carried) = tries[tries.len() - 1];
            let half = format!("{}", (allowed(HEAD_OF_UDP) / 2.0) as u64);
            let length = format!("{}", MTU - HEAD_OF_UDP);
            let udp = iperf3(&cell, &["-u", "-b", &half, "-l", &length]);
            let [sent, lost] = ["packets", "lost_packets"].map(|of| udp["sum"][of].as_f64().unwrap());
            assert!(sent > 0.0 && lost * 100.0 <= sent * FEW, "{sent} sent, {lost} lost");
            figure(
                test,
                &format!(
                    "{mode}: TCP {:.2} of the {:.2} Mbit/s that slots allow and the {:.2} that this host let them carry, \
                     at the {}. try; UDP at half of it lost {lost} of {sent}",
                    goodput / 1e6,
                    allowed(HEAD_OF_TCP) / 1e6,
                    carried / 1e6,
                    tries.len()
                ),
            );
            cell.down();
        }
    });
}

#[test]
fn nc_copies_every_byte() {
    let test = "nc_copies_every_byte";
    shared(test, || {
        let help = Command::new("nc").arg("-h").output();
        if !help.is_ok_and(|help| (text(&help.stdout) + &text(&help.stderr)).contains("OpenBSD")) {
            return skip(test, "no nc of OpenBSD: apt-get install netcat-openbsd");
        }
        let sent = bytes(1_000_000);
        let dir = tempfile::tempdir().unwrap();
        let (original, copy) = (dir.path().join("original"), dir.path().join("copy"));
        fs::write(&original, &sent).unwrap();
        for mode in MODES {
            let cell = lab("nc", TUNNEL, mode);
            assert_answers(&cell, "slave2", "10.1.0.4");
            let mut server = program(&cell, "slave3", &["nc", "-l", "4000"]);
            server.stdout(File::create(&copy).unwrap());
            let mut server = Running::server(&cell, "slave3", 4000, server);
            let began = Instant::now();
            let mut client = program(&cell, "slave2", &["nc", "-N", "10.1.0.4", "4000"]);
            client.stdin(File::open(&original).unwrap());
            Running::start(quiet(client)).ended(PATIENCE);
            server.ended(PATIENCE);
            let took = began.elapsed();
            let came = fs::read(&copy).unwrap();
            assert!(came == sent, "{} of {} bytes, or others", came.len(), sent.len());
            figure(test, &format!("{mode}: {} bytes in {:.1} s", came.len(), took.as_secs_f64()));
            cell.down();
        }
    });
}

/// How much is fetched: few in a suite; `scripts/accept vnic` by itself says more.
fn wanted() -> usize {
    let said = std::env::var("RTNET_VNIC_BYTES").ok();
    said.map_or(3_000_000, |said| said.parse().expect("RTNET_VNIC_BYTES is a number of bytes"))
}

fn sum(file: &std::path::Path) -> String {
    let output = Command::new("sha256sum").stdin(File::open(file).unwrap()).output().unwrap();
    assert!(output.status.success());
    text(&output.stdout)
}

#[test]
fn a_download_has_the_checksum_of_what_is_served() {
    let test = "a_download_has_the_checksum_of_what_is_served";
    network(test, || {
        let tools = [("python3", "python3"), ("curl", "curl"), ("sha256sum", "coreutils")];
        if !are_there(test, &tools) {
            return;
        }
        let dir = tempfile::tempdir().unwrap();
        let (file, came) = (dir.path().join("file"), dir.path().join("came"));
        fs::write(&file, bytes(wanted())).unwrap();
        // As slow as one turn in two milliseconds.
        let patience = PATIENCE + Duration::from_secs(wanted() as u64 / 500_000);
        for mode in MODES {
            let cell = lab("download", DOWNLOAD, mode);
            assert_answers(&cell, "slave1", MASTER);
            let (served, to) = (dir.path().to_str().unwrap(), came.to_str().unwrap());
            let serve = ["python3", "-m", "http.server", "8000", "--bind", MASTER, "--directory", served];
            let server = Running::server(&cell, "master", 8000, quiet(program(&cell, "master", &serve)));
            let began = Instant::now();
            let url = format!("http://{MASTER}:8000/file");
            let fetch = ["curl", "--fail", "--silent", "--show-error", "--output", to, &url];
            Running::start(program(&cell, "slave1", &fetch)).ended(patience);
            let took = began.elapsed().as_secs_f64();
            assert_eq!(sum(&came), sum(&file));
            let rate = wanted() as f64 / took / 1e6;
            figure(test, &format!("{mode}: {} bytes in {took:.1} s, {rate:.2} MB/s", wanted()));
            drop(server);
            assert_eq!(cell.down()["unexplained"], 0);
        }
    });
}
