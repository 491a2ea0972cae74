//! What becomes of a station when something happens to its interface.

use rtnet::live::clock::monotonic;
use serde_json::Value;
use tools::lab::namespace::Namespace;
use tools::station::link::{LabOptions, Report};

use crate::host::shared;
use crate::rtnet;
use crate::station::{B, Medium, Station, is, set, status, wait_until};

#[test]
fn a_slave_whose_carrier_is_lost_and_back_follows_again() {
    shared("a_slave_whose_carrier_is_lost_and_back_follows_again", || {
        let medium = Medium::new();
        let (_master, slave) =
            (Station::master(&medium, "carrier-master"), Station::slave(&medium, "carrier-slave"));
        medium.set_port("port1", false);
        let cut = wait_until("it is cut off", "carrier-slave", is("no carrier", "lost"));
        assert_eq!(
            (&cut["counters"]["carrier_lost"], &cut["standing"]["link"]),
            (&1.into(), &"no carrier".into())
        );
        slave.wait_for("carrier-slave: the interface 'rt0' has no carrier: look at the cable");
        let words = rtnet().args(["tdma", "-S", "carrier-slave", "status"]).output().unwrap();
        let words = String::from_utf8(words.stdout).unwrap();
        assert!(
            words.contains(", no carrier), process")
                && words.contains(" guard\n")
                && words.contains("carrier_lost 1"),
            "{words}"
        );

        medium.set_port("port1", true);
        let back = wait_until("it follows again", "carrier-slave", is("up", "locked"));
        assert_eq!((&back["pid"], &back["counters"]["carrier_lost"]), (&cut["pid"], &1.into()));
        slave.wait_for("the interface 'rt0' has its carrier again");
        let master = status("carrier-master");
        assert_eq!((&master["link"], &master["counters"]["carrier_lost"]), (&"up".into(), &0.into()));
    });
}

#[test]
fn a_master_whose_interface_is_down_for_a_while_goes_on_without_a_flood_of_lines() {
    shared("a_master_whose_interface_is_down_for_a_while_goes_on_without_a_flood_of_lines", || {
        let medium = Medium::new();
        let (master, _slave) =
            (Station::master(&medium, "down-master"), Station::slave(&medium, "down-slave"));
        set(&medium.a, "rt0", false);
        wait_until("its slave has lost it", "down-slave", is("up", "lost"));
        let failed = |status: &Value| status["counters"]["send_failed"].as_u64().unwrap_or(0);
        let down =
            wait_until("syncs fail", "down-master", |master| master["link"] == "down" && failed(master) > 50);
        let words = rtnet().args(["tdma", "-S", "down-master", "status", "--misses"]).output().unwrap();
        let words = String::from_utf8(words.stdout).unwrap();
        assert!(words.contains("send failed: ENETDOWN: Network is down: "), "by its name: {words}");
        let late = down["misses"]["worst"].as_array().unwrap();
        assert!(late.iter().all(|miss| miss["what"] != "send_failed"), "an errno is no lateness: {late:?}");
        set(&medium.a, "rt0", true);
        wait_until("its slave follows again", "down-slave", is("up", "locked"));
        // The master's interface thread polls: it may see the interface up after the slave has received a sync.
        let up = wait_until("it sends again", "down-master", |master| {
            let sent = |of: &Value| of["counters"]["syncs_sent"].as_u64();
            sent(master) > sent(&down) && master["link"] == "up"
        });
        assert_eq!((&up["pid"], &up["counters"]["carrier_lost"]), (&down["pid"], &1.into()));
        // Two threads write these lines, in either order.
        let has_line = |lines: &[String], what: &str| lines.iter().any(|line| line.contains(what));
        let mut lines = Vec::new();
        while !["send_failed: the last of", "has its carrier again"].iter().all(|what| has_line(&lines, what))
        {
            lines.push(master.wait_for(""));
        }
        assert!(has_line(&lines, "'rt0' is down: bring it up with `ip link set rt0 up`"), "{lines:?}");
        let failures: Vec<_> = lines.iter().filter(|line| line.contains("send_failed")).collect();
        assert_eq!(failures.len(), 2, "the first, and how many more: {lines:?}");
        assert!(failures[0].contains("send_failed: Network is down"), "{lines:?}");
    });
}

#[test]
fn a_slave_whose_interface_is_renamed_goes_on_under_the_new_name() {
    shared("a_slave_whose_interface_is_renamed_goes_on_under_the_new_name", || {
        let medium = Medium::new();
        let (_master, slave) =
            (Station::master(&medium, "renamed-master"), Station::slave(&medium, "renamed-slave"));
        let mut netlink = medium.b.netlink().unwrap();
        let index = netlink.link_index("rt0").unwrap();
        netlink.set_down(index).unwrap();
        netlink.rename(index, "rt9").unwrap();
        netlink.set_up(index).unwrap();
        slave.wait_for("renamed-slave: the interface 'rt0' is called 'rt9' now");
        let renamed = wait_until("it follows again", "renamed-slave", is("up", "locked"));
        assert_eq!((&renamed["interface"], &renamed["counters"]["renamed"]), (&"rt9".into(), &1.into()));
    });
}

#[test]
fn a_station_whose_interface_is_gone_ends_with_a_clear_line_and_the_others_go_on() {
    shared("a_station_whose_interface_is_gone_ends_with_a_clear_line_and_the_others_go_on", || {
        let elsewhere = Namespace::new().unwrap();
        let removed = |medium: &mut Medium| medium.segment.detach("port1").unwrap();
        let move_rt0 = |from: &Namespace, to: &Namespace| {
            let mut netlink = from.netlink().unwrap();
            let index = netlink.link_index("rt0").unwrap();
            netlink.move_to(index, to.fd()).unwrap();
        };
        let moved = |medium: &mut Medium| move_rt0(&medium.b, &elsewhere);
        // It is there, by the same name and index, and yet not what the station's sockets were bound to.
        let back = |medium: &mut Medium| {
            let elsewhere = Namespace::new().unwrap();
            move_rt0(&medium.b, &elsewhere);
            move_rt0(&elsewhere, &medium.b);
        };
        let ways: [&dyn Fn(&mut Medium); 3] = [&removed, &moved, &back];
        for away in ways {
            let mut medium = Medium::new();
            let (_master, mut slave) =
                (Station::master(&medium, "gone-master"), Station::slave(&medium, "gone-slave"));
            away(&mut medium);
            assert_eq!(slave.ended().and_then(|status| status.code()), Some(1));
            let line = slave.wait_for("rtnet: ");
            assert!(
                line.contains("the interface 'rt0' is gone: it was removed, or moved to another"),
                "{line}"
            );
            assert!(line.contains("start the station again"), "the remedy: {line}");
            let syncs = |master: &Value| master["counters"]["syncs_sent"].as_u64();
            let before = status("gone-master");
            assert_eq!((&before["link"], &before["standing"]["state"]), (&"up".into(), &"locked".into()));
            wait_until("the master goes on", "gone-master", |master| syncs(master) > syncs(&before));
        }
    });
}

#[test]
fn a_lab_is_told_when_its_stations_carrier_is_lost_and_back_and_when_it_cannot_go_on() {
    shared("a_lab_is_told_when_its_stations_carrier_is_lost_and_back_and_when_it_cannot_go_on", || {
        let mut medium = Medium::new();
        let lab = LabOptions {
            station: 0,
            name: "told".into(),
            control: None,
            anchor: 0,
            offset_ns: 0,
            drift_ppb: 0,
            epoch: 0,
            destination: B,
            from: 1,
            payload: 46,
            from_payload: 46,
            step_limit_ns: 100_000,
            resume: None,
            first: 0,
            flows: Default::default(),
            may_stall: false,
            changes: None,
        };
        let lab = serde_json::to_string(&lab).unwrap();
        let mut station =
            Station::of_lab(&medium.a, &["--interface", "rt0", "--master", "--cycle", "5ms", "--lab", &lab]);
        let report = |station: &Station, of: &str| -> Report {
            serde_json::from_str(&station.wait_for(&format!("{{\"{of}\":"))).unwrap()
        };
        let Report::Standing(standing) = report(&station, "standing") else { panic!("asked for by name") };
        assert_eq!(standing.link, "up");
        let mut last = 0;
        for up in [false, true] {
            medium.set_port("port0", up);
            let Report::Link { at, carrier } = report(&station, "link") else { panic!("asked for by name") };
            assert_eq!(carrier, up);
            assert!(last < at && at < monotonic(), "seen to be otherwise at {last} and {at}");
            last = at;
        }
        medium.segment.detach("port0").unwrap();
        let Report::Failed(why) = report(&station, "failed") else { panic!("asked for by name") };
        assert!(why.contains("'rt0' is gone"), "{why}");
        assert_eq!(station.ended().and_then(|status| status.code()), Some(1));
    });
}
