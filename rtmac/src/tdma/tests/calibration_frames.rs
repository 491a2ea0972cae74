//! What calibration's frames say, and by which clocks.

use super::*;

/// Its next frame, with the stamp that the port writes into it, and to whom it goes.
fn stamped(tdma: &mut Tdma, chosen: Instant, sent: Instant) -> (Address, Message) {
    let Transmission { mut frame, stamp, .. } = tdma.next_transmission(chosen).expect("a frame");
    stamp.expect("it has a stamp").write(&mut frame, sent);
    tdma.on_sent(Sent::At(sent));
    let (header, _) = Header::parse(&frame).unwrap();
    assert_eq!(header.source, OWN);
    match wire::parse(&frame) {
        Ok(Rtmac::Tdma(message)) => (header.destination, message),
        other => panic!("{other:?}"),
    }
}

fn hear_sync_of(tdma: &mut Tdma, master: Address, cycle: u32) {
    let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000);
    let mut frame = Pool::new(1).take().unwrap();
    Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, master, &mut frame);
    assert!(matches!(tdma.on_frame(Some(at(u64::from(cycle) * 1_000 + 77)), frame), Claimed::Kept));
}

#[test]
fn a_request_goes_to_whoever_sent_the_last_sync_and_asks_for_the_slots_next_turn_by_this_clock() {
    for (id, period, asks_in) in [(0, 1, 2), (3, 3, 3)] {
        let mut slave = Tdma::new(&with_slots(5, &[(id, period)])).unwrap();
        let masters = [OTHER, Address([2, 0, 0, 0, 0, 9])];
        // The second has taken over from the first.
        (1..=asks_in)
            .for_each(|cycle| hear_sync_of(&mut slave, masters[usize::from(cycle == asks_in)], cycle));
        let turn = at(u64::from(asks_in) * 1_000 + 477);
        let (to, request) = stamped(&mut slave, turn, turn + Span::from_nanos(123));
        assert_eq!(to, masters[1]);
        // By its own clock, which is 77 us ahead of the master's.
        let xmit = (turn + Span::from_nanos(123)).nanos();
        let expected = Message::Request { xmit, reply_cycle: asks_in + period, reply_offset: 400_000 };
        assert_eq!(request, expected);
    }
}

#[test]
fn a_reply_is_stamped_by_the_clock_of_the_masters_syncs_and_returns_the_requests_stamp_as_it_was() {
    const EPOCH: i64 = 1_795_000_000_123_456_789;
    let epoch = Offset::between(Instant::default(), GlobalTime::from_nanos(EPOCH as u64));
    let mut master =
        Tdma::new(&config(RoleConfig::Master(MasterConfig { epoch, ..master_config() }))).unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    let request_xmit = 0xfedc_ba98_7654_3210;
    let request = Message::Request { xmit: request_xmit, reply_cycle: 1, reply_offset: 200_000 };
    // Received at 3 500.
    assert!(matches!(hear(&mut master, OTHER, request), Claimed::Kept));

    let global = |micros: u64, nanos: u64| EPOCH as u64 + micros * 1_000 + nanos;
    let (_, sync) = stamped(&mut master, at(3_960), at(4_000) + Span::from_nanos(41));
    let [xmit, sched] = [global(4_000, 41), global(4_000, 0)].map(GlobalTime::from_nanos);
    assert_eq!(sync, Message::Sync { cycle: 1, xmit, sched });
    let (to, reply) = stamped(&mut master, at(4_200), at(4_200) + Span::from_nanos(59));
    let (reception, xmit) = (global(3_500, 0), global(4_200, 59));
    assert_eq!((to, reply), (OTHER, Message::Reply { request_xmit, reception, xmit }));
}
