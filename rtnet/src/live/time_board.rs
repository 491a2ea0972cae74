//! Where the real-time thread shows the time, and any thread of the process reads it without a lock.
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
//! acquired. Nor does any word of it come from view n+2, the next that is written there: the writer's release fence
//! stands between its store of n+1 and those words, and the reader's acquire fence behind its loads of them. Had one
//! load read a word of n+2, the fences would order the store of n+1 before the reader's second look, which then could
//! not have seen n. (Views n+1, n+3.. are on the other face; n+4.. come after n+2.) The numbers have 64 bits: they do
//! not come round.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering, fence};

use crate::clock::EmulatedClock;
use crate::discipline::{SyncState, TimeView};
use crate::time::{GlobalTime, Instant, Offset, Span};

use super::clock::monotonic;
use super::clock_order::{self, CLOCK_WORDS};
use super::wait::Waiter;

/// State, holdover and cycle, start, offset, period, drift.
const VIEW_WORDS: usize = 5;
/// The same, and the clock by which it is so.
const WORDS: usize = VIEW_WORDS + CLOCK_WORDS;

/// What a station shows of the master's time, to the threads of its process.
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
    /// How many views were published; the last is on face `shown % 2`.
    shown: AtomicU64,
    faces: [[AtomicU64; WORDS]; 2],
    ended: AtomicBool,
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
        let face = || pack(&TimeView::default(), &clock).map(AtomicU64::new);
        let (shown, ended) = (AtomicU64::new(0), AtomicBool::new(false));
        let board = Arc::new(TimeBoard { shown, faces: [face(), face()], ended });
        Self { board, last: TimeView::default(), clock }
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
        self.board.ended.store(true, Ordering::Release);
    }
}

impl TimeBoard {
    /// What is known of the master's time. Of a station that has ended, or that is held up, it is lost.
    pub fn view(&self) -> TimeView {
        self.view_and_clock().0
    }

    /// How far the station is with the master's time.
    pub fn state(&self) -> SyncState {
        self.view().state
    }

    /// Whether the station's loop has ended: nothing is shown any more.
    pub fn has_ended(&self) -> bool {
        self.ended.load(Ordering::Acquire)
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
        view.state = if self.has_ended() { SyncState::Lost } else { view.state_at(now) };
        (view, clock)
    }

    /// For the one thread that has the publisher.
    fn show(&self, view: &TimeView, clock: &EmulatedClock) {
        let next = self.shown.load(Ordering::Relaxed) + 1;
        // What follows is not seen by anybody who does not see that the view before is shown.
        fence(Ordering::Release);
        let words = pack(view, clock);
        for (place, word) in self.face(next).iter().zip(words) {
            place.store(word, Ordering::Relaxed);
        }
        self.shown.store(next, Ordering::Release);
    }

    fn read(&self) -> TimeView {
        self.read_both().0
    }

    fn read_both(&self) -> (TimeView, EmulatedClock) {
        loop {
            let shown = self.shown.load(Ordering::Acquire);
            let face = self.face(shown);
            let words = std::array::from_fn(|i| face[i].load(Ordering::Relaxed));
            fence(Ordering::Acquire);
            if self.shown.load(Ordering::Relaxed) == shown {
                return unpack(words);
            }
        }
    }

    fn face(&self, number: u64) -> &[AtomicU64; WORDS] {
        &self.faces[(number % 2) as usize]
    }
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
mod tests {
    use super::*;

    /// A view of which every part says which one it is.
    fn view(n: u64) -> TimeView {
        TimeView {
            state: STATES[(n % 5) as usize],
            cycle: n as u32,
            start: Instant::from_nanos(n.wrapping_mul(3)),
            offset: Offset::between(Instant::default(), GlobalTime::from_nanos(n.wrapping_mul(5))),
            period: Some(Span::from_nanos(n as i64 + 1)),
            drift_ppb: -(n as i64),
            holdover: n as u16,
        }
    }

    #[test]
    fn every_state_is_read_as_it_was_shown() {
        let mut publisher = TimePublisher::new(EmulatedClock::default());
        let board = publisher.board();
        assert_eq!(board.read(), TimeView::default());
        for n in 0..10 {
            publisher.publish(&view(n));
            assert_eq!(board.read(), view(n));
        }
    }

    #[test]
    fn what_is_shown_already_is_not_shown_again() {
        let mut publisher = TimePublisher::new(EmulatedClock::default());
        publisher.publish(&view(7));
        publisher.publish(&view(7));
        assert_eq!(publisher.board().shown.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn threads_that_read_while_it_is_shown_never_see_half_of_a_view() {
        /// That each reader is to see: some of them, on any machine, while they are being written.
        const DIFFERENT: u64 = 300;
        let mut publisher = TimePublisher::new(EmulatedClock::default());
        publisher.publish(&view(0));
        let read = |board: Arc<TimeBoard>| {
            let (mut last, mut different) = (0, 0);
            while different < DIFFERENT {
                let seen = board.read();
                let number = seen.period.unwrap().nanos() as u64 - 1;
                assert_eq!(seen, view(number), "torn");
                assert!(number >= last, "what is older never comes again");
                different += u64::from(number > last);
                last = number;
            }
        };
        let reader = |board| std::thread::spawn(move || read(board));
        let readers: Vec<_> = (0..3).map(|_| reader(publisher.board())).collect();
        let mut n = 0;
        while readers.iter().any(|reader| !reader.is_finished()) {
            n += 1;
            publisher.publish(&view(n));
        }
        readers.into_iter().for_each(|reader| reader.join().unwrap());
    }

    #[test]
    fn a_writer_that_was_stopped_in_the_middle_holds_nobody_up() {
        let mut publisher = TimePublisher::new(EmulatedClock::default());
        let board = publisher.board();
        publisher.publish(&view(1));
        publisher.publish(&view(2));
        // As far as it had come with the third.
        board.face(3)[0].store(u64::MAX, Ordering::Relaxed);
        assert_eq!(board.read(), view(2));
    }

    #[test]
    fn times_are_of_the_stations_own_clock() {
        let clock = EmulatedClock { anchor: 0, offset: Span::from_millis(-700), drift_ppb: 50_000 };
        let mut publisher = TimePublisher::new(clock);
        let board = publisher.board();
        let start = board.now();
        assert!((start - clock.local(monotonic())).abs() < Span::from_millis(1_000));
        // By the master's clock the same moment is at 9 s.
        let global = GlobalTime::from_nanos(9_000_000_000);
        let offset = Offset::between(start, global);
        let (state, period) = (SyncState::Locked, Some(Span::from_millis(1)));
        publisher.publish(&TimeView {
            state,
            cycle: 1,
            start,
            offset,
            period,
            drift_ppb: 50_000,
            holdover: 1,
        });
        let later = start + Span::from_nanos(1_000_050_000);
        assert_eq!(board.to_global(later).unwrap() - global, Span::from_millis(1_000));
        assert_eq!(board.to_local(global + Span::from_millis(1_000)), Some(later));
    }

    #[test]
    fn a_station_whose_clock_is_set_shows_its_time_by_that() {
        let mut publisher = TimePublisher::new(EmulatedClock::default());
        let board = publisher.board();
        publisher.publish(&view(2));
        let before = board.now();
        publisher.set_clock(EmulatedClock::default().stepped(Span::from_millis(60_000)));
        let gone = board.now() - before;
        assert!((60_000..70_000).contains(&(gone.nanos() / 1_000_000)), "{gone}");
        assert_eq!(board.read(), view(2), "what it takes the time for");
    }

    #[test]
    fn a_station_that_has_ended_is_synchronised_no_more() {
        let mut publisher = TimePublisher::new(EmulatedClock::default());
        let board = publisher.board();
        let period = Some(Span::from_millis(100_000));
        let locked = TimeView { state: SyncState::Locked, start: board.now(), period, ..view(2) };
        publisher.publish(&locked);
        assert_eq!(board.state(), SyncState::Locked);
        drop(publisher);
        assert_eq!(board.state(), SyncState::Lost);
        assert!(board.global_now().is_some_and(|(_, state)| state == SyncState::Lost));
    }
}
