//! Labs whose programs ask how old a package is, and where the time went.

use std::process::Command;
use std::time::Duration;

use package_router::component::{Component, Mailbox};
use package_router::journey::Journey;
use package_router::mailbox::Shape;
use rtnet::time::{GlobalTime, Span};
use serde_json::Value;

use crate::cell::{Cell, text};
use crate::host::{figure, shared, skip};
use crate::packages::{PATIENCE, ROUTES, component, lab_of, name};
use crate::rtnet;

const PACKAGES: u8 = 60;
const CYCLE: Span = Span::from_millis(2);
/// How far two stations' clocks may be apart on a host that others use, too.
const APART: Span = Span::from_millis(1);
/// The rest of a frame that takes all of a slot.
const FULL: usize = 1_456;

/// What the station of 0.Camera.0 sends there, now and then in two frames, each sent when the last one has come.
fn journeys(cell: &Cell) -> Vec<(usize, Journey)> {
    let pilot = Component::named(&cell.place("master")).unwrap();
    let (times, mut pilot) =
        (pilot.times(), pilot.mailbox(name("0.Pilot.0"), Shape::new(16, 2_000)).unwrap());
    let camera: Mailbox = component(cell, "arm", "0.Camera.0");
    let mut way = camera.sender(pilot.name()).unwrap();
    let send_and_receive = |n: u8| {
        let len = [10, 101, 1_800, FULL][usize::from(n % 4)];
        way.send(21, &vec![n; len]).unwrap();
        let package = pilot.receive(Some(PATIENCE)).unwrap();
        assert_eq!(package.body().to_vec(), vec![n; len]);
        (len, times.journey(&package))
    };
    (0..PACKAGES).map(send_and_receive).collect()
}

#[test]
fn a_package_from_another_station_tells_how_old_it_is_and_where_the_time_went() {
    shared("a_package_from_another_station_tells_how_old_it_is_and_where_the_time_went", || {
        let cell = lab_of("ages", ROUTES, "");
        let all = journeys(&cell);
        let mut ages = Vec::new();
        for (len, journey) in &all {
            let [came, delivered, received] =
                [journey.came, journey.delivered, journey.received].map(Option::unwrap);
            assert!(came < delivered + APART && delivered <= received, "{journey:?}");
            // A frame that is full has no room to say more, and times never take another.
            if *len == FULL {
                assert_eq!((journey.age(), journey.left), (None, None));
                continue;
            }
            let [sent, left] = [journey.sent, journey.left].map(Option::unwrap);
            assert!(sent < left && left < came + APART, "{journey:?}");
            let parts = [journey.slot_wait(), journey.wire(), journey.router(), Some(received - delivered)];
            let sum: i64 = parts.into_iter().flatten().map(Span::nanos).sum();
            assert_eq!(journey.age().unwrap().nanos(), sum);
            ages.push(journey.age().unwrap());
        }
        assert_eq!(ages.len(), usize::from(PACKAGES) * 3 / 4);
        ages.sort();
        let median = ages[ages.len() / 2];
        figure(
            "ages",
            &format!("packages of another station are {median} old at the median, cycles of {CYCLE}"),
        );
        // One for the slot, one more for a second frame, and one for the receiver's station to look.
        assert!(median < CYCLE * 4, "{ages:?}");
        assert_eq!(cell.down()["unexplained"], 0);
    });
}

#[test]
fn stations_that_are_not_to_say_so_send_packages_of_unknown_age() {
    shared("stations_that_are_not_to_say_so_send_packages_of_unknown_age", || {
        let cell = lab_of("ageless", ROUTES, "package_times = false\n");
        for (_, journey) in journeys(&cell) {
            assert_eq!((journey.age(), journey.sent, journey.left), (None, None, None));
            assert!(journey.is_from_elsewhere && journey.came.is_some() && journey.router().is_some());
        }
        cell.down();
    });
}

#[test]
fn a_package_that_never_left_its_station_was_in_its_mailbox_all_the_time() {
    shared("a_package_that_never_left_its_station_was_in_its_mailbox_all_the_time", || {
        let cell = lab_of("stays", ROUTES, "");
        let arm = Component::named(&cell.place("arm")).unwrap();
        let (times, mut camera) = (arm.times(), arm.mailbox(name("0.Camera.0"), Shape::new(4, 8)).unwrap());
        camera.sender(camera.name()).unwrap().send(1, b"here").unwrap();
        std::thread::sleep(Duration::from_millis(5));
        let package = camera.receive(Some(PATIENCE)).unwrap();
        let journey = times.journey(&package);
        assert!(!journey.is_from_elsewhere && journey.came.is_none());
        assert!((CYCLE * 2..CYCLE * 1_000).contains(&journey.age().unwrap()), "{journey:?}");
        assert_eq!(journey.age(), Some(journey.mailbox));
        // By global time it is the same, but for how fast the clocks are.
        let by_global = journey.received.zip(journey.sent).map(|(end, begin): (GlobalTime, _)| end - begin);
        assert!((by_global.unwrap() - journey.mailbox).abs() < APART);
        drop(package);
        cell.down();
    });
}

#[test]
fn tshark_takes_packages_with_times_for_sound_datagrams() {
    let test = "tshark_takes_packages_with_times_for_sound_datagrams";
    shared(test, || {
        if Command::new("tshark").arg("--version").output().is_err() {
            return skip(test, "tshark is not installed");
        }
        let (cell, dir) = (lab_of("decoded", ROUTES, ""), tempfile::tempdir().unwrap());
        let pcap = dir.path().join("frames.pcapng");
        let mut dump = rtnet();
        dump.args(["dump", "--lab", &cell.name, "--duration", "2s", "--write"]).arg(&pcap);
        std::thread::scope(|scope| {
            let dump = scope.spawn(move || dump.output().unwrap());
            while !dump.is_finished() {
                journeys(&cell);
            }
            let output = dump.join().unwrap();
            assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        });
        let read = |filter: &str, fields: &[&str]| {
            let mut tshark = Command::new("tshark");
            tshark.args(["-o", "udp.check_checksum:TRUE", "-r"]).arg(&pcap).args(["-Y", filter]);
            let fields = fields.iter().flat_map(|field| ["-e", field]);
            text(&tshark.args(["-T", "fields"]).args(fields).output().unwrap().stdout)
        };
        // Of a datagram in fragments that it has put together, it shows the last one's length.
        let shown = read(
            "udp.dstport == 8192 && ip.frag_offset == 0",
            &["ip.len", "udp.length", "udp.checksum.status"],
        );
        let lines: Vec<Vec<usize>> = shown
            .lines()
            .map(|line| line.split('\t').map(|field| field.parse().unwrap()).collect())
            .collect();
        let behind = |line: &Vec<usize>| line[0] - 20 - line[1];
        let with_times = lines.iter().filter(|line| behind(line) == 22 + line[1] % 2).count();
        let malformed = read("_ws.malformed || udp.checksum.bad", &["frame.number"]).lines().count();
        figure(
            test,
            &format!(
                "{with_times} of {} datagrams in one frame with times, {malformed} malformed",
                lines.len()
            ),
        );
        assert!(with_times > 10 && lines.iter().all(|line| line[2] == 1), "{shown}");
        assert!(lines.iter().all(|line| [0, 22, 23].contains(&behind(line))), "{shown}");
        assert_eq!(malformed, 0);
        cell.down();
    });
}

/// What `rtnet package receive --json` says of a package from another station.
pub fn assert_tells_its_age(package: &Value) {
    let at = |field: &str| package[field].as_i64().unwrap_or_else(|| panic!("{field}: {package:#}"));
    let [sent, left, came, received] = ["sent_ns", "left_ns", "came_ns", "received_ns"].map(at);
    let apart = APART.nanos();
    assert!(sent < left && left < came + apart && came < received + apart, "{package:#}");
    assert_eq!(
        (at("age_ns"), at("slot_wait_ns"), at("wire_ns")),
        (received - sent, left - sent, came - left)
    );
    assert!(at("router_ns") > -apart && at("mailbox_ns") >= 0, "{package:#}");
}
