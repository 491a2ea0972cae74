//! How large a slot may be, and what fits it.

use super::*;
use crate::wire::{self, Rtmac};

fn sized(size: usize) -> SlotConfig {
    SlotConfig { size, ..config(0, 100, 0, 1) }
}

#[test]
fn a_slot_takes_from_46_to_1500_bytes_and_no_other_size_is_one() {
    for size in [0, 45, 1501] {
        assert_eq!(set(&mut Slots::new(7), sized(size)), Err(Refused::Size { id: 0, size }));
    }
    let frames = Frames::new();
    for size in [46, 1500] {
        let mut slots = with(&[sized(size)]);
        assert_eq!(slots.payload_limit(0), Ok(size));
        slots.enqueue(frames.of(1, size), Priority::DEFAULT, 0).unwrap();
        assert_eq!(slots.dequeue(0).unwrap().1.len(), ethernet::HEADER_LEN + size);
    }
}

#[test]
fn the_head_of_a_tunnelled_frame_counts_against_the_size_of_its_slot() {
    let frames = Frames::new();
    let tunnelled = |inside: usize| {
        let mut frame = frames.of(0, 4 + inside);
        frame[12..18].copy_from_slice(&[0x90, 0x21, 0x08, 0x00, 2, 1]);
        assert!(matches!(wire::parse(&frame), Ok(Rtmac::Tunnel(_, payload)) if payload.len() == inside));
        frame
    };
    let mut slots = with(&[sized(100)]);
    slots.enqueue(tunnelled(96), Priority::NON_RT, 1).unwrap();
    let error = slots.enqueue(tunnelled(97), Priority::NON_RT, 1).unwrap_err().0;
    assert_eq!(error, SendError::TooLong { channel: 1, got: 101, limit: 100 });
    assert_eq!(slots.dequeue(0).map(|(priority, _)| priority), Some(Priority::NON_RT));
}
