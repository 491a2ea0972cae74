//! What a schedule leaves free, and what that absorbs.

use rtnet::time::Span;

use super::{Schedule, Slot, phases_meet};

/// What is free behind a slot's frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gap<'a> {
    /// Whose frame is before it.
    pub slot: &'a Slot,
    /// Up to whose begin; `None`: the cycle's end.
    pub until: Option<&'a Slot>,
    /// How long it is; less than nothing where they overlap.
    pub length: Span,
}

impl Schedule {
    /// What is free behind each slot's largest frame, in the cycles in which that is least, in the order of the slots'
    /// begins.
    pub fn gaps(&self) -> Vec<Gap<'_>> {
        let mut order: Vec<&Slot> = self.slots.iter().collect();
        order.sort_by_key(|slot| slot.offset);
        let gap = |place: usize| {
            let slot = order[place];
            let until = order[place + 1..].iter().find(|other| phases_meet(slot, other)).copied();
            let end = until.map_or(self.cycle, |until| until.offset);
            Gap { slot, until, length: end - slot.offset - self.air_time(slot) }
        };
        (0..order.len()).map(gap).collect()
    }
}

/// The largest rate error of clocks, in parts per billion, that a clocks' share of a guard band absorbs where so many
/// cycles without a Synchronisation are bridged: [`guard_band`] the other way round. Less than nothing: not even the
/// stamps' error.
///
/// [`guard_band`]: super::guard_band
pub fn drift_bound(share: Span, cycle: Span, holdover: u32, stamp_error: Span) -> i64 {
    let half_cycles = i128::from(2 * (1 + holdover) + 1);
    let left = share - Span::from_nanos(2) - stamp_error * 2;
    (i128::from(left.nanos()) * 2_000_000_000).div_euclid(i128::from(cycle.nanos().max(1)) * half_cycles)
        as i64
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::{Rate, Uncertainty, guard_band};
    use super::*;

    fn schedule(slots: &[(&str, i64, u32, u32)]) -> Schedule {
        let slot = |&(owner, offset, phase, period): &(&str, i64, u32, u32)| {
            let offset = Span::from_micros(offset);
            Slot { owner: owner.into(), id: 0, offset, phase, period, size: 1500 }
        };
        Schedule {
            cycle: Span::from_micros(1_000),
            sync_window: Span::from_micros(50),
            rate: Rate::from_bits_per_second(100_000_000),
            guard: Span::ZERO,
            backups: Vec::new(),
            slots: slots.iter().map(slot).collect(),
        }
    }

    #[test]
    fn what_is_free_behind_a_frame_ends_where_the_next_one_of_the_same_cycle_begins() {
        // A frame is on the air for 123.04 us.
        let schedule = schedule(&[("c", 500, 1, 2), ("a", 100, 0, 1), ("b", 300, 0, 2), ("d", 600, 0, 1)]);
        let gaps = schedule.gaps();
        let gaps = gaps
            .iter()
            .map(|gap| (&gap.slot.owner[..], gap.until.map(|until| &until.owner[..]), gap.length.nanos()));
        let expected = [
            ("a", Some("b"), 76_960),
            ("b", Some("d"), 176_960),
            ("c", Some("d"), -23_040),
            ("d", None, 276_960),
        ];
        assert_eq!(gaps.collect::<Vec<_>>(), expected);
    }

    proptest! {
        #[test]
        fn clocks_that_drift_so_much_need_no_more_than_their_share_and_a_little_more_need_more(
            share in 3_000i64..1_000_000, cycle in 100_000i64..100_000_000, holdover in 0u32..4, stamp in 0i64..1_000,
        ) {
            let [share, cycle, stamp_error] = [share, cycle, stamp].map(Span::from_nanos);
            let bound = drift_bound(share, cycle, holdover, stamp_error);
            let needs = |drift_ppb| {
                guard_band(Uncertainty { drift_ppb, cycle, holdover, lateness: Span::ZERO, stamp_error })
            };
            prop_assert!(bound >= 0 && needs(bound) <= share * 2, "{bound}: {}", needs(bound));
            // A part per billion is less than a nanosecond.
            let more = 1_000_000_000 / cycle.nanos() + 1;
            prop_assert!(needs(bound + more) > share * 2, "{bound} + {more}");
        }
    }
}
