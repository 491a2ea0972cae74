//! The schedule of a live lab is changed while all its slots are in use.
//!
//! `RTNET_CHANGES` says how often; `scripts/accept plan` asks for more than the default.

mod killed;

use std::path::PathBuf;
use std::process::{Child, Command, Output};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;

use crate::cell::{Cell, json, text, wait_until};
use crate::host::{again, figure, network, shared, stop, unique};
use crate::rtnet;
use crate::station::{Medium, Station};

fn changes() -> usize {
    std::env::var("RTNET_CHANGES").map_or(20, |changes| changes.parse().expect("RTNET_CHANGES is a number"))
}

/// A lab with two backups, and files beside it.
struct Lab {
    cell: Cell,
    dir: tempfile::TempDir,
}

const FILE: &str = include_str!("backups.toml");

/// The slots of the backups and the slaves in one another's places.
fn turned() -> String {
    let places = ["1100us", "1700us", "2300us", "2900us"];
    let mut text = FILE.to_owned();
    for (i, place) in places.iter().enumerate() {
        text = text.replace(&format!("offset = \"{place}\""), &format!("offset = \"@{}\"", (i + 1) % 4));
    }
    for (i, place) in places.iter().enumerate() {
        text = text.replace(&format!("\"@{i}\""), &format!("\"{place}\""));
    }
    text
}

impl Lab {
    fn up(name: &str, file: &str) -> Self {
        let cell = Cell::with(name, |_| file.into());
        wait_until("all counts", || cell.status()["cycles"].as_u64() > Some(0));
        Lab { cell, dir: tempfile::tempdir().unwrap() }
    }

    fn file(&self, name: &str, content: &str) -> PathBuf {
        let path = self.dir.path().join(name);
        std::fs::write(&path, content).unwrap();
        path
    }

    fn schedule(&self, station: &str, arguments: &[&str]) -> Output {
        rtnet().args(["schedule", "-S", &self.cell.place(station)]).args(arguments).output().unwrap()
    }

    /// Changes at the master that are to go well, one after the other.
    fn goes_well(&self, changes: &[&[&str]]) -> Output {
        self.made_by(|| {
            let (last, before) = changes.split_last().unwrap();
            let mut outputs = before.iter().map(|change| self.schedule("master", change));
            let failed = outputs.find(|output| !output.status.success());
            failed.unwrap_or_else(|| self.schedule("master", last))
        })
    }

    /// A host that stands still for so long that a backup takes over stops a change, or withdraws what is proposed: it is made
    /// again, aloud.
    fn made_by(&self, mut attempt: impl FnMut() -> Output) -> Output {
        const BY_THE_HOST: [&str; 3] =
            ["all go on as before", "ask the acting master", "no schedule is proposed"];
        for number in 1..=5 {
            let output = attempt();
            if output.status.success() {
                return output;
            }
            let said = text(&output.stderr);
            assert!(BY_THE_HOST.iter().any(|why| said.contains(why)), "{said}");
            again("change_of_a_schedule", &format!("attempt {number}: {}", said.trim_end()));
            wait_until("the master gives the time", || self.cell.station("master")["mastery"] == "active");
            // If anything is proposed still.
            self.schedule("master", &["cancel"]);
        }
        panic!("five times in vain");
    }

    fn shown(&self, station: &str) -> Value {
        json(rtnet().args(["schedule", "-S", &self.cell.place(station), "--json", "show"]))
    }

    fn offset(&self, station: &str) -> i64 {
        self.cell.station(station)["slots"][0]["offset_ns"].as_i64().unwrap()
    }
}

/// A program that takes whatever time is left.
struct Busy(Child);

impl Busy {
    fn program() -> Self {
        Busy(Command::new("sh").args(["-c", "while :; do :; done"]).spawn().unwrap())
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        // Gone already, or reaped here.
        let _ = self.0.kill().and_then(|()| self.0.wait());
    }
}

const LOADED: &str = include_str!("changing.toml");

/// The schedules that the loaded cell has in turn, and where the first slot of `backup1` is in each: slots change places, sizes,
/// ids, phases and whom they are joined to, and the cycle its length.
fn in_turn() -> [(String, i64); 3] {
    let changed = |slots: [&str; 5]| {
        let mut slots = slots.iter();
        let line = |line: &str| match line.starts_with("slots") {
            true => format!("slots = [{}]\n", slots.next().unwrap()),
            false => format!("{line}\n"),
        };
        LOADED.lines().map(line).collect::<String>()
    };
    let second = changed([
        "{ id = 0, offset = '1150us', size = 400 }",
        "{ id = 0, offset = '1750us', size = 450 }",
        "{ id = 0, offset = '2350us', size = 500 }",
        "{ id = 0, offset = '2950us', size = 520 }, { id = 2, offset = '550us', size = 520, joint = 0 }",
        "{ id = 0, offset = '3550us', size = 450 }, { id = 1, offset = '4150us', size = 420, phase = '2/2' }",
    ]);
    let third = changed([
        "{ id = 0, offset = '550us', size = 500 }",
        "{ id = 0, offset = '2350us', size = 500 }",
        "{ id = 0, offset = '1150us', size = 400 }",
        "{ id = 0, offset = '4150us', size = 600 }, { id = 3, offset = '1750us', size = 480 }",
        "{ id = 0, offset = '2950us', size = 500 }, { id = 1, offset = '3550us', size = 500, phase = '1/3', joint = 0 }",
    ]);
    [(LOADED.to_owned(), 1_150_000), (second, 1_750_000), (third.replace("5ms", "6ms"), 2_350_000)]
}

#[test]
fn the_schedule_changes_a_hundred_times_under_load_and_no_frame_is_lost() {
    let test = "the_schedule_changes_a_hundred_times_under_load_and_no_frame_is_lost";
    network(test, || {
        let lab = Lab::up("changed", LOADED);
        let _busy = Busy::program();
        let schedules = in_turn();
        let files: Vec<PathBuf> = (0..3).map(|i| lab.file(&format!("{i}.toml"), &schedules[i].0)).collect();
        let (mut made, mut stopped) = (0, 0);
        while made < changes() {
            let next = (made + 1) % 3;
            let output = lab.schedule("master", &["propose", files[next].to_str().unwrap(), "--now"]);
            let said = text(&output.stderr);
            match output.status.code() {
                Some(0) => made += 1,
                // A host may be late for so long that a backup takes over, or hold a station up: all stay with the old one.
                _ => {
                    stopped += 1;
                    wait_until("the master gives the time", || {
                        lab.cell.station("master")["mastery"] == "active"
                    });
                }
            }
            assert!(stopped <= 3 + changes() / 4, "stopped {stopped} times, made {made} times: {said}");
            wait_until("it is in use", || lab.offset("backup1") == schedules[made % 3].1);
        }
        let last = if made % 3 == 2 { 6_000_000 } else { 5_000_000 };
        wait_until("a slave has made all of them", || {
            lab.shown("slave2")["switched"].as_u64() >= Some(made as u64)
        });
        std::thread::sleep(Duration::from_millis(300));
        let account = lab.cell.down();
        figure(
            test,
            &format!(
                "{made} changes, {stopped} stopped; {} frames lost, {} unexplained",
                account["frames_lost"], account["unexplained"]
            ),
        );
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
        assert_eq!(account["frames_lost"], 0, "{account:#}");
        assert_eq!(
            (&account["schedule_changes"], &account["cycle_ns"]),
            (&made.into(), &last.into()),
            "{account:#}"
        );
    });
}

#[test]
fn a_station_that_does_not_answer_stops_the_change_and_is_named() {
    shared("a_station_that_does_not_answer_stops_the_change_and_is_named", || {
        let lab = Lab::up("silent-one", FILE);
        let file = lab.file("b.toml", &turned());
        let address = lab.cell.station("slave2")["address"].as_str().unwrap().to_owned();
        let tdma = |verb: &str| {
            let place = lab.cell.place("slave2");
            let output = rtnet().args(["tdma", "-S", &place, verb]).output().unwrap();
            assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        };
        tdma("detach");
        let output = lab.schedule("master", &["propose", file.to_str().unwrap(), "--now"]);
        tdma("slave");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains(&address) && said.contains("did not acknowledge"), "{said}");
        assert!(said.contains("all go on as before"), "{said}");
        assert_eq!(lab.offset("backup1"), 1_100_000);
        lab.cell.wait_until_locked();
        let account = lab.cell.down();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
    });
}

#[test]
fn what_cannot_be_is_refused_with_the_reason_and_nothing_changes() {
    shared("what_cannot_be_is_refused_with_the_reason_and_nothing_changes", || {
        let lab = Lab::up("refused", FILE);
        let propose = |station: &str, content: &str, when: &[&str]| {
            let file = lab.file("x.toml", content);
            let mut arguments = vec!["propose", file.to_str().unwrap()];
            arguments.extend(when);
            let output = lab.schedule(station, &arguments);
            (output.status.code(), text(&output.stderr))
        };
        let (code, why) = propose("master", &turned().replace("\"2300us\"", "\"1750us\""), &["--now"]);
        assert!(code == Some(2) && why.contains("overlap"), "{why}");
        let (code, why) = propose("master", &turned().replace("slave2", "slave9"), &["--now"]);
        assert!(code == Some(2) && why.contains("slave9"), "{why}");
        let (code, why) = propose("slave1", &turned(), &["--now"]);
        assert!(code == Some(2) && why.contains("ask the acting master"), "{why}");
        let (code, why) = propose("master", &turned(), &["--at-cycle", "5"]);
        assert!(code == Some(2) && why.contains("cycles ahead"), "{why}");
        for verb in ["activate", "cancel"] {
            let output = lab.schedule("master", &[verb]);
            assert!(text(&output.stderr).contains("no schedule is proposed"), "{}", text(&output.stderr));
        }
        assert!(lab.shown("master")["in_use"] == 0 && lab.shown("slave1")["state"] == "idle");
        lab.cell.down();
    });
}

#[test]
fn a_schedule_waits_until_it_is_activated_or_cancelled_and_a_slot_does_not_change_meanwhile() {
    let test = "a_schedule_waits_until_it_is_activated_or_cancelled_and_a_slot_does_not_change_meanwhile";
    shared(test, || {
        let lab = Lab::up("waits", FILE);
        let file = lab.file("b.toml", &turned());
        let propose = ["propose", file.to_str().unwrap()];
        let output = lab.goes_well(&[&propose]);
        assert!(
            text(&output.stdout).contains("4 of 4 stations have acknowledged"),
            "{}",
            text(&output.stdout)
        );
        wait_until("a slot does not change meanwhile", || {
            let set = lab.cell.slot("slave2", &["set", "0=3ms"]);
            let is_refused = text(&set.stderr).contains("a change of the schedule is under way");
            // Where a sync is late a backup withdraws what is proposed, and the master proposes it again in the next cycle, if it was
            // not away for longer.
            if !is_refused && lab.shown("master")["state"] != "proposed" {
                lab.goes_well(&[&propose]);
            }
            is_refused
        });
        let cancelled = lab.schedule("master", &["cancel"]);
        let said = text(&cancelled.stderr);
        assert!(cancelled.status.success() || said.contains("no schedule is proposed"), "{said}");
        assert_eq!(lab.offset("slave1"), 2_300_000);
        lab.goes_well(&[&propose, &["activate", "--in", "500ms"]]);
        let all = ["master", "backup1", "backup2", "slave1", "slave2"];
        wait_until("all have switched", || all.iter().all(|station| lab.shown(station)["switched"] == 1));
        assert!(all.iter().all(|station| lab.shown(station)["in_use"] == lab.shown("master")["in_use"]));
        assert_eq!(lab.offset("slave1"), 2_900_000);
        let shown = text(&lab.schedule("slave1", &["show"]).stdout);
        assert!(shown.lines().next().unwrap().ends_with(", cycle 4ms, slots 0 at 2.9ms"), "{shown}");
        let account = lab.cell.down();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
    });
}

#[test]
fn a_station_that_is_stopped_stops_the_change_and_all_go_on() {
    shared("a_station_that_is_stopped_stops_the_change_and_all_go_on", || {
        let lab = Lab::up("stopped", FILE);
        let file = lab.file("b.toml", &turned());
        let slave = lab.cell.station("slave2");
        let address = slave["address"].as_str().unwrap();
        let pid = Pid::from_raw(slave["pid"].as_i64().unwrap() as i32);
        stop(pid);
        let output = lab.schedule("master", &["propose", file.to_str().unwrap(), "--now"]);
        kill(pid, Signal::SIGCONT).unwrap();
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains(address) && said.contains("did not acknowledge"), "{said}");
        lab.cell.wait_until_locked();
        lab.goes_well(&[&["propose", file.to_str().unwrap(), "--now"]]);
        wait_until("it has switched", || lab.offset("slave1") == 2_900_000);
        // It has lost what came for it meanwhile, which the lab says when it is taken down.
        let account = lab.cell.status();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
    });
}

#[test]
fn a_schedule_is_in_use_from_the_cycle_on_that_is_said() {
    shared("a_schedule_is_in_use_from_the_cycle_on_that_is_said", || {
        let lab = Lab::up("at-cycle", FILE);
        let files = [lab.file("b.toml", &turned()), lab.file("a.toml", FILE)];
        let [first, second] = files.each_ref().map(|file| file.to_str().unwrap());
        let cycle = || lab.shown("master")["cycle"].as_u64().unwrap();
        let mut at = 0;
        lab.made_by(|| {
            at = cycle() + 400;
            lab.schedule("master", &["propose", first, "--at-cycle", &at.to_string()])
        });
        wait_until("it is in use", || lab.shown("slave2")["switched"] == 1);
        assert_eq!(lab.shown("slave2")["activation"], at);
        let mut before = 0;
        lab.made_by(|| {
            before = cycle();
            lab.schedule("master", &["propose", second, "--in", "800ms"])
        });
        let shown = lab.shown("slave2");
        let ahead = shown["activation"].as_u64().unwrap() - before;
        assert!((200..300).contains(&ahead), "800 ms are 200 cycles: {ahead}, {shown:#}");
        let account = lab.cell.down();
        assert_eq!((&account["unexplained"], &account["overlaps"]), (&0.into(), &0.into()), "{account:#}");
    });
}

#[test]
fn stations_of_their_own_change_their_schedule_if_all_were_started_for_it() {
    shared("stations_of_their_own_change_their_schedule_if_all_were_started_for_it", || {
        let medium = Medium::new();
        let names = ["a", "b"].map(|side| unique(&format!("schedule-{side}")));
        let cycle = ["--interface", "rt0", "--master", "--cycle", "5ms", "--sync-window", "150us"];
        let giving = [&cycle[..], &["--slot", "0=1ms", "--extensions", "--name", &names[0]]].concat();
        let master = Station::start(&medium.a, &giving);
        master.wait_for("master_active");
        let following =
            ["--interface", "rt0", "--slave", "--rounds", "10", "--slot", "0=2ms", "--name", &names[1]];
        let slave = Station::start(&medium.b, &following);
        slave.wait_for("locked, cycle");

        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("two.toml");
        let two = "cycle = '4ms'\nsync_window = '150us'\n[[station]]\nname = 'a'\nrole = 'master'\nslots = [{ id = 0, offset = '2ms' }]\n\
             [[station]]\nname = 'b'\nrole = 'slave'\nslots = [{ id = 0, offset = '1ms' }]\n";
        std::fs::write(&file, two).unwrap();
        let run = |of: &str, arguments: &[&str]| {
            let output = rtnet().args(["schedule", "-S", of]).args(arguments).output().unwrap();
            (output.status.code(), text(&output.stdout) + &text(&output.stderr))
        };
        let propose = ["propose", file.to_str().unwrap(), "--now", "--address", "a=02:00:00:00:00:0a"];
        let both = [&propose[..], &["--address", "b=02:00:00:00:00:0b"]].concat();
        let (code, said) = run(&names[0], &propose);
        assert!(code == Some(2) && said.contains("say --address b=ADDRESS"), "{said}");
        let (code, said) = run(&names[1], &both);
        assert!(
            code == Some(2) && said.contains("start it, and all others of its network, with --extensions"),
            "{said}"
        );
        let (code, said) = run(&names[0], &both);
        assert!(code == Some(1) && said.contains("02:00:00:00:00:0b did not acknowledge"), "{said}");
        assert!(said.contains("--extensions"), "{said}");
        assert_eq!(slave.end(), Some(0));

        let slave = Station::start(&medium.b, &[&following[..], &["--extensions"]].concat());
        slave.wait_for("locked, cycle");
        let (code, said) = run(&names[0], &both);
        assert!(code == Some(0) && said.contains("schedule in use: number"), "{said}");
        wait_until("the slave has switched, too", || {
            let status = json(rtnet().args(["tdma", "-S", &names[1], "status", "--json"]));
            status["slots"][0]["offset_ns"] == 1_000_000
        });
        // What is asked of single slots is judged by the slots that there are now.
        let slot = rtnet().args(["slot", "-S", &names[0], "set", "1=2ms"]).output().unwrap();
        assert!(text(&slot.stderr).contains("slot 0 and slot 1 overlap"), "{}", text(&slot.stderr));
        assert_eq!((master.end(), slave.end()), (Some(0), Some(0)));
    });
}

#[test]
fn a_master_alone_takes_a_schedule_of_one_station() {
    shared("a_master_alone_takes_a_schedule_of_one_station", || {
        let medium = Medium::new();
        let name = unique("schedule-alone");
        let cycle = ["--interface", "rt0", "--master", "--cycle", "5ms", "--sync-window", "150us"];
        let master = Station::start(
            &medium.a,
            &[&cycle[..], &["--slot", "0=1ms", "--extensions", "--name", &name]].concat(),
        );
        master.wait_for("master_active");
        let file = tempfile::NamedTempFile::new().unwrap();
        let one = "cycle = '4ms'\nsync_window = '150us'\n[[station]]\nname = 'm'\nrole = 'master'\nslots = [{ id = 0, offset = '2ms' }]\n";
        std::fs::write(&file, one).unwrap();
        let propose = || {
            let mut propose = rtnet();
            propose.args(["schedule", "-S", &name, "propose"]).arg(file.path());
            let output = propose.args(["--now", "--address", "m=02:00:00:00:00:0a"]).output().unwrap();
            (output.status.success(), text(&output.stdout) + &text(&output.stderr))
        };
        // It knows which schedule is in use once its first Synchronisation has left.
        let proposed = std::cell::RefCell::new(propose());
        wait_until("it takes proposals", || {
            let refused = proposed.borrow().1.contains("ask the acting master");
            if refused {
                *proposed.borrow_mut() = propose();
            }
            !refused
        });
        let proposed = proposed.into_inner();
        assert!(proposed.0 && proposed.1.contains("cycle 4ms, slots 0 at 2ms"), "{}", proposed.1);
        assert_eq!(master.end(), Some(0));
    });
}
