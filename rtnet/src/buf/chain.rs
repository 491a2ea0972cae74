//! Buffers one behind the other, linked through themselves: the fragments of a datagram, and what waits to be sent.
//!
//! ```text
//! Chain { last } ──────────────────────────┐
//!                                          ▼
//!   ┌─► first ──behind──► second ──behind──► last ──┐      the next to be taken is the one behind the last
//!   └────────────────────behind───────────────────┘
//! ```
//!
//! Either end costs the same however long it is: a datagram may have thousands of fragments, and thousands of frames may wait,
//! while a slot is at stake. That needs a pointer to the last buffer besides the one that owns it.

#![allow(unsafe_code)]

use core::ptr::NonNull;
use core::{fmt, iter};

use super::{Buf, Storage};

/// Buffers in their order, as many as there are, and one pointer large. `len` and `count` walk through it, which costs 1 or 2
/// ns for each buffer that is in a cache.
#[derive(Default)]
pub struct Chain {
    last: Behind,
}

/// The buffer that a chain knows, or that another in it knows. `None` while there is none, and in every buffer that is not in
/// a chain.
#[derive(Clone, Copy, Default)]
pub(super) struct Behind(Option<NonNull<Storage>>);

// SAFETY: it is a part of a `Chain`, or of a buffer in one, and used only by who has the chain: who sends a chain to another
// thread sends all buffers in it, which may be sent.
unsafe impl Send for Behind {}
// SAFETY: who shares a chain shares the bytes of its buffers, to be read only.
unsafe impl Sync for Behind {}

impl Behind {
    /// Whether it is that of a buffer which is in no chain.
    pub fn is_none(self) -> bool {
        self.0.is_none()
    }
}

impl Chain {
    /// Of no buffer.
    pub const fn new() -> Self {
        Self { last: Behind(None) }
    }

    /// Of one buffer.
    pub fn of(buf: Buf) -> Self {
        let mut chain = Self::new();
        chain.push(buf);
        chain
    }

    /// Appends a buffer.
    #[inline]
    pub fn push(&mut self, buf: Buf) {
        self.last = self.link(buf);
    }

    /// Puts a buffer before all others.
    #[inline]
    pub fn push_front(&mut self, buf: Buf) {
        let first = self.link(buf);
        if self.is_empty() {
            self.last = first;
        }
    }

    /// Takes the first buffer out.
    #[inline]
    pub fn pop_front(&mut self) -> Option<Buf> {
        let last = self.last.0?;
        let first = self.first()?;
        // SAFETY: it came out of a box in `link`, nobody has a reference to it, and it is in the chain no more from here on.
        let mut storage = unsafe { Box::from_raw(first.as_ptr()) };
        let second = core::mem::take(&mut storage.behind);
        if first == last {
            self.last = Behind(None);
        } else {
            // SAFETY: the last is the chain's alone, as in `link`, and another than the one that was taken.
            unsafe { (*last.as_ptr()).behind = second };
        }
        Some(Buf { storage: Some(storage) })
    }

    /// What is filled and not trimmed in each buffer, in order.
    pub fn parts(&self) -> impl Iterator<Item = &[u8]> {
        let last = self.last.0;
        // SAFETY: all of them are the chain's, which is not changed while it is borrowed.
        let behind = move |at: &NonNull<Storage>| unsafe { (*at.as_ptr()).behind.0 };
        let all = iter::successors(self.first(), move |at| behind(at).filter(|_| Some(*at) != last));
        // SAFETY: as above.
        all.map(|at| unsafe { at.as_ref() }.filled())
    }

    /// Bytes in all parts together.
    pub fn len(&self) -> usize {
        self.parts().map(<[u8]>::len).sum()
    }

    /// How many buffers there are.
    pub fn count(&self) -> usize {
        self.parts().count()
    }

    /// Whether there is no buffer in it. A datagram without a byte still has one.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.last.is_none()
    }

    /// Copies the bytes from offset `from` on, as many as there are and fit `into`, and tells how many.
    pub fn copy_to(&self, from: usize, into: &mut [u8]) -> usize {
        let (mut before, mut copied) = (from, 0);
        for part in self.parts() {
            let wanted = part.get(before..).unwrap_or_default();
            before = before.saturating_sub(part.len());
            let n = wanted.len().min(into.len() - copied);
            into[copied..copied + n].copy_from_slice(&wanted[..n]);
            copied += n;
        }
        copied
    }

    /// Whether the chain has these bytes from offset `from` on.
    pub fn is_at(&self, from: usize, bytes: &[u8]) -> bool {
        let (mut before, mut left) = (from, bytes);
        for part in self.parts() {
            let here = part.get(before..).unwrap_or_default();
            before = before.saturating_sub(part.len());
            let n = here.len().min(left.len());
            if here[..n] != left[..n] {
                return false;
            }
            left = &left[n..];
        }
        left.is_empty()
    }

    /// The one behind the last.
    #[inline]
    fn first(&self) -> Option<NonNull<Storage>> {
        // SAFETY: a buffer in a chain is its chain's alone, from `link` on until it is taken out.
        self.last.0.and_then(|last| unsafe { (*last.as_ptr()).behind.0 })
    }

    /// Makes a buffer the one behind the last, or that of a chain of one: before the first and behind the last are one place.
    #[inline]
    fn link(&mut self, mut buf: Buf) -> Behind {
        let storage = buf.storage.take().expect("only what ends it takes it");
        let new = NonNull::from(Box::leak(storage));
        let last = self.last.0.unwrap_or(new);
        // SAFETY: both are the chain's alone; they may be one. A buffer that is in no chain has none behind it.
        unsafe {
            (*new.as_ptr()).behind = Behind((*last.as_ptr()).behind.0.or(Some(new)));
            (*last.as_ptr()).behind = Behind(Some(new));
        }
        Behind(Some(new))
    }
}

impl Drop for Chain {
    /// Each goes home, one after the other: a chain of any length needs no more stack than one buffer.
    fn drop(&mut self) {
        while self.pop_front().is_some() {}
    }
}

impl fmt::Debug for Chain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Chain")?;
        f.debug_list().entries(self.parts().map(<[u8]>::len)).finish()
    }
}

#[cfg(test)]
mod tests;
