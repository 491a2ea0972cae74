//! The worst waits that a plan tells of programs' frames are reached, and never exceeded.

use tests::seeds;
use tools::plan::{Plan, WaitRow};
use tools::scenario::{Scenario, Source};
use tools::sim::{self, Options};

/// An arm with these slots and this traffic, whose clock is right as the master's is.
fn arm(slots: &str, traffic: &str) -> String {
    format!(
        "cycle = \"1ms\"\nrate = \"100M\"\nduration = \"45s\"\n[[station]]\nname = \"master\"\nrole = \"master\"\nclock = {{}}\nslots = [{{ id \
         = 0, offset = \"100us\" }}]\n[[station]]\nname = \"arm\"\nrole = \"slave\"\nrounds = 4\nclock = {{}}\nslots = [{slots}]\n{traffic}"
    )
}

fn traffic(priority: u8, every: &str, burst: u32) -> String {
    format!("[[station.traffic]]\npriority = {priority}\nevery = \"{every}\"\nburst = {burst}\nslot = 0\n")
}

fn parse(text: &str) -> Scenario {
    Source::new("net.toml", text).parse().unwrap().with_seed(seeds::one("planned"))
}

fn worst_is_reached(slots: &str, traffic: &str) {
    let text = arm(slots, traffic);
    let scenario = parse(&text);
    let plan = Plan::of(&scenario, None);
    assert!(plan.works(), "{:?}", plan.refused);
    let figures = sim::run(&scenario, &Options::default()).unwrap().figures.figures;
    let flows = |row: &&WaitRow| row.station == "arm" && row.flow.is_some();
    let rows: Vec<_> = plan.waits.iter().filter(flows).collect();
    assert_eq!(rows.len(), figures.queueing.len());
    for (row, seen) in rows.iter().zip(&figures.queueing) {
        assert_eq!((row.flow.map(|flow| flow.priority), seen.refused), (Some(seen.priority), 0));
        let (said, most) = (row.worst_ns.unwrap(), seen.delay_ns.max.unwrap());
        // Seen from the cycle, a program's moments move by so much from one to the next: in 45 s they come so near to any.
        let step = row.flow.unwrap().every_ns as i64 % 1_000;
        assert!(most <= said && most >= said - step - 2, "priority {}: {most} of {said}", seen.priority);
    }
}

#[test]
fn of_one_slot_behind_bursts_of_what_is_more_urgent() {
    let all = [traffic(2, "4000100ns", 1), traffic(9, "8000200ns", 2), traffic(20, "16000400ns", 4)].concat();
    worst_is_reached("{ id = 0, offset = \"400us\" }", &all);
}

#[test]
fn of_joint_slots_in_some_cycles_only() {
    let slots = "{ id = 0, offset = \"400us\" }, { id = 2, offset = \"700us\", phase = \"2/3\", joint = 0 }";
    worst_is_reached(slots, &[traffic(0, "3000100ns", 2), traffic(5, "6000200ns", 3)].concat());
}

#[test]
fn what_wants_more_turns_than_there_are_is_refused_and_loses_frames() {
    let text = arm(
        "{ id = 0, offset = \"400us\", phase = \"1/2\" }",
        &[traffic(3, "10ms", 4), traffic(7, "9ms", 1)].concat(),
    );
    let scenario = parse(&text);
    let plan = Plan::of(&scenario, None);
    assert_eq!(
        plan.refused,
        [
            "traffic of priority 7 of station 'arm' waits for ever: slot 0 has 500.0 turns a second, and with what is more urgent 511.1 are \
          wanted (1 every 9ms of it); send less often, or give the slot more turns: a shorter cycle or period, or a joint slot"
        ]
    );
    let figures = sim::run(&scenario, &Options::default()).unwrap().figures.figures;
    let refused: Vec<_> = figures.queueing.iter().map(|seen| (seen.priority, seen.refused > 0)).collect();
    assert_eq!(refused, [(3, false), (7, true)]);
}

#[test]
fn a_burst_of_more_frames_than_buffers_is_refused_and_loses_frames() {
    let text = arm("{ id = 0, offset = \"400us\" }", &traffic(3, "100ms", 65));
    let scenario = parse(&text);
    let plan = Plan::of(&scenario, None);
    assert!(
        plan.refused[0]
            .starts_with("traffic of priority 3 of station 'arm' loses frames: 65 may wait at once"),
        "{:?}",
        plan.refused
    );
    let figures = sim::run(&scenario, &Options::default()).unwrap().figures.figures;
    assert!(figures.queueing[0].refused > 0);
}

#[test]
fn of_joint_slots_that_meet_too_seldom_nothing_is_said() {
    let slots = "{ id = 0, offset = \"400us\", phase = \"1/1023\" }, { id = 2, offset = \"700us\", phase = \"2/1024\", joint = 0 }";
    let scenario = parse(&arm(slots, &traffic(3, "100s", 1)));
    let plan = Plan::of(&scenario, None);
    let of = |row: &&WaitRow| row.flow.is_some();
    let row = plan.waits.iter().find(of).unwrap();
    assert_eq!((row.worst_ns, row.is_endless(), row.turn_ns), (None, false, Some(1_023_000_000)));
    assert!(plan.works(), "{:?}", plan.refused);
}
