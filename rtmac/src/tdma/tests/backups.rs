//! A backup: what it must be like, when it takes over, and what it does when it hears a Synchronisation beside its line.

use super::*;

/// One that has heard cycles 1 to 3, on which cycle n begins at n ms.
fn stand_by(servo: Servo) -> Tdma {
    let follow = SlaveConfig { rounds: 0, servo, ..SlaveConfig::default() };
    let backup = MasterConfig { backup: Some(Span::from_micros(100)), follow, ..master_config() };
    let mut tdma = Tdma::new(&config(RoleConfig::Master(backup))).unwrap();
    tdma.on_timeout(at(500));
    hear_syncs(&mut tdma, 1..=3);
    tdma.on_timeout(at(3_300));
    assert_eq!(tdma.status().mastery, Some(Mastery::StandBy));
    tdma
}

/// The Synchronisation of a cycle, held up or of another line.
fn hear_beside(tdma: &mut Tdma, cycle: u32, rx: Instant) {
    let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000);
    let mut frame = Pool::new(1).take().unwrap();
    Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
    assert!(matches!(tdma.on_frame(Some(rx), frame), Claimed::Kept));
}

#[test]
fn a_backup_sends_nothing_before_the_next_of_what_it_heard_would_have_come_with_a_filter_or_without() {
    for servo in [Servo::Linear, Servo::None] {
        for rx in [3_600, 3_900, 4_090, 4_240, 4_600] {
            let mut tdma = stand_by(servo);
            hear_beside(&mut tdma, 4, at(rx));
            let Role::Master(master) = &tdma.role else { panic!("it is a master") };
            let (_, at_earliest, _) = master.next_sync().unwrap();
            let next = at(rx) + Span::from_millis(1);
            assert!(at_earliest > next, "{servo:?}, heard at {rx}: {at_earliest:?} is before {next:?}");
        }
    }
}

/// The Synchronisation of cycle 4, which its sender was late with by so many microseconds.
fn hear_late(tdma: &mut Tdma, micros: u64) -> Claimed {
    let sched = GlobalTime::from_nanos(4_000_000);
    let mut frame = Pool::new(1).take().unwrap();
    let xmit = sched + Span::from_micros(micros as i64);
    Message::Sync { cycle: 4, xmit, sched }.write(Address::BROADCAST, OTHER, &mut frame);
    tdma.on_frame(Some(at(4_000 + micros)), frame)
}

#[test]
fn a_sync_keeps_a_backup_silent_that_comes_before_it_looks_and_not_one_that_comes_after() {
    // It sends at 4 100 and looks 20 us before that.
    let mut tdma = stand_by(Servo::Linear);
    assert!(tdma.next_transmission(at(4_050)).is_none(), "it is awake, and nothing was queued for its slot");
    tdma.on_timeout(at(4_050));
    assert_eq!(tdma.next_deadline(), Some(at(4_080)));
    assert!(tdma.next_transmission(at(4_079)).is_none(), "it has not looked yet");
    assert!(matches!(hear_late(&mut tdma, 79), Claimed::Kept));
    assert!((4_080..5_080).all(|now| tdma.next_transmission(at(now)).is_none()));
    assert_eq!(tdma.status().mastery, Some(Mastery::StandBy));
    assert!(tdma.next_transmission(at(5_080)).is_some(), "but one is missing in the next cycle");

    let mut tdma = stand_by(Servo::Linear);
    assert!(tdma.next_transmission(at(4_079)).is_none());
    let sync = tdma.next_transmission(at(4_080)).expect("there was none");
    assert_eq!(sync.at, at(4_100));
    tdma.on_sent(Sent::At(sync.at));
    assert_eq!((tdma.status().mastery, tdma.status().counters.syncs_sent), (Some(Mastery::Active), 1));
    hear_late(&mut tdma, 81);
    assert_eq!(tdma.status().mastery, Some(Mastery::StandBy), "as soon as it knows");
}

#[test]
fn a_backup_that_makes_way_tells_of_the_syncs_that_it_has_slept_through() {
    let mut tdma = stand_by(Servo::Linear);
    assert!(tdma.next_transmission(at(4_050)).is_none());
    let sync = tdma.next_transmission(at(4_080)).expect("there was none");
    tdma.on_sent(Sent::At(sync.at));
    told(&mut tdma);
    // Those of 5 and 6 were its own, and that of 7 would be yet.
    hear_syncs(&mut tdma, 7..=7);
    let told = told(&mut tdma);
    let kinds: Vec<_> = told.iter().take(3).map(|&(cycle, kind, _)| (cycle, kind)).collect();
    let skipped = |cycle| (cycle, EventKind::SyncSkipped);
    assert_eq!(kinds, [skipped(5), skipped(6), (4, EventKind::SteppedDown)]);
    assert_eq!(told[0].2 - told[1].2, Span::from_millis(1));
    assert!((Span::ZERO..Span::from_micros(900)).contains(&told[1].2), "{:?}", told[1]);
    assert_eq!(tdma.status().counters.syncs_skipped, 2);
}

#[test]
fn a_backup_wakes_on_frames_as_long_as_it_only_listens() {
    let backup = MasterConfig { backup: Some(Span::from_micros(100)), ..master_config() };
    let mut tdma = Tdma::new(&config(RoleConfig::Master(backup))).unwrap();
    tdma.on_timeout(at(500));
    assert!(tdma.wakes_on_frames(), "it listens");
    hear_syncs(&mut tdma, 1..=1);
    tdma.on_timeout(at(1_300));
    assert_eq!(
        (tdma.status().mastery, tdma.wakes_on_frames()),
        (Some(Mastery::Following), true),
        "no line yet"
    );
    hear_syncs(&mut tdma, 2..=3);
    tdma.on_timeout(at(3_300));
    assert!(!tdma.wakes_on_frames(), "it has slots to wait for");
}

#[test]
fn what_cannot_be_of_a_backup_is_refused() {
    let refused = |backup: u64, offset: u64| {
        let backup = MasterConfig { backup: Some(Span::from_micros(backup as i64)), ..master_config() };
        let mut config = config(RoleConfig::Master(backup));
        config.slots[0].offset = Span::from_micros(offset as i64);
        Tdma::new(&config).err()
    };
    assert_eq!(refused(100, 140), None);
    assert!(matches!(refused(100, 139), Some(Refused::BeforeBackup { id: 0, .. })));
    assert!(matches!(refused(40, 400), Some(Refused::Backup { .. })), "the primary may still send");
    assert!(matches!(refused(960, 400), Some(Refused::Backup { .. })), "of the next cycle");
}

#[test]
fn a_backup_without_a_slot_or_not_calibrated_takes_over_all_the_same() {
    for slots in [0, 1] {
        let follow = SlaveConfig { rounds: 20, ..SlaveConfig::default() };
        let backup = MasterConfig { backup: Some(Span::from_micros(100)), follow, ..master_config() };
        let mut config = config(RoleConfig::Master(backup));
        config.slots.truncate(slots);
        let mut tdma = Tdma::new(&config).unwrap();
        // It speaks, hears a primary in its second cycle, and stands by without ever having calibrated.
        for ms in 0..53 {
            tdma.on_timeout(at(ms * 1_000));
        }
        let TimeView { cycle, .. } = tdma.time();
        let (start, sched) =
            tdma.line().map(|line| (line.start_of(cycle + 1), line.sched_of(cycle + 1))).unwrap();
        let mut frame = Pool::new(1).take().unwrap();
        Message::Sync { cycle: cycle + 1, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
        tdma.on_frame(Some(start), frame);
        assert_eq!(tdma.status().mastery, Some(Mastery::StandBy));
        let missing = start + Span::from_micros(1_090);
        tdma.on_timeout(missing);
        let sync = tdma.next_transmission(missing).expect("the next one is missing");
        assert!(matches!(wire::parse(&sync.frame), Ok(Rtmac::Tdma(Message::Sync { .. }))), "{slots} slots");
    }
}

/// Cycle 4's, from somebody with this address whose line is so many microseconds behind, which is not much for it.
fn hear_behind(tdma: &mut Tdma, from: Address, micros: u64) -> u32 {
    let sched = GlobalTime::from_nanos(4_000_000);
    let mut frame = Pool::new(1).take().unwrap();
    Message::Sync { cycle: 4, xmit: sched, sched }.write(Address::BROADCAST, from, &mut frame);
    tdma.on_frame(Some(at(4_000 + micros)), frame);
    let Role::Master(master) = &tdma.role else { panic!("it is a master") };
    master.next_sync().unwrap().0
}

/// One that stands by after cycle 3, of this address, and has or has not sent cycle 4's.
fn of_address(address: Address, has_spoken: bool) -> Tdma {
    let step_limit = Some(Span::from_micros(200));
    let follow = SlaveConfig { rounds: 0, step_limit, ..SlaveConfig::default() };
    let backup = MasterConfig { backup: Some(Span::from_micros(100)), follow, ..master_config() };
    let mut tdma = Tdma::new(&TdmaConfig { address, ..config(RoleConfig::Master(backup)) }).unwrap();
    tdma.on_timeout(at(500));
    hear_syncs(&mut tdma, 1..=3);
    tdma.on_timeout(at(3_300));
    if has_spoken {
        let sync = tdma.next_transmission(at(4_080)).expect("there was none");
        tdma.on_sent(Sent::At(sync.at));
    }
    tdma
}

#[test]
fn a_backup_that_hears_a_sync_only_after_it_would_have_spoken_hesitates_for_the_next() {
    let next = |micros| hear_behind(&mut of_address(OWN, false), OTHER, micros);
    assert_eq!([0, 79, 90, 150].map(next), [5, 5, 6, 6], "it looks after 80 us");
}

#[test]
fn of_two_backups_that_speak_in_one_cycle_the_one_with_the_higher_address_hesitates_for_longer() {
    let (lower, higher) = (Address([2, 0, 0, 0, 0, 6]), Address([2, 0, 0, 0, 0, 7]));
    let next = |own, other| hear_behind(&mut of_address(own, true), other, 150);
    assert_eq!((next(lower, higher), next(higher, lower)), (6, 7));
}
