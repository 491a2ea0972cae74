//! How Linux is held back, also where no cycle is known, and where others take filter or device: no figure is lost.

use serde_json::Value;

use super::{Running, TUNNEL, are_there, assert_answers, done, lab, program, said, shared, status, vnic};
use crate::cell::{Cell, wait_until};
use crate::rtnet;

const MASTER: &str = "10.1.0.1";
/// More datagrams than may wait, again and again.
const FLOOD: &str = "\
    exec 3<>/dev/udp/$0/9; printf -v datagram '%01467d' 0; \
    while :; do for ((n = 0; n < 300; n++)); do echo \"$datagram\"; done; sleep 0.2; done >&3 2>/dev/null";
/// A socket waits while so much of its own is in the queue as it may have there.
const SOCKETS: usize = 3;
const RATE: u64 = 985 * 1510 / 4;

fn flood(cell: &Cell) -> [Running; SOCKETS] {
    [(); SOCKETS].map(|()| Running::start(program(cell, "slave1", &["bash", "-c", FLOOD, MASTER])))
}

fn tdma(cell: &Cell, arguments: &[&str]) {
    done(rtnet().args(["tdma", "-S", &cell.place("slave1")]).args(arguments).output().unwrap());
}

fn of(status: &Value, what: [&str; 2]) -> u64 {
    status[what[0]][what[1]].as_u64().unwrap_or_else(|| panic!("{what:?}: {status:#}"))
}

fn dropped(status: &Value) -> u64 {
    let dropped = of(status, ["lost", "filter_dropped"]);
    assert_eq!(dropped, of(status, ["filter", "dropped"]));
    dropped
}

/// What has been counted does not become less.
#[track_caller]
fn assert_goes_on(before: &Value, after: &Value) {
    for what in ["packets", "bytes", "dropped"].map(|name| ["filter", name]).into_iter().chain([
        ["lost", "filter_dropped"],
        ["lost", "device_queue_full"],
        ["counters", "sent"],
    ]) {
        let [before, after] = [before, after].map(|status| of(status, what));
        assert!(after >= before, "{what:?}: {before}, then {after}");
    }
}

#[test]
fn what_the_filter_has_counted_goes_on_while_no_cycle_is_known() {
    shared("what_the_filter_has_counted_goes_on_while_no_cycle_is_known", || {
        let cell = lab("no-cycle", TUNNEL, "tap");
        assert_answers(&cell, "slave1", MASTER);
        let floods = flood(&cell);
        wait_until("Linux is held back", || dropped(&status(&cell, "slave1")) > 0);
        tdma(&cell, &["detach"]);
        let is = |what: &str, value: Value| {
            wait_until(&format!("{what} is {value}"), || status(&cell, "slave1")[what] == value);
        };
        is("held_back_as_before", "no cycle is known any more".into());
        let detached = status(&cell, "slave1");
        assert_eq!((&detached["bytes_per_second"], &detached["not_held_back"]), (&RATE.into(), &Value::Null));
        wait_until("some wait", || of(&status(&cell, "slave1"), ["filter", "waiting"]) > 0);
        drop(floods);
        let waits = status(&cell, "slave1");
        assert_goes_on(&detached, &waits);
        let text = done(vnic(&cell, "slave1", &["status"]));
        assert!(text.contains(" bytes/s as before (no cycle is known any more): "), "{text}");
        assert!(text.contains("lost: ") && text.contains("filter_dropped "), "{text}");

        tdma(&cell, &["slave", "--rounds", "20"]);
        is("held_back_as_before", Value::Null);
        assert_answers(&cell, "slave1", MASTER);
        let again = status(&cell, "slave1");
        assert_goes_on(&waits, &again);
        let passed_on = |status| of(status, ["filter", "packets"]);
        let went = passed_on(&again) - passed_on(&waits);
        assert!(went >= of(&waits, ["filter", "waiting"]), "what waited was not lost: {waits:#} {again:#}");

        // It has to have one, to calibrate.
        for change in [["remove", "1"], ["set", "2=2450us"], ["remove", "0"]] {
            done(cell.slot("slave1", &change));
        }
        is("held_back_as_before", "the station has no slot 1 or 0 for it".into());
        assert_goes_on(&again, &status(&cell, "slave1"));
    });
}

#[test]
fn a_filter_or_a_device_that_others_take_away_takes_no_figure_with_it() {
    let test = "a_filter_or_a_device_that_others_take_away_takes_no_figure_with_it";
    shared(test, || {
        if !are_there(test, &[("tc", "iproute2")]) {
            return;
        }
        let cell = lab("taken", TUNNEL, "tap");
        assert_answers(&cell, "slave1", MASTER);
        let floods = flood(&cell);
        wait_until("Linux is held back", || dropped(&status(&cell, "slave1")) > 0);
        // So that what waits stays.
        tdma(&cell, &["detach"]);
        wait_until("some wait", || of(&status(&cell, "slave1"), ["filter", "waiting"]) > 0);
        drop(floods);
        let before = status(&cell, "slave1");
        said(&cell, "slave1", &["tc", "qdisc", "del", "dev", "vnic0", "root"]);
        let taken = status(&cell, "slave1");
        let why = "somebody has taken the filter away: `rtnet vnic up` puts it back";
        assert_eq!((&taken["not_held_back"], &taken["bytes_per_second"]), (&why.into(), &Value::Null));
        assert_goes_on(&before, &taken);
        // Passed on, dropped, or waiting: there are no fewer.
        let all = |status| {
            ["packets", "dropped", "waiting"].iter().map(|what| of(status, ["filter", what])).sum::<u64>()
        };
        assert!(
            all(&taken) >= all(&before) && of(&taken, ["filter", "waiting"]) == 0,
            "{before:#} {taken:#}"
        );
        let up = done(vnic(&cell, "slave1", &["up"]));
        assert!(up.contains("Linux is held back to 371 837 bytes/s"), "{up}");
        assert_goes_on(&taken, &status(&cell, "slave1"));

        // What its device has counted outlasts it.
        tdma(&cell, &["slave", "--rounds", "20"]);
        assert_answers(&cell, "slave1", MASTER);
        let before = status(&cell, "slave1");
        said(&cell, "slave1", &["ip", "link", "del", "vnic0"]);
        wait_until("it is gone", || status(&cell, "slave1")["state"] == "gone");
        let gone = status(&cell, "slave1");
        assert_eq!(gone["not_held_back"], "there is no device");
        assert_goes_on(&before, &gone);
        done(vnic(&cell, "slave1", &["up"]));
        let anew = status(&cell, "slave1");
        assert_goes_on(&gone, &anew);
        assert_eq!(anew["bytes_per_second"], RATE);
        // Linux empties the filter of what it sets down.
        let floods = flood(&cell);
        wait_until("some wait", || of(&status(&cell, "slave1"), ["filter", "waiting"]) > 10);
        done(vnic(&cell, "slave1", &["down"]));
        drop(floods);
        let down = status(&cell, "slave1");
        assert_goes_on(&anew, &down);
        assert!(dropped(&down) > dropped(&anew), "{down:#}");
        assert_eq!(of(&down, ["filter", "waiting"]), 0);
    });
}
