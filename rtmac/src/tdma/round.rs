//! One round of calibration, and what all rounds say together.
//!
//! ```text
//!   master's clock          reception ──── reply_xmit
//!                            ▲                   │
//!   this clock      request_xmit ── middle ──── reply_rx         age: since the Synchronisation
//! ```
//!
//! Half of what the round took is the delay of a frame for one station. A Synchronisation is for all, and may take
//! longer: a bridge delivers a broadcast port by port. So the middle of a round, which is the same moment on both
//! clocks, is compared with what the Synchronisations say of the master's clock: by as much as that is behind, they
//! are late. Stations whose clock for these stamps is not that of their Synchronisations give no answer that can
//! be; then the delay of the round is taken for both, as RTnet does.

use rtnet::time::{GlobalTime, Instant, Offset, Span};

use super::line::{self, DRIFT_PARTS, TimeLine};
use super::rate::Rate;
use super::report::Delays;

/// What a Synchronisation is later than a frame for one station by: less is noise; more than so many times the delay
/// (a bridge of 32 ports takes eight), or than this part of a cycle, is a host that held syncs up all the while, or a
/// wrong clock.
const LATER_AT_LEAST: Span = Span::from_nanos(250);
const LATER_AT_MOST: i64 = 12;
const LATER_PARTS: i64 = 16;

/// The quicker half of the rounds is kept, but no more than so many...
const KEPT: usize = 128;
/// ... and none that took longer than the quicker quarter by more than this, or by more than this part of it, nor shorter.
/// What holds up one way (a tick of the host's that falls into the slot, a core that has to be woken) moves a round's middle
/// by as much as it adds to its delay, and if from some time on, that looks like a rate.
const ALIKE: Span = Span::from_micros(2);
const ALIKE_PARTS: i64 = 4;
/// From the first round to the last a busy host may make one way longer than the other by twice this much: measured.
const ASKEW: Span = Span::from_micros(1);

/// Room for rounds, as many as are to be measured.
#[derive(Debug, Default)]
pub struct Room {
    /// For those that are being measured.
    pub samples: Vec<Round>,
    /// For the quicker ones of the last calibration.
    pub kept: Vec<Round>,
}

/// A round.
#[derive(Clone, Copy, Debug)]
pub struct Round {
    /// How long a frame for one station takes.
    pub delay: Span,
    /// When it was, on this clock and on the master's.
    middle: Instant,
    global: GlobalTime,
    /// The cycle that had begun, as it was known then.
    begun: Begun,
    /// Which of the lines that were followed that was, and by how much the cycle's start is later than that line.
    pub line: u32,
    pub beside: Span,
}

/// A cycle's number and start, and from this clock to the master's what its Synchronisation says.
#[derive(Clone, Copy, Debug)]
pub struct Begun {
    /// Its number.
    pub cycle: u32,
    /// Its start on this clock.
    pub start: Instant,
    /// From this clock to the master's.
    pub offset: Offset,
}

impl Room {
    pub fn of(rounds: u32) -> Self {
        let rounds = rounds as usize;
        Self { samples: Vec::with_capacity(rounds), kept: Vec::with_capacity(kept_of(rounds)) }
    }

    /// Is the other from now on if it is too small for so many rounds, and the other what it was.
    pub fn widen(&mut self, rounds: u32, other: &mut Room) {
        if self.samples.capacity() < rounds as usize {
            core::mem::swap(self, other);
            // What the last calibration has kept is of use until this one is done.
            self.kept.append(&mut other.kept);
        }
    }
}

impl Round {
    /// From a round's four stamps, and the line of a slave that knows of no delay yet.
    pub fn new(request_xmit: u64, reception: u64, reply_xmit: u64, rx: Instant, line: &TimeLine) -> Self {
        let half = |from: u64, to: u64| Span::from_nanos(to.wrapping_sub(from) as i64 / 2);
        let &TimeLine { cycle, start, offset, .. } = line;
        Self {
            delay: line::delay(request_xmit, reception, reply_xmit, rx.nanos()),
            middle: Instant::from_nanos(request_xmit) + half(request_xmit, rx.nanos()),
            global: GlobalTime::from_nanos(reception) + half(reception, reply_xmit),
            begun: Begun { cycle, start, offset },
            line: 0,
            beside: Span::ZERO,
        }
    }

    /// The cycle that had begun, as it was known then.
    pub fn begun(&self) -> Begun {
        self.begun
    }

    /// By how much the master's clock, which gains `apart` on this one, was ahead of what a cycle's start says.
    pub fn ahead_of(&self, begun: Begun, apart: f64) -> Span {
        let age = self.middle - begun.start;
        let (drifted, at_most) = ((apart * age.nanos() as f64) as i64, age.abs() / DRIFT_PARTS);
        self.global - begun.offset.global(self.middle) - Span::from_nanos(drifted).clamp(-at_most, at_most)
    }
}

/// Keeps the quicker rounds that are alike, in order; what all of them say. The delay of a frame for one station: hold-ups
/// only ever make a round longer, so the lower quartile of all counts. All this is done at once when the last reply comes, so
/// only what is kept is sorted: the time that it takes grows as the rounds do.
pub fn keep_quicker(rounds: &mut Vec<Round>) -> Delays {
    let delays = Delays::of(rounds, |round| round.delay);
    let alike = ALIKE.max(delays.quartile / ALIKE_PARTS);
    let kept = kept_of(rounds.len());
    // They are among those that are not longer than the median, as the quartile is.
    rounds.truncate(rounds.len() / 2 + 1);
    rounds.retain(|round| (round.delay - delays.quartile).abs() <= alike);
    if kept < rounds.len() {
        rounds.select_nth_unstable_by_key(kept - 1, |round| round.delay);
        rounds.truncate(kept);
    }
    rounds.sort_unstable_by_key(|round| round.delay);
    delays
}

/// How many of so many rounds are kept at most.
fn kept_of(rounds: usize) -> usize {
    rounds.div_ceil(2).min(KEPT)
}

/// How much later than a frame for `one` station Synchronisations are, by how `late` each of the quicker rounds shows
/// them to be; `None` if they say nothing that can be. Hold-ups only ever make them later: the lower eighth counts, as
/// for the line they are on.
pub fn later(rounds: &mut [Round], one: Span, period: Span, late: impl Fn(&Round) -> Span) -> Option<Span> {
    if rounds.is_empty() {
        return None;
    }
    let (_, early, _) = rounds.select_nth_unstable_by_key(rounds.len() / 8, &late);
    let later = late(early) - one;
    let at_most = (one * LATER_AT_MOST).min(period / LATER_PARTS).min(period - one);
    (-LATER_AT_LEAST..=at_most)
        .contains(&later)
        .then(|| if later < LATER_AT_LEAST { Span::ZERO } else { later })
}

/// By how much the line that was followed is late, if rounds show by how much each of their syncs was, and those
/// were beside it. The middle one counts: a line is neither early nor late.
pub fn of_line(rounds: &mut [Round], late: impl Fn(&Round) -> Span) -> Option<Span> {
    let of_line = |round: &Round| late(round) - round.beside;
    let middle = rounds.len() / 2;
    (!rounds.is_empty()).then(|| of_line(rounds.select_nth_unstable_by_key(middle, of_line).1))
}

/// How fast this clock gains on the master's, by the middles of the quicker rounds. By as much as their delays gained, one
/// way may have: so much of it may not be the clock's.
pub fn rate(rounds: &[Round]) -> Option<Rate> {
    let first = *rounds.first()?;
    let gained = |of: fn(&Round, Round) -> Span| {
        let points = rounds.iter().map(move |round| {
            ((round.middle - first.middle).nanos() as f64, of(round, first).nanos() as f64)
        });
        Rate::of_points(points, ASKEW)
    };
    let middles = gained(|round, first| (round.middle - first.middle) - (round.global - first.global))?;
    let delays = gained(|round, first| round.delay - first.delay)?;
    Some(Rate { unsure: middles.unsure + delays.gains.abs(), ..middles })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tdma::line::Drift;

    const PERIOD: Span = Span::from_millis(1);
    const AHEAD: u64 = 1 << 40;

    /// Rounds of a slave whose clock is `AHEAD` behind its master's and slower by `ppm`; a frame takes 5 us, a
    /// Synchronisation 9; each round begins 400 us after its Synchronisation, the master's `own` clock is off.
    fn rounds(ppm: u64, own: u64, held_up: impl Fn(u64) -> u64) -> Vec<Round> {
        let global = |local: u64| local + AHEAD + local * ppm / 1_000_000;
        let round = |i: u64| {
            let (sync, request) = (i * 2_000_000, i * 2_000_000 + 400_000);
            let offset =
                Offset::between(Instant::from_nanos(sync + 9_000), GlobalTime::from_nanos(global(sync)));
            let (start, sched) = (Instant::from_nanos(sync + 9_000), GlobalTime::from_nanos(global(sync)));
            let line =
                TimeLine { cycle: 2 * i as u32, start, sched, period: PERIOD, offset, drift: Drift::NONE };
            let rx = request + 100_000 + 10_000 + held_up(i);
            let stamps = [global(request + 5_000), global(request + 105_000)].map(|at| at.wrapping_add(own));
            Round::new(request, stamps[0], stamps[1], Instant::from_nanos(rx), &line)
        };
        (1..=50).map(round).collect()
    }

    /// What they say, if syncs were later than the rounds know by `more`.
    fn told(mut rounds: Vec<Round>, more: impl Fn(&Round) -> i64) -> i64 {
        let one = keep_quicker(&mut rounds).quartile;
        let apart = rate(&rounds).map_or(0.0, |rate| -rate.gains);
        let late = |round: &Round| round.ahead_of(round.begun, apart) + Span::from_nanos(more(round));
        (one + later(&mut rounds, one, PERIOD, late).unwrap_or(Span::ZERO)).nanos()
    }

    fn measured(ppm: u64, own: u64, held_up: impl Fn(u64) -> u64) -> i64 {
        told(rounds(ppm, own, held_up), |_| 0)
    }

    #[test]
    fn a_sync_that_takes_longer_than_a_frame_for_one_station_is_known_to() {
        assert_eq!(measured(0, 0, |_| 0), 9_000);
        let held_up = |i: u64| if i.is_multiple_of(3) { 300_000 } else { 0 };
        assert_eq!(measured(0, 0, held_up), 9_000, "hold-ups do not matter");
    }

    #[test]
    fn syncs_that_are_held_up_all_the_while_are_not_believed() {
        assert_eq!(told(rounds(0, 0, |_| 0), |_| 65_000), 5_000);
        let some = |round: &Round| i64::from(round.begun.cycle / 2 % 2) * 10_000;
        assert_eq!(told(rounds(0, 0, |_| 0), some), 9_000);
    }

    #[test]
    fn of_the_quicker_half_those_that_are_alike_are_kept_in_order_and_no_more_than_there_is_room_for() {
        for count in [1, 2, 3, 100, 255, 256, 257, 10_000] {
            let delays = (0..count).map(|i| Span::from_nanos(i * 7_919 % 10_007));
            let mut rounds: Vec<_> =
                delays.clone().map(|delay| Round { delay, ..rounds(0, 0, |_| 0)[0] }).collect();
            let mut in_order: Vec<_> = delays.collect();
            in_order.sort_unstable();
            let said = keep_quicker(&mut rounds);
            assert_eq!(said.median, in_order[in_order.len() / 2]);
            let kept = in_order.len().div_ceil(2).min(KEPT);
            in_order.truncate(in_order.len() / 2 + 1);
            in_order.retain(|&delay| (delay - said.quartile).abs() <= ALIKE);
            in_order.truncate(kept);
            assert!(!rounds.is_empty());
            assert!(rounds.iter().map(|round| round.delay).eq(in_order), "of {count}");
        }
    }

    #[test]
    fn a_host_that_holds_up_one_way_of_most_rounds_from_some_time_on_shows_no_rate() {
        let held_up = |i: u64| if i > 12 && !i.is_multiple_of(4) { 26_000 } else { i % 2 * 400 };
        let mut rounds = rounds(30, 0, held_up);
        let one = keep_quicker(&mut rounds).quartile;
        assert!(
            rounds.len() >= 20 && rounds.iter().all(|round| round.delay < one + ALIKE),
            "{}",
            rounds.len()
        );
        let rate = rate(&rounds).unwrap();
        assert!((rate.gains + 30e-6).abs() < 3e-6, "{rate:?}");
    }

    #[test]
    fn rounds_of_a_while_that_were_far_quicker_than_most_do_not_count_for_the_rate() {
        // Replies to a core that was awake for a while took 7 us less: measured, and taken for 41 ppm of drift.
        let held_up = |i: u64| if (12..22).contains(&i) { i % 3 * 100 } else { 14_000 + i % 5 * 100 };
        let mut rounds = rounds(30, 0, held_up);
        keep_quicker(&mut rounds);
        assert!(rounds.len() >= 12, "{}", rounds.len());
        let rate = rate(&rounds).unwrap();
        assert!((rate.gains + 30e-6).abs() < 3e-6, "{rate:?}");
    }

    #[test]
    fn what_one_way_may_have_gained_is_not_sure() {
        for each in [-200, 200] {
            let mut rounds = rounds(30, 0, |i| (10_000 + i as i64 * each) as u64);
            keep_quicker(&mut rounds);
            let rate = rate(&rounds).unwrap();
            let error = (rate.gains + 30e-6).abs();
            assert!(error > 40e-6 && error < rate.unsure, "{rate:?}");
        }
    }

    #[test]
    fn what_was_kept_moves_along_to_a_larger_room() {
        let (mut room, mut brought) = (Room::of(20), Room::of(60));
        room.kept.extend(rounds(0, 0, |_| 0).into_iter().take(10));
        room.widen(20, &mut brought);
        assert_eq!((room.samples.capacity(), brought.samples.capacity()), (20, 60), "it is large enough");
        room.widen(21, &mut brought);
        assert_eq!((room.samples.capacity(), brought.samples.capacity()), (60, 20));
        assert_eq!((room.kept.len(), room.kept.capacity(), brought.kept.len()), (10, 30, 0));
    }

    #[test]
    fn clocks_that_run_apart_do_not_matter() {
        let measured = measured(150, 0, |_| 0);
        assert!((8_980..9_020).contains(&measured), "{measured}");
    }

    #[test]
    fn a_master_whose_stamps_are_of_another_clock_is_taken_by_its_rounds() {
        for own in [1, 1 << 30, u64::MAX / 2, u64::MAX - (1 << 20)] {
            let own = own << 20;
            assert_eq!(measured(0, own, |_| 0), 5_000, "{own}");
        }
    }
}
