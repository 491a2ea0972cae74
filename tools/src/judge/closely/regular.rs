//! How regular the frames of each slot are, and how much they carry: what IEC 61784-2 asks for.

use std::collections::BTreeMap;

use rtnet::clock::True;
use rtnet::time::Span;

/// The largest of some times, and how many there were.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Largest {
    /// None, if there was no such time.
    pub span: Option<Span>,
    /// Of so many.
    pub n: u64,
}

impl Largest {
    /// One of them.
    pub fn note(&mut self, span: Span) {
        (self.span, self.n) = (self.span.max(Some(span)), self.n + 1);
    }

    /// Of these and those.
    pub fn and(self, those: Self) -> Self {
        Self { span: self.span.max(those.span), n: self.n + those.n }
    }
}

/// Of all slots.
#[derive(Clone, Debug, Default)]
pub struct Regular {
    /// When the frames of a slot's last two turns were there, the newest first; none of a turn that was missed.
    last: BTreeMap<(usize, u8), [Option<True>; 2]>,
    /// From the begin of a slot's frame to the end of its next one, no turn missed between.
    pub delivery: Largest,
    /// The same where any number of turns was missed between.
    pub delivery_with_misses: Largest,
    /// The same to the end of the one after that: the one between might have been lost, or was.
    pub delivery_with_a_loss: Largest,
    /// Payload behind the Ethernet header, and frames, by station: what is not tunnelled.
    pub real_time: Vec<(u64, u64)>,
    /// The same of what is.
    pub tunnelled: (u64, u64),
}

impl Regular {
    /// Of so many stations: nothing yet.
    pub fn of(stations: usize) -> Self {
        Self { real_time: vec![(0, 0); stations], ..Self::default() }
    }

    /// A frame of a slot, behind so many turns without one.
    pub fn frame(&mut self, (station, slot): (usize, u8), at: True, air: Span, missed: u64) {
        let [last, before] = self.last.entry((station, slot)).or_default();
        let since = |then: True| Span::from_nanos(at.wrapping_sub(then) as i64) + air;
        match (missed, *last, *before) {
            (0, Some(then), before) => {
                self.delivery.note(since(then));
                before.into_iter().for_each(|then| self.delivery_with_a_loss.note(since(then)));
            }
            (1, Some(then), _) => self.delivery_with_a_loss.note(since(then)),
            _ => {}
        }
        if let (1.., Some(then)) = (missed, *last) {
            self.delivery_with_misses.note(since(then));
        }
        *before = last.filter(|_| missed == 0);
        *last = Some(at);
    }

    /// What a frame has carried, in bytes behind its Ethernet header.
    pub fn carried(&mut self, station: usize, payload: u64, is_tunnelled: bool) {
        let of = match self.real_time.get_mut(station) {
            Some(of) if !is_tunnelled => of,
            _ => &mut self.tunnelled,
        };
        *of = (of.0 + payload, of.1 + 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AIR: Span = Span::from_nanos(700);

    #[test]
    fn a_value_that_just_missed_its_frame_waits_for_the_next_and_if_that_is_lost_for_the_one_after() {
        let mut regular = Regular::of(1);
        for (at, missed) in [(0, 0), (1_000, 0), (2_100, 0), (4_000, 1), (5_000, 0), (9_000, 3), (10_000, 0)]
        {
            regular.frame((0, 0), at, AIR, missed);
        }
        // 1000, 1100, 1000 behind the missed turn, and 1000 behind the three.
        assert_eq!(regular.delivery, Largest { span: Some(Span::from_nanos(1_800)), n: 4 });
        // 2100 over the frame between, 1900 where it was missing; three in a row are no single loss.
        // 1900 with one missed, 4000 with three.
        let with_misses = Largest { span: Some(Span::from_nanos(4_700)), n: 2 };
        assert_eq!(regular.delivery_with_misses, with_misses);
        let with_a_loss = Largest { span: Some(Span::from_nanos(2_800)), n: 2 };
        assert_eq!(regular.delivery_with_a_loss, with_a_loss);
    }

    #[test]
    fn every_slot_has_intervals_of_its_own() {
        let mut regular = Regular::of(2);
        [(0, 0), (0, 2), (1, 0)].iter().for_each(|&slot| regular.frame(slot, 5, AIR, 0));
        assert_eq!(regular.delivery, Largest::default());
        regular.frame((0, 2), 105, AIR, 0);
        assert_eq!(regular.delivery.n, 1);
    }

    #[test]
    fn what_is_tunnelled_is_counted_apart() {
        let mut regular = Regular::of(2);
        regular.carried(1, 64, false);
        regular.carried(1, 100, false);
        regular.carried(0, 1_500, true);
        assert_eq!((regular.real_time, regular.tunnelled), (vec![(0, 0), (164, 2)], (1_500, 1)));
    }
}
