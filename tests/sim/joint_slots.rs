//! Stations with joint slots: several opportunities in a cycle for one queue.

use rtmac::tdma::{Counters, SlotConfig, TdmaStatus};
use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, Opportunity, Outlet, Service};
use rtnet::queue::Priority;
use rtnet::sim::Host;
use rtnet::time::Instant;
use rtnet::wire::ethernet::EtherType;
use tests::mixed::MixedStatus;
use tests::observed::Observed;
use tests::seeds;

/// The axis sends twice in each cycle, the sensor in every second besides, from one queue each.
const LAB: &str = r#"
cycle = "1ms"

[[station]]
name = "master"
role = "master"
slots = [{ id = 0, offset = "125us" }]

[[station]]
name = "axis"
role = "slave"
slots = [{ id = 2, offset = "625us", joint = 0 }, { id = 0, offset = "250us" }]

[[station]]
name = "sensor"
role = "slave"
slots = [{ id = 0, offset = "375us" }, { id = 7, offset = "750us", phase = "2/2", joint = 0 }]
"#;
const AXIS: usize = 1;
const CYCLES: u32 = 2_000;

#[test]
fn a_station_with_a_joint_slot_sends_twice_as_often_and_nothing_is_unexplained() {
    let mut lab = Observed::lab(LAB, Host::IDEAL);
    lab.judge(CYCLES);
    assert_eq!(lab.findings(), (0, vec![]));
    let seen: Vec<u64> = lab.analysis().stations.iter().map(|station| station.frames).collect();
    let cycles = u64::from(CYCLES);
    assert_eq!(seen, [cycles, 2 * cycles, cycles + cycles / 2]);
    for (id, counts) in lab.received.iter().enumerate() {
        let arrived = counts.arrived(None);
        assert_eq!(arrived.missing, 0, "in the order in which they were queued");
        assert!(arrived.received >= seen[lab.plan.scenario.sender(id)]);
        assert_eq!(lab.network.member(id).station.refusals().total(), 0);
    }
}

#[test]
fn what_hosts_spoil_of_joint_slots_is_told_of_slot_by_slot() {
    seeds::each(4, |seed| {
        let mut lab = Observed::seeded(LAB, Host::VIRTUAL_MACHINE, seed);
        lab.judge(30_000);
        let (found, unexplained) = lab.findings();
        assert!(found > 0, "the host model is on");
        assert_eq!(unexplained, []);
    });
}

#[test]
fn a_frame_leaves_in_the_nearest_of_its_queues_slots() {
    let mut lab = Observed::with(LAB, (Host::IDEAL, seeds::one("joint_slots")), |_, _, _| {
        Box::new(Pairs { pool: Pool::new(64) })
    });
    lab.run_cycles(1_000);
    let before = sent(&lab);
    lab.run_cycles(1_000);
    let pairs: Vec<u64> = sent(&lab).iter().zip(before).map(|(now, before)| now - before).collect();
    assert_eq!(pairs, [1_000; 2], "one of each pair in slot 0, the other in slot 2 of the same cycle");
    assert_eq!(axis(&lab).slots[0].unwrap().queued, 0);
}

#[test]
fn slots_that_are_parted_resized_and_joined_while_they_run_lose_no_frame() {
    let mut lab = Observed::lab(LAB, Host::IDEAL);
    lab.run_cycles(1_000);
    let of = |lab: &Observed| [0, 1].map(|place| axis(lab).slots[place].unwrap().config);
    let [own, joint] = of(&lab);
    let large = SlotConfig { size: 200, ..own };
    for (change, expected) in [
        (large, [(200, None), (64, None)]),
        (SlotConfig { size: 200, joint: None, ..joint }, [(200, None), (200, None)]),
        (SlotConfig { size: 200, ..joint }, [(200, None), (200, Some(0))]),
        (own, [(64, None), (64, Some(0))]),
    ] {
        let before = axis(&lab).counters.frames_sent;
        lab.set_slot(AXIS, change);
        lab.run_cycles(50);
        assert_eq!(of(&lab).map(|slot| (slot.size, slot.joint)), expected);
        assert_eq!(axis(&lab).counters.frames_sent - before, 100, "in every turn of both");
    }
    let Counters { returned_dropped, joints_detached, .. } = axis(&lab).counters;
    assert_eq!((returned_dropped, joints_detached), (0, 1));
    assert!(lab.received.iter().all(|counts| counts.arrived(None).missing == 0));
}

/// What waits stays where it waits: frames of one priority may overtake others then, but not be lost, and every turn that
/// nothing waits for has its usual frame.
#[test]
fn slots_with_queued_traffic_are_joined_and_parted_while_it_waits_and_every_turn_has_its_frame() {
    let traffic = r#"name = "axis"
traffic = [{ priority = 5, every = "9ms", burst = 5 }, { priority = 9, every = "9ms", burst = 9, slot = 2 }]"#;
    let mut lab = Observed::lab(&LAB.replace(r#"name = "axis""#, traffic), Host::IDEAL);
    lab.judge_while(600, |lab| {
        let joint = axis(lab).slots[1].unwrap().config;
        lab.run_cycles(15);
        for turn in 0..60 {
            lab.set_slot(AXIS, SlotConfig { joint: Some(0).filter(|_| turn % 2 == 1), ..joint });
            lab.run_cycles(10);
        }
    });
    assert_eq!(lab.findings(), (0, vec![]));
    assert_eq!(lab.analysis().stations[AXIS].frames, 1_200);
    let receiver = lab.plan.scenario.receiver(AXIS);
    for priority in [5, 9] {
        let arrived = lab.received[receiver].arrived(Some(priority));
        assert!(arrived.received > 300 && arrived.missing == 0, "priority {priority}: {arrived:?}");
    }
    assert_eq!(lab.network.member(receiver).station.refusals().total(), 0);
}

fn axis(lab: &Observed) -> TdmaStatus {
    match lab.network.member(AXIS).station.discipline().status() {
        MixedStatus::Ours(status) => status,
        MixedStatus::Peer(_) => panic!("the axis is ours"),
    }
}

/// Frames that the axis has sent in each of its slots.
fn sent(lab: &Observed) -> [u64; 2] {
    [0, 1].map(|place| axis(lab).slots[place].unwrap().sent)
}

/// Queues two frames when slot 0 comes, and none when another does.
struct Pairs {
    pool: Pool,
}

impl Service for Pairs {
    fn claims(&self, ether_type: EtherType) -> bool {
        ether_type == EtherType::EXPERIMENTAL
    }

    fn on_frame(&mut self, _rx: Option<Instant>, _frame: Buf) -> Result<(), Refusal> {
        Ok(())
    }

    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>) {
        for _ in (0..2).filter(|_| slot.channel == 0) {
            let Some(mut frame) = self.pool.take() else { return };
            frame.fill(&[0; 60]);
            frame[12..14].copy_from_slice(&EtherType::EXPERIMENTAL.0.to_be_bytes());
            // Who has one slot only soon has a full queue.
            let _ = out(frame, Priority::DEFAULT, 0);
        }
    }
}
