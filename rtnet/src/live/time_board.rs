//! Where the real-time thread shows the time, and any thread of its process, or of another, reads it without a lock.
//!
//! ```text
//! real-time thread   publish(view n+1) ─► faces[(n+1) % 2], then shown = n+1       never waits
//! any other          shown = n ─► faces[n % 2] ─► shown still n? else once more    never waits for the other
//! ```
//!
//! A seqlock with two faces: a writer that is preempted in the middle leaves the face that is shown as it is, so that
//! a reader, however urgent, does not spin until the writer goes on. It looks again only if a whole view was published
//! while it read: a few nanoseconds, once a cycle.
//!
//! *No torn reads.* There is one writer. Let a reader see `shown = n`, read face `n % 2`, and see `shown = n` again.
//! The face holds view n at least: its stores are before the release store of n, which the reader's first load
//! and fence acquired. Nor does any word of it come from view n+2, the next that is written there: the writer's release fence
//! stands between its store of n+1 and those words, and the reader's acquire fence behind its loads of them. Had one
//! load read a word of n+2, the fences would order the store of n+1 before the reader's second look, which then could
//! not have seen n. (Views n+1, n+3.. are on the other face; n+4.. come after n+2.) The numbers have 64 bits: they do
//! not come round.
//!
//! All of it is words of one page, which other processes read:
//!
//! ```text
//! word 0   what it is, and in which version    1  the station's time namespace    2  ended    3  shown
//!      8   face 0    16  face 1                                                 each in a cache line of its own
//! ```

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::MetadataExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering, fence};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use crate::clock::{EmulatedClock, True};
use crate::discipline::{SyncState, TimeView};
use crate::time::{GlobalTime, Instant, Offset, Span};

use super::clock::monotonic;
use super::clock_order::{self, CLOCK_WORDS};
use super::time_page::Page;
use super::wait::Waiter;

/// State, holdover and cycle, start, offset, period, drift.
const VIEW_WORDS: usize = 5;
/// The same, and the clock by which it is so.
const WORDS: usize = VIEW_WORDS + CLOCK_WORDS;

/// Begins a page; another number, another order of words.
const VERSION: u64 = u64::from_be_bytes(*b"RTtime\0\x01");
const IS: usize = 0;
/// Where CLOCK_MONOTONIC is the station's: the number of its time namespace, 0 if that is not known.
const CLOCKS: usize = 1;
const ENDED: usize = 2;
/// How many views were published; the last is on face `shown % 2`.
const SHOWN: usize = 3;
const FACES: [usize; 2] = [8, 16];

/// What a station shows of the master's time, to the threads of its process, and to other processes, which have it by
/// [`rtnet::api::Station::time`](crate::api::Station::time).
///
/// An [`Instant`] is of the station's own clock: CLOCK_MONOTONIC, unless it was given an emulated one.
///
/// ```
/// use rtnet::clock::EmulatedClock;
/// use rtnet::discipline::{SyncState, TimeView};
/// use rtnet::live::TimePublisher;
/// use rtnet::time::{Offset, Span};
/// use std::time::Duration;
///
/// // A driver has one, and `Driver::time` gives its board; here the time line is made by hand.
/// let mut publisher = TimePublisher::new(EmulatedClock::default());
/// let board = publisher.board();
/// let (start, offset) = (board.now(), Offset::default());
/// let (state, period) = (SyncState::Locked, Some(Span::from_millis(2)));
/// publisher.publish(&TimeView { state, cycle: 7, start, offset, period, ..TimeView::default() });
///
/// let (global, state) = board.global_now().expect("there is a time line");
/// assert_eq!(board.to_local(global).map(|local| board.to_global(local)), Some(Some(global)));
/// assert!(state.is_synchronised());
///
/// let cycle = board.waiter().wait_cycle(Duration::from_secs(1))?;
/// assert!(cycle.number > 7 && cycle.start <= board.now());
/// # Ok::<(), rtnet::live::WaitError>(())
/// ```
pub struct TimeBoard {
    page: Page,
    /// In another process, the connection to the station, which hangs up whatever it ends by.
    station: Option<OwnedFd>,
    /// Whether it was seen to have hung up.
    is_gone: AtomicBool,
}

/// The real-time thread's end of a [`TimeBoard`]. Once it is dropped the station has ended.
pub struct TimePublisher {
    board: Arc<TimeBoard>,
    last: TimeView,
    clock: EmulatedClock,
}

impl TimePublisher {
    /// The board of a station with this clock, which knows no time yet.
    pub fn new(clock: EmulatedClock) -> Self {
        let page = Page::new();
        page[CLOCKS].store(time_namespace(), Ordering::Relaxed);
        page[IS].store(VERSION, Ordering::Relaxed);
        let board = TimeBoard { page, station: None, is_gone: AtomicBool::new(false) };
        board.show(&TimeView::default(), &clock);
        Self { board: Arc::new(board), last: TimeView::default(), clock }
    }

    /// What others read.
    pub fn board(&self) -> Arc<TimeBoard> {
        self.board.clone()
    }

    /// Shows what is known of the time now, unless that is shown already.
    #[inline]
    pub fn publish(&mut self, view: &TimeView) {
        if *view != self.last {
            self.last = *view;
            self.board.show(view, &self.clock);
        }
    }

    /// The station has another clock: what is known of the time is taken to be so by that, until something else is.
    pub fn set_clock(&mut self, clock: EmulatedClock) {
        self.clock = clock;
        self.board.show(&self.last, &clock);
    }
}

impl Drop for TimePublisher {
    fn drop(&mut self) {
        self.board.page[ENDED].store(1, Ordering::Release);
    }
}

impl TimeBoard {
    /// The board of a station that is another process: the page that it has given, and the connection by which it did.
    pub(crate) fn open(page: OwnedFd, station: OwnedFd) -> io::Result<Arc<Self>> {
        let page = Page::open(page)?;
        if page[IS].load(Ordering::Relaxed) != VERSION {
            let why = "the station shows its time in another way: build both from the same version of rtnet";
            return Err(io::Error::new(io::ErrorKind::InvalidData, why));
        }
        let (here, there) = (time_namespace(), page[CLOCKS].load(Ordering::Relaxed));
        if here != there && here != 0 && there != 0 {
            let why =
                "the station's clock is that of another time namespace: run the program in the station's";
            return Err(io::Error::new(io::ErrorKind::Unsupported, why));
        }
        Ok(Arc::new(Self { page, station: Some(station), is_gone: AtomicBool::new(false) }))
    }

    /// What another process opens to read this; it cannot write it. `None` if the kernel has no such files.
    pub(crate) fn page(&self) -> Option<BorrowedFd<'_>> {
        self.page.file()
    }

    /// What is known of the master's time. Of a station that has ended, or that is held up, it is lost. It takes no system
    /// call: that the process of a station was killed is known once [`TimeBoard::has_ended`] was asked, or the line is too old.
    pub fn view(&self) -> TimeView {
        self.view_and_clock().0
    }

    /// How far the station is with the master's time.
    pub fn state(&self) -> SyncState {
        self.view().state
    }

    /// Whether the station's loop has ended: nothing is shown any more. In another process it asks the kernel, unless it has.
    pub fn has_ended(&self) -> bool {
        self.is_known_to_have_ended() || self.has_hung_up()
    }

    /// What the station's clock shows now.
    pub fn now(&self) -> Instant {
        self.clock().local(monotonic())
    }

    /// What the master's clock shows now, and how far it can be believed: only synchronised stations correct it.
    /// `None` before there is any time line.
    pub fn global_now(&self) -> Option<(GlobalTime, SyncState)> {
        let (view, clock) = self.view_and_clock();
        view.to_global(clock.local(monotonic())).map(|global| (global, view.state))
    }

    /// What the master's clock shows at moments of CLOCK_MONOTONIC, by one line; `None` unless the station is synchronised now.
    pub fn global_at<const N: usize>(&self, moments: [True; N]) -> Option<[GlobalTime; N]> {
        let (view, clock) = self.view_and_clock();
        if !view.state.is_synchronised() {
            return None;
        }
        Some(moments.map(|at| view.to_global(clock.local(at)).unwrap_or_default()))
    }

    /// What the master's clock shows at a moment of the station's; `None` before there is any time line. For more
    /// than one moment by the same line, see [`TimeBoard::view`].
    pub fn to_global(&self, local: Instant) -> Option<GlobalTime> {
        self.read().to_global(local)
    }

    /// When the master's clock shows this, on the station's; `None` before there is any time line.
    pub fn to_local(&self, global: GlobalTime) -> Option<Instant> {
        self.read().to_local(global)
    }

    /// For a thread that waits for cycles. Any number of them may.
    pub fn waiter(self: &Arc<Self>) -> Waiter {
        Waiter::new(self.clone())
    }

    /// The station's clock.
    pub(super) fn clock(&self) -> EmulatedClock {
        self.read_both().1
    }

    /// What is known now, and the clock by which it is so.
    pub(super) fn view_and_clock(&self) -> (TimeView, EmulatedClock) {
        let (mut view, clock) = self.read_both();
        let now = clock.local(monotonic());
        view.state = if self.is_known_to_have_ended() { SyncState::Lost } else { view.state_at(now) };
        (view, clock)
    }

    fn is_known_to_have_ended(&self) -> bool {
        self.page[ENDED].load(Ordering::Relaxed) != 0 || self.is_gone.load(Ordering::Relaxed)
    }

    fn has_hung_up(&self) -> bool {
        let Some(station) = &self.station else { return false };
        let hangs_up = PollFlags::from_bits_retain(libc::POLLRDHUP);
        let mut fds = [PollFd::new(station.as_fd(), hangs_up)];
        // Interrupted, it is asked again soon.
        let is_gone = poll(&mut fds, PollTimeout::ZERO).is_ok_and(|ready| ready > 0);
        if is_gone {
            self.is_gone.store(true, Ordering::Relaxed);
        }
        is_gone
    }

    /// For the one thread that has the publisher.
    fn show(&self, view: &TimeView, clock: &EmulatedClock) {
        let next = self.page[SHOWN].load(Ordering::Relaxed) + 1;
        // What follows is not seen by anybody who does not see that the view before is shown.
        fence(Ordering::Release);
        let words = pack(view, clock);
        for (place, word) in self.face(next).iter().zip(words) {
            place.store(word, Ordering::Relaxed);
        }
        self.page[SHOWN].store(next, Ordering::Release);
    }

    fn read(&self) -> TimeView {
        self.read_both().0
    }

    fn read_both(&self) -> (TimeView, EmulatedClock) {
        loop {
            let shown = self.page[SHOWN].load(Ordering::Relaxed);
            // Together they acquire. In another process nothing may be loaded otherwise than relaxed.
            fence(Ordering::Acquire);
            let face = self.face(shown);
            let words = std::array::from_fn(|i| face[i].load(Ordering::Relaxed));
            fence(Ordering::Acquire);
            if self.page[SHOWN].load(Ordering::Relaxed) == shown {
                return unpack(words);
            }
        }
    }

    fn face(&self, number: u64) -> &[AtomicU64] {
        &self.page[FACES[(number % 2) as usize]..][..WORDS]
    }
}

/// Where CLOCK_MONOTONIC is as this process sees it; 0 if that cannot be told.
fn time_namespace() -> u64 {
    std::fs::metadata("/proc/self/ns/time").map_or(0, |namespace| namespace.ino())
}

/// In the order of their numbers.
const STATES: [SyncState; 5] =
    [SyncState::Waiting, SyncState::Calibrating, SyncState::Locked, SyncState::Holdover, SyncState::Lost];

fn pack(view: &TimeView, clock: &EmulatedClock) -> [u64; WORDS] {
    let &TimeView { state, cycle, start, offset, period, drift_ppb, holdover } = view;
    let state_and_cycle = (state as u64) << 48 | u64::from(holdover) << 32 | u64::from(cycle);
    // No period is 0.
    let period = period.map_or(0, Span::nanos) as u64;
    let [anchor, ahead, runs] = clock_order::pack(clock);
    [state_and_cycle, start.nanos(), offset.nanos(), period, drift_ppb as u64, anchor, ahead, runs]
}

fn unpack(words: [u64; WORDS]) -> (TimeView, EmulatedClock) {
    let [state_and_cycle, start, offset, period, drift, clock @ ..] = words;
    let state = STATES.get((state_and_cycle >> 48) as usize);
    let view = TimeView {
        state: state.copied().unwrap_or_default(),
        cycle: state_and_cycle as u32,
        start: Instant::from_nanos(start),
        offset: Offset::between(Instant::default(), GlobalTime::from_nanos(offset)),
        period: (period > 0).then_some(Span::from_nanos(period as i64)),
        drift_ppb: drift as i64,
        holdover: (state_and_cycle >> 32) as u16,
    };
    (view, clock_order::unpack(clock))
}

#[cfg(test)]
mod tests;
