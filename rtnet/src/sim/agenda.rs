//! What happens next in virtual time.
//!
//! ```text
//!                digits of 6 bits    ...  3    2    1    0
//! reached: the time of what was taken ... 00 . 17 . 05 . 40
//! an action at                        ... 00 . 17 . 09 . 12     is of level 1, in its bucket 9
//!          at                         ... 00 . 20 . 00 . 00     is of level 2, in its bucket 20
//! ```
//!
//! An action is of the level of the first digit in which its time differs from the time reached. So all of a level come before
//! all of the next one, and a bucket's come before the next bucket's. When a bucket is reached that has several, they are
//! divided anew, among the levels below. So an action is moved once for each level at the most, however many there are; in a heap
//! it is the more often the more there are.

use crate::clock::True;

const BITS: u32 = 6;
const BUCKETS: usize = 1 << BITS;
const LEVELS: usize = True::BITS.div_ceil(BITS) as usize;
/// The number of no place.
const NONE: u32 = u32::MAX;

/// Actions in the order of their times; those of one time in the order they were put down.
pub struct Agenda<A> {
    /// No action is before this.
    reached: True,
    /// Bit n: level n has some.
    in_use: u16,
    levels: Box<[Level; LEVELS]>,
    places: Vec<Place<A>>,
    /// A place without an action; behind it the others.
    free: u32,
}

struct Level {
    /// Bit n: bucket n has some.
    in_use: u64,
    buckets: [Bucket; BUCKETS],
}

/// The places of actions, in the order in which those of one time were put down.
#[derive(Clone, Copy)]
struct Bucket {
    first: u32,
    last: u32,
}

/// Where an action is.
struct Place<A> {
    at: True,
    /// The place behind it in its bucket.
    next: u32,
    action: Option<A>,
}

impl<A> Agenda<A> {
    pub fn new() -> Self {
        const EMPTY: Bucket = Bucket { first: NONE, last: NONE };
        let level = |_| Level { in_use: 0, buckets: [EMPTY; BUCKETS] };
        let levels = Box::new(std::array::from_fn(level));
        Self { reached: 0, in_use: 0, levels, places: Vec::new(), free: NONE }
    }

    /// An action for a time, or for the one that is reached if that is later.
    pub fn put(&mut self, at: True, action: A) {
        let place = Place { at: at.max(self.reached), next: NONE, action: Some(action) };
        let mut number = self.free;
        if let Some(free) = self.places.get_mut(number as usize) {
            self.free = std::mem::replace(free, place).next;
        } else {
            number = self.places.len() as u32;
            self.places.push(place);
        }
        self.file(number);
    }

    /// The first action, if its time is not after `until`.
    pub fn take(&mut self, until: True) -> Option<(True, A)> {
        loop {
            let height = self.in_use.trailing_zeros();
            let level = self.levels.get_mut(height as usize)?;
            let digit = level.in_use.trailing_zeros();
            let bucket = &mut level.buckets[digit as usize];
            let number = bucket.first;
            let place = &mut self.places[number as usize];
            let next = place.next;
            // Those of level 0 are of one time.
            let is_divided = height > 0 && next != NONE;
            let at = if is_divided { place.at >> (height * BITS) << (height * BITS) } else { place.at };
            if at > until {
                return None;
            }
            self.reached = at;
            bucket.first = next;
            if is_divided || next == NONE {
                level.in_use &= !(1 << digit);
                self.in_use &= !(u16::from(level.in_use == 0) << height);
            }
            if !is_divided {
                place.next = std::mem::replace(&mut self.free, number);
                return place.action.take().map(|action| (at, action));
            }
            self.divide(number);
        }
    }

    /// Those from this one on are put where they belong by now.
    fn divide(&mut self, mut number: u32) {
        while number != NONE {
            let next = std::mem::replace(&mut self.places[number as usize].next, NONE);
            self.file(number);
            number = next;
        }
    }

    /// Behind all others of its bucket.
    fn file(&mut self, number: u32) {
        let at = self.places[number as usize].at;
        let height = ((at ^ self.reached) | 1).ilog2() / BITS;
        let digit = (at >> (height * BITS)) as usize % BUCKETS;
        let level = &mut self.levels[height as usize];
        let bucket = &mut level.buckets[digit];
        if level.in_use & (1 << digit) == 0 {
            bucket.first = number;
        } else {
            self.places[bucket.last as usize].next = number;
        }
        bucket.last = number;
        level.in_use |= 1 << digit;
        self.in_use |= 1 << height;
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::sim::Random;

    #[test]
    fn actions_of_one_time_keep_their_order() {
        let mut agenda = Agenda::new();
        for (at, action) in [(5, 'b'), (3, 'a'), (5, 'c'), (9, 'd')] {
            agenda.put(at, action);
        }
        let order: String = std::iter::from_fn(|| agenda.take(5)).map(|(_, action)| action).collect();
        assert_eq!(order, "abc");
        agenda.put(9, 'e');
        assert_eq!([agenda.take(9), agenda.take(9)], [Some((9, 'd')), Some((9, 'e'))]);
        assert_eq!((agenda.take(9), agenda.places.len()), (None, 4), "places are used again");
    }

    #[test]
    fn what_is_put_down_for_a_time_that_is_over_is_next() {
        let mut agenda = Agenda::new();
        agenda.put(100, 'a');
        agenda.put(101, 'b');
        assert_eq!(agenda.take(100), Some((100, 'a')));
        agenda.put(3, 'c');
        assert_eq!([agenda.take(200), agenda.take(200)], [Some((100, 'c')), Some((101, 'b'))]);
    }

    #[test]
    fn looking_as_far_as_a_time_keeps_nothing_from_being_put_down_for_it() {
        let mut agenda = Agenda::new();
        agenda.put(70_000, 'z');
        agenda.put(70_001, 'z');
        assert_eq!(agenda.take(69_000), None);
        agenda.put(69_000, 'a');
        assert_eq!(agenda.take(u64::MAX), Some((69_000, 'a')));
    }

    #[test]
    fn any_actions_come_as_from_a_list_that_is_sorted() {
        let (mut agenda, mut list, mut random) = (Agenda::new(), BTreeSet::new(), Random::new(1));
        let mut now: True = 0;
        let ahead = |random: &mut Random| random.below(1 << 50) >> random.below(51);
        for number in 0..100_000_u32 {
            let at = now.saturating_add(ahead(&mut random));
            agenda.put(at, number);
            list.insert((at, number));
            let until = now.saturating_add(ahead(&mut random));
            while random.happens(600_000) {
                let first = list.first().copied().filter(|&(at, _)| at <= until);
                assert_eq!(agenda.take(until), first);
                first.iter().for_each(|first| _ = list.remove(first));
                now = first.map_or(until, |(at, _)| at);
            }
        }
        agenda.put(True::MAX, 0);
        list.insert((True::MAX, 0));
        let rest: Vec<_> = std::iter::from_fn(|| agenda.take(True::MAX)).collect();
        assert_eq!(rest, Vec::from_iter(list));
    }
}
