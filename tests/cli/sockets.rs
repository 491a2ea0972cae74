//! Stations with an address: `rtnet if`, `route`, `ping`, `pool` and `stat`.

use std::net::SocketAddrV4;
use std::process::{Output, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use rtnet::api::Station as Attached;
use serde_json::Value;

use crate::host::{shared, stop, unique};
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

const A: &str = "02:00:00:00:00:0a";
const B: &str = "02:00:00:00:00:0b";

/// Two stations without slots, of which only the first knows where the other is.
struct Two {
    a: String,
    b: String,
    stations: [Station; 2],
    medium: Medium,
}

impl Two {
    fn start(what: &str) -> Self {
        let medium = Medium::new();
        let [a, b] = ["a", "b"].map(|which| unique(&format!("{what}-{which}")));
        let of = |name: &str, ip: &str, more: &[&str]| {
            let options = ["--interface", "rt0", "--discipline", "direct", "--name", name, "--ip", ip];
            [&options, more].concat().iter().map(|text| text.to_string()).collect::<Vec<_>>()
        };
        let start = |namespace, options: Vec<String>| {
            let options: Vec<&str> = options.iter().map(String::as_str).collect();
            let station = Station::start(namespace, &options);
            station.wait_for("Ctrl-C ends it");
            station
        };
        let first = start(&medium.a, of(&a, "10.0.0.1/24", &["--route", &format!("10.0.0.2={B}")]));
        let second = start(&medium.b, of(&b, "10.0.0.2/24", &["--sockets", "8", "--ports", "2000-2009"]));
        Self { a, b, stations: [first, second], medium }
    }
}

fn ask(verb: &str, station: &str, arguments: &[&str]) -> Output {
    rtnet().args([verb, "-S", station]).args(arguments).output().unwrap()
}

fn json(verb: &str, station: &str, arguments: &[&str]) -> Value {
    let output = ask(verb, station, &[arguments, &["--json"]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    crate::schema::read(&output.stdout)
}

fn said(verb: &str, station: &str, arguments: &[&str]) -> String {
    let output = ask(verb, station, arguments);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn refused(verb: &str, station: &str, arguments: &[&str], status: i32) -> String {
    let output = ask(verb, station, arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), message.lines().count()), (Some(status), 1), "{message}");
    message
}

#[test]
fn a_station_with_an_address_shows_it_and_what_its_slots_take() {
    shared("a_station_with_an_address_shows_it_and_what_its_slots_take", || {
        let two = Two::start("if");
        let shown = json("if", &two.a, &[]);
        assert_eq!((&shown["ip"], &shown["prefix"]), (&"10.0.0.1".into(), &24.into()), "{shown:#}");
        assert_eq!((&shown["address"], &shown["link"]), (&A.into(), &"up".into()), "{shown:#}");
        assert_eq!((&shown["broadcast"], &shown["mtu"]), (&"10.0.0.255".into(), &1500.into()), "{shown:#}");
        assert_eq!(shown["channels"], serde_json::json!({"0": {"payload": 1500}}), "{shown:#}");
        let words = said("if", &two.a, &[]);
        assert!(
            words.contains("10.0.0.1/24, broadcast 10.0.0.255")
                && words.contains("every channel: a payload of up to 1500"),
            "{words}"
        );
    });
}

#[test]
fn routes_are_said_asked_for_and_deleted_by_hand() {
    shared("routes_are_said_asked_for_and_deleted_by_hand", || {
        let two = Two::start("route");
        let route = |arguments: &[&str]| said("route", &two.b, arguments);
        assert!(refused("route", &two.b, &["get", "10.0.0.1"], 1).contains("EHOSTUNREACH"));
        assert_eq!(route(&["solicit", "10.0.0.1"]), format!("10.0.0.1 is at {A}\n"));
        let nobody = refused("route", &two.b, &["solicit", "10.0.0.9"], 1);
        assert!(nobody.contains("within 1s that 10.0.0.9 is theirs"), "{nobody}");
        route(&["add", "10.9.0.0/16", "via", "10.0.0.1"]);
        assert_eq!(json("route", &two.b, &["get", "10.9.0.7"])["via"], "10.0.0.1");
        let listed = json("route", &two.b, &["list"]);
        assert_eq!(listed["hosts"][0]["origin"], "solicited", "{listed:#}");
        assert_eq!(listed["networks"][0]["network"], "10.9.0.0/16", "{listed:#}");
        route(&["add", "10.0.0.1", B]);
        assert!(route(&["list"]).contains(&format!("10.0.0.1 {B} static")));
        route(&["del", "10.9.0.0/16"]);
        route(&["del", "10.0.0.1"]);
        let gone = refused("route", &two.b, &["del", "10.0.0.1"], 1);
        assert!(gone.contains("there is no route to 10.0.0.1"), "{gone}");
        for (arguments, why) in [
            (&["add", "10.0.0.2", A][..], "10.0.0.2 is no station's address: it is this station's own"),
            (&["add", "10.0.0.7", "ff:ff:ff:ff:ff:ff"], "is a group: a route leads to one station"),
            (&["add", "10.0.0.7", "01:00:5e:00:00:07"], "is a group: a route leads to one station"),
            (
                &["add", "10.0.0.7", "00:00:00:00:00:00"],
                "00:00:00:00:00:00 is no station's: write the address",
            ),
            (&["solicit", "10.0.0.2"], "10.0.0.2 is no station's address: it is this station's own"),
            (&["solicit", "10.0.0.255"], "10.0.0.255 is no station's address: it is the broadcast address"),
            (&["solicit", "127.0.0.1"], "127.0.0.1 is no station's address: it is a loopback address"),
            (&["add", "10.0.0.7", "02:00"], "'02:00' is not an Ethernet address: write six bytes"),
            (&["add", "10.9.0.0/16", "10.0.0.1"], "write IP MAC, or NET/PREFIX via IP"),
        ] {
            let message = refused("route", &two.b, arguments, 2);
            assert!(message.contains(why), "{message}");
        }
    });
}

#[test]
fn of_a_file_with_a_bad_line_no_route_is_taken() {
    shared("of_a_file_with_a_bad_line_no_route_is_taken", || {
        let two = Two::start("load");
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("routes");
        let many: String = (3..200).map(|n| format!("10.0.0.{n} 02:00:00:00:00:{n:02x} # {n}\n")).collect();
        let load = file.to_str().unwrap();
        for (line, why) in [
            ("10.0.0.201 02:00", "routes, line 198: '02:00' is not an Ethernet address"),
            ("10.0.0.2 02:00:00:00:00:02", "routes, line 198: 10.0.0.2 is no station's address"),
            ("10.0.0.201 00:00:00:00:00:00", "routes, line 198: 00:00:00:00:00:00 is no station's"),
        ] {
            std::fs::write(&file, format!("{many}{line}\n")).unwrap();
            let message = refused("route", &two.b, &["load", load], 2);
            assert!(message.contains(why), "{message}");
            assert_eq!(json("route", &two.b, &["list"])["hosts"], Value::Array(Vec::new()));
        }
        std::fs::write(&file, format!("{many}10.1.0.0/16 via 10.0.0.7\n")).unwrap();
        assert_eq!(json("route", &two.b, &["load", load])["routes"], 198);
        let listed = json("route", &two.b, &["list"]);
        assert_eq!(listed["hosts"].as_array().unwrap().len(), 197);
        assert_eq!(json("route", &two.b, &["get", "10.1.2.3"])["address"], "02:00:00:00:00:07");
    });
}

#[test]
fn a_ping_tells_how_long_it_took_and_how_much_of_that_it_waited() {
    shared("a_ping_tells_how_long_it_took_and_how_much_of_that_it_waited", || {
        let two = Two::start("ping");
        // What cannot be asked counts, and the summary comes.
        let unknown = ask("ping", &two.b, &["-c", "2", "-i", "20ms", "10.0.0.1"]);
        let words = String::from_utf8(unknown.stdout).unwrap();
        assert_eq!((unknown.status.code(), unknown.stderr.len()), (Some(1), 0), "{words}");
        assert!(words.contains("seq=1 was not asked: no route to 10.0.0.1"), "{words}");
        assert!(words.contains(&format!("`rtnet route -S {} solicit`", two.b)), "{words}");
        assert!(
            words.contains("0 sent, 0 came back, 0.0 % lost, 2 were not asked:\n  2 times: no route"),
            "{words}"
        );
        said("route", &two.b, &["add", "10.0.0.1", A]);
        let round = json("ping", &two.a, &["-c", "5", "-i", "20ms", "--size", "100", "10.0.0.2"]);
        assert_eq!((&round["sent"], &round["answers"][0]["bytes"]), (&5.into(), &100.into()), "{round:#}");
        assert!(round["received"].as_u64().unwrap() > 0, "{round:#}");
        let all = round["round_trip_ns"]["max"].as_u64().unwrap();
        let waited = round["waited_ns"]["p50"].as_u64().unwrap();
        assert!(waited < all, "{round:#}");
        let words = said("ping", &two.a, &["-c", "2", "-i", "20ms", "10.0.0.2"]);
        assert!(words.contains("56 bytes from 10.0.0.2: seq=1 time="), "{words}");
        assert!(words.contains("2 sent, ") && words.contains("waiting for the slot: min "), "{words}");
        said("route", &two.a, &["add", "10.0.0.9", "02:00:00:00:00:09"]);
        // Its own address asks for nothing on the medium.
        let own = said("ping", &two.a, &["-c", "1", "10.0.0.1"]);
        assert!(own.contains("seq=1 time=") && !own.contains("waiting"), "{own}");
        let own = json("ping", &two.a, &["-c", "1", "10.0.0.1"]);
        assert!(!own.to_string().contains("waited_ns"), "{own:#}");
        let all = refused("ping", &two.a, &["-c", "1", "10.0.0.255"], 2);
        assert!(all.contains("it is the broadcast address; name one that another station has"), "{all}");
        let nobody = ask("ping", &two.a, &["-c", "1", "10.0.0.9"]);
        assert_eq!(nobody.status.code(), Some(1), "nothing came back");
        let stat = json("stat", &two.b, &[]);
        assert!(stat["stack"]["echoes_answered"].as_u64().unwrap() > 0, "{stat:#}");
        assert!(stat["refused"].as_object().unwrap().contains_key("udp_checksum"), "{stat:#}");
        assert!(said("stat", &two.b, &[]).contains("echoes_answered"));
        let pools = json("pool", &two.a, &[]);
        assert_eq!(names(&pools), ["receive", "icmp", "arp"]);
        assert!(pools[1]["least"].as_u64() < pools[1]["capacity"].as_u64(), "{pools:#}");
        assert!(said("pool", &two.a, &[]).starts_with("pool "));
    });
}

/// Of pools.
fn names(pools: &Value) -> Vec<&str> {
    pools.as_array().unwrap().iter().filter_map(|of| of["pool"].as_str()).collect()
}

#[test]
fn a_station_with_slots_shows_the_pool_of_its_control_frames() {
    shared("a_station_with_slots_shows_the_pool_of_its_control_frames", || {
        let (medium, name) = (Medium::new(), unique("control"));
        let options = ["--master", "--cycle", "5ms", "--ip", "10.0.0.1/24", "--name", &name];
        let station = Station::start(&medium.a, &[&["--interface", "rt0"], &options[..]].concat());
        station.wait_for("master_active");
        let deadline = Instant::now() + PATIENCE;
        // Once it has sent a sync, and told of it.
        loop {
            let pools = json("pool", &name, &[]);
            assert_eq!(names(&pools), ["receive", "control", "icmp", "arp"]);
            let control = &pools[1];
            assert_eq!((&control["capacity"], &control["dropped"]), (&2.into(), &0.into()), "{control:#}");
            if control["least"] == 1 {
                return;
            }
            assert!(Instant::now() < deadline, "it takes one buffer at a time: {control:#}");
            std::thread::sleep(Duration::from_millis(20));
        }
    });
}

#[test]
fn what_a_station_that_stands_still_loses_is_shown_as_lost_by_its_receive_pool() {
    shared("what_a_station_that_stands_still_loses_is_shown_as_lost_by_its_receive_pool", || {
        let two = Two::start("lost");
        let socket = Attached::named(&two.a).and_then(|station| station.udp()).unwrap();
        let to = SocketAddrV4::new([10, 0, 0, 2].into(), 36_000);
        let still = Pid::from_raw(two.stations[1].child.id() as i32);
        stop(still);
        let deadline = Instant::now() + PATIENCE;
        // Far more than the kernel keeps for it.
        for _ in 0..1_000 {
            // Until the sender's station has taken what was sent before.
            while socket.send_to(&[0; 1_000], to).is_err() {
                assert!(Instant::now() < deadline, "it leaves");
                std::thread::yield_now();
            }
        }
        kill(still, Signal::SIGCONT).unwrap();
        let deadline = Instant::now() + PATIENCE;
        loop {
            let (pools, stat) = (json("pool", &two.b, &[]), json("stat", &two.b, &[]));
            let (lost, full) = (&pools[0]["dropped"], &stat["port"]["socket_full"]);
            if full.as_u64() > Some(0) && lost == full {
                return;
            }
            assert!(Instant::now() < deadline, "{pools:#} {stat:#}");
            std::thread::sleep(Duration::from_millis(20));
        }
    });
}

#[test]
fn of_a_station_that_is_killed_only_what_it_was_asked_counts_as_sent_and_that_is_a_failure() {
    shared("of_a_station_that_is_killed_only_what_it_was_asked_counts_as_sent_and_that_is_a_failure", || {
        let mut two = Two::start("killed");
        said("route", &two.b, &["add", "10.0.0.1", A]);
        let mut command = rtnet();
        command.args(["ping", "-S", &two.a, "--json", "-c", "30", "-i", "50ms", "10.0.0.2"]);
        let ping = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let deadline = Instant::now() + PATIENCE;
        while json("stat", &two.b, &[])["stack"]["echoes_answered"].as_u64() < Some(3) {
            assert!(Instant::now() < deadline, "it answers");
        }
        two.stations[0].child.kill().unwrap();
        let output = ping.wait_with_output().unwrap();
        let round = crate::schema::read(&output.stdout);
        let [sent, received, failed] = ["sent", "received", "failed"].map(|of| round[of].as_u64().unwrap());
        assert_eq!((output.status.code(), sent + failed), (Some(1), 30), "{round:#}");
        assert!(0 < received && received <= sent && sent < 30, "{round:#}");
        // Whoever has its name next takes along what it has left.
        let options = ["--interface", "rt0", "--discipline", "direct", "--name", &two.a];
        Station::start(&two.medium.a, &options).wait_for("Ctrl-C ends it");
    });
}

#[test]
fn a_station_without_an_address_says_what_to_start_it_with() {
    shared("a_station_without_an_address_says_what_to_start_it_with", || {
        let medium = Medium::new();
        let name = unique("plain");
        let options = ["--interface", "rt0", "--discipline", "direct", "--name", &name];
        let station = Station::start(&medium.a, &options);
        station.wait_for("Ctrl-C ends it");
        for (verb, arguments) in [
            ("if", &[][..]),
            ("route", &["list"]),
            ("pool", &[]),
            ("stat", &[]),
            ("route", &["solicit", "10.0.0.1"]),
            ("ping", &["10.0.0.1"]),
        ] {
            let message = refused(verb, &name, arguments, 2);
            assert!(
                message.contains(&name) && message.contains("`rtnet station --ip 10.0.0.1/24`"),
                "{message}"
            );
        }
    });
}
