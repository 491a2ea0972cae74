//! `rtnet dump` and `rtnet jitter`: what they tell of a lab, and that they send nothing.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use pcap_file::pcapng::{Block, PcapNgReader};
use serde_json::Value;
use tools::lab::enter::enter;
use tools::observe::decode::What;
use tools::observe::watch::{Watch, When};
use tools::report::histogram::SignedHistogram;

use crate::cell::status;
use crate::host::{is_sound, network, shared, skip, unique};
use crate::{rtnet, schema};

/// A lab that goes when the test is done with it.
struct Lab {
    name: String,
    is_up: bool,
}

impl Lab {
    fn up(what: &str, stations: &str) -> Self {
        let name = unique(what);
        let output = run(&["lab", "up", "--stations", stations, "--cycle", "2ms", "--name", &name]);
        assert!(output.status.success(), "{}", text(&output.stderr));
        Self { name, is_up: true }
    }

    fn status(&self) -> Value {
        status(&self.name)
    }

    /// Packets that the bridge itself has sent: an observer that sent anything would send it there.
    fn sent_by_bridge(&self) -> u64 {
        let status = self.status();
        let pid = u32::try_from(status["pid"].as_u64().unwrap()).unwrap();
        let namespace = status["bridge_namespace"].as_str().unwrap().to_owned();
        let bridge = format!("{}:", status["bridge"].as_str().unwrap());
        let counters = std::thread::spawn(move || {
            enter(pid, Path::new(&namespace)).unwrap();
            fs::read_to_string("/proc/thread-self/net/dev").unwrap()
        });
        let counters = counters.join().unwrap();
        let line = counters.lines().find_map(|line| line.trim().strip_prefix(&bridge)).expect("the bridge");
        // Eight figures of what it received come first; bytes, then packets.
        line.split_whitespace().nth(9).unwrap().parse().unwrap()
    }

    fn down(mut self) -> Value {
        self.is_up = false;
        let output = run(&["lab", "down", &self.name, "--json"]);
        let account = crate::schema::read(&output.stdout);
        assert!(is_sound(&self.name, output.status.code(), &account[0]["verdict"]), "{account:#}");
        account[0].clone()
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        if self.is_up {
            let _ = run(&["lab", "down", &self.name]);
        }
    }
}

fn run(arguments: &[&str]) -> Output {
    rtnet().args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[test]
fn observers_tell_of_a_lab_what_it_does_and_send_nothing() {
    let test = "observers_tell_of_a_lab_what_it_does_and_send_nothing";
    shared(test, || {
        let lab = Lab::up("observed", "3");
        let dir = tempfile::tempdir().unwrap();
        let (pcap, report) = (dir.path().join("frames.pcapng"), dir.path().join("jitter.json"));
        let sent = lab.sent_by_bridge();

        let dump = run(&["dump", "--lab", &lab.name, "-w", pcap.to_str().unwrap(), "--duration", "1s"]);
        assert_eq!(dump.status.code(), Some(0), "{}", text(&dump.stderr));
        assert!(dump.stdout.is_empty());
        let summary = text(&dump.stderr);
        assert!(
            summary.contains("data ") && summary.contains("sync ") && summary.contains("lost by the ring 0"),
            "{summary}"
        );

        let screen = run(&["dump", "--lab", &lab.name, "--count", "40"]);
        assert_eq!(screen.status.code(), Some(0), "{}", text(&screen.stderr));
        let screen = text(&screen.stdout);
        assert_eq!(screen.lines().count(), 40);
        assert!(screen.contains("sync cycle") && screen.contains("data station 2 slot 0 cycle"), "{screen}");

        let jitter =
            run(&["jitter", "--lab", &lab.name, "--duration", "1s", "--json", report.to_str().unwrap()]);
        assert_eq!(jitter.status.code(), Some(0), "{}", text(&jitter.stderr));
        assert!(text(&jitter.stdout).contains("slave2"), "{}", text(&jitter.stdout));
        let figures: Value = schema::read(fs::read(&report).unwrap());
        check_figures(&figures);

        assert_eq!(lab.sent_by_bridge(), sent, "nothing but stations' frames on the medium");
        let account = lab.down();
        assert_eq!((&account["unexplained"], &account["frames_lost"]), (&0.into(), &0.into()), "{account}");
        decoded_by_tshark(test, &pcap);
    });
}

/// A master and two slaves at 2 ms, for a second, on a host that may be busy.
fn check_figures(figures: &Value) {
    assert_eq!(figures["cycle_ns"], 2_000_000);
    assert_eq!(figures["dropped_by_ring"], 0);
    let slots = figures["slots"].as_array().unwrap();
    assert_eq!(slots.len(), 4, "syncs and three slots: {figures:#}");
    for slot in slots {
        let (frames, missed) = (slot["frames"].as_u64().unwrap(), slot["missed"].as_u64().unwrap());
        assert!((400..=560).contains(&(frames + missed)), "{slot}");
        // Less than the slot is long: nobody's frames are taken for somebody else's.
        assert!(slot["slot_error_ns"]["p50"].as_i64().unwrap().abs() < 300_000, "{slot}");
    }
    let count = |kind: &str| figures["kinds"][kind].as_u64().unwrap_or(0);
    assert_eq!(count("sync") + count("data"), figures["frames"].as_u64().unwrap(), "nothing else was sent");
}

/// What others read in the file: nanoseconds, comments, and only frames of stations.
fn decoded_by_tshark(test: &str, pcap: &Path) {
    let fields = ["-T", "fields", "-e", "frame.time_epoch", "-e", "frame.comment", "-e", "eth.src"];
    let Ok(output) = Command::new("tshark").arg("-r").arg(pcap).args(fields).output() else {
        return skip(test, "tshark is not installed: the capture is not read by others");
    };
    let decoded = text(&output.stdout);
    let lines: Vec<Vec<&str>> = decoded.lines().map(|line| line.split('\t').collect()).collect();
    assert!(lines.len() > 200, "{} frames", lines.len());
    let nanoseconds =
        |line: &&Vec<&str>| line[0].split_once('.').is_some_and(|(_, f)| f.len() == 9 && !f.ends_with("000"));
    assert!(lines.iter().filter(nanoseconds).count() > lines.len() / 2, "{}", lines[0][0]);
    assert!(lines.iter().all(|line| line[1].starts_with("cycle ") && line[1].contains(", slot error ")));
    assert!(lines.iter().any(|line| line[1].contains(", slot 0 of station 2, slot error ")));
    assert!(lines.iter().any(|line| line[1].contains(", sync, slot error ")));
    let stations = ["02:00:00:00:00:01", "02:00:00:00:00:02", "02:00:00:00:00:03"];
    assert!(lines.iter().all(|line| stations.contains(&line[2])), "only stations send");
    match Command::new("capinfos").arg(pcap).output() {
        Ok(output) => assert!(text(&output.stdout).contains("nanoseconds"), "{}", text(&output.stdout)),
        Err(_) => skip(test, "capinfos is not installed"),
    }
}

#[test]
fn ctrl_c_ends_a_dump_with_a_complete_file() {
    let test = "ctrl_c_ends_a_dump_with_a_complete_file";
    shared(test, || {
        let lab = Lab::up("interrupted", "2");
        let dir = tempfile::tempdir().unwrap();
        let pcap = dir.path().join("frames.pcapng");
        let mut command = rtnet();
        command.args(["dump", "--lab", &lab.name, "--write"]).arg(&pcap).stderr(Stdio::piped());
        let dump = command.spawn().unwrap();
        std::thread::sleep(Duration::from_millis(1_500));
        kill(Pid::from_raw(dump.id() as i32), Signal::SIGINT).unwrap();
        let output = dump.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        // It says how many, and so many are in the file.
        let summary = text(&output.stderr).replace(' ', "");
        let (_, rest) = summary.rsplit_once("rtnet:").unwrap();
        let frames: usize = rest.split_once("frames:").unwrap().0.parse().unwrap();
        assert!(frames > 100, "{summary}");
        let mut written = 0;
        each_frame(&pcap, |_, _| written += 1);
        assert_eq!(written, frames);
    });
}

#[test]
fn what_cannot_be_listened_to_is_named_with_a_remedy() {
    let refused = |arguments: &[&str], expected: &str| {
        let output = run(arguments);
        let message = text(&output.stderr);
        assert_eq!((output.status.code(), message.lines().count()), (Some(2), 1), "{message}");
        assert!(message.contains(expected), "{message}");
    };
    for verb in ["dump", "jitter"] {
        refused(&[verb, "--interface", "nosuch0"], "there is no interface 'nosuch0' here; there are: ");
        refused(&[verb, "--lab", "nosuch"], "there is no lab 'nosuch': ");
    }
    let dump = ["dump", "--interface", "nosuch0", "-w", "/nowhere/a.pcapng"];
    refused(&dump, "nosuch0");
}

#[test]
fn an_interface_without_a_master_is_told_to_be_silent() {
    use tools::lab::namespace::{Namespace, Segment};
    shared("an_interface_without_a_master_is_told_to_be_silent", || {
        let (namespace, mut segment) = (Namespace::new().unwrap(), Segment::new().unwrap());
        segment.attach(&namespace, "port0", "rt0", [2, 0, 0, 0, 0, 1]).unwrap();
        let mut command = rtnet();
        command.args(["jitter", "--interface", "rt0", "--duration", "100ms"]);
        let output = namespace.run(move || command.output()).unwrap().unwrap();
        assert_eq!(output.status.code(), Some(1));
        assert!(text(&output.stderr).contains("no sync was heard on rt0"), "{}", text(&output.stderr));
        assert!(text(&output.stdout).contains("0 frames"), "{}", text(&output.stdout));
    });
}

/// A lab knows its master's clock; an observer does not, and finds the same up to what the quickest of syncs
/// is late by.
#[test]
fn an_observer_that_knows_no_clock_finds_the_slot_errors_of_the_lab_that_does() {
    network("an_observer_that_knows_no_clock_finds_the_slot_errors_of_the_lab_that_does", || {
        let dir = tempfile::tempdir().unwrap();
        let (pcap, report) = (dir.path().join("frames.pcapng"), dir.path().join("report.json"));
        let mut lab = rtnet();
        lab.args(["lab", "run", "--stations", "3", "--cycle", "5ms", "--duration", "3s", "--pcap"])
            .arg(&pcap);
        let output = lab.arg("--json").arg(&report).output().unwrap();
        assert!(matches!(output.status.code(), Some(0 | 3 | 4)), "{}", text(&output.stdout));
        let truth: Value = schema::read(fs::read(&report).unwrap());

        let mut observed = vec![SignedHistogram::new(); 3];
        let mut watch = Watch::default();
        each_frame(&pcap, |at, bytes| {
            let sight = watch.frame(Some(at), bytes, bytes.len());
            if let (What::Data(tag), When::SlotError(error), true) =
                (sight.decoded.what, sight.when, watch.line.is_settled())
            {
                observed[tag.station()].record(error.nanos());
            }
        });
        assert_eq!(watch.line.restarts(), 0);
        for (station, observed) in observed.iter().enumerate() {
            let known = &truth["per_station"][station];
            let (known, seen) = (known["slot_error_ns"]["p50"].as_i64().unwrap(), observed.median());
            assert!(
                observed.len() > 300 && (seen - known).abs() < BIAS_NS,
                "station {station}: {seen}, not {known}"
            );
        }
        let master = &truth["per_station"][0]["clock_drift_ppb"];
        let drift = watch.line.drift_ppb().unwrap();
        assert!((drift - master.as_i64().unwrap()).abs() < 15_000, "{drift}, not {master}");
    });
}

/// So late a master may be, and often is, on a busy host.
const BIAS_NS: i64 = 25_000;

/// Every frame of a capture, with its time.
pub fn each_frame(pcap: &Path, mut f: impl FnMut(u64, &[u8])) {
    let mut reader = PcapNgReader::new(fs::File::open(pcap).unwrap()).unwrap();
    while let Some(block) = reader.next_block() {
        if let (Block::EnhancedPacket(packet), _) = block.expect("a whole block") {
            f(packet.timestamp.as_nanos() as u64, &packet.data);
        }
    }
}
