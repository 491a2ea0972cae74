//! Pools: who owns how many buffers, and where each of them is.
//!
//! ```text
//! places   0  1  2  3  4  5  6  7  ...      a buffer of the pool belongs to each of some places
//! owned    x  x  x  x     x                 extending and shrinking change which, one caller at a time
//! filled         x        x                 its buffer is at home
//! hint           ^                          none below is filled, as far as is known
//! reach                      ^              none from here on is owned
//! ```
//!
//! The buffer taken is that of the first filled place, as far as is known. So the few buffers that are really in
//! use are the same all the time, and *fewer are free than ever* when a place is emptied for the first time: all that
//! ever were are empty then. So `least` costs takers and returners one comparison each, and who is the first one count more;
//! but where some were out while the capacity changed the first looks at all places.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

use crossbeam::atomic::AtomicCell;

use super::{Buf, Storage};

/// Buffers that a pool may own at most: a buffer has 16 bits for its place.
pub const MOST: usize = 1 << 16;
/// When the capacity changed: places are not taken in turn from then on. As many may be taken beyond it as there are, and more.
const SOME_WERE_OUT: usize = usize::MAX / 2;

/// A number of buffers, shared between threads by reference. It changes only when somebody asks for it.
pub struct Pool {
    home: &'static Home,
}

/// What `rtnet pool` shows of a pool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolStatistics {
    /// How many buffers the pool owns.
    pub capacity: usize,
    /// How many of them are in the pool right now.
    pub free: usize,
    /// The fewest that were, since the pool was made or last changed its capacity. Exact where one thread at a
    /// time takes and returns; where several do so in the same instant a few more or fewer may be told than there were,
    /// but 0 once somebody found none.
    pub least: usize,
    /// How often somebody wanted one and there was none.
    pub exhausted: u64,
}

/// What every take and return looks at comes first, in one line of the cache: in a network of a thousand stations none of
/// it is there any more when it is looked at again.
#[repr(C, align(64))]
pub(super) struct Home {
    /// Where to look first: below it no place is filled, unless its buffer came home while somebody took another.
    hint: AtomicUsize,
    /// The pool is gone: buffers that come home now are released.
    closed: AtomicBool,
    places: Box<[Place]>,
    /// Where to stop looking: behind the last place that is owned.
    reach: AtomicUsize,
    capacity: AtomicUsize,
    least: AtomicUsize,
    /// Places whose `was_taken` is set, beyond [`SOME_WERE_OUT`] if they were.
    ever_taken: AtomicUsize,
    exhausted: AtomicU64,
    /// Held while the capacity changes.
    resizing: Mutex<()>,
}

/// Of one buffer, at most.
struct Place {
    buffer: AtomicCell<Option<Box<Storage>>>,
    /// Whether it is worth to look: set before the place is filled, cleared after it was emptied, both by the one
    /// who owns the buffer then. So an empty place may seem filled for a moment; the reverse holds for nobody
    /// who comes after the owner.
    is_filled: AtomicBool,
    /// Whether a buffer of the pool belongs here, at home or not. Changes while `resizing` is held.
    is_owned: AtomicBool,
    /// Whether its buffer was taken since the capacity changed.
    was_taken: AtomicBool,
}

impl Pool {
    /// A pool of `capacity` buffers (at least 1) of [`ROOM`](super::ROOM) bytes, and of no more ever.
    pub fn new(capacity: usize) -> Self {
        Self::with_room(capacity, capacity)
    }

    /// A pool of `capacity` buffers (at least 1) of [`ROOM`](super::ROOM) bytes, which may be extended to `most`
    /// (up to [`MOST`]).
    pub fn with_room(capacity: usize, most: usize) -> Self {
        assert!(capacity > 0, "a pool owns at least one buffer");
        assert!((capacity..=MOST).contains(&most), "a pool of {capacity} to {most} buffers");
        let pool = Self { home: Box::leak(Box::new(Home::of(most))) };
        pool.extend(capacity);
        pool
    }

    /// An empty buffer, or `None` when all are in use; where several threads take, possibly also when one comes
    /// home behind the search.
    #[inline]
    pub fn take(&self) -> Option<Buf> {
        let home = self.home;
        let hint = home.hint.load(Relaxed);
        let mut storage = home.empty(hint).or_else(|| home.search(hint))?;
        storage.is_filled_up_to(0);
        let number = usize::from(storage.place);
        home.hint.store(number + 1, Relaxed);
        if !home.places[number].was_taken.load(Relaxed) || number < hint {
            home.note_taken(number);
        }
        Some(Buf { storage: Some(storage) })
    }

    /// How many buffers are in the pool right now.
    pub fn available(&self) -> usize {
        self.home.available()
    }

    /// What it took to find that fewer than `n` buffers are in the pool right now: so many places were looked at. `None`: there
    /// are as many, which is known as soon as so many are found.
    pub fn lacks(&self, n: usize) -> Option<usize> {
        self.home.lacks(n)
    }

    /// How many buffers the pool owns.
    pub fn capacity(&self) -> usize {
        self.home.capacity.load(Relaxed)
    }

    /// How many buffers it can be extended to.
    pub fn room(&self) -> usize {
        self.home.places.len()
    }

    /// How the pool fares. It looks at every place once, and waits for nobody.
    pub fn statistics(&self) -> PoolStatistics {
        let capacity = self.capacity();
        let free = self.available().min(capacity);
        let least = self.home.least.load(Relaxed).min(free);
        PoolStatistics { capacity, free, least, exhausted: self.home.exhausted.load(Relaxed) }
    }

    /// From now on it is told of as a new one: for who takes a pool over. For the control thread.
    pub fn start_anew(&self) {
        let home = self.home;
        home.exhausted.store(0, Relaxed);
        let _alone = home.resizing.lock().unwrap_or_else(PoisonError::into_inner);
        home.count_anew();
    }

    /// Adds up to `n` buffers, as many as there are places for, and tells how many. For the control thread: it
    /// allocates, and waits for others who extend or shrink; who takes and returns meanwhile waits for nothing.
    pub fn extend(&self, n: usize) -> usize {
        let home = self.home;
        home.resize(|| {
            let vacant = (0..home.places.len()).filter(|&number| !home.places[number].is_owned.load(Relaxed));
            vacant.take(n).map(|number| home.add(number)).count()
        })
    }

    /// Releases up to `n` buffers, free ones only and not the last one, and tells how many. For the control thread,
    /// as [`Pool::extend`].
    pub fn shrink(&self, n: usize) -> usize {
        let home = self.home;
        home.resize(|| {
            // From the end: the last ones are seldom in use, and a search ends the earlier.
            let removed = (0..home.reach.load(Relaxed)).rev().filter(|&number| home.remove(number));
            removed.take(n.min(self.capacity() - 1)).count()
        })
    }
}

impl Drop for Pool {
    /// Releases the free buffers; those still in use follow when they are dropped (one that comes home in
    /// this very moment may stay for the life of the process).
    fn drop(&mut self) {
        self.home.closed.store(true, Relaxed);
        (0..self.home.places.len()).for_each(|place| drop(self.home.empty(place)));
    }
}

impl Home {
    fn of(most: usize) -> Self {
        Self {
            hint: AtomicUsize::new(0),
            closed: AtomicBool::new(false),
            places: (0..most).map(|_| Place::vacant()).collect(),
            reach: AtomicUsize::new(0),
            capacity: AtomicUsize::new(0),
            least: AtomicUsize::new(0),
            ever_taken: AtomicUsize::new(0),
            exhausted: AtomicU64::new(0),
            resizing: Mutex::new(()),
        }
    }

    /// Nobody else fills this place, and it is empty: its only buffer is here.
    #[inline]
    pub(super) fn keep(&self, storage: Box<Storage>) {
        debug_assert!(storage.behind.is_none(), "it is in a chain");
        if self.closed.load(Relaxed) {
            return;
        }
        let number = usize::from(storage.place);
        let place = &self.places[number];
        place.is_filled.store(true, Relaxed);
        let before = place.buffer.swap(Some(storage));
        debug_assert!(before.is_none(), "two buffers with one place");
        if number < self.hint.load(Relaxed) {
            self.hint.store(number, Relaxed);
        }
    }

    /// The buffer of a place, if there is that place and it is at home.
    #[inline]
    fn empty(&self, number: usize) -> Option<Box<Storage>> {
        let place = self.places.get(number)?;
        if !place.is_filled.load(Relaxed) {
            return None;
        }
        let storage = place.buffer.swap(None)?;
        place.is_filled.store(false, Relaxed);
        Some(storage)
    }

    /// A buffer from anywhere: each place is looked at once.
    #[cold]
    fn search(&self, hint: usize) -> Option<Box<Storage>> {
        let (before, after) = (0..hint, hint..self.reach.load(Relaxed));
        let found = after.chain(before).find_map(|place| self.empty(place));
        if found.is_none() {
            self.least.store(0, Relaxed);
            self.exhausted.fetch_add(1, Relaxed);
        }
        found
    }

    /// For the first time, or out of turn: fewer may be free than ever.
    #[cold]
    fn note_taken(&self, number: usize) {
        let is_first = !self.places[number].was_taken.swap(true, Relaxed);
        let out = if is_first { self.ever_taken.fetch_add(1, Relaxed) + 1 } else { SOME_WERE_OUT };
        let least = if out < SOME_WERE_OUT {
            // Nobody passes over a filled place, so that all that were ever taken are out now.
            self.capacity.load(Relaxed).saturating_sub(out)
        } else {
            self.available()
        };
        self.least.fetch_min(least, Relaxed);
    }

    fn available(&self) -> usize {
        let within = &self.places[..self.reach.load(Relaxed)];
        within.iter().filter(|place| place.is_filled.load(Relaxed)).count()
    }

    fn lacks(&self, n: usize) -> Option<usize> {
        let reach = self.reach.load(Relaxed);
        // As takers look: those that are in use come before the hint.
        let (before, after) = self.places[..reach].split_at(self.hint.load(Relaxed).min(reach));
        let is_filled = |place: &&Place| place.is_filled.load(Relaxed);
        let of_after = after.iter().filter(is_filled).take(n).count();
        let found = of_after + before.iter().filter(is_filled).take(n - of_after).count();
        (found < n).then_some(reach)
    }

    /// Changes the capacity, one at a time.
    fn resize(&self, change: impl FnOnce() -> usize) -> usize {
        let _alone = self.resizing.lock().unwrap_or_else(PoisonError::into_inner);
        let changed = change();
        if changed > 0 {
            self.count_anew();
        }
        changed
    }

    /// A new buffer for a place that has none.
    fn add(&'static self, number: usize) {
        self.places[number].is_owned.store(true, Relaxed);
        self.reach.fetch_max(number + 1, Relaxed);
        self.capacity.fetch_add(1, Relaxed);
        self.keep(Box::new(Storage::new(self, number as u16)));
    }

    /// Releases the buffer of a place, if it is at home.
    fn remove(&self, number: usize) -> bool {
        let Some(storage) = self.empty(number) else { return false };
        drop(storage);
        self.places[number].is_owned.store(false, Relaxed);
        self.capacity.fetch_sub(1, Relaxed);
        true
    }

    /// After a change of the capacity.
    fn count_anew(&self) {
        let reach =
            self.places.iter().rposition(|place| place.is_owned.load(Relaxed)).map_or(0, |last| last + 1);
        self.reach.store(reach, Relaxed);
        self.places.iter().for_each(|place| place.was_taken.store(false, Relaxed));
        let some_are_out = self.available() < self.capacity.load(Relaxed);
        self.ever_taken.store(if some_are_out { SOME_WERE_OUT } else { 0 }, Relaxed);
        self.least.store(self.available(), Relaxed);
    }
}

impl Place {
    fn vacant() -> Self {
        Self {
            buffer: AtomicCell::new(None),
            is_filled: AtomicBool::new(false),
            is_owned: AtomicBool::new(false),
            was_taken: AtomicBool::new(false),
        }
    }
}

#[cfg(test)]
mod tests;
