use super::*;
use crate::discipline::Stamp;
use crate::live::ring::tests::{in_a_namespace, loopback_up};
use crate::time::Span;
use crate::wire::ethernet::{Address, Header};
use zerocopy::IntoBytes;

const ROOM_FOR_A_BUSY_HOST: Span = Span::from_millis(1_000);

/// A port that hears itself: on the loopback of a namespace of the test's own.
fn port() -> Port {
    port_with(GuardMode::Auto)
}

fn port_with(guard: GuardMode) -> Port {
    let index = nix::net::if_::if_nametoindex("lo").unwrap();
    let interface = Interface { name: "lo".into(), index, address: Address::default() };
    let clock = EmulatedClock { anchor: monotonic(), offset: Span::from_millis(300), drift_ppb: 40_000 };
    Port::open(&interface, &[EtherType::EXPERIMENTAL], clock, 50_000, guard).unwrap()
}

fn transmission(pool: &Pool, at: Instant, latest: Instant) -> Transmission {
    let mut frame = pool.take().unwrap();
    let header = Header::new(Address::default(), Address::default(), EtherType::EXPERIMENTAL);
    frame.fill(header.as_bytes());
    frame.pad_to(60);
    Transmission { frame, at, latest, stamp: Some(Stamp { at_byte: 20, add: 7, sum_at: None }) }
}

fn received(port: &mut Port) -> Vec<(Option<Instant>, Vec<u8>)> {
    let mut frames = Vec::new();
    port.wait_for_frame(20);
    port.drain_control(|_, _| panic!("no control frame was sent"));
    port.drain_data(|rx, frame| frames.push((rx, frame.to_vec())));
    frames
}

#[test]
fn what_is_later_than_latest_is_not_sent_and_comes_back() {
    in_a_namespace(|| {
        let (mut port, pool) = (port(), Pool::new(1));
        let now = port.now();
        let late = transmission(&pool, now - Span::from_millis(2), now - Span::from_nanos(1));
        let Sent::Late(at, frame) = port.transmit(late) else { panic!("it was late") };
        assert!(at >= now);
        assert_eq!((frame.len(), frame[20..28].to_vec()), (60, vec![0; 8]), "as it was, and not stamped");
        assert_eq!(received(&mut port), []);
    });
}

#[test]
fn what_is_in_time_leaves_at_its_instant_with_its_stamp() {
    in_a_namespace(|| {
        let (mut port, pool) = (port(), Pool::new(1));
        let at = port.now() + Span::from_millis(2);
        let sent = port.transmit(transmission(&pool, at, at + ROOM_FOR_A_BUSY_HOST));
        let Sent::At(stamped) = sent else { panic!("{sent:?}") };
        assert!(stamped >= at, "the first frame has no cost of `send` to anticipate");
        let frames = received(&mut port);
        let [(Some(rx), frame)] = &frames[..] else { panic!("{frames:?}") };
        assert_eq!(frame[20..28], (stamped.nanos() + 7).to_be_bytes());
        let on_the_way = *rx - stamped;
        assert!(on_the_way >= Span::ZERO && on_the_way < ROOM_FOR_A_BUSY_HOST, "{on_the_way}: one clock");
    });
}

#[test]
fn what_has_come_is_heard_until_there_is_an_answer_and_an_empty_socket_is_not_asked_before_the_next_wait() {
    in_a_namespace(|| {
        let (mut port, pool) = (port(), Pool::new(1));
        let send = |port: &mut Port| {
            let at = port.now();
            assert!(matches!(port.transmit(transmission(&pool, at, at + ROOM_FOR_A_BUSY_HOST)), Sent::At(_)));
        };
        let heard = |port: &mut Port, most: usize| {
            let mut count = 0;
            port.hear(|_, _| {
                count += 1;
                count < most
            });
            count
        };
        let far = ROOM_FOR_A_BUSY_HOST.nanos() as u64;
        for _ in 0..3 {
            send(&mut port);
        }
        assert_eq!([heard(&mut port, 1), heard(&mut port, 9), heard(&mut port, 9)], [1, 2, 0]);
        send(&mut port);
        assert_eq!(heard(&mut port, 9), 0, "it was found empty, and nobody has waited since");
        let begun = monotonic();
        port.wait_for_frame_until(None, begun + far);
        assert!(monotonic() < begun + far, "a frame ends the wait");
        assert_eq!(heard(&mut port, 9), 1);
        port.wait_for_frame_until(None, monotonic() + 1_000_000);
        send(&mut port);
        assert_eq!(heard(&mut port, 9), 0, "the wait has found nothing");
        port.look_again();
        assert_eq!(heard(&mut port, 9), 1);
    });
}

#[test]
fn a_command_ends_a_wait_for_frames_each_time() {
    in_a_namespace(|| {
        let mut port = port();
        let errands = crate::live::errands::Errands::<(), ()>::new(port.bell());
        let far = 60_000_000_000;
        for _ in 0..3 {
            errands.send(()).unwrap();
            let begun = monotonic();
            port.wait_for_frame_until(None, begun + far);
            assert!(monotonic() < begun + far / 2, "it was rung for");
            assert_eq!(errands.take_back(), Some(()));
        }
        let begun = monotonic();
        port.wait_for_frame_until(None, begun + 1_000_000);
        assert!(monotonic() >= begun + 1_000_000, "nothing was sent, and nobody has to silence it");
    });
}

#[test]
fn a_port_hears_as_many_ether_types_as_it_has_places_and_refuses_more() {
    in_a_namespace(|| {
        let index = nix::net::if_::if_nametoindex("lo").unwrap();
        let interface = Interface { name: "lo".into(), index, address: Address::default() };
        // The one that is sent has the last place.
        let mut types: Vec<EtherType> =
            (0..ETHER_TYPES_AT_MOST as u16).map(|n| EtherType(0x9900 + n)).collect();
        types[ETHER_TYPES_AT_MOST - 1] = EtherType::EXPERIMENTAL;
        let open = |types: &[EtherType]| {
            Port::open(&interface, Data::Only(types), EmulatedClock::default(), 50_000, GuardMode::User)
        };
        let (mut port, pool) = (open(&types).unwrap(), Pool::new(1));
        let far = ROOM_FOR_A_BUSY_HOST.nanos() as u64;
        for _ in 0..2 {
            let at = port.now();
            assert!(matches!(port.transmit(transmission(&pool, at, at + ROOM_FOR_A_BUSY_HOST)), Sent::At(_)));
            port.wait_for_frame_until(None, monotonic() + far);
            let mut heard = [0; 2];
            for heard in &mut heard {
                port.hear(|_, _| {
                    *heard += 1;
                    true
                });
            }
            assert_eq!(heard, [1, 0], "each place is asked for itself");
            assert_eq!(port.empty, !0, "and was found empty");
        }
        types.push(EtherType(0x9a00));
        let refused = open(&types).err().map(|error| error.to_string()).unwrap_or_default();
        assert!(
            refused.starts_with("'lo' cannot be heard for 62 EtherTypes one by one: 61 at the most ("),
            "{refused}"
        );
    });
}

#[test]
fn what_the_kernel_drops_from_a_full_socket_is_counted() {
    in_a_namespace(|| {
        let (mut port, pool) = (port(), Pool::new(1));
        // Room for a few dozen small frames.
        port.data[0].set_recv_buffer_size(32 * 1024).unwrap();
        let sent = 1_000;
        for _ in 0..sent {
            let at = port.now();
            let outcome = port.transmit(transmission(&pool, at, at + ROOM_FOR_A_BUSY_HOST));
            assert!(matches!(outcome, Sent::At(_)), "{outcome:?}");
        }
        let (mut frames, mut dropped, deadline) = (0, 0, port.now() + ROOM_FOR_A_BUSY_HOST);
        // A busy kernel delivers some of them a little later.
        while frames + dropped < sent && port.now() < deadline {
            port.drain_data(|_, _| frames += 1);
            dropped = port.counters().socket_full;
        }
        assert!(dropped > 0 && frames > 0);
        assert_eq!(frames + dropped, sent);
        assert_eq!(port.counters().socket_full, dropped, "none is counted twice");
    });
}

/// A frame held up for 200 ms after the last look at the clock, when it had 100: what became of it, and what arrived.
fn held_up(guard: GuardMode) -> (Sent, usize, Port) {
    for _ in 0..20 {
        let (mut port, pool) = (port_with(guard), Pool::new(1));
        port.hold_before_send(|| sleep_until(monotonic() + 200_000_000));
        let at = port.now() + Span::from_millis(1);
        let sent = port.transmit(transmission(&pool, at, at + Span::from_millis(100)));
        if matches!(sent, Sent::Late(..)) {
            let line = b"AGAIN held_up: this host held the thread up before its last look at the clock\n";
            let _ = io::Write::write_all(&mut io::stderr(), line);
            continue;
        }
        let arrived = received(&mut port).len();
        return (sent, arrived, port);
    }
    panic!("each time it was late at its last look at the clock")
}

#[test]
fn what_is_held_up_after_the_check_leaves_late_only_without_a_guard() {
    in_a_namespace(|| {
        let (sent, arrived, port) = held_up(GuardMode::User);
        assert!(matches!(sent, Sent::StalledUntil(_)), "{sent:?}");
        assert_eq!((arrived, port.is_guarded(), port.guard_refused()), (1, false, None));
        let (sent, arrived, port) = held_up(GuardMode::Auto);
        if let Some(line) = port.guard_refused() {
            let _ = io::Write::write_all(&mut io::stderr(), format!("SKIP: {line}\n").as_bytes());
            return;
        }
        let Sent::Guarded(at, frame) = sent else { panic!("{sent:?}") };
        assert!(port.now() >= at);
        assert_eq!((frame.len(), arrived), (60, 0));
    });
}

#[test]
fn a_frame_that_the_kernel_refuses_for_another_reason_was_not_dropped_by_the_guard() {
    in_a_namespace(|| {
        let (mut port, pool) = (port(), Pool::new(1));
        let at = port.now();
        let mut short = transmission(&pool, at, at + ROOM_FOR_A_BUSY_HOST);
        // No frame is shorter than its header.
        short.frame.set_len(13);
        short.stamp = None;
        let sent = port.transmit(short);
        assert!(matches!(sent, Sent::Failed(_, _)), "{sent:?}");
    });
}

#[test]
fn a_port_sleeps_while_its_interface_is_down_and_works_again_once_it_is_up() {
    in_a_namespace(|| {
        let (mut port, pool) = (port(), Pool::new(1));
        let send = |port: &mut Port| {
            let at = port.now();
            port.transmit(transmission(&pool, at, at + ROOM_FOR_A_BUSY_HOST))
        };
        loopback_up(false);
        assert_eq!(received(&mut port), [], "the kernel's word to each socket is taken with this");
        let began = monotonic();
        port.wait_for_frame(50);
        assert!(monotonic() - began >= 50_000_000, "and with it the reason to wake");
        let sent = send(&mut port);
        assert!(matches!(sent, Sent::Failed(libc::ENETDOWN, _)), "{sent:?}");
        drop(sent);

        loopback_up(true);
        let sent = send(&mut port);
        assert!(matches!(sent, Sent::At(_)), "{sent:?}");
        assert_eq!(received(&mut port).len(), 1);
    });
}
