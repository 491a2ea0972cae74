use proptest::prelude::*;
use rtnet::discipline::SendError;
use rtnet::time::GlobalTime;

use super::*;

const STATION: Address = Address([2, 0, 0, 0, 0, 3]);
const OTHER: Address = Address([2, 0, 0, 0, 0, 1]);
const BEHIND: Address = Address([2, 0, 0, 0, 7, 7]);
const ARP: EtherType = EtherType::ARP;

fn small(buffers: usize) -> (Tunnel, Mouth) {
    new(Config { buffers, ..Config::of(STATION) })
}

/// A turn of slot 1, whose size this is.
fn turn(size: usize) -> Opportunity {
    let (begin, scheduled) = (Instant::default(), GlobalTime::default());
    Opportunity { channel: 1, cycle: 7, begin, scheduled, non_rt: Some(size) }
}

/// What leaves in a turn.
fn filled(tunnel: &mut Tunnel, slot: &Opportunity) -> Vec<Vec<u8>> {
    let mut left = Vec::new();
    tunnel.poll(slot, &mut |_, _, _| panic!("it is not real-time"));
    tunnel.fill(slot, None, &mut |frame, priority, channel| {
        assert_eq!((priority, channel), (Priority::NON_RT, 1));
        let limit = slot.non_rt.unwrap();
        if frame.len() > ethernet::HEADER_LEN + limit {
            let got = frame.len() - ethernet::HEADER_LEN;
            return Err((SendError::TooLong { channel, got, limit }, frame));
        }
        left.push(frame.to_vec());
        Ok(())
    });
    left.iter_mut().for_each(|frame| tunnel.leaves(slot, frame));
    left
}

/// Sends an Ethernet frame as the device has read it.
fn send(mouth: &Mouth, to: Address, from: Address, kind: EtherType, payload: &[u8]) -> Result<(), Loss> {
    let mut room = mouth.take().expect("a buffer");
    let frame = [&to.0[..], &from.0, &kind.0.to_be_bytes(), payload].concat();
    room.room_mut()[FRAME..][..frame.len()].copy_from_slice(&frame);
    mouth.send_frame(room, frame.len())
}

#[test]
fn a_frame_is_wrapped_where_it_lies_and_comes_out_as_it_was() {
    let (mut tunnel, mouth) = small(2);
    send(&mouth, OTHER, STATION, EtherType(0x86dd), &[0x60; 80]).unwrap();
    let wire = filled(&mut tunnel, &turn(1500)).remove(0);
    let head = [2, 0, 0, 0, 0, 1, 2, 0, 0, 0, 0, 3, 0x90, 0x21, 0x86, 0xdd, 2, 1];
    assert_eq!(wire, [&head[..], &[0x60; 80]].concat());
    let inner = Inner::of(&wire).unwrap();
    assert_eq!((inner.kind(), inner.payload()), (EtherType(0x86dd), &[0x60; 80][..]));
    assert_eq!(inner.pieces().concat(), [&head[..12], &[0x86, 0xdd], &[0x60; 80]].concat());
}

#[test]
fn the_source_is_the_station_unless_it_is_to_be_kept() {
    for (keeps_source, expected) in [(false, STATION), (true, BEHIND)] {
        let (mut tunnel, mouth) = new(Config { keeps_source, ..Config::of(STATION) });
        send(&mouth, OTHER, BEHIND, ARP, &[0; 46]).unwrap();
        assert_eq!(filled(&mut tunnel, &turn(1500))[0][6..12], expected.0);
    }
}

#[test]
fn one_frame_leaves_in_a_turn_of_its_slot_and_none_in_others() {
    let (mut tunnel, mouth) = small(4);
    for n in 0..3 {
        send(&mouth, OTHER, STATION, ARP, &[n; 46]).unwrap();
    }
    assert!(filled(&mut tunnel, &Opportunity { non_rt: None, ..turn(1500) }).is_empty());
    for n in 0..3 {
        assert_eq!(filled(&mut tunnel, &turn(1500))[0][18], n);
    }
    assert!(filled(&mut tunnel, &turn(1500)).is_empty());
    assert_eq!(mouth.counts().sent, 3);
}

#[test]
fn without_slots_several_leave_at_once_but_not_all() {
    let (mut tunnel, mouth) = new(Config { per_turn: 3, buffers: 8, ..Config::of(STATION) });
    (0..5).for_each(|_| send(&mouth, OTHER, STATION, ARP, &[0; 46]).unwrap());
    assert_eq!(filled(&mut tunnel, &turn(1500)).len(), 3);
    assert_eq!(filled(&mut tunnel, &turn(1500)).len(), 2);
}

#[test]
fn the_mtu_follows_the_slot_up_and_down_and_what_is_longer_is_counted() {
    let (mut tunnel, mouth) = small(4);
    assert_eq!(mouth.mtu(), 1496);
    for (size, mtu) in [(500, 496), (1500, 1496), (60, 56), (104, 100)] {
        filled(&mut tunnel, &turn(size));
        assert_eq!(mouth.mtu(), mtu);
        send(&mouth, OTHER, STATION, ARP, &vec![0; mtu]).unwrap();
        assert_eq!(filled(&mut tunnel, &turn(size))[0].len(), 18 + mtu.max(42));
        if mtu < MTU {
            assert_eq!(send(&mouth, OTHER, STATION, ARP, &vec![0; mtu + 1]), Err(Loss::TooLong));
        }
    }
    assert_eq!(mouth.counts().lost(Loss::TooLong), 3);
    assert_eq!(mouth.pool().statistics().free, 4, "none is kept");
}

#[test]
fn what_waited_while_its_slot_shrank_makes_room_for_what_fits() {
    let (mut tunnel, mouth) = small(4);
    send(&mouth, OTHER, STATION, ARP, &[1; 1000]).unwrap();
    send(&mouth, OTHER, STATION, ARP, &[2; 100]).unwrap();
    assert_eq!(filled(&mut tunnel, &turn(500))[0][18], 2);
    let counts = mouth.counts();
    assert_eq!((counts.sent, counts.losses().collect::<Vec<_>>()), (1, vec![(Loss::TooLong, 1)]));
}

#[test]
fn a_station_that_takes_no_frame_has_it_counted() {
    let (mut tunnel, mouth) = small(2);
    send(&mouth, OTHER, STATION, ARP, &[0; 46]).unwrap();
    tunnel.fill(&turn(1500), None, &mut |frame, _, channel| Err((SendError::NoSlot(channel), frame)));
    assert_eq!(mouth.counts().losses().collect::<Vec<_>>(), [(Loss::NotQueued, 1)]);
    assert_eq!(mouth.pool().statistics().free, 2);
}

#[test]
fn a_frame_that_missed_its_turn_is_not_counted_as_sent() {
    let (mut tunnel, mouth) = small(2);
    send(&mouth, OTHER, STATION, ARP, &[0; 46]).unwrap();
    let wire = filled(&mut tunnel, &turn(1500)).remove(0);
    assert!(tunnel.still_wanted(&wire, Priority::NON_RT), "it leaves in the next");
    assert_eq!((mouth.counts().sent, mouth.counts().put_off), (0, 1));
    assert!(tunnel.still_wanted(&[0; 60], Priority::LAST_REAL_TIME), "somebody else's");
    assert_eq!(mouth.counts().put_off, 1);
}

#[test]
fn whoever_sends_waits_for_buffers_and_is_rung_when_half_of_them_are_home() {
    use std::sync::atomic::AtomicUsize;
    let rung = Arc::new(AtomicUsize::new(0));
    let (tunnel, mouth) = small(4);
    let by = rung.clone();
    let mut tunnel = tunnel.ringing(Box::new(move || {
        by.fetch_add(1, Ordering::Relaxed);
    }));
    (0..4).for_each(|_| send(&mouth, OTHER, STATION, ARP, &[0; 46]).unwrap());
    assert!(mouth.take().is_none() && !mouth.wait_for_buffers());
    for (sent, expected) in [(1, 0), (2, 1), (3, 1), (4, 1)] {
        filled(&mut tunnel, &turn(1500));
        tunnel.rest();
        assert_eq!(rung.load(Ordering::Relaxed), expected, "after {sent}");
    }
    assert!(mouth.take().is_some() && mouth.wait_for_buffers());
}

#[test]
fn a_station_that_sleeps_is_rung_once_for_all_that_was_sent() {
    let (mut tunnel, mouth) = small(4);
    assert!(!tunnel.sleeps(true), "there is nothing");
    assert!(!mouth.should_ring(), "nor is there now");
    (0..2).for_each(|_| send(&mouth, OTHER, STATION, ARP, &[0; 46]).unwrap());
    assert!(mouth.should_ring() && !mouth.should_ring());
    assert!(!tunnel.sleeps(false));
    assert!(!mouth.should_ring(), "it is awake");
    tunnel.poll(&turn(1500), &mut |_, _, _| Ok(()));
    assert!(tunnel.sleeps(true), "it had better not: something waits");
}

#[test]
fn a_station_without_turns_sleeps_whatever_waits_for_one() {
    let (mut tunnel, mouth) = small(4);
    send(&mouth, OTHER, STATION, ARP, &[0; 46]).unwrap();
    assert!(!tunnel.sleeps(true), "no turn has come");
    filled(&mut tunnel, &Opportunity { non_rt: None, ..turn(64) });
    assert!(!tunnel.sleeps(true), "that was none for it");
    tunnel.poll(&turn(1500), &mut |_, _, _| Ok(()));
    assert!(tunnel.sleeps(true) && !tunnel.sleeps(true), "once for each time that it was awake");
}

#[test]
fn whoever_sends_waits_while_the_last_buffer_is_on_its_way() {
    let (_tunnel, mouth) = small(1);
    let frame = mouth.take();
    assert!(frame.is_some() && mouth.take().is_none());
    assert!(!mouth.wait_for_buffers(), "nothing waits for a turn, but there is none");
    drop(frame);
    assert!(mouth.wait_for_buffers());
}

#[test]
fn a_crowd_that_is_too_long_by_now_takes_no_more_time_than_some() {
    let (mut tunnel, mouth) = small(4 * LOOKED_AT);
    (0..LOOKED_AT + 1).for_each(|_| send(&mouth, OTHER, STATION, ARP, &[0; 1000]).unwrap());
    send(&mouth, OTHER, STATION, ARP, &[1; 100]).unwrap();
    assert!(filled(&mut tunnel, &turn(500)).is_empty());
    assert_eq!(mouth.counts().lost(Loss::TooLong), LOOKED_AT as u64);
    assert_eq!(filled(&mut tunnel, &turn(500))[0][18], 1);
}

#[test]
fn what_the_kernel_refused_for_good_is_lost_not_sent() {
    let (mut tunnel, mouth) = small(2);
    (0..2).for_each(|_| send(&mouth, OTHER, STATION, ARP, &[0; 46]).unwrap());
    let wire = filled(&mut tunnel, &turn(1500)).remove(0);
    filled(&mut tunnel, &turn(1500));
    tunnel.given_up(&wire, Priority::NON_RT);
    tunnel.given_up(&[0; 60], Priority::LAST_REAL_TIME);
    let counts = mouth.counts();
    assert_eq!((counts.sent, counts.losses().collect::<Vec<_>>()), (1, vec![(Loss::KernelRefused, 1)]));
}

#[test]
fn what_comes_costs_an_own_buffer_and_without_one_it_is_lost() {
    let (mut tunnel, mouth) = small(2);
    let received = Pool::new(3);
    let arrive = |tunnel: &mut Tunnel, len| {
        let mut frame = received.take().unwrap();
        frame.fill(&[2, 0, 0, 0, 0, 3, 2, 0, 0, 0, 0, 1, 0x90, 0x21, 8, 6, 2, 1, 0xaa, 0xbb][..len]);
        tunnel.on_frame(None, frame)
    };
    assert_eq!(arrive(&mut tunnel, 17), Err(Refusal::Truncated));
    assert_eq!([arrive(&mut tunnel, 20), arrive(&mut tunnel, 18)], [Ok(()), Ok(())]);
    assert_eq!(arrive(&mut tunnel, 20), Err(Refusal::PoolEmpty));
    assert_eq!(received.statistics().free, 3, "each was paid for, or came back");
    let inner = mouth.received().unwrap();
    assert_eq!(Inner::of(&inner).unwrap().payload(), [0xaa, 0xbb]);
    drop(inner);
    assert_eq!(Inner::of(&mouth.received().unwrap()).unwrap().payload(), []);
    assert!(mouth.received().is_none());
    assert_eq!((mouth.counts().received, mouth.pool().statistics().free), (2, 2));
}

proptest! {
    #[test]
    fn whatever_linux_sends_is_wrapped_or_counted_and_no_buffer_is_lost(
        frames in prop::collection::vec((prop::collection::vec(any::<u8>(), 0..64), 0usize..1600), 1..40),
        sizes in prop::collection::vec(46usize..=1500, 1..8),
    ) {
        let (mut tunnel, mouth) = small(8);
        let (mut sent, mut left) = (0, 0);
        for (n, (bytes, len)) in frames.iter().enumerate() {
            if let Some(mut room) = mouth.take() {
                let bytes = &bytes[..bytes.len().min(*len)];
                room.room_mut()[FRAME..][..bytes.len()].copy_from_slice(bytes);
                sent += u64::from(mouth.send_frame(room, *len).is_ok());
            }
            for frame in filled(&mut tunnel, &turn(sizes[n % sizes.len()])) {
                prop_assert!(is_tunnelled(&frame) && frame.len() >= 60);
                left += 1;
            }
        }
        let counts = mouth.counts();
        prop_assert_eq!(counts.sent, left);
        while !mouth.shared.outward.is_empty() {
            filled(&mut tunnel, &turn(1500));
        }
        prop_assert_eq!(mouth.pool().statistics().free, 8);
        let lost_later = mouth.counts().lost(Loss::TooLong) + mouth.counts().lost(Loss::Short);
        prop_assert!(mouth.counts().sent <= sent && mouth.counts().sent + lost_later >= sent);
    }
}
