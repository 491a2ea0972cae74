//! What a slot's turn carries where nothing is queued, nobody gives the time, or the delay is not known yet.

use super::*;

/// Frames that can be told from one another.
fn queue_marked(tdma: &mut Tdma, pool: &Pool, marks: impl Iterator<Item = u8>) {
    for mark in marks {
        let mut frame = pool.take().unwrap();
        frame.fill(&[mark; 60]);
        tdma.enqueue(frame, Priority::DEFAULT, 0).unwrap();
    }
}

/// What leaves in the turn of a cycle whose Synchronisation has come.
fn turn(tdma: &mut Tdma, cycle: u32) -> Option<Transmission> {
    hear_syncs(tdma, cycle..=cycle);
    let sent = tdma.next_transmission(at(u64::from(cycle) * 1_000 + 400))?;
    tdma.on_sent(Sent::At(sent.at));
    Some(sent)
}

#[test]
fn a_turn_with_nothing_queued_sends_nothing_and_is_counted_and_the_next_one_sends() {
    let mut slave = Tdma::new(&with_slots(0, &[(0, 1)])).unwrap();
    hear_syncs(&mut slave, 1..=2);
    assert!(slave.next_transmission(at(2_400)).is_none());
    assert_eq!(slave.status().counters.slots_empty, 1);
    queue(&mut slave, &Pool::new(1), 60);
    assert!(slave.next_transmission(at(2_401)).is_none(), "its turn of this cycle is over");
    assert_eq!(turn(&mut slave, 3).expect("what is queued").at, at(3_400));
    let Counters { slots_empty, frames_sent, slots_silent, overruns, .. } = slave.status().counters;
    assert_eq!((slots_empty, frames_sent, slots_silent, overruns), (1, 1, 0, 0));
}

#[test]
fn what_is_queued_before_calibration_waits_and_is_sent_after_it_in_order() {
    let pool = Pool::new(4);
    let mut slave = Tdma::new(&with_slots(2, &[(0, 1)])).unwrap();
    queue_marked(&mut slave, &pool, 1..=2);
    hear_syncs(&mut slave, 1..=1);
    for (cycle, mark) in [(2, 3), (4, 4)] {
        let request = turn(&mut slave, cycle).expect("a request");
        assert!(matches!(wire::parse(&request.frame), Ok(Rtmac::Tdma(Message::Request { .. }))));
        queue_marked(&mut slave, &pool, mark..=mark);
        assert!(turn(&mut slave, cycle + 1).is_none(), "there the reply comes");
        let [asked, answered] = [cycle, cycle + 1].map(|cycle| u64::from(cycle) * 1_000_000 + 400_000);
        let reply = Message::Reply { request_xmit: asked, reception: asked + 1_000, xmit: answered };
        let mut frame = Pool::new(1).take().unwrap();
        reply.write(OWN, OTHER, &mut frame);
        assert!(matches!(slave.on_frame(Some(Instant::from_nanos(answered + 1_000)), frame), Claimed::Kept));
    }
    assert_eq!(slave.time().state, SyncState::Locked);
    let sent = [6, 7, 8, 9].map(|cycle| turn(&mut slave, cycle).map(|sent| sent.frame[0]));
    assert_eq!(sent, [Some(1), Some(2), Some(3), Some(4)]);
}

#[test]
fn without_a_master_what_is_queued_waits_however_much_it_is() {
    let mut lost = locked_slave();
    (0..100).for_each(|ms| lost.on_timeout(at(3_000 + ms * 1_000)));
    assert_eq!(lost.time().state, SyncState::Lost);
    let never_heard = Tdma::new(&with_slots(0, &[(0, 1)])).unwrap();
    for mut slave in [never_heard, lost] {
        let pool = Pool::new(200);
        queue_marked(&mut slave, &pool, 1..=200);
        assert!((103_000..200_000).step_by(50).all(|now| slave.next_transmission(at(now)).is_none()));
        assert_eq!(slave.status().slots[0].unwrap().queued, 200, "and what waits is not dropped");
    }
}
