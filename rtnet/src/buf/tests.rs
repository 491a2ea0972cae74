use super::*;

#[test]
fn a_buffer_goes_home_when_it_is_dropped() {
    let pool = Pool::new(2);
    let (a, b) = (pool.take().unwrap(), pool.take().unwrap());
    assert!(pool.take().is_none());
    drop(a);
    assert_eq!(pool.available(), 1);
    drop(b);
    assert_eq!((pool.available(), pool.capacity()), (2, 2));
}

#[test]
fn keeping_a_frame_costs_the_consumer_an_empty_buffer() {
    let (nic, socket) = (Pool::new(1), Pool::new(1));
    let mut frame = nic.take().unwrap();
    frame.fill(b"frame");
    let kept = hand_over(frame, &socket).unwrap();
    assert_eq!(&kept[..], b"frame");
    assert_eq!((nic.available(), socket.available()), (1, 0));

    let mut second = nic.take().unwrap();
    second.fill(b"lost");
    let refused = hand_over(second, &socket).unwrap_err();
    assert_eq!(&refused[..], b"lost");
    drop(refused);
    drop(kept);
    assert_eq!((nic.available(), socket.available()), (1, 1));
}

#[test]
fn padding_is_zero_even_in_a_used_buffer() {
    let pool = Pool::new(1);
    let mut used = pool.take().unwrap();
    used.fill(&[0xff; 64]);
    drop(used);
    let mut again = pool.take().unwrap();
    assert!(again.is_empty());
    again.fill(b"x");
    again.pad_to(60);
    assert_eq!(again[1..], [0; 59]);
}

#[test]
fn threads_share_a_pool_and_nothing_is_lost() {
    let pool = Pool::new(8);
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                for _ in 0..10_000 {
                    let held: Vec<_> = (0..3).filter_map(|_| pool.take()).collect();
                    drop(held);
                }
            });
        }
    });
    assert_eq!(pool.available(), 8);
}

#[test]
fn frames_handed_from_pool_to_pool_by_several_threads_all_come_home() {
    let (nic, socket) = (Pool::new(4), Pool::new(3));
    std::thread::scope(|scope| {
        for byte in 1..=4u8 {
            let (nic, socket) = (&nic, &socket);
            scope.spawn(move || {
                for _ in 0..10_000 {
                    let Some(mut frame) = nic.take() else { continue };
                    frame.fill(&[byte; 64]);
                    let kept = hand_over(frame, socket);
                    let frame = kept.as_ref().unwrap_or_else(|refused| refused);
                    assert!(frame.iter().all(|&filled| filled == byte), "two owners of one buffer");
                }
            });
        }
    });
    assert_eq!((nic.available(), socket.available()), (4, 3));
    let all: Vec<_> = std::iter::from_fn(|| nic.take().or_else(|| socket.take())).collect();
    assert_eq!(all.len(), 7);
}

#[test]
fn a_buffer_may_outlive_its_pool() {
    let pool = Pool::new(2);
    let mut buf = pool.take().unwrap();
    drop(pool);
    buf.fill(b"still here");
    assert_eq!(&buf[..], b"still here");
}

#[test]
fn a_trimmed_header_no_longer_belongs_to_the_frame() {
    let pool = Pool::new(1);
    let mut frame = pool.take().unwrap();
    frame.fill(b"header, payload, padding");
    frame.trim_front(6);
    frame.trim_front(2);
    frame.truncate(99);
    assert_eq!(&frame[..], b"payload, padding");
    frame.truncate(7);
    assert_eq!((&frame[..], frame.len()), (&b"payload"[..], 7));
    frame[0] = b'P';
    assert_eq!(&frame.room_mut()[..16], b"header, Payload,", "it is still in the room");
    frame.trim_front(7);
    assert!(frame.is_empty());
    frame.untrim_front();
    assert_eq!(&frame[..], b"header, Payload", "what was cut off behind it stays so");
}

#[test]
fn trimming_survives_hand_over_and_the_buffer_given_for_it_is_whole() {
    let (nic, socket) = (Pool::new(1), Pool::new(1));
    let mut frame = nic.take().unwrap();
    frame.fill(b"header, payload, padding");
    frame.trim_front(8);
    frame.truncate(7);
    let kept = hand_over(frame, &socket).unwrap();
    assert_eq!(&kept[..], b"payload");
    let mut spare = nic.take().unwrap();
    assert!(spare.is_empty());
    spare.set_len(3);
    assert_eq!(spare.len(), 3);
    drop(kept);
    let again = socket.take().unwrap();
    assert!(again.is_empty(), "nothing is left of what it was");
}

#[test]
fn who_fills_a_trimmed_buffer_starts_over() {
    let pool = Pool::new(1);
    let mut frame = pool.take().unwrap();
    let trimmed = |frame: &mut Buf| {
        frame.fill(b"header, payload");
        frame.trim_front(8);
    };
    trimmed(&mut frame);
    frame.fill(b"anew");
    assert_eq!(&frame[..], b"anew");
    trimmed(&mut frame);
    frame.set_len(6);
    assert_eq!(&frame[..], b"header");
    trimmed(&mut frame);
    drop(frame);
    let mut again = pool.take().unwrap();
    again.pad_to(ROOM);
    assert_eq!(again.len(), ROOM, "nothing is trimmed after it was taken");
}

#[test]
fn padding_counts_from_what_was_not_trimmed() {
    let pool = Pool::new(1);
    let mut frame = pool.take().unwrap();
    frame.fill(&[0xff; ROOM]);
    frame.fill(b"header, payload");
    frame.trim_front(8);
    frame.pad_to(7);
    assert_eq!(&frame[..], b"payload");
    frame.pad_to(46);
    assert_eq!((&frame[..7], &frame[7..]), (&b"payload"[..], &[0; 39][..]));
    frame.pad_to(ROOM - 8);
    assert_eq!(frame.len(), ROOM - 8);
}

#[test]
#[should_panic(expected = "5 bytes trimmed of 4")]
fn more_than_what_is_filled_cannot_be_trimmed() {
    let pool = Pool::new(1);
    let mut frame = pool.take().unwrap();
    frame.fill(b"12345");
    frame.trim_front(1);
    frame.trim_front(5);
}
