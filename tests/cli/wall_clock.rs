//! Somebody sets the wall clock while a lab runs. The kernel stamps frames by that clock; schedules are
//! not kept by it. This sets the clock of the machine for a second, so it must be asked for:
//! `RTNET_SET_CLOCK=1`. It is alone in this file: other tests would be told that the clock was set.

// A test of real processes waits for them.
#![allow(clippy::disallowed_methods)]

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use nix::sys::time::TimeSpec;
use nix::time::{ClockId, clock_gettime, clock_settime};
use pcap_file::pcapng::{Block, PcapNgReader};
use serde_json::Value;
use tools::station::traffic::Tag;

#[allow(dead_code)] // marks of other tests
#[path = "../src/aloud.rs"]
mod aloud;

const CYCLE_NS: i64 = 5_000_000;
/// Of three stations: whose frame is so far from where it was is not in its slot.
const SLOT_NS: i64 = 1_250_000;
const STEP: Duration = Duration::from_secs(1);

/// Sets the wall clock forth, and back again when dropped.
struct Stepped;

impl Stepped {
    fn now() -> nix::Result<Self> {
        set(|now| now + TimeSpec::from_duration(STEP)).map(|()| Stepped)
    }
}

impl Drop for Stepped {
    fn drop(&mut self) {
        set(|now| now - TimeSpec::from_duration(STEP)).expect("it could be set before");
    }
}

fn set(to: impl Fn(TimeSpec) -> TimeSpec) -> nix::Result<()> {
    clock_settime(ClockId::CLOCK_REALTIME, to(clock_gettime(ClockId::CLOCK_REALTIME)?))
}

/// Why the clock is not to be, or cannot be set.
fn why_not() -> Option<String> {
    if std::env::var("RTNET_SET_CLOCK").as_deref() != Ok("1") {
        return Some("sets the clock of this machine for a second: ask for it with RTNET_SET_CLOCK=1".into());
    }
    if !nix::unistd::geteuid().is_root() {
        return Some("needs root".into());
    }
    set(|now| now).err().map(|error| format!("the clock cannot be set here: {error}"))
}

#[test]
fn a_step_of_the_wall_clock_moves_no_frame() {
    if let Some(why) = why_not() {
        return aloud::skip("a_step_of_the_wall_clock_moves_no_frame", &why);
    }
    let dir = tempfile::tempdir().unwrap();
    let (json, pcap) = (dir.path().join("report.json"), dir.path().join("all.pcapng"));
    let mut lab = Command::new(env!("CARGO_BIN_EXE_rtnet"));
    lab.args(["lab", "run", "--stations", "3", "--cycle", "5ms", "--duration", "5s", "--json"]).arg(&json);
    lab.arg("--pcap").arg(&pcap);
    let mut lab = lab.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut progress = BufReader::new(lab.stderr.take().unwrap()).lines();
    assert!(progress.any(|line| line.unwrap().starts_with("rtnet: cycle")), "the network comes up");
    let stepped = Stepped::now().unwrap();
    std::thread::sleep(Duration::from_secs(1));
    drop(stepped);
    let screen = String::from_utf8(lab.wait_with_output().unwrap().stdout).unwrap();
    let report: Value = serde_json::from_slice(&std::fs::read(&json).unwrap()).unwrap();
    let reasons = report["verdict"]["reasons"].as_array().unwrap();
    let is_told = |why: &Value| why.as_str().unwrap().starts_with("the wall clock was set during the run");
    assert!(reasons.iter().any(is_told), "{screen}");
    assert_eq!(report["verdict"]["word"], "inconclusive", "{screen}");
    // Once forth and once back, seen by each station and by the observer.
    assert!(report["clock_steps"].as_u64().unwrap() >= 2 * (3 + 1), "{screen}");
    assert_eq!((&report["unexplained"], &report["frames_lost"]), (&0.into(), &0.into()), "{screen}");
    // The report does not judge what was stamped while the clock was set: the capture has it nonetheless.
    let told: u64 = report["causes"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum();
    let sent = sent(&pcap);
    for station in 0..3 {
        let own: Vec<&Sent> = sent.iter().filter(|sent| sent.station == station).collect();
        let (mut steps, mut missed) = (0, 0);
        for (before, after) in own.iter().zip(&own[1..]) {
            let cycles = i64::from(after.cycle.wrapping_sub(before.cycle) as i32);
            missed += cycles as u64 - 1;
            let moved = after.stamp - before.stamp - cycles * CYCLE_NS;
            let step = moved.abs() > SLOT_NS;
            steps += u32::from(step);
            let moved = if step { moved.abs() - STEP.as_nanos() as i64 } else { moved };
            assert!(moved.abs() < SLOT_NS, "station {station} moved by {moved} ns in cycle {}", after.cycle);
        }
        assert!(own.len() > 900 && missed <= told, "station {station}: {missed} of {} missed", own.len());
        assert_eq!(steps, 2, "forth and back, of the stamps only");
    }
}

/// A frame of test traffic.
struct Sent {
    station: usize,
    cycle: u32,
    /// By the wall clock.
    stamp: i64,
}

/// All of it, as it was captured.
fn sent(pcap: &Path) -> Vec<Sent> {
    let mut reader = PcapNgReader::new(File::open(pcap).unwrap()).unwrap();
    let mut sent = Vec::new();
    while let Some(block) = reader.next_block() {
        let (Block::EnhancedPacket(packet), _) = block.unwrap() else { continue };
        if let Some((tag, _)) = Tag::read(&packet.data) {
            let stamp = packet.timestamp.as_nanos() as i64;
            sent.push(Sent { station: tag.station(), cycle: tag.cycle(), stamp });
        }
    }
    sent
}
