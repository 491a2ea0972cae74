//! What a station knows of the master's time, and what follows from it for other moments and cycles.
//!
//! ```text
//! local   ──┬───────────────────────┬──────────── start, start_of(cycle + 1): period and drift later
//!           │ offset                │ offset less what the station's clock has gained since
//! master  ──┴───────────────────────┴──────────── as scheduled, a period apart
//! ```

use crate::clock::{BILLION, floor_of_product};
use crate::time::{GlobalTime, Instant, Offset, Span};

/// A station looks at its line within two cycles, or some more when its loop sleeps as long as it ever does: a view
/// that is older than this, and than what is bridged, is of a station that is held up.
const OLD_CYCLES: i64 = 4;
/// See [`OLD_CYCLES`].
const OLD_AFTER: Span = Span::from_millis(200);

/// How far a station is with the master's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum SyncState {
    /// No Synchronisation yet: silent.
    #[default]
    Waiting,
    /// Measuring the delay to the master: sends only calibration requests.
    Calibrating,
    /// Synchronised.
    Locked,
    /// Synchronisations are missing, no more than are bridged: one, unless configured otherwise.
    Holdover,
    /// More are missing: silent.
    Lost,
}

impl SyncState {
    /// Whether it knows which cycle it is, and may send.
    pub const fn is_synchronised(self) -> bool {
        matches!(self, SyncState::Locked | SyncState::Holdover)
    }

    /// The state's name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            SyncState::Waiting => "waiting",
            SyncState::Calibrating => "calibrating",
            SyncState::Locked => "locked",
            SyncState::Holdover => "holdover",
            SyncState::Lost => "lost",
        }
    }
}

/// What a station knows of the master's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct TimeView {
    /// How far it is.
    pub state: SyncState,
    /// Number of the last cycle that a Synchronisation told of.
    pub cycle: u32,
    /// That cycle's start on this station's clock.
    pub start: Instant,
    /// From this station's clock to the master's, at that start.
    pub offset: Offset,
    /// From one start to the next on the master's clock. `None`: there is no time line.
    pub period: Option<Span>,
    /// How fast this station's clock gains on the master's, in parts per 10^9, as far as that is known.
    pub drift_ppb: i64,
    /// Cycles without a Synchronisation that are bridged.
    pub holdover: u16,
}

impl TimeView {
    /// What the master's clock shows at `local`; `None` without a time line.
    pub fn to_global(&self, local: Instant) -> Option<GlobalTime> {
        self.period?;
        Some(self.offset.global(self.start) + self.by_master(local - self.start))
    }

    /// When the master's clock shows `global`: the first local moment; `None` without a time line.
    pub fn to_local(&self, global: GlobalTime) -> Option<Instant> {
        self.period?;
        let gone = (global - self.offset.global(self.start)).nanos();
        let gained = floor_of_product(gone, self.drift_ppb, BILLION);
        Some(self.start + Span::from_nanos(gone) + Span::from_nanos(gained))
    }

    /// A cycle's start, shortest way round 2^32; `None` without a time line.
    pub fn start_of(&self, cycle: u32) -> Option<Instant> {
        let ahead = cycle.wrapping_sub(self.cycle) as i32;
        self.to_local(self.offset.global(self.start) + self.period? * i64::from(ahead))
    }

    /// The first cycle whose moment `offset` behind its start is not before `from`, and that moment; `None` without a
    /// time line. Never the same moment as `last`, the cycle and offset that were waited for before: when the line has
    /// moved a little since, that one seems to be still to come.
    pub fn next_moment(
        &self,
        from: Instant,
        offset: Span,
        last: Option<(u32, Span)>,
    ) -> Option<(u32, Instant)> {
        let period = self.period?.nanos().max(1);
        let gone = self.by_master(from - (self.start + offset)).nanos();
        let ahead = gone.div_euclid(period) + i64::from(gone.rem_euclid(period) > 0);
        let mut cycle = self.cycle.wrapping_add(ahead as u32);
        if last.is_some_and(|(number, at)| number == cycle && offset <= at) {
            cycle = cycle.wrapping_add(1);
        }
        Some((cycle, self.start_of(cycle)? + offset))
    }

    /// How far the station is at `now`. What is too old to be true is lost: the station is held up, and does not know
    /// what has become of its master.
    pub fn state_at(&self, now: Instant) -> SyncState {
        let cycles = OLD_CYCLES + i64::from(self.holdover);
        let old = self.period.map_or(Span::ZERO, |period| period * cycles + OLD_AFTER);
        if self.state.is_synchronised() && now - self.start > old { SyncState::Lost } else { self.state }
    }

    /// What passes on the master's clock while so much does on this station's.
    fn by_master(&self, local: Span) -> Span {
        let gained = floor_of_product(local.nanos(), self.drift_ppb, BILLION + self.drift_ppb);
        local - Span::from_nanos(gained)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const MS: Span = Span::from_millis(1);

    /// Cycle 100 began at 5 ms by a clock that gains 100 ppm, and at 2 s by the master's.
    fn view() -> TimeView {
        let start = Instant::from_nanos(5_000_000);
        let offset = Offset::between(start, GlobalTime::from_nanos(2_000_000_000));
        let (state, period) = (SyncState::Locked, Some(MS));
        TimeView { state, cycle: 100, start, offset, period, drift_ppb: 100_000, holdover: 0 }
    }

    #[test]
    fn cycles_and_global_time_follow_the_drift_of_the_clock() {
        let view = view();
        assert_eq!(view.start_of(101).unwrap().nanos(), 6_000_100);
        assert_eq!(view.start_of(99).unwrap().nanos(), 3_999_900);
        assert_eq!(view.to_global(Instant::from_nanos(6_000_100)).unwrap().nanos(), 2_001_000_000);
        assert_eq!(view.to_local(GlobalTime::from_nanos(2_010_000_000)).unwrap().nanos(), 15_001_000);
    }

    #[test]
    fn the_next_moment_is_the_first_that_is_not_over_and_never_the_last_one_again() {
        let view = view();
        let at = |nanos| Instant::from_nanos(nanos);
        let slot = Span::from_micros(300);
        assert_eq!(view.next_moment(at(5_000_000), Span::ZERO, None), Some((100, at(5_000_000))));
        assert_eq!(view.next_moment(at(5_000_001), Span::ZERO, None), Some((101, at(6_000_100))));
        assert_eq!(view.next_moment(at(5_000_001), slot, None), Some((100, at(5_300_000))));
        assert_eq!(view.next_moment(at(5_300_001), slot, None), Some((101, at(6_300_100))));
        assert_eq!(view.next_moment(at(5_900_000), -slot, None).unwrap().0, 102, "before the start of 101");
        // The line has moved since 100 was waited for: it seems to be still to come.
        assert_eq!(view.next_moment(at(4_999_000), Span::ZERO, Some((100, Span::ZERO))).unwrap().0, 101);
        assert_eq!(view.next_moment(at(4_999_000), slot, Some((100, Span::ZERO))).unwrap().0, 100);
        // Another master, with numbers of its own.
        assert_eq!(view.next_moment(at(4_999_000), Span::ZERO, Some((7_000, Span::ZERO))).unwrap().0, 100);
    }

    #[test]
    fn cycles_count_on_across_the_wrap() {
        let view = TimeView { cycle: u32::MAX, ..view() };
        let from = Instant::from_nanos(5_500_000);
        assert_eq!(view.next_moment(from, Span::ZERO, None), Some((0, Instant::from_nanos(6_000_100))));
        let last = Some((0, Span::ZERO));
        assert_eq!(view.next_moment(from, Span::ZERO, last).unwrap().0, 1);
    }

    #[test]
    fn without_a_line_there_is_no_time() {
        let none = TimeView::default();
        let now = Instant::from_nanos(1);
        assert_eq!((none.to_global(now), none.start_of(1)), (None, None));
        assert_eq!(none.next_moment(now, Span::ZERO, None), None);
    }

    #[test]
    fn a_station_that_is_held_up_has_lost_its_master() {
        let view = view();
        let after = |span| view.start + span;
        assert_eq!(view.state_at(after(MS * OLD_CYCLES + OLD_AFTER)), SyncState::Locked);
        assert_eq!(view.state_at(after(MS * OLD_CYCLES + OLD_AFTER + MS)), SyncState::Lost);
        let bridging = TimeView { state: SyncState::Holdover, holdover: 20, ..view };
        assert_eq!(bridging.state_at(after(MS * (OLD_CYCLES + 20) + OLD_AFTER)), SyncState::Holdover);
        assert_eq!(bridging.state_at(after(MS * (OLD_CYCLES + 21) + OLD_AFTER)), SyncState::Lost);
        let calibrating = TimeView { state: SyncState::Calibrating, ..view };
        assert_eq!(calibrating.state_at(after(MS * 100_000)), SyncState::Calibrating);
    }

    proptest! {
        #[test]
        fn local_and_global_are_each_others_inverse(
            start in any::<u64>(), offset in any::<u64>(), drift_ppb in -200_000i64..200_000,
            ahead in -(1i64 << 40)..1i64 << 40,
        ) {
            let start = Instant::from_nanos(start);
            let offset = Offset::between(Instant::default(), GlobalTime::from_nanos(offset));
            let view = TimeView { start, offset, drift_ppb, ..view() };
            let global = offset.global(start) + Span::from_nanos(ahead);
            let local = view.to_local(global).unwrap();
            // Of global moments that fall on one local nanosecond, the first.
            let back = view.to_global(local).unwrap();
            prop_assert!((0..=1).contains(&(global - back).nanos()));
            prop_assert_eq!(view.to_local(back), Some(local));
        }

        #[test]
        fn no_moment_is_passed_over(
            from in -(1i64 << 45)..1i64 << 45, offset in -5_000_000i64..5_000_000,
            drift_ppb in -200_000i64..200_000,
        ) {
            let view = TimeView { drift_ppb, ..view() };
            let (from, offset) = (view.start + Span::from_nanos(from), Span::from_nanos(offset));
            let (cycle, at) = view.next_moment(from, offset, None).unwrap();
            prop_assert!(at - from >= Span::ZERO);
            let before = view.start_of(cycle.wrapping_sub(1)).unwrap() + offset;
            prop_assert!(before - from < Span::ZERO);
        }
    }
}
