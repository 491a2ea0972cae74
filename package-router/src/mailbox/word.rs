//! The words that a mailbox's two sides have in common. Each word has one writer; whoever else sees it only loads it.

use core::sync::atomic::{AtomicU64, Ordering, fence};
use std::sync::Arc;

/// A word that one side writes and others read, at any time.
pub trait Word {
    /// What it is; nothing else follows from it.
    fn get(&self) -> u64;
    /// What it is; what its writer wrote before it is there, too.
    fn get_acquire(&self) -> u64;
    /// Writes it.
    fn set(&self, value: u64);
    /// Writes it behind everything that was written before.
    fn set_release(&self, value: u64);
    /// Everything before it is there for everybody before anything behind it is read.
    fn fence();
}

impl Word for AtomicU64 {
    #[inline]
    fn get(&self) -> u64 {
        self.load(Ordering::Relaxed)
    }
    #[inline]
    fn get_acquire(&self) -> u64 {
        // A load with an order is none of memory that cannot be written, but for that of a word on the machines there are.
        self.load(Ordering::Acquire)
    }
    #[inline]
    fn set(&self, value: u64) {
        self.store(value, Ordering::Relaxed);
    }
    #[inline]
    fn set_release(&self, value: u64) {
        self.store(value, Ordering::Release);
    }
    #[inline]
    fn fence() {
        fence(Ordering::SeqCst);
    }
}

/// A segment: words at their places. One outside is a mistake of this crate's, not of what is written there.
pub trait Segment {
    /// What it is made of.
    type Word: Word;
    /// The word at a place.
    fn at(&self, place: usize) -> &Self::Word;
    /// So many words from a place on: one check for all.
    fn part(&self, place: usize, count: usize) -> &[Self::Word];
    /// How many there are.
    fn count(&self) -> usize;
}

/// In one process.
impl<W: Word> Segment for Arc<[W]> {
    type Word = W;
    #[inline]
    fn at(&self, place: usize) -> &W {
        &self[place]
    }
    #[inline]
    fn part(&self, place: usize, count: usize) -> &[W] {
        &self[place..][..count]
    }
    fn count(&self) -> usize {
        self.len()
    }
}
