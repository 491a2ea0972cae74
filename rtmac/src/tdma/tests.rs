mod anew;
pub(super) mod as_station;
mod backups;
mod calibration_frames;
pub(super) mod every;
mod first_slot;
mod joint_slots;
mod late_replies;
mod made_way;
mod reply_turn;
mod requests;
mod shown;
mod slept;
mod turns;
mod without_holdover;
mod wrap;

use super::*;
use crate::wire::Message;
use rtnet::time::{GlobalTime, Offset};

pub(super) const OWN: Address = Address([2, 0, 0, 0, 0, 1]);
const OTHER: Address = Address([2, 0, 0, 0, 0, 2]);

fn config(role: RoleConfig) -> TdmaConfig {
    let offset = Span::from_micros(400);
    let (joint, latest) = (None, Span::from_micros(20));
    let slot = SlotConfig { id: 0, offset, phase: 0, period: 1, size: 100, joint, latest };
    let (max_slot_id, lead, late) = (DEFAULT_MAX_SLOT_ID, DEFAULT_LEAD, LatePolicy::Skip);
    TdmaConfig { address: OWN, role, slots: vec![slot], max_slot_id, lead, late }
}

pub(super) fn master_config() -> MasterConfig {
    let late = Span::from_micros(40);
    MasterConfig {
        follow: SlaveConfig { rounds: 0, ..SlaveConfig::default() },
        ..MasterConfig::new(Span::from_millis(1), late)
    }
}

fn at(micros: u64) -> Instant {
    Instant::from_nanos(micros * 1_000)
}

/// A master in its first cycle: listening began at 0, cycle 1 begins at 4 ms.
fn active_master() -> Tdma {
    let mut tdma = Tdma::new(&config(RoleConfig::Master(master_config()))).unwrap();
    tdma.on_timeout(at(0));
    tdma.on_timeout(at(3_000));
    assert_eq!(tdma.time().state, SyncState::Locked);
    tdma
}

fn hear(tdma: &mut Tdma, source: Address, message: Message) -> Claimed {
    hear_at(tdma, 3_500, source, message)
}

fn hear_at(tdma: &mut Tdma, micros: u64, source: Address, message: Message) -> Claimed {
    let mut frame = Pool::new(1).take().unwrap();
    message.write(OWN, source, &mut frame);
    tdma.on_frame(Some(at(micros)), frame)
}

#[test]
fn nobody_is_answered_who_cannot_be_one_station() {
    let request = Message::Request { xmit: 0, reply_cycle: 2, reply_offset: 0 };
    let mut master = active_master();
    for source in [Address::BROADCAST, Address([3, 0, 0, 0, 0, 1]), OWN] {
        let claimed = hear(&mut master, source, request);
        assert!(matches!(claimed, Claimed::Refused(Refusal::ForgedSource)), "{source}: {claimed:?}");
    }
    assert!(matches!(hear(&mut master, OTHER, request), Claimed::Kept));
}

#[test]
fn a_master_wakes_a_lead_before_its_sync_and_stamps_it_at_byte_26() {
    let mut master = active_master();
    assert_eq!(master.next_deadline(), Some(at(4_000) - DEFAULT_LEAD));
    assert!(master.next_transmission(at(3_949)).is_none(), "too early");
    let sync = master.next_transmission(at(3_950)).unwrap();
    assert_eq!((sync.at, sync.latest), (at(4_000), at(4_040)));
    assert_eq!(sync.stamp.unwrap().at_byte, 26);
    assert!(matches!(wire::parse(&sync.frame), Ok(Rtmac::Tdma(Message::Sync { cycle: 1, .. }))));
}

#[test]
fn a_late_sync_is_skipped_and_the_next_carries_the_grids_number() {
    let mut master = active_master();
    let sync = master.next_transmission(at(6_041)).map(|sync| wire::parse(&sync.frame).map(|_| sync.at));
    assert_eq!(sync, None, "cycles 1 to 3 have passed, cycle 4 has not come");
    assert_eq!(master.status().counters.syncs_skipped, 3);
    let sync = master.next_transmission(at(6_960)).unwrap();
    assert!(matches!(wire::parse(&sync.frame), Ok(Rtmac::Tdma(Message::Sync { cycle: 4, .. }))));
}

#[test]
fn what_was_late_comes_back_and_can_be_put_back() {
    let mut master = active_master();
    master.next_transmission(at(3_960)).unwrap();
    assert!(master.on_sent(Sent::At(at(4_000))).is_none());
    let mut frame = Pool::new(1).take().unwrap();
    frame.fill(&[0; 60]);
    master.enqueue(frame, Priority::DEFAULT, 0).unwrap();
    let opportunity = master.opportunity(at(4_360)).unwrap();
    assert_eq!((opportunity.cycle, opportunity.begin), (1, at(4_400)));
    let data = master.next_transmission(at(4_360)).unwrap();
    let late = master.on_sent(Sent::Late(at(4_421), data.frame)).unwrap();
    assert_eq!((late.priority, late.channel), (Priority::DEFAULT, 0));
    assert_eq!(master.status().counters.overruns, 1);
    master.put_back(late);
    master.next_transmission(at(4_960)).unwrap();
    master.on_sent(Sent::At(at(5_000)));
    assert!(master.next_transmission(at(5_360)).is_some(), "in the next cycle");
}

#[test]
fn who_is_to_send_late_does_so_up_to_a_cycle() {
    let mut late =
        Tdma::new(&TdmaConfig { late: LatePolicy::Send, ..config(RoleConfig::Master(master_config())) });
    let master = late.as_mut().unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    master.next_transmission(at(3_960)).unwrap();
    master.on_sent(Sent::At(at(4_000)));
    let mut frame = Pool::new(1).take().unwrap();
    frame.fill(&[0; 60]);
    master.enqueue(frame, Priority::DEFAULT, 0).unwrap();
    let data = master.next_transmission(at(4_900)).unwrap();
    assert_eq!((data.at, data.latest), (at(4_400), at(5_400)), "half a cycle late, and sent at once");
    assert_eq!(master.status().counters.overruns, 0);
}

#[test]
fn a_slave_is_silent_before_it_has_heard_anything() {
    let mut slave =
        Tdma::new(&config(RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() }))).unwrap();
    slave.on_timeout(at(9_000));
    assert_eq!(slave.next_deadline(), None);
    assert!(slave.opportunity(at(9_000)).is_none() && slave.next_transmission(at(9_000)).is_none());
}

#[test]
fn slots_change_by_command_and_a_masters_must_be_in_its_cycle() {
    let mut master = active_master();
    let slot = config(RoleConfig::Master(master_config())).slots[0];
    let beyond = SlotConfig { id: 2, offset: Span::from_millis(1), ..slot };
    let refused = master.command(at(3_500), &mut TdmaCommand::set_slot(beyond)).unwrap_err();
    assert!(refused.to_string().contains("beyond the cycle of 1ms"), "{refused}");
    master.command(at(3_500), &mut TdmaCommand::set_slot(SlotConfig { id: 2, ..slot })).unwrap();
    assert_eq!(master.payload_limit(2), Ok(100));
    master.command(at(3_500), &mut TdmaCommand::RemoveSlot(2)).unwrap();
    assert_eq!(master.payload_limit(2), Err(SendError::NoSlot(2)));
}

/// A slave that has heard cycles 1 and 2 of a line on which cycle n begins at n ms.
fn locked_slave() -> Tdma {
    let role = RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() });
    let mut slave = Tdma::new(&config(role)).unwrap();
    hear_syncs(&mut slave, 1..=2);
    assert_eq!(slave.time().state, SyncState::Locked);
    // So far there was nothing to send.
    assert!(slave.next_transmission(at(2_400)).is_none());
    told(&mut slave);
    slave
}

fn hear_syncs(slave: &mut Tdma, cycles: std::ops::RangeInclusive<u32>) {
    for cycle in cycles {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000);
        let mut frame = Pool::new(1).take().unwrap();
        Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
        assert!(matches!(slave.on_frame(Some(at(u64::from(cycle) * 1_000)), frame), Claimed::Kept));
    }
}

fn told(tdma: &mut Tdma) -> Vec<(u32, EventKind, Span)> {
    let next = || tdma.next_event().map(|event| (event.cycle, event.kind, event.span));
    std::iter::from_fn(next).collect()
}

#[test]
fn a_station_that_was_late_with_its_request_asks_a_turn_later() {
    let role = RoleConfig::Slave(SlaveConfig { rounds: 5, ..SlaveConfig::default() });
    let mut slave = Tdma::new(&config(role)).unwrap();
    hear_syncs(&mut slave, 1..=2);
    let request = slave.next_transmission(at(2_400)).expect("a request");
    slave.on_sent(Sent::At(request.at));
    hear_syncs(&mut slave, 3..=4);
    assert!(slave.next_transmission(at(4_450)).is_none(), "too late");
    hear_syncs(&mut slave, 5..=5);
    assert!(slave.next_transmission(at(5_400)).is_some(), "nobody was asked for a reply there");
}

/// Its line is the master's, and its only round is answered in cycle 3; slot 2 is 200 us behind slot 0.
fn answered_in_cycle_3() -> Tdma {
    let whole = with_slots(1, &[(0, 1), (2, 1)]);
    let mut slots = whole.slots.clone();
    slots[1].offset = Span::from_micros(600);
    let mut slave = Tdma::new(&TdmaConfig { slots, ..whole }).unwrap();
    hear_syncs(&mut slave, 1..=2);
    let request = slave.next_transmission(at(2_400)).expect("a request");
    slave.on_sent(Sent::At(request.at));
    hear_syncs(&mut slave, 3..=3);
    let reply = Message::Reply { request_xmit: 2_400_000, reception: 2_401_000, xmit: 3_400_000 };
    let mut frame = Pool::new(1).take().unwrap();
    reply.write(OWN, OTHER, &mut frame);
    assert!(matches!(slave.on_frame(Some(at(3_401)), frame), Claimed::Kept));
    slave
}

#[test]
fn slots_begin_when_the_last_reply_is_looked_at() {
    // At once, before slot 2; or where the next thing to do is, a cycle later.
    for (looks_at, first) in [(3_402, (3, 2)), (4_350, (4, 0))] {
        let mut slave = answered_in_cycle_3();
        if looks_at > 4_000 {
            hear_syncs(&mut slave, 4..=4);
        }
        slave.on_timeout(at(looks_at));
        assert_eq!(slave.time().state, SyncState::Locked);
        let deadline = slave.next_deadline().unwrap();
        slave.on_timeout(deadline);
        let turn = slave.opportunity(deadline).expect("a turn");
        assert_eq!((turn.cycle, turn.channel), first, "looked at {looks_at}");
        assert_eq!(slave.status().counters.overruns, 0);
        assert!(told(&mut slave).iter().all(|(_, kind, _)| !kind.is_miss()));
    }
}

#[test]
fn who_has_had_the_last_reply_in_its_slot_sends_there_from_the_next_turn_on() {
    let role = RoleConfig::Slave(SlaveConfig { rounds: 1, ..SlaveConfig::default() });
    let mut slave = Tdma::new(&config(role)).unwrap();
    queue(&mut slave, &Pool::new(1), 60);
    // Synchronisations take 3 us, other frames 1, which stamps of another clock do not tell: its line is 2 us late.
    let hear_late = |slave: &mut Tdma, cycle: u32| {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000);
        let mut frame = Pool::new(1).take().unwrap();
        Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
        slave.on_frame(Some(at(u64::from(cycle) * 1_000 + 3)), frame);
    };
    (1..=2).for_each(|cycle| hear_late(&mut slave, cycle));
    let request = slave.next_transmission(at(2_400)).expect("a request");
    assert_eq!(request.at, at(2_403));
    slave.on_sent(Sent::At(request.at));
    hear_late(&mut slave, 3);
    let [request_xmit, reception, xmit] = [2_403_000, (1 << 50) + 2_404_000, (1 << 50) + 3_400_000];
    let mut frame = Pool::new(1).take().unwrap();
    Message::Reply { request_xmit, reception, xmit }.write(OWN, OTHER, &mut frame);
    assert!(matches!(slave.on_frame(Some(at(3_401)), frame), Claimed::Kept));
    assert_eq!(slave.status().delay, Some(Span::from_micros(1)));
    assert!(slave.next_transmission(at(3_401)).is_none(), "the reply is still on the air");
    hear_late(&mut slave, 4);
    assert_eq!(slave.next_transmission(at(4_400)).expect("what is queued").at, at(4_402));
}

#[test]
fn who_loses_its_master_while_it_calibrates_has_missed_no_slots() {
    let role = RoleConfig::Slave(SlaveConfig { rounds: 5, ..SlaveConfig::default() });
    let mut slave = Tdma::new(&config(role)).unwrap();
    hear_syncs(&mut slave, 1..=2);
    slave.on_timeout(at(4_500));
    slave.on_timeout(at(1_500_100));
    let kinds: Vec<_> = told(&mut slave).into_iter().map(|(_, kind, _)| kind).collect();
    assert_eq!(kinds, [EventKind::SyncLost, EventKind::LineGivenUp]);
}

fn queue(tdma: &mut Tdma, pool: &Pool, length: usize) {
    let mut frame = pool.take().unwrap();
    frame.fill(&vec![0; length]);
    tdma.enqueue(frame, Priority::DEFAULT, 0).unwrap();
}

/// When the next frame is sent, and in which cycle's time.
fn sent_next(tdma: &mut Tdma) -> Instant {
    let deadline = tdma.next_deadline().unwrap();
    tdma.on_timeout(deadline);
    match tdma.next_transmission(deadline) {
        Some(sent) => {
            tdma.on_sent(Sent::At(sent.at));
            sent.at
        }
        None => sent_next(tdma),
    }
}

#[test]
fn at_one_instant_a_sync_goes_first_and_a_reply_before_data() {
    let mut config = config(RoleConfig::Master(master_config()));
    config.slots[0].offset = Span::ZERO;
    let mut master = Tdma::new(&config).unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    let request = Message::Request { xmit: 0, reply_cycle: 1, reply_offset: 0 };
    assert!(matches!(hear(&mut master, OTHER, request), Claimed::Kept));
    queue(&mut master, &Pool::new(1), 60);
    // The Synchronisation a lead before; the reply, and what follows it, shortly before.
    let order = [3_960, 3_990, 3_990].map(|now| {
        let next = master.next_transmission(at(now)).unwrap();
        assert_eq!(next.at, at(4_000));
        master.on_sent(Sent::At(next.at));
        wire::parse(&next.frame).ok().map(|parsed| match parsed {
            Rtmac::Tdma(Message::Sync { .. }) => "sync",
            Rtmac::Tdma(Message::Reply { .. }) => "reply",
            other => panic!("{other:?}"),
        })
    });
    assert_eq!(order, [Some("sync"), Some("reply"), None], "what is no RTmac frame is data");
}

#[test]
fn a_reply_is_chosen_shortly_before_its_instant() {
    let mut config = config(RoleConfig::Master(master_config()));
    config.slots.clear();
    let mut master = Tdma::new(&config).unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    let request = Message::Request { xmit: 0, reply_cycle: 1, reply_offset: 400_000 };
    assert!(matches!(hear(&mut master, OTHER, request), Claimed::Kept));
    let sync = master.next_transmission(at(3_960)).expect("a lead before its instant");
    master.on_sent(Sent::At(sync.at));
    assert_eq!(master.next_deadline(), Some(at(4_390)));
    assert!(master.next_transmission(at(4_389)).is_none());
    assert_eq!(master.next_transmission(at(4_390)).map(|reply| reply.at), Some(at(4_400)));
}

/// Its slot 0, moved or of another size.
fn moved(offset: i64, size: usize) -> TdmaCommand {
    let slot = config(RoleConfig::Master(master_config())).slots[0];
    TdmaCommand::set_slot(SlotConfig { offset: Span::from_micros(offset), size, ..slot })
}

#[test]
fn a_slot_that_moves_keeps_its_turn_of_this_cycle_and_its_frames() {
    let pool = Pool::new(3);
    for (asked_at, second) in [(2_100, 3_700), (2_100, 3_100)] {
        let mut slave = locked_slave();
        (0..2).for_each(|_| queue(&mut slave, &pool, 60));
        // Its turn in cycle 2, at 2 400, has passed unused; that in cycle 3 is still to come.
        hear_syncs(&mut slave, 3..=3);
        let offset = second - 3_000;
        let from = slave.command(at(asked_at + 1_000), &mut moved(offset as i64, 100)).unwrap();
        assert_eq!(from, 4);
        assert_eq!(sent_next(&mut slave), at(3_400), "as it was");
        hear_syncs(&mut slave, 4..=4);
        assert_eq!(sent_next(&mut slave), at(second + 1_000), "as it is from cycle 4 on");
        assert_eq!(slave.status().counters.returned_dropped, 0);
    }
}

#[test]
fn a_slot_whose_turn_has_passed_moves_at_once() {
    let mut slave = locked_slave();
    assert_eq!(slave.command(at(2_600), &mut moved(100, 100)), Ok(3));
    queue(&mut slave, &Pool::new(1), 60);
    assert_eq!(sent_next(&mut slave), at(3_100));
    assert_eq!(slave.status().slots[0].unwrap().sent, 1);
}

#[test]
fn frames_too_large_for_the_slot_as_it_is_now_are_counted() {
    let pool = Pool::new(2);
    let mut slave = locked_slave();
    queue(&mut slave, &pool, 114);
    queue(&mut slave, &pool, 60);
    slave.command(at(2_600), &mut moved(400, 60)).unwrap();
    let status = slave.status();
    assert_eq!((status.counters.returned_dropped, status.slots[0].unwrap().queued), (1, 1));
    assert!(pool.take().is_some(), "its buffer has come home");
}

#[test]
fn a_slave_keeps_the_slot_it_calibrates_in() {
    let mut slave = locked_slave();
    let error = slave.command(at(2_600), &mut TdmaCommand::RemoveSlot(0)).unwrap_err();
    assert!(error.to_string().contains("only one of a slave"), "{error}");
    let other = SlotConfig { id: 2, ..slave.status().slots[0].unwrap().config };
    slave.command(at(2_600), &mut TdmaCommand::set_slot(other)).unwrap();
    slave.command(at(2_600), &mut TdmaCommand::RemoveSlot(0)).unwrap();
    assert_eq!(slave.status().slots.iter().flatten().count(), 1);
}

/// A slave with these slots, each an id and a period.
fn with_slots(rounds: u32, slots: &[(u8, u32)]) -> TdmaConfig {
    let whole = config(RoleConfig::Slave(SlaveConfig { rounds, ..SlaveConfig::default() }));
    let slots = slots.iter().map(|&(id, period)| SlotConfig { id, period, ..whole.slots[0] });
    TdmaConfig { slots: slots.collect(), ..whole }
}

#[test]
fn a_slot_beyond_the_masters_cycle_is_refused_once_that_is_known() {
    let mut slave = locked_slave();
    let error = slave.command(at(2_600), &mut moved(5_000, 100)).unwrap_err();
    assert!(error.to_string().contains("5ms is beyond the cycle of 1ms"), "{error}");
}

#[test]
fn who_is_detached_is_silent_and_deaf_until_attached_again() {
    let pool = Pool::new(1);
    let mut slave = locked_slave();
    queue(&mut slave, &pool, 60);
    slave.command(at(2_100), &mut TdmaCommand::Become(NewRole::detached())).unwrap();
    assert_eq!(slave.next_deadline(), None);
    assert!(slave.opportunity(at(2_390)).is_none() && slave.next_transmission(at(2_390)).is_none());
    let sync = Message::Sync { cycle: 3, xmit: GlobalTime::default(), sched: GlobalTime::default() };
    assert!(matches!(hear(&mut slave, OTHER, sync), Claimed::Refused(Refusal::Detached)));
    assert_eq!(slave.status().role, RoleName::Detached);

    let role = RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() });
    slave.command(at(9_000), &mut TdmaCommand::Become(NewRole::attached(role).unwrap())).unwrap();
    assert_eq!(slave.time().state, SyncState::Waiting);
    hear_syncs(&mut slave, 10..=11);
    assert_eq!(sent_next(&mut slave), at(11_400), "with what was queued before");
}

#[test]
fn a_slave_becomes_master_where_its_slots_fit_the_cycle() {
    let mut slave = locked_slave();
    let short = MasterConfig { cycle: Span::from_micros(300), ..master_config() };
    let mut command = TdmaCommand::Become(NewRole::attached(RoleConfig::Master(short)).unwrap());
    let error = slave.command(at(2_100), &mut command).unwrap_err();
    assert!(error.to_string().contains("slot 0: the offset 400us is beyond the cycle of 300us"), "{error}");
    assert_eq!(slave.time().state, SyncState::Locked, "nothing has changed");
    let mut command = TdmaCommand::Become(NewRole::attached(RoleConfig::Master(master_config())).unwrap());
    slave.command(at(2_100), &mut command).unwrap();
    slave.on_timeout(at(2_100));
    slave.on_timeout(at(5_100));
    assert_eq!(sent_next(&mut slave), at(6_100), "its first Synchronisation");
}

#[test]
fn what_the_guard_drops_comes_back_and_a_cycle_without_its_sync_is_a_skipped_one() {
    let mut master = active_master();
    let sync = master.next_transmission(at(3_960)).unwrap();
    assert!(master.on_sent(Sent::Guarded(at(4_047), sync.frame)).is_none(), "the next is made anew");
    let mut frame = Pool::new(1).take().unwrap();
    frame.fill(&[0; 60]);
    master.enqueue(frame, Priority::DEFAULT, 0).unwrap();
    let data = master.next_transmission(at(4_360)).unwrap();
    let dropped = master.on_sent(Sent::Guarded(at(4_422), data.frame)).unwrap();
    assert_eq!((dropped.priority, dropped.channel), (Priority::DEFAULT, 0));
    let told: Vec<_> = std::iter::from_fn(|| master.next_event()).collect();
    let event = |kind, slot, micros| Event { cycle: 1, kind, slot, span: Span::from_micros(micros) };
    let expected = [
        event(EventKind::MasterActive, None, 0),
        event(EventKind::SyncDropped, None, 7),
        event(EventKind::GuardDropped, Some(0), 2),
    ];
    assert_eq!(told, expected);
    let Counters { guard_drops, syncs_skipped, overruns, frames_sent, .. } = master.status().counters;
    assert_eq!((guard_drops, syncs_skipped, overruns, frames_sent), (2, 1, 0, 0));
}

#[test]
fn a_reply_that_the_guard_drops_goes_in_a_slot_of_the_masters() {
    let mut master = active_master();
    let request = Message::Request { xmit: 0, reply_cycle: 2, reply_offset: 100_000 };
    assert!(matches!(hear(&mut master, OTHER, request), Claimed::Kept));
    master.next_transmission(at(3_960)).map(|sync| master.on_sent(Sent::Late(at(4_041), sync.frame)));
    master.next_transmission(at(4_960)).map(|sync| master.on_sent(Sent::At(sync.at)));
    let reply = master.next_transmission(at(5_100)).unwrap();
    assert!(master.on_sent(Sent::Guarded(at(5_141), reply.frame)).is_none());
    let next = master.next_transmission(at(5_360)).expect("its own slot");
    assert!(matches!(wire::parse(&next.frame), Ok(Rtmac::Tdma(Message::Reply { .. }))));
    assert_eq!(next.at, at(5_400));
}
