//! What happens next in virtual time.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::clock::True;

/// Actions in the order of their times; those of one time in the order they were put down.
pub struct Agenda<A> {
    /// Small, since it is moved about: thousands of stations' stay in the nearest cache.
    heap: BinaryHeap<Reverse<Entry>>,
    written: u64,
    /// The actions themselves, each at its place.
    actions: Vec<Option<A>>,
    /// Places without one, the one that was left last at the end.
    free: Vec<u32>,
}

/// When, and the how manieth that was put down; and where it is, which never decides.
type Entry = (True, u64, u32);

impl<A> Agenda<A> {
    pub fn new() -> Self {
        Self { heap: BinaryHeap::new(), written: 0, actions: Vec::new(), free: Vec::new() }
    }

    pub fn put(&mut self, at: True, action: A) {
        let place = self.free.pop().unwrap_or_else(|| {
            self.actions.push(None);
            (self.actions.len() - 1) as u32
        });
        self.actions[place as usize] = Some(action);
        self.heap.push(Reverse((at, self.written, place)));
        self.written += 1;
    }

    /// The first action, if its time is not after `until`.
    pub fn take(&mut self, until: True) -> Option<(True, A)> {
        let &Reverse((at, ..)) = self.heap.peek()?;
        if at > until {
            return None;
        }
        let Reverse((at, _, place)) = self.heap.pop()?;
        self.free.push(place);
        self.actions[place as usize].take().map(|action| (at, action))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert_eq!((agenda.take(9), agenda.actions.len()), (None, 4), "places are used again");
    }
}
