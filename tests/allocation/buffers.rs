//! What the real-time thread does with buffers and chains of them.

use rtnet::buf::{Chain, Pool, hand_over};

use crate::calls;

/// Fragments of the largest datagram.
const FRAGMENTS: usize = 45;

#[test]
fn buffers_chains_of_them_take_no_memory_of_their_own() {
    let (nic, socket) = (Pool::new(1), Pool::with_room(4 * FRAGMENTS, 8 * FRAGMENTS));
    let mut text = [0; 4 * FRAGMENTS];
    let before = calls();
    let mut datagrams = [const { Chain::new() }; 4];
    for datagram in &mut datagrams {
        for _ in 0..FRAGMENTS {
            let mut frame = nic.take().expect("another one was given for it");
            frame.fill(b"a frame");
            frame.trim_front(2);
            frame.truncate(4);
            datagram.push(hand_over(frame, &socket).expect("the socket has enough"));
        }
    }
    let full = (nic.take().map(|frame| hand_over(frame, &socket).is_err()), socket.statistics());
    let [received, ..] = &mut datagrams;
    let copied = received.copy_to(0, &mut text);
    let left = (received.pop_front().map(drop), received.len(), received.count());
    drop(datagrams);
    let allocations = calls() - before;

    assert_eq!((full.0, full.1.least, full.1.exhausted), (Some(true), 0, 1));
    assert_eq!((copied, text), (text.len(), *b"fram".repeat(FRAGMENTS).first_chunk().unwrap()));
    assert_eq!(left, (Some(()), 4 * (FRAGMENTS - 1), FRAGMENTS - 1));
    assert_eq!((nic.available(), socket.available()), (1, 4 * FRAGMENTS));
    assert_eq!(allocations, 0);
}
