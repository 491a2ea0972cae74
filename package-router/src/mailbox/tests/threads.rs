//! Senders and owner at the same time.

use core::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use super::*;

/// Packages that are told from others by every word of them.
fn body(lane: usize, count: u64) -> [u8; 40] {
    let word = (count << 8 | lane as u64).to_ne_bytes();
    let mut body = [0; 40];
    body.chunks_mut(8).for_each(|part| part.copy_from_slice(&word));
    body
}

/// What came of each lane, in its order: whole packages only.
fn course(shape: Shape, each: u64) -> Vec<(Sender, Vec<u64>)> {
    let (mut inbox, senders) = mailbox(shape);
    let is_over = AtomicBool::new(false);
    thread::scope(|scope| {
        let sending: Vec<_> = senders
            .into_iter()
            .enumerate()
            .map(|(lane, mut sender)| {
                let is_over = &is_over;
                scope.spawn(move || {
                    for count in 1..=each {
                        let head = head(lane, 7, count as u8);
                        while sender.send(&head, &body(lane, count), &at(count))
                            == Err(SendError::Full(shape.slots))
                        {
                            // An owner that has failed reads nothing more.
                            if is_over.load(Ordering::Relaxed) {
                                return sender;
                            }
                            thread::yield_now();
                        }
                    }
                    sender
                })
            })
            .collect();
        let receiving = scope.spawn(|| {
            // However this ends, nobody waits for it.
            struct Over<'a>(&'a AtomicBool);
            impl Drop for Over<'_> {
                fn drop(&mut self) {
                    self.0.store(true, Ordering::Relaxed);
                }
            }
            let _over = Over(&is_over);
            let mut came = vec![Vec::new(); shape.senders];
            // The last of each lane always comes: nothing is newer.
            while came.iter().any(|came| came.last() != Some(&each)) {
                let Some(package) = inbox.receive(u64::MAX) else {
                    thread::yield_now();
                    continue;
                };
                let lane = usize::from(package.head().from.instance());
                let bytes = package.body().to_vec();
                let count = u64::from_ne_bytes(bytes[..8].try_into().unwrap()) >> 8;
                assert_eq!((bytes, package.head().id), (body(lane, count).to_vec(), count as u8));
                assert_eq!(package.stamps().sent, count);
                came[lane].push(count);
            }
            drop(inbox.receive(u64::MAX));
            came
        });
        let came = receiving.join().unwrap();
        let senders = sending.into_iter().map(|sender| sender.join().unwrap());
        senders.zip(came).collect()
    })
}

#[test]
fn all_that_several_send_at_once_comes_whole_and_in_its_order() {
    for (_, came) in course(Shape::new(3, 40).senders(3), 60_000) {
        assert_eq!(came, (1..=60_000).collect::<Vec<_>>());
    }
}

#[test]
fn where_the_new_replaces_the_old_each_is_read_or_counted_and_none_is_both_or_torn() {
    for slots in [1, 2, 3, 5, 7, 15] {
        for (mut sender, came) in course(Shape::new(slots, 40).senders(2).replacing(), 100_000) {
            assert!(came.is_sorted());
            assert_eq!(sender.waiting(), Ok(0));
            let replaced = sent(&sender, of_sender::REPLACED);
            assert_eq!(came.len() as u64 + replaced, sent(&sender, of_sender::SENT));
        }
    }
}
