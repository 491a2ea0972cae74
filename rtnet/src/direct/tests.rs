use super::*;
use crate::at_once::DEFAULT_ASK_EVERY;
use crate::buf::Pool;
use crate::discipline::{Discipline, EventKind, Opportunity, Outlet, SendError, Sent, Service};
use crate::station::Station;
use crate::time::{Instant, Span};
use crate::wire::ethernet::Address;

const NOW: Instant = Instant::from_nanos(1_000_000_000);

/// A frame of this EtherType with a number in it.
fn frame(pool: &Pool, ether_type: EtherType, number: u8) -> Buf {
    let mut frame = pool.take().expect("the pool of a test has enough");
    let mut bytes = [number; 60];
    bytes[..6].copy_from_slice(&Address([2, 0, 0, 0, 0, 1]).0);
    bytes[12..14].copy_from_slice(&ether_type.0.to_be_bytes());
    frame.fill(&bytes);
    frame
}

fn data(pool: &Pool, number: u8) -> Buf {
    frame(pool, EtherType::EXPERIMENTAL, number)
}

/// The number of the frame that is sent next.
fn sent(direct: &mut Direct) -> Option<u8> {
    let chosen = direct.next_transmission(NOW)?;
    assert!(chosen.at == NOW && chosen.stamp.is_none());
    assert_eq!(direct.on_sent(Sent::At(NOW)).map(|_| ()), None);
    Some(chosen.frame[20])
}

#[test]
fn frames_leave_at_once_in_the_order_in_which_they_were_queued() {
    let pool = Pool::new(4);
    let mut direct = Direct::new(DEFAULT_ASK_EVERY);
    direct.on_timeout(NOW);
    for (number, level, channel) in [(1, 31, 1), (2, 0, 0), (3, 15, 200)] {
        direct.enqueue(data(&pool, number), Priority::new(level).unwrap(), channel).unwrap();
    }
    assert_eq!(std::iter::from_fn(|| sent(&mut direct)).collect::<Vec<_>>(), [1, 2, 3]);
    assert_eq!((direct.status().frames_sent, pool.available()), (3, 4));
}

#[test]
fn nothing_of_rtmac_is_claimed_or_leaves() {
    let pool = Pool::new(1);
    let mut direct = Direct::new(DEFAULT_ASK_EVERY);
    let rtmac = frame(&pool, EtherType::RTMAC, 0);
    let (header, _) = Header::parse(&rtmac).unwrap();
    assert!(!direct.claims(header));
    let (why, mut rtmac) = direct.enqueue(rtmac, Priority::FIRST, 0).unwrap_err();
    assert_eq!(why, SendError::Lethal);
    rtmac.set_len(13);
    assert!(matches!(direct.enqueue(rtmac, Priority::FIRST, 0), Err((SendError::Lethal, _))), "no frame");
    assert_eq!((direct.status().lethal, direct.status().queued), (2, 0));
}

#[test]
fn a_frame_that_the_kernel_refuses_is_gone_and_told_of() {
    let pool = Pool::new(1);
    let mut direct = Direct::new(DEFAULT_ASK_EVERY);
    direct.on_timeout(NOW);
    direct.enqueue(data(&pool, 1), Priority::FIRST, 0).unwrap();
    let chosen = direct.next_transmission(NOW).unwrap();
    assert!(direct.on_sent(Sent::Failed(100, chosen.frame)).is_some(), "for who wants to know");
    assert!(!direct.tries_again());
    let told = direct.next_event().unwrap();
    assert_eq!((told.kind, told.span), (EventKind::SendFailed, Span::from_nanos(100)));
    assert_eq!((sent(&mut direct), direct.status().send_failed, pool.available()), (None, 1, 1));
}

#[test]
fn all_buffers_that_there_are_may_wait_and_a_hold_up_loses_none() {
    let pool = Pool::new(64);
    let mut direct = Direct::new(DEFAULT_ASK_EVERY);
    direct.on_timeout(NOW);
    (0..64).for_each(|n| direct.enqueue(data(&pool, n), Priority::FIRST, 0).unwrap());
    assert_eq!((direct.status().queued, pool.available()), (64, 0));
    let chosen = direct.next_transmission(NOW).unwrap();
    let returned = direct.on_sent(Sent::Late(NOW, chosen.frame)).unwrap();
    direct.put_back(returned);
    assert_eq!(std::iter::from_fn(|| sent(&mut direct)).collect::<Vec<_>>(), (0..64).collect::<Vec<_>>());
}

/// Has a frame whenever it is asked.
struct Eager(Pool, u8);

impl Service for Eager {
    fn claims(&self, _ether_type: EtherType) -> bool {
        true
    }
    fn on_frame(&mut self, _rx: Option<Instant>, _frame: Buf) -> Result<(), Refusal> {
        Ok(())
    }
    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>) {
        self.1 += 1;
        let _ = out(data(&self.0, self.1), Priority::FIRST, slot.channel);
    }
}

#[test]
fn services_are_asked_once_whenever_the_loop_has_waited() {
    let eager = Eager(Pool::new(4), 0);
    let mut station = Station::new(Direct::new(DEFAULT_ASK_EVERY), vec![Box::new(eager)]);
    let mut turn = |at: Instant| {
        station.on_timeout(at);
        let chosen = station.next_transmission(at).map(|chosen| chosen.frame[20]);
        if chosen.is_some() {
            station.on_sent(Sent::At(at));
        }
        (chosen, station.next_deadline().unwrap() - at, station.discipline().status().ticks)
    };
    let half = DEFAULT_ASK_EVERY / 2;
    assert_eq!(turn(NOW), (Some(1), DEFAULT_ASK_EVERY, 1));
    assert_eq!(turn(NOW), (None, DEFAULT_ASK_EVERY, 1), "now it waits");
    assert_eq!(turn(NOW + half), (Some(2), half, 1), "a frame has woken it");
    assert_eq!(turn(NOW + half), (None, half, 1));
    assert_eq!(
        turn(NOW + DEFAULT_ASK_EVERY * 3),
        (Some(3), DEFAULT_ASK_EVERY, 4),
        "it has slept through two"
    );
}
