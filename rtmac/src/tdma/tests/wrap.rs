//! The cycle's number goes from 2^32 - 1 to 0.

use super::*;

const ACROSS: [u32; 4] = [u32::MAX - 1, u32::MAX, 0, 1];

#[test]
fn a_master_that_goes_on_before_the_wrap_sends_each_number_once_and_in_order() {
    // Cycle u32::MAX - 4 of the one before it began at 1 ms; this one listens until 3 ms.
    let resume = Some((u32::MAX - 4, GlobalTime::from_nanos(1_000_000)));
    let mut master =
        Tdma::new(&config(RoleConfig::Master(MasterConfig { resume, ..master_config() }))).unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    let sent = ACROSS.map(|_| {
        let sync = (0..3).find_map(|_| master.next_transmission(master.next_deadline()?)).expect("a sync");
        master.on_sent(Sent::At(sync.at));
        match wire::parse(&sync.frame) {
            Ok(Rtmac::Tdma(Message::Sync { cycle, sched, .. })) => (cycle, sync.at, sched.nanos()),
            other => panic!("{other:?}"),
        }
    });
    let expected = [4, 5, 6, 7].map(|ms| ms * 1_000).map(|micros| (at(micros), micros * 1_000));
    let expected = ACROSS.into_iter().zip(expected).map(|(cycle, (at, sched))| (cycle, at, sched));
    assert_eq!(sent[..], expected.collect::<Vec<_>>());
    assert_eq!(master.status().counters.syncs_skipped, 0);
}

#[test]
fn a_slave_stays_locked_across_the_wrap_and_sends_in_every_cycle() {
    let mut slave = Tdma::new(&with_slots(0, &[(0, 1)])).unwrap();
    let pool = Pool::new(1);
    let hear = |slave: &mut Tdma, cycle: u32, ms: u64| {
        let sched = GlobalTime::from_nanos(ms * 1_000_000);
        let mut frame = pool.take().unwrap();
        Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
        assert!(matches!(slave.on_frame(Some(at(ms * 1_000)), frame), Claimed::Kept), "cycle {cycle}");
    };
    hear(&mut slave, u32::MAX - 2, 1);
    for (cycle, ms) in ACROSS.into_iter().zip(2..) {
        hear(&mut slave, cycle, ms);
        let TimeView { state, cycle: now, start, .. } = slave.time();
        assert_eq!((state, now, start), (SyncState::Locked, cycle, at(ms * 1_000)));
        queue(&mut slave, &Pool::new(1), 60);
        assert_eq!(sent_next(&mut slave), at(ms * 1_000 + 400), "cycle {cycle}");
    }
    let Counters { frames_sent, overruns, slots_silent, slots_empty, .. } = slave.status().counters;
    assert_eq!((frames_sent, overruns, slots_silent, slots_empty), (4, 0, 0, 0));
    let kinds: Vec<_> = told(&mut slave).into_iter().map(|(_, kind, _)| kind).collect();
    assert_eq!(kinds, [EventKind::Locked]);
}
