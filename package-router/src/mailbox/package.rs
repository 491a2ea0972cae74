//! A package that lies in its slot while it is read.

use super::inbox::Inbox;
use super::sender::Stamps;
use super::word::{Segment, Word};
use crate::wire::Head;

/// A package, lent by its mailbox. Its slot is its sender's again once it is dropped.
pub struct Package<'a, Own: Segment, Theirs: Segment> {
    inbox: &'a mut Inbox<Own, Theirs>,
    is_put_back: bool,
}

/// Room that is too small for a package: it stays in the mailbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the package has {needed} bytes, and there is room for {got}: it stays in the mailbox")]
pub struct TooSmall {
    /// Bytes of room.
    pub got: usize,
    /// Bytes of the body.
    pub needed: usize,
}

/// A body as it lies there. Its sender may write it at any time, whatever it should: so it is copied, once, by whoever looks.
#[derive(Clone, Copy)]
pub struct Body<'a, Theirs> {
    segment: Option<(&'a Theirs, usize)>,
    len: usize,
}

impl<'a, Own: Segment, Theirs: Segment> Package<'a, Own, Theirs> {
    pub(super) fn new(inbox: &'a mut Inbox<Own, Theirs>) -> Self {
        Self { inbox, is_put_back: false }
    }

    /// Its head.
    #[inline]
    pub fn head(&self) -> &Head {
        &self.inbox.found().head
    }
    /// When it was where.
    pub fn stamps(&self) -> Stamps {
        self.inbox.stamps()
    }
    /// How long it has waited in this mailbox until it was received: nanoseconds of this host's monotonic clock.
    pub fn waited(&self) -> u64 {
        self.inbox.found().took
    }
    /// Its body.
    #[inline]
    pub fn body(&self) -> Body<'_, Theirs> {
        Body { segment: self.inbox.body(), len: self.head().body_len() }
    }
    /// Leaves it in the mailbox, as the first of its priority.
    pub fn put_back(mut self) {
        self.is_put_back = true;
    }
}

impl<Own: Segment, Theirs: Segment> Drop for Package<'_, Own, Theirs> {
    #[inline]
    fn drop(&mut self) {
        if self.is_put_back {
            self.inbox.put_back();
        } else {
            self.inbox.let_go();
        }
    }
}

impl<Theirs: Segment> Body<'_, Theirs> {
    /// How many bytes.
    #[inline]
    pub fn len(&self) -> usize {
        self.len
    }
    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Copies what is behind so many bytes, as far as it fits: how many bytes that are.
    #[inline]
    pub fn copy_to(&self, skip: usize, into: &mut [u8]) -> usize {
        const WORD: usize = size_of::<u64>();
        let len = self.len.saturating_sub(skip).min(into.len());
        let Some((segment, begin)) = self.segment else { return 0 };
        let (mut at, odd) = (begin + skip / WORD, skip % WORD);
        let mut rest = &mut into[..len];
        if odd > 0 && !rest.is_empty() {
            let n = rest.len().min(WORD - odd);
            let (first, behind) = rest.split_at_mut(n);
            first.copy_from_slice(&segment.at(at).get().to_ne_bytes()[odd..odd + n]);
            (rest, at) = (behind, at + 1);
        }
        let (words, last) = rest.as_chunks_mut::<WORD>();
        let from = segment.part(at, words.len());
        at += words.len();
        for (word, from) in words.iter_mut().zip(from) {
            *word = from.get().to_ne_bytes();
        }
        if !last.is_empty() {
            last.copy_from_slice(&segment.at(at).get().to_ne_bytes()[..last.len()]);
        }
        len
    }

    /// A copy of all of it: it takes memory.
    pub fn to_vec(&self) -> Vec<u8> {
        let mut bytes = vec![0; self.len];
        self.copy_to(0, &mut bytes);
        bytes
    }
}
