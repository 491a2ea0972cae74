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

use rtnet::time::{GlobalTime, Instant, Span};

use super::line::{self, DRIFT_PARTS, TimeLine};

/// What a Synchronisation is later than a frame for one station by: less is noise; more than so many times the delay
/// (a bridge of 32 ports takes eight), or than this part of a cycle, is a host that held syncs up all the while, or a
/// wrong clock.
const LATER_AT_LEAST: Span = Span::from_nanos(250);
const LATER_AT_MOST: i64 = 12;
const LATER_PARTS: i64 = 16;

/// A round.
#[derive(Clone, Copy, Debug)]
pub struct Round {
    /// How long a frame for one station takes.
    pub delay: Span,
    /// By how much the master's clock was ahead of what the last Synchronisation says, and how old that was.
    sync: Span,
    age: Span,
    /// When it was, on this clock.
    middle: Instant,
    /// From this clock to the master's, as the Synchronisations say.
    offset: u64,
}

impl Round {
    /// From a round's four stamps, and the line of a slave that knows of no delay yet.
    pub fn new(request_xmit: u64, reception: u64, reply_xmit: u64, rx: Instant, line: &TimeLine) -> Self {
        let behind = |stamp: u64, local: Instant| GlobalTime::from_nanos(stamp) - line.offset.global(local);
        let there = behind(reception, Instant::from_nanos(request_xmit)).nanos();
        let back = behind(reply_xmit, rx).nanos();
        let middle = Instant::from_nanos(request_xmit) + (rx - Instant::from_nanos(request_xmit)) / 2;
        Self {
            delay: line::delay(request_xmit, reception, reply_xmit, rx.nanos()),
            sync: Span::from_nanos(there.wrapping_add(back).wrapping_add(1) >> 1),
            age: middle - line.start,
            middle,
            offset: line.offset.nanos(),
        }
    }
}

/// The delay of Synchronisations that these rounds show. Hold-ups only ever make a round longer and a Synchronisation
/// later: of the former the lower quartile counts, of the latter, in the quicker half of the rounds, the lower eighth,
/// since that is what the line is laid through.
pub fn delay(rounds: &mut [Round], period: Span) -> Span {
    let apart = apart(rounds);
    rounds.sort_unstable_by_key(|round| round.delay);
    let delay = rounds[rounds.len() / 4].delay;
    let (quicker, _) = rounds.split_at_mut(rounds.len().div_ceil(2));
    let sync = |round: &Round| {
        let drifted = (apart * round.age.nanos() as f64) as i64;
        let at_most = round.age.abs() / DRIFT_PARTS;
        round.sync - Span::from_nanos(drifted).clamp(-at_most, at_most)
    };
    quicker.sort_unstable_by_key(sync);
    let later = sync(&quicker[quicker.len() / 8]) - delay;
    let at_most = (delay * LATER_AT_MOST).min(period / LATER_PARTS).min(period - delay);
    if (LATER_AT_LEAST..=at_most).contains(&later) { delay + later } else { delay }
}

/// By how much the master's clock gains on this one, from the first round to the last.
fn apart(rounds: &[Round]) -> f64 {
    let (Some(first), Some(last)) = (rounds.first(), rounds.last()) else { return 0.0 };
    let took = (last.middle - first.middle).nanos();
    let gained = last.offset.wrapping_sub(first.offset) as i64;
    if took > 0 { gained as f64 / took as f64 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tdma::line::Drift;
    use rtnet::time::Offset;

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

    fn measured(ppm: u64, own: u64, held_up: impl Fn(u64) -> u64) -> i64 {
        delay(&mut rounds(ppm, own, held_up), PERIOD).nanos()
    }

    #[test]
    fn a_sync_that_takes_longer_than_a_frame_for_one_station_is_known_to() {
        assert_eq!(measured(0, 0, |_| 0), 9_000);
        let held_up = |i: u64| if i.is_multiple_of(3) { 300_000 } else { 0 };
        assert_eq!(measured(0, 0, held_up), 9_000, "hold-ups do not matter");
    }

    #[test]
    fn syncs_that_are_held_up_all_the_while_are_not_believed() {
        let mut late = rounds(0, 0, |_| 0);
        late.iter_mut().for_each(|round| round.sync = round.sync + Span::from_micros(65));
        assert_eq!(delay(&mut late, PERIOD), Span::from_micros(5));
        let mut some = rounds(0, 0, |_| 0);
        some.iter_mut().step_by(2).for_each(|round| round.sync = round.sync + Span::from_micros(10));
        assert_eq!(delay(&mut some, PERIOD), Span::from_micros(9));
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
