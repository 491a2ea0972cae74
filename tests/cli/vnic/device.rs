//! What somebody does to its device, and what `rtnet vnic` and `rtnet slot` do.

use serde_json::Value;

use super::{MODES, TUNNEL, answers, assert_answers, done, lab, refused, said, shared, status, vnic};
use crate::cell::{Cell, wait_until};

const MASTER: &str = "10.1.0.1";

fn strings(value: &Value) -> Vec<&str> {
    value.as_array().unwrap().iter().map(|one| one.as_str().unwrap()).collect()
}

/// Linux's own addresses of a link are of no interest here.
fn addresses(status: &Value) -> Vec<String> {
    let all = strings(&status["addresses"]);
    let mut all: Vec<_> = all.into_iter().filter(|a| !a.starts_with("fe80")).map(str::to_owned).collect();
    all.sort();
    all
}

fn set(cell: &Cell, arguments: &[&str]) {
    done(vnic(cell, "slave1", &[&["set"], arguments].concat()));
}

#[test]
fn a_device_that_is_deleted_is_told_of_and_made_anew_on_request() {
    shared("a_device_that_is_deleted_is_told_of_and_made_anew_on_request", || {
        for mode in MODES {
            let cell = lab("deleted", TUNNEL, mode);
            assert_answers(&cell, "slave1", MASTER);
            said(&cell, "slave1", &["ip", "link", "del", "vnic0"]);
            wait_until("it is told", || status(&cell, "slave1")["state"] == "gone");
            let news = "the VNIC's device 'vnic0' was deleted or moved to another namespace by somebody: `rtnet vnic up` \
                        makes it anew";
            assert_eq!(status(&cell, "slave1")["news"], news);
            assert!(done(vnic(&cell, "slave1", &["status"])).ends_with(&format!("{news}\n")));
            let lost = || status(&cell, "slave1")["lost"]["device_down"].as_u64().unwrap_or(0);
            let before = lost();
            assert!(!answers(&cell, "master", "10.1.0.2"));
            assert!(lost() > before, "what comes for it meanwhile is counted: {}", lost());
            let gone = "the VNIC's device 'vnic0' is gone: `rtnet vnic up` makes it anew";
            for wish in [&["down"][..], &["set", "--mtu", "900"], &["set", "--address", "10.8.0.2/24"]] {
                assert!(refused(vnic(&cell, "slave1", wish)).contains(gone));
            }
            let up = done(vnic(&cell, "slave1", &["up"]));
            // Linux may have asked for its neighbour once more until then.
            let lost = lost();
            assert!(up.starts_with(&format!("vnic0 ({mode}, up): 10.1.0.2/24")), "{up}");
            assert!(up.contains("MTU 1496: ") && up.contains("Linux is held back to 3"), "{up}");
            for to in [MASTER, "fd00::1"] {
                assert_answers(&cell, "slave1", to);
            }
            let now = status(&cell, "slave1");
            assert_eq!((&now["news"], &now["lost"]["device_down"]), (&Value::Null, &lost.into()), "{now:#}");
            assert_eq!(cell.down()["unexplained"], 0);
        }
    });
}

#[test]
fn a_device_that_is_renamed_is_followed() {
    shared("a_device_that_is_renamed_is_followed", || {
        let cell = lab("renamed", TUNNEL, "tap");
        // Linux renames none that is up, on some kernels.
        done(vnic(&cell, "slave1", &["down"]));
        said(&cell, "slave1", &["ip", "link", "set", "vnic0", "name", "office"]);
        wait_until("it is told", || status(&cell, "slave1")["device"] == "office");
        let shown = status(&cell, "slave1");
        assert_eq!(shown["news"], "the VNIC's device 'vnic0' is called 'office' now");
        assert_eq!(shown["state"], "down");
        done(vnic(&cell, "slave1", &["up"]));
        assert_answers(&cell, "slave1", MASTER);
        // Also where it is made anew.
        said(&cell, "slave1", &["ip", "link", "del", "office"]);
        wait_until("it is gone", || status(&cell, "slave1")["state"] == "gone");
        assert!(done(vnic(&cell, "slave1", &["up"])).starts_with("office (tap, up): "));
        assert_answers(&cell, "slave1", MASTER);
        cell.down();
    });
}

#[test]
fn the_mtu_follows_the_slot_both_ways_and_what_was_asked_for() {
    shared("the_mtu_follows_the_slot_both_ways_and_what_was_asked_for", || {
        let cell = lab("mtu", TUNNEL, "tap");
        let is = |mtu: u64| {
            wait_until(&format!("its MTU is {mtu}"), || status(&cell, "slave1")["mtu"] == mtu);
            let linux = said(&cell, "slave1", &["ip", "-o", "link", "show", "dev", "vnic0"]);
            assert!(linux.contains(&format!(" mtu {mtu} ")), "{linux}");
        };
        let resize = |size: &str| {
            assert!(cell.slot("slave1", &["set", &format!("1=2450us,size={size}")]).status.success());
        };
        is(1_496);
        resize("500");
        is(496);
        let waits = "IPv6 waits: it needs an MTU of 1280 (fd00::2/64)";
        let shown = status(&cell, "slave1");
        assert_eq!(
            (addresses(&shown), strings(&shown["remarks"])),
            (vec!["10.1.0.2/24".into()], vec![waits])
        );
        assert!(done(vnic(&cell, "slave1", &["status"])).contains(&format!("{waits}\n")));
        assert_answers(&cell, "slave1", MASTER);
        resize("1500");
        is(1_496);
        wait_until("its address of IPv6 is back", || {
            addresses(&status(&cell, "slave1")) == ["10.1.0.2/24", "fd00::2/64"]
        });
        assert_answers(&cell, "slave1", "fd00::1");
        set(&cell, &["--mtu", "1300"]);
        is(1_300);
        resize("1000");
        is(996);
        resize("1400");
        is(1_300);
        let shown = status(&cell, "slave1");
        assert_eq!((&shown["mtu_at_most"], &shown["slot_takes"]), (&1_300.into(), &1_396.into()));
        // What somebody else sets is set back, and told.
        for mtu in ["1450", "1000"] {
            said(&cell, "slave1", &["ip", "link", "set", "vnic0", "mtu", mtu]);
            let news = format!(
                "the MTU of 'vnic0' was set to {mtu} by somebody: set back to 1300; `rtnet vnic set --mtu` sets it"
            );
            wait_until("it is told", || status(&cell, "slave1")["news"] == news);
            is(1_300);
        }
        assert_answers(&cell, "slave1", "fd00::1");
        resize("64");
        let small = "the slot takes 60 bytes of inner payload, a device of Linux at least 68: what is longer is lost; make \
                     slot 1, or what stands for it, 72 or more";
        wait_until("it is told", || strings(&status(&cell, "slave1")["remarks"]).contains(&small));
        is(68);
        cell.down();
    });
}

#[test]
fn another_ethernet_address_than_its_stations_is_set_back_and_told() {
    shared("another_ethernet_address_than_its_stations_is_set_back_and_told", || {
        let cell = lab("mac", TUNNEL, "tap");
        assert_answers(&cell, "slave1", MASTER);
        said(&cell, "slave1", &["ip", "link", "set", "vnic0", "address", "02:00:00:00:00:99"]);
        let own = "02:00:00:00:00:02";
        let news = format!(
            "the address of 'vnic0' was set to 02:00:00:00:00:99 by somebody: set back to {own}, its station's"
        );
        wait_until("it is told", || status(&cell, "slave1")["news"] == news);
        assert_eq!(status(&cell, "slave1")["mac"], own);
        assert!(done(vnic(&cell, "slave1", &["status"])).contains(&format!("\nMAC {own}\n")));
        assert_answers(&cell, "slave1", MASTER);
        cell.down();
    });
}

#[test]
fn a_vnic_is_set_down_and_up_and_changed_while_it_runs() {
    shared("a_vnic_is_set_down_and_up_and_changed_while_it_runs", || {
        for mode in MODES {
            let cell = lab("set", TUNNEL, mode);
            assert_answers(&cell, "slave1", MASTER);
            assert!(done(vnic(&cell, "slave1", &["down"])).contains(&format!("vnic0 ({mode}, down): ")));
            assert!(!answers(&cell, "master", "10.1.0.2"));
            done(vnic(&cell, "slave1", &["up"]));
            for to in [MASTER, "fd00::1"] {
                assert_answers(&cell, "slave1", to);
            }
            // Two stations move to another network.
            for (station, old, new, peer) in [
                ("slave1", "10.1.0.2/24", "10.7.0.1/24", "10.7.0.2=02:00:00:00:00:01"),
                ("master", "10.1.0.1/24", "10.7.0.2/24", "10.7.0.1=02:00:00:00:00:02"),
            ] {
                let moves = ["set", "--address", new, "--no-address", old, "--peer", peer];
                // By a tap Linux asks.
                let words = if mode == "tun" { &moves[..] } else { &moves[..5] };
                done(vnic(&cell, station, words));
            }
            let shown = status(&cell, "slave1");
            assert_eq!(addresses(&shown), ["10.7.0.1/24", "fd00::2/64"]);
            let knows = strings(&shown["peers"]).contains(&"10.7.0.2/32=02:00:00:00:00:01");
            assert_eq!(knows, mode == "tun", "{shown:#}");
            assert_answers(&cell, "slave1", "10.7.0.2");
            // Within their network, too: with an address Linux takes those away that came after it.
            set(&cell, &["--address", "10.7.0.9/24", "--no-address", "10.7.0.1/24"]);
            assert_eq!(addresses(&status(&cell, "slave1")), ["10.7.0.9/24", "fd00::2/64"]);
            set(&cell, &["--address", "10.7.0.1/24", "--no-address", "10.7.0.9/24"]);
            assert_answers(&cell, "slave1", "10.7.0.2");
            cell.down();
        }
    });
}

#[test]
fn a_station_that_is_restarted_has_its_device_again() {
    shared("a_station_that_is_restarted_has_its_device_again", || {
        for mode in MODES {
            let cell = lab("restarted", TUNNEL, mode);
            assert_answers(&cell, "slave1", MASTER);
            let before = status(&cell, "slave1");
            // Of what was asked of it while it ran nothing is left: it is started as its file has it.
            set(&cell, &["--mtu", "1300", "--no-address", "10.1.0.2/24"]);
            cell.restart("slave1");
            let shown = || {
                let output = vnic(&cell, "slave1", &["status", "--json"]);
                serde_json::from_slice(&output.stdout).unwrap_or(Value::Null)
            };
            wait_until("its device is there", || shown()["mtu"] == before["mtu"]);
            cell.wait_until_locked();
            for to in [MASTER, "fd00::1"] {
                assert_answers(&cell, "slave1", to);
            }
            for to in ["10.1.0.2", "fd00::2"] {
                assert_answers(&cell, "master", to);
            }
            let after = status(&cell, "slave1");
            for what in ["device", "mode", "state", "mtu", "mtu_at_most", "slot_takes", "peers", "news"] {
                assert_eq!(before[what], after[what], "{what}");
            }
            assert_eq!(addresses(&before), addresses(&after));
            let linux = said(&cell, "slave1", &["ip", "-o", "link"]);
            assert_eq!(linux.matches("vnic").count(), 1, "{linux}");
            let account = cell.down();
            assert_eq!(
                (&account["unexplained"], &account["stations"][1]["restarts"]),
                (&0.into(), &1.into())
            );
        }
    });
}

#[test]
fn what_is_refused_changes_nothing() {
    shared("what_is_refused_changes_nothing", || {
        let peer = ["set", "--mtu", "900", "--peer", "10.7.0.3=02:00:00:00:00:03"];
        let cell = lab("nothing", TUNNEL, "tap");
        let before = status(&cell, "slave1");
        let message = refused(vnic(&cell, "slave1", &peer));
        assert!(message.ends_with("by which Linux asks who has an address: leave --peer out\n"), "{message}");
        assert_eq!(before["mtu"], status(&cell, "slave1")["mtu"]);
        cell.down();

        let cell = lab("nothing", TUNNEL, "tun");
        let before = status(&cell, "slave1");
        let group = ["set", "--mtu", "900", "--peer", "10.7.0.3=ff:ff:ff:ff:ff:ff"];
        let message = refused(vnic(&cell, "slave1", &group));
        assert!(
            message.ends_with("slave1': ff:ff:ff:ff:ff:ff is the address of a group: name a station's\n"),
            "{message}"
        );
        // The first can be done, the second cannot.
        let foreign = ["set", "--address", "10.7.0.2/24", "--no-address", "10.9.0.9/24", "--mtu", "900"];
        let message = refused(vnic(&cell, "slave1", &foreign));
        assert!(message.contains("10.9.0.9/24") && message.contains("it has no such address"), "{message}");
        let after = status(&cell, "slave1");
        for what in ["mtu", "mtu_at_most", "peers", "addresses"] {
            assert_eq!(before[what], after[what]);
        }
        cell.down();
    });
}
