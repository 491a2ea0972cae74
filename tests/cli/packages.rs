//! Labs whose stations' programs send each other packages.

mod calls;

use std::fs;
use std::process::Stdio;
use std::time::{Duration, Instant};

use package_router::component::{Component, Mailbox, ReceiveError, SendError, Sender};
use package_router::mailbox::Shape;
use package_router::name::MailboxName;
use package_router::wire::{Head, NOT_AVAILABLE, OK};
use serde_json::Value;

use crate::ages::assert_tells_its_age;
use crate::cell::{Cell, json, text, wait_until};
use crate::host::{figure, network, shared};
use crate::{rtnet, schema};

const LAB: &str = include_str!("packages.toml");
pub const ROUTES: &str = include_str!("packages_routes.toml");
pub const PATIENCE: Duration = Duration::from_secs(30);

/// A lab with these routes; they are read when it is stood up.
fn lab(what: &str, routes: &str) -> Cell {
    lab_of(what, routes, "")
}

/// The same with more said of its stations.
pub fn lab_of(what: &str, routes: &str, more: &str) -> Cell {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("routes.toml");
    fs::write(&file, routes).unwrap();
    let text = LAB.replace("packages_routes.toml", file.to_str().unwrap());
    Cell::with(what, |_| text.replace("packages = true\n", &format!("packages = true\n{more}")))
}

pub fn name(text: &str) -> MailboxName {
    text.parse().unwrap()
}

/// A component at a station, with one mailbox.
pub fn component(cell: &Cell, station: &str, mailbox: &str) -> Mailbox {
    let component = Component::named(&cell.place(station)).unwrap();
    component.mailbox(name(mailbox), Shape::new(16, 2_000)).unwrap()
}

/// Each sends to all, itself among them, as often, and each hears all of it whole and in its order.
fn all_exchange(all: &mut [Mailbox], rounds: u8) {
    let names: Vec<_> = all.iter().map(Mailbox::name).collect();
    let mut ways: Vec<Vec<Sender>> =
        all.iter().map(|from| names.iter().map(|to| from.sender(*to).unwrap()).collect()).collect();
    for round in 0..rounds {
        for (from, ways) in ways.iter_mut().enumerate() {
            for way in ways {
                // Some in one frame, some in two.
                way.send(21, &[[round, from as u8]; 900][..if round % 2 == 0 { 3 } else { 900 }].concat())
                    .unwrap();
            }
        }
        for mailbox in all.iter_mut() {
            let mut heard = vec![false; names.len()];
            while heard.iter().any(|heard| !heard) {
                let package = mailbox.receive(Some(PATIENCE)).unwrap();
                let from = names.iter().position(|name| *name == package.head().from).unwrap();
                let body = package.body().to_vec();
                assert_eq!(body.len(), if round % 2 == 0 { 6 } else { 1_800 });
                assert!(body.chunks(2).all(|part| part == [round, from as u8]));
                assert!(!std::mem::replace(&mut heard[from], true), "twice");
                // What came from elsewhere says when.
                assert_eq!(package.stamps().came.is_none(), package.head().from == package.head().to);
            }
        }
    }
}

fn ask(cell: &Cell, station: &str, words: &[&str]) -> Value {
    json(rtnet().args(words).args(["-S", &cell.place(station), "--json"]))
}

#[test]
fn components_of_three_stations_exchange_packages_by_name_and_one_moves_by_its_route() {
    shared("components_of_three_stations_exchange_packages_by_name_and_one_moves_by_its_route", || {
        let cell = lab("exchange", ROUTES);
        let mut all = [("master", "0.Pilot.0"), ("arm", "0.Camera.0"), ("leg", "0.Joystick.0")]
            .map(|(station, mailbox)| component(&cell, station, mailbox));
        all_exchange(&mut all, 20);
        // While all run: another station has the camera.
        let [pilot, camera, joystick] = all;
        let mut looks = pilot.sender(camera.name()).unwrap();
        drop(camera);
        let camera = component(&cell, "leg", "0.Camera.0");
        for station in ["master", "arm", "leg"] {
            let output = rtnet()
                .args(["package", "-S", &cell.place(station), "route", "add", "0.Camera.*=10.0.0.3"])
                .output()
                .unwrap();
            assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        }
        assert!(!looks.is_current());
        looks.follow().unwrap();
        let mut all = [pilot, camera, joystick];
        looks.send(7, &[]).unwrap();
        assert_eq!(all[1].receive(Some(PATIENCE)).unwrap().head().kind, 7);
        cell.down();
        // From the beginning: a changed file, and the same programs.
        let moved = ROUTES.replace("station = \"arm\"", "station = \"master\"");
        let cell = lab("moved", &moved);
        let mut all = [("master", "0.Pilot.0"), ("master", "0.Camera.0"), ("leg", "0.Joystick.0")]
            .map(|(station, mailbox)| component(&cell, station, mailbox));
        let names: Vec<_> = all.iter().map(Mailbox::name).collect();
        let mut way = all[2].sender(names[1]).unwrap();
        way.send(8, &[1, 2, 3]).unwrap();
        let package = all[1].receive(Some(PATIENCE)).unwrap();
        assert_eq!((package.head().kind, package.body().to_vec()), (8, vec![1, 2, 3]));
        drop(package);
        assert_eq!(cell.down()["unexplained"], 0);
    });
}

/// The network's slots take one frame of each station in a cycle: what waits for them at the sender is sorted by who sends.
#[test]
fn an_urgent_package_overtakes_a_backlog_on_its_way_to_another_station() {
    shared("an_urgent_package_overtakes_a_backlog_on_its_way_to_another_station", || {
        let cell = lab("overtakes", ROUTES);
        let mut pilot = component(&cell, "master", "0.Pilot.0");
        let slow = component(&cell, "arm", "0.0xe0.0");
        let quick = component(&cell, "arm", "0.Camera.0");
        let (mut slow, mut quick) = (slow.sender(pilot.name()).unwrap(), quick.sender(pilot.name()).unwrap());
        let mut before = Vec::new();
        for round in 0..20u8 {
            let backlog = (0..12).map(|n| slow.send(1, &[round, n])).filter(Result::is_ok).count();
            assert_eq!(backlog, 12);
            quick.send(2, &[round]).unwrap();
            let mut kinds = Vec::new();
            while kinds.len() < 13 {
                kinds.push(pilot.receive(Some(PATIENCE)).unwrap().head().kind);
            }
            before.push(kinds.iter().position(|kind| *kind == 2).unwrap());
        }
        // One may be chosen already, and another have left while the urgent one was handed over.
        before.sort_unstable();
        assert!(before[before.len() / 2] <= 2, "{before:?} of the backlog came before it");
        figure(
            "an_urgent_package_overtakes_a_backlog_on_its_way_to_another_station",
            &format!(
                "of 12 that waited {} came before it, in the middle of 20 times",
                before[before.len() / 2]
            ),
        );
        cell.down();
    });
}

#[test]
fn what_people_see_of_mailboxes_is_what_components_do() {
    shared("what_people_see_of_mailboxes_is_what_components_do", || {
        let cell = lab("seen", ROUTES);
        let place = |station: &str| cell.place(station);
        assert_eq!(ask(&cell, "arm", &["mailbox", "list"]), Value::Array(Vec::new()));
        let mut receives = rtnet();
        receives.args([
            "package",
            "-S",
            &place("arm"),
            "receive",
            "0.Camera.0",
            "--echo",
            "--count",
            "12",
            "--json",
        ]);
        let receives = receives.stdout(Stdio::piped()).spawn().unwrap();
        wait_until("the mailbox is there", || {
            ask(&cell, "arm", &["mailbox", "list"]).as_array().is_some_and(|all| all.len() == 1)
        });
        // Who asks has to be found, too.
        let add = ["route", "add", "0.0xff.*=10.0.0.1"];
        let output = rtnet().args(["package", "-S", &place("arm")]).args(add).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let trips = ask(&cell, "master", &["package", "ping", "0.Camera.0", "-c", "10", "-i", "5ms"]);
        assert_eq!((&trips["asked"], &trips["came"]), (&10.into(), &10.into()), "{trips:#}");
        let cycle = 2_000_000;
        assert!(trips["min_ns"].as_u64().unwrap() < 2 * cycle, "{trips:#}");
        let send = |words: &[&str]| {
            rtnet().args(["package", "-S", &place("master"), "send"]).args(words).output().unwrap()
        };
        let sent = send(&["0.Camera.0", "hello", "--type", "-6", "--priority", "200"]);
        assert_eq!(sent.status.code(), Some(0), "{}", text(&sent.stderr));
        wait_until("it was received", || {
            ask(&cell, "arm", &["mailbox", "stat", "0.Camera.0"])[0]["received"] == 11
        });
        let stat = ask(&cell, "arm", &["mailbox", "stat"]);
        assert_eq!(
            (&stat[0]["name"], &stat[0]["forged"], &stat[0]["slots"]),
            (&"Camera(0/0)".into(), &0.into(), &64.into())
        );
        assert_eq!(stat[0]["process"], receives.id());
        let watch = ["mailbox", "watch", "0.Camera.0", "--every", "20ms", "--count", "3", "-S"];
        let watched = rtnet().args(watch).arg(place("arm")).output().unwrap();
        let idle = "Camera(0/0): 0 received, 0 refused; 0 wait, 1 at the most\n";
        assert_eq!(text(&watched.stdout), idle.repeat(3));
        assert_eq!(send(&["0.Camera.0"]).status.code(), Some(0));
        let heard = receives.wait_with_output().unwrap();
        let lines: Vec<Value> = text(&heard.stdout).lines().map(schema::read).collect();
        assert_eq!(lines.len(), 12);
        let hello = &lines[10];
        assert_eq!(
            (&hello["body"], &hello["type"], &hello["priority"]),
            (&"hello".into(), &(-6).into(), &200.into())
        );
        assert_tells_its_age(hello);
        // It has gone, and its mailbox with it.
        wait_until("the mailbox is gone", || {
            ask(&cell, "arm", &["mailbox", "list"]) == Value::Array(Vec::new())
        });
        let told = |words: &[&str]| {
            let output = rtnet().args(words).args(["-S", &place("master")]).output().unwrap();
            (output.status.code(), text(&output.stderr))
        };
        let (status, why) = told(&["package", "ping", "0.Camera.0", "-c", "1"]);
        assert!(
            status == Some(1) && why.contains("Camera(0/0) is not available: nobody has it"),
            "{status:?} {why}"
        );
        let (status, why) = told(&["package", "send", "0.Gyro.0"]);
        assert!(
            status == Some(2)
                && why
                    .contains("no mailbox of this station, and no route of the station's system leads to it"),
            "{status:?} {why}"
        );
        let (status, why) = told(&["mailbox", "stat", "0.Gyro.0"]);
        assert!(status == Some(2) && why.contains("see `rtnet mailbox list`"), "{status:?} {why}");
        let (status, why) = told(&["package", "route", "delete", "0.Gyro.*"]);
        assert!(status == Some(2) && why.contains("there is no route to 0.Gyro.*"), "{status:?} {why}");
        let routes = ask(&cell, "master", &["package", "route"]);
        assert_eq!(routes.as_array().unwrap().len(), 3, "{routes:#}");
        cell.down();
    });
}

#[test]
fn a_lab_without_packages_says_how_to_have_some() {
    shared("a_lab_without_packages_says_how_to_have_some", || {
        let cell = Cell::up("no-packages");
        let output = rtnet().args(["mailbox", "-S", &cell.place("slave1"), "list"]).output().unwrap();
        assert_eq!(output.status.code(), Some(2));
        assert!(
            text(&output.stderr).contains("has no packages: start it with --packages"),
            "{}",
            text(&output.stderr)
        );
        cell.down();
    });
}

#[test]
fn who_asks_a_mailbox_that_is_not_there_is_told_so_by_its_station_and_all_that_a_station_ends() {
    shared(
        "who_asks_a_mailbox_that_is_not_there_is_told_so_by_its_station_and_all_that_a_station_ends",
        || {
            let cell = lab("not-there", ROUTES);
            let mut pilot = component(&cell, "master", "0.Pilot.0");
            let mut asks = pilot.sender(name("0.Camera.0")).unwrap();
            let id = asks.send(21, &[]).unwrap();
            let Head { kind, from, id: told, .. } = *pilot.receive(Some(PATIENCE)).unwrap().head();
            assert_eq!((kind, from, told), (NOT_AVAILABLE, name("0.Camera.0"), id));
            let counted = json(rtnet().args(["stat", "-S", &cell.place("arm"), "--json"]));
            let packages = &counted["packages"];
            assert_eq!(
                (&packages["no_route"], &packages["answered"]),
                (&1.into(), &1.into()),
                "{packages:#}"
            );
            // A reply to nobody is not answered.
            asks.send(OK, &[]).unwrap();
            assert_eq!(pilot.receive(Some(Duration::from_millis(50))).err(), Some(ReceiveError::TimedOut));
            let begun = Instant::now();
            let waits = std::thread::spawn(move || pilot.receive(Some(PATIENCE)).err());
            cell.down();
            assert_eq!(waits.join().unwrap(), Some(ReceiveError::Gone));
            assert!(begun.elapsed() < PATIENCE);
            let deadline = Instant::now() + PATIENCE;
            while !matches!(asks.send(OK, &[]), Err(SendError::Station(_) | SendError::Unbound(_))) {
                assert!(Instant::now() < deadline, "a station that has ended takes packages");
            }
        },
    );
}

#[test]
fn what_a_way_to_another_station_takes_is_measured_beside_what_its_slots_say() {
    network("what_a_way_to_another_station_takes_is_measured_beside_what_its_slots_say", || {
        let back = "\n[[route]]\nto = \"0.0xff.*\"\nstation = \"master\"\n";
        let cell = lab("bench", &format!("{ROUTES}{back}"));
        let answers = |station: &str, mailbox: &str| {
            let mut command = rtnet();
            command.args(["package", "-S", &cell.place(station), "receive", mailbox]);
            command.args(["--echo", "--quiet", "--json"]).stdout(Stdio::piped()).spawn().unwrap()
        };
        let (there, here) = (answers("arm", "0.Camera.0"), answers("master", "0.Pilot.0"));
        for station in ["arm", "master"] {
            wait_until("the mailbox is there", || {
                ask(&cell, station, &["mailbox", "list"]).as_array().is_some_and(|all| all.len() == 1)
            });
        }
        let bench = |to: &str, words: &[&str]| {
            ask(&cell, "master", &[&["package", "bench", to, "--time", "400ms"][..], words].concat())
        };
        let number = |of: &Value| of.as_u64().unwrap();
        // Cycles of 2 ms, and a lead, twice; what is on its way takes less than a lead of 50 us.
        let trips = bench("0.Camera.0", &["--pause", "2ms"]);
        let scheduled = &trips["scheduled"];
        let wait = 2_000_000 + number(&scheduled["lead_ns"]);
        let waits: Vec<_> = scheduled["waits"].as_array().unwrap().iter().collect();
        assert_eq!(waits.iter().map(|wait| number(&wait["worst_wait_ns"])).collect::<Vec<_>>(), [wait; 2]);
        assert_eq!(waits[1]["station"], cell.place("arm"));
        assert!(
            (2 * wait..2 * wait + 100_000).contains(&number(&scheduled["two_worst_waits_ns"])),
            "{trips:#}"
        );
        let came = number(&trips["came"]);
        assert!(came > 20 && number(&trips["lost"]) == 0, "{trips:#}");
        // A program waits for its core besides: that of the quickest is next to nothing.
        assert!(number(&trips["round_trip_ns"]["min"]) < 4_200_000, "{trips:#}");
        // A frame each, as fast as slots take them.
        let stream = bench("0.Camera.0", &["--stream", "--size", "1456"]);
        assert_eq!((&stream["lost"], &stream["came"]), (&0.into(), &stream["sent"]), "{stream:#}");
        let (sent, turns) = (number(&stream["came"]), number(&stream["turns"]));
        assert!(turns >= 150 && sent <= turns + 1 && number(&stream["no_buffers"]) > 0, "{stream:#}");
        // One byte more takes two turns.
        let longer = bench("0.Camera.0", &["--stream", "--size", "1457"]);
        let long = number(&longer["came"]);
        assert_eq!((&longer["turns"], &longer["lost"]), (&Value::Null, &0.into()), "{longer:#}");
        // So many small ones wait at the end that they take seconds, and the answer that counts them is longer than they are.
        let small = bench("0.Camera.0", &["--stream", "--size", "0"]);
        assert_eq!((&small["lost"], &small["came"]), (&0.into(), &small["sent"]), "{small:#}");
        let small = number(&small["came"]);
        assert!(small > 1_000, "{small} of them take no longer than a second");
        let hurried = given_up(&cell);
        // On the same station: no slot.
        let near = bench("0.Pilot.0", &[]);
        assert_eq!((number(&near["lost"]), &near["scheduled"]), (0, &Value::Null), "{near:#}");
        let near_stream = bench("0.Pilot.0", &["--stream"]);
        assert_eq!((&near_stream["lost"], &near_stream["scheduled"]), (&0.into(), &Value::Null));
        let nobody = ["package", "bench", "0.Camera.1", "-S", &cell.place("master")];
        let output = rtnet().args(nobody).output().unwrap();
        let (status, why) = (output.status.code(), text(&output.stderr));
        assert!(status == Some(1) && why.contains("Camera(0/1) is not available"), "{status:?} {why}");
        // An answer may have another slot where there is one: here in every other cycle.
        let offset = cell.station("arm")["slots"][0]["offset_ns"].as_u64().unwrap();
        for slot in [format!("0={offset}ns,phase=1/2"), format!("2={offset}ns,phase=2/2")] {
            let set = cell.slot("arm", &["set", &slot]);
            assert_eq!(set.status.code(), Some(0), "{}", text(&set.stderr));
        }
        let unknown = bench("0.Camera.0", &[]);
        let scheduled = &unknown["scheduled"];
        let waits = scheduled["waits"].as_array().unwrap().len();
        let both = [&scheduled["two_worst_waits_ns"], &scheduled["round_trip_ns"]];
        assert!(waits == 1 && both.iter().all(|both| both.is_null()), "{unknown:#}");
        let came = came + 1 + number(&unknown["came"]);
        // Told when they are ended: what was asked, first of all, and what was counted, before and behind.
        let heard = |child: std::process::Child| {
            let process = nix::unistd::Pid::from_raw(child.id() as i32);
            nix::sys::signal::kill(process, nix::sys::signal::Signal::SIGTERM).unwrap();
            let output = child.wait_with_output().unwrap();
            assert_eq!(output.status.code(), Some(0));
            let all = crate::schema::read(&output.stdout);
            (number(&all["received"]), number(&all["answered"]))
        };
        let asked = came + 1 + 6 + 1;
        let (received, answered) = heard(there);
        assert_eq!(answered, asked);
        // Of those that did not all leave it is not known which did.
        let least = asked + sent + long + small;
        assert!((least..=least + hurried).contains(&received), "{received} of {least} to {hurried} more");
        let (asked, sent) = (number(&near["came"]) + 1 + 2, number(&near_stream["sent"]));
        assert_eq!(heard(here), (asked + sent, asked));
        cell.down();
    });
}

/// Who is ended before all that was sent has left tells what was: how many.
fn given_up(cell: &Cell) -> u64 {
    let words =
        ["package", "bench", "0.Camera.0", "--stream", "--size", "0", "--time", "100ms", "--json", "-S"];
    let bench = rtnet().args(words).arg(cell.place("master")).stdout(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(Duration::from_millis(600));
    let process = nix::unistd::Pid::from_raw(bench.id() as i32);
    nix::sys::signal::kill(process, nix::sys::signal::Signal::SIGINT).unwrap();
    let output = bench.wait_with_output().unwrap();
    let told = crate::schema::read(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{told:#}");
    assert_eq!(
        (&told["all_left"], &told["came"], &told["lost"]),
        (&false.into(), &Value::Null, &Value::Null)
    );
    told["sent"].as_u64().filter(|sent| *sent > 1_000).unwrap()
}
