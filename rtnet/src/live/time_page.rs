//! The page that a station shows its time on: its threads read it where it writes, other processes in a mapping that they
//! cannot write.

use core::ops::Deref;
use core::sync::atomic::AtomicU64;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use super::sealed::Sealed;

/// Words of a page.
pub(super) const WORDS: usize = 512;

/// A page of words, which it dereferences to.
pub(super) enum Page {
    /// For this process alone: the kernel has no such files, or no more of them.
    Own(Box<[AtomicU64; WORDS]>),
    /// For others, too.
    Shared(Sealed),
}

impl Page {
    /// A new one, all zero and there: who touches it does not wait for the kernel.
    pub(super) fn new() -> Self {
        Sealed::new(c"rtnet-time", WORDS)
            .map_or_else(|_| Page::Own(Box::new([const { AtomicU64::new(0) }; WORDS])), Page::Shared)
    }

    /// One that another process has made, to be read.
    pub(super) fn open(file: OwnedFd) -> io::Result<Self> {
        Sealed::open(file, WORDS).map(Page::Shared)
    }

    /// What other processes open; `None`: there is nothing for them.
    pub(super) fn file(&self) -> Option<BorrowedFd<'_>> {
        match self {
            Page::Own(_) => None,
            Page::Shared(memory) => Some(memory.as_fd()),
        }
    }
}

impl Deref for Page {
    type Target = [AtomicU64];

    #[inline]
    fn deref(&self) -> &[AtomicU64] {
        match self {
            Page::Own(words) => &words[..],
            Page::Shared(memory) => memory,
        }
    }
}
