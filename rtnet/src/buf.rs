//! Buffers and the pools that own them.
//!
//! A pool owns a constant number of buffers, all made when it is: nothing is allocated later. A
//! [`Buf`] goes home when it is dropped, on whichever thread. Who wants to *keep* a filled buffer of
//! somebody else's pays with an empty one of its own ([`hand_over`]), so that a slow consumer can
//! lose only its own frames.
//!
//! Every buffer has a place of its own in its home, so going home is one atomic exchange with nobody to
//! compete with, and taking is one more at the place that was filled last. A buffer knows its home by plain
//! reference, without a count: for that a pool's places (16 bytes a buffer) stay for the life of the process;
//! the buffers themselves are released with the pool.

use core::fmt;
use core::ops::{Deref, DerefMut};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed};

use crossbeam::atomic::AtomicCell;

/// Bytes in every buffer: the largest Ethernet frame without its check sequence.
pub const ROOM: usize = 1514;

/// A constant number of buffers, shared between threads by reference.
pub struct Pool {
    home: &'static Home,
}

/// One buffer, filled up to its length, which dereferences to the filled bytes.
pub struct Buf {
    // `Some` until dropped: safe code can move the box home only out of an `Option`.
    storage: Option<Box<Storage>>,
}

struct Home {
    places: Box<[Place]>,
    /// Where to look first: the place that somebody filled or emptied last.
    hint: AtomicUsize,
    /// The pool is gone: buffers that come home now are released.
    closed: AtomicBool,
}

/// Of one buffer.
struct Place {
    buffer: AtomicCell<Option<Box<Storage>>>,
    /// Whether it is worth to look: set before the place is filled, cleared after it was emptied, both by the one
    /// who owns the buffer then. So an empty place may seem filled for a moment; the reverse holds for nobody
    /// who comes after the owner.
    is_filled: AtomicBool,
}

struct Storage {
    home: &'static Home,
    place: usize,
    len: usize,
    bytes: [u8; ROOM],
}

impl Pool {
    /// A pool of `capacity` buffers (at least 1) of [`ROOM`] bytes.
    pub fn new(capacity: usize) -> Self {
        assert!(capacity > 0, "a pool owns at least one buffer");
        let home: &'static Home = Box::leak(Box::new(Home {
            places: (0..capacity).map(|_| Place::empty()).collect(),
            hint: AtomicUsize::new(0),
            closed: AtomicBool::new(false),
        }));
        for place in 0..capacity {
            home.keep(Box::new(Storage { home, place, len: 0, bytes: [0; ROOM] }));
        }
        // The first is beside what all look at.
        home.hint.store(0, Relaxed);
        Self { home }
    }

    /// An empty buffer, or `None` when all are in use; where several threads take, possibly also when one comes
    /// home behind the search. Looks at the last place used, else at each one once.
    #[inline]
    pub fn take(&self) -> Option<Buf> {
        let home = self.home;
        let mut storage = home.empty(home.hint.load(Relaxed)).or_else(|| home.search())?;
        storage.len = 0;
        Some(Buf { storage: Some(storage) })
    }

    /// How many buffers are in the pool right now.
    pub fn available(&self) -> usize {
        self.home.places.iter().filter(|place| place.is_filled.load(Relaxed)).count()
    }

    /// How many buffers the pool owns.
    pub fn capacity(&self) -> usize {
        self.home.places.len()
    }
}

impl Drop for Pool {
    /// Releases the free buffers; those still in use follow when they are dropped (one that comes home in
    /// this very moment may stay for the life of the process).
    fn drop(&mut self) {
        self.home.closed.store(true, Relaxed);
        (0..self.capacity()).for_each(|place| drop(self.home.empty(place)));
    }
}

impl Place {
    fn empty() -> Self {
        Self { buffer: AtomicCell::new(None), is_filled: AtomicBool::new(false) }
    }
}

impl Home {
    /// Nobody else fills this place, and it is empty: its only buffer is here.
    #[inline]
    fn keep(&self, storage: Box<Storage>) {
        if self.closed.load(Relaxed) {
            return;
        }
        let number = storage.place;
        let place = &self.places[number];
        place.is_filled.store(true, Relaxed);
        let before = place.buffer.swap(Some(storage));
        debug_assert!(before.is_none(), "two buffers with one place");
        self.hint.store(number, Relaxed);
    }

    /// The buffer of a place, if it is at home.
    #[inline]
    fn empty(&self, number: usize) -> Option<Box<Storage>> {
        let place = &self.places[number];
        if !place.is_filled.load(Relaxed) {
            return None;
        }
        let storage = place.buffer.swap(None)?;
        place.is_filled.store(false, Relaxed);
        Some(storage)
    }

    /// A buffer from anywhere. The next search begins where this one ended.
    #[cold]
    fn search(&self) -> Option<Box<Storage>> {
        let hint = self.hint.load(Relaxed);
        let (before, after) = (0..hint, hint..self.places.len());
        let (place, storage) = after.chain(before).find_map(|place| Some((place, self.empty(place)?)))?;
        self.hint.store(place, Relaxed);
        Some(storage)
    }
}

/// Makes a filled buffer `consumer`'s, which gives an empty one of its own to the pool it came from.
/// Nothing is copied. An exhausted consumer gets nothing: the frame comes back as the error.
pub fn hand_over(mut filled: Buf, consumer: &Pool) -> Result<Buf, Buf> {
    let Some(mut empty) = consumer.take() else { return Err(filled) };
    let (full, spare) = (filled.storage_mut(), empty.storage_mut());
    core::mem::swap(&mut full.home, &mut spare.home);
    core::mem::swap(&mut full.place, &mut spare.place);
    Ok(filled)
}

impl Buf {
    /// All [`ROOM`] bytes, to be filled before [`Buf::set_len`].
    #[inline]
    pub fn room_mut(&mut self) -> &mut [u8; ROOM] {
        &mut self.storage_mut().bytes
    }

    /// Declares the first `len` bytes filled. Panics above [`ROOM`].
    #[inline]
    pub fn set_len(&mut self, len: usize) {
        assert!(len <= ROOM, "a buffer holds {ROOM} bytes, not {len}");
        self.storage_mut().len = len;
    }

    /// Copies `bytes` in and takes their length. Panics above [`ROOM`].
    pub fn fill(&mut self, bytes: &[u8]) {
        self.room_mut()[..bytes.len()].copy_from_slice(bytes);
        self.set_len(bytes.len());
    }

    /// Appends zeros up to `len`; a longer frame stays as it is.
    pub fn pad_to(&mut self, len: usize) {
        let filled = self.len();
        if filled < len {
            self.room_mut()[filled..len].fill(0);
            self.set_len(len);
        }
    }

    #[inline]
    fn storage(&self) -> &Storage {
        self.storage.as_deref().expect("only drop takes it")
    }
    #[inline]
    fn storage_mut(&mut self) -> &mut Storage {
        self.storage.as_deref_mut().expect("only drop takes it")
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
        let storage = self.storage();
        &storage.bytes[..storage.len]
    }
}

impl DerefMut for Buf {
    #[inline]
    fn deref_mut(&mut self) -> &mut [u8] {
        let storage = self.storage_mut();
        &mut storage.bytes[..storage.len]
    }
}

impl fmt::Debug for Buf {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Buf[{}]", self.len())
    }
}

#[cfg(test)]
mod tests {
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
    fn taking_needs_no_lock() {
        assert!(AtomicCell::<Option<Box<Storage>>>::is_lock_free());
    }

    #[test]
    fn a_buffer_may_outlive_its_pool() {
        let pool = Pool::new(2);
        let mut buf = pool.take().unwrap();
        drop(pool);
        buf.fill(b"still here");
        assert_eq!(&buf[..], b"still here");
    }
}
