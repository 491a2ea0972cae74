//! Buffers, the pools that own them, and the chains that they form.
//!
//! A [`Pool`] owns its buffers, all made when it is: nothing is allocated later, unless its owner asks for
//! more or fewer of them ([`Pool::extend`], [`Pool::shrink`]). A [`Buf`] goes home when it is dropped, on whichever
//! thread. Who wants to *keep* a filled buffer of somebody else's pays with an empty one of its own
//! ([`hand_over`]), so that a slow consumer can lose only its own frames.
//!
//! Every buffer has a place of its own in its home, so going home is one atomic exchange with nobody to
//! compete with, and taking is one more at the first place that is filled. A buffer knows its home by plain
//! reference, without a count: for that a pool's places (16 bytes for each buffer that it may ever own) stay for
//! the life of the process; the buffers themselves are released with the pool, or when it shrinks.
//!
//! Buffers of any pools form a [`Chain`]: the fragments of one datagram, or frames that wait. The links are in the
//! buffers, so it takes no memory of its own, however long it grows.

mod chain;
mod pool;
#[cfg(test)]
mod tests;

use core::fmt;
use core::ops::{Deref, DerefMut};

use chain::Behind;
pub use chain::Chain;
use pool::Home;
pub use pool::{MOST, Pool, PoolStatistics};

/// Bytes in every buffer: the largest Ethernet frame without its check sequence.
pub const ROOM: usize = 1514;

/// One buffer, filled up to its length, which dereferences to the filled bytes that were not trimmed.
pub struct Buf {
    // `Some` until dropped or linked: safe code can move the box on only out of an `Option`.
    storage: Option<Box<Storage>>,
}

/// A field of a frame that says when it left, which is written as the last act before it does, and the checksum over it: their
/// offsets from the frame's first byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Blank {
    /// Of the field, eight bytes.
    pub at_byte: u16,
    /// Of the checksum, two.
    pub sum_at: u16,
}

struct Storage {
    home: &'static Home,
    /// The next in the [`Chain`] that it is part of.
    behind: Behind,
    place: u16,
    /// What is filled and not trimmed: `start..end` of `bytes`.
    start: u16,
    end: u16,
    blank: Option<Blank>,
    bytes: [u8; ROOM],
}

/// Makes a filled buffer `consumer`'s, which gives an empty one of its own to the pool it came from.
/// Nothing is copied, what was trimmed stays so. An exhausted consumer gets nothing: the frame comes back as the
/// error.
pub fn hand_over(mut filled: Buf, consumer: &Pool) -> Result<Buf, Buf> {
    let Some(mut empty) = consumer.take() else { return Err(filled) };
    let (full, spare) = (filled.storage_mut(), empty.storage_mut());
    core::mem::swap(&mut full.home, &mut spare.home);
    core::mem::swap(&mut full.place, &mut spare.place);
    Ok(filled)
}

impl Buf {
    /// All [`ROOM`] bytes, to be filled before [`Buf::set_len`]; trimmed ones are among them.
    #[inline]
    pub fn room_mut(&mut self) -> &mut [u8; ROOM] {
        &mut self.storage_mut().bytes
    }

    /// Declares the first `len` bytes of the room filled, and none of them trimmed. Panics above [`ROOM`].
    #[inline]
    pub fn set_len(&mut self, len: usize) {
        assert!(len <= ROOM, "a buffer holds {ROOM} bytes, not {len}");
        self.storage_mut().is_filled_up_to(len);
    }

    /// Copies `bytes` in and takes their length; nothing is trimmed then. Panics above [`ROOM`].
    pub fn fill(&mut self, bytes: &[u8]) {
        self.room_mut()[..bytes.len()].copy_from_slice(bytes);
        self.set_len(bytes.len());
    }

    /// Appends zeros up to `len`; a longer frame stays as it is. Panics if that needs more than [`ROOM`], of
    /// which trimmed bytes are part.
    pub fn pad_to(&mut self, len: usize) {
        let filled = self.len();
        if filled < len {
            let storage = self.storage_mut();
            let (start, end) = (usize::from(storage.start), usize::from(storage.end));
            storage.bytes[end..start + len].fill(0);
            storage.end = (start + len) as u16;
        }
    }

    /// Leaves the first `n` filled bytes out from here on, as a header that was parsed. Panics if there are fewer.
    #[inline]
    pub fn trim_front(&mut self, n: usize) {
        let filled = self.len();
        assert!(n <= filled, "{n} bytes trimmed of {filled}");
        self.storage_mut().start += n as u16;
    }

    /// Takes in again all that was left out from its front.
    #[inline]
    pub fn untrim_front(&mut self) {
        self.storage_mut().start = 0;
    }

    /// Leaves out what is filled behind the first `n` bytes; a shorter frame stays as it is.
    #[inline]
    pub fn truncate(&mut self, n: usize) {
        if n < self.len() {
            let storage = self.storage_mut();
            storage.end = storage.start + n as u16;
        }
    }

    /// What is to be written in it when it leaves.
    #[inline]
    pub fn blank(&self) -> Option<Blank> {
        self.storage().blank
    }
    /// This is to be written in it when it leaves, until it is filled with something else.
    pub fn set_blank(&mut self, blank: Blank) {
        self.storage_mut().blank = Some(blank);
    }

    #[inline]
    fn storage(&self) -> &Storage {
        self.storage.as_deref().expect("only what ends it takes it")
    }
    #[inline]
    fn storage_mut(&mut self) -> &mut Storage {
        self.storage.as_deref_mut().expect("only what ends it takes it")
    }
}

impl Storage {
    fn new(home: &'static Home, place: u16) -> Self {
        Self { home, behind: Behind::default(), place, start: 0, end: 0, blank: None, bytes: [0; ROOM] }
    }

    /// By something that has no blank so far.
    #[inline]
    fn is_filled_up_to(&mut self, len: usize) {
        (self.start, self.end, self.blank) = (0, len as u16, None);
    }

    #[inline]
    fn filled(&self) -> &[u8] {
        &self.bytes[usize::from(self.start)..usize::from(self.end)]
    }
}

impl Drop for Buf {
    #[inline]
    fn drop(&mut self) {
        if let Some(storage) = self.storage.take() {
            let home = storage.home;
            home.keep(storage);
        }
    }
}

impl Deref for Buf {
    type Target = [u8];
    #[inline]
    fn deref(&self) -> &[u8] {
        self.storage().filled()
    }
}

impl DerefMut for Buf {
    #[inline]
    fn deref_mut(&mut self) -> &mut [u8] {
        let storage = self.storage_mut();
        &mut storage.bytes[usize::from(storage.start)..usize::from(storage.end)]
    }
}

impl fmt::Debug for Buf {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Buf[{}]", self.len())
    }
}
