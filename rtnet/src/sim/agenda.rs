//! What happens next in virtual time.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::clock::True;

/// Actions in the order of their times; those of one time in the order they were put down.
pub struct Agenda<A> {
    heap: BinaryHeap<Reverse<Entry<A>>>,
    written: u64,
}

struct Entry<A> {
    at: True,
    order: u64,
    action: A,
}

impl<A> Agenda<A> {
    pub fn new() -> Self {
        Self { heap: BinaryHeap::new(), written: 0 }
    }

    pub fn put(&mut self, at: True, action: A) {
        self.heap.push(Reverse(Entry { at, order: self.written, action }));
        self.written += 1;
    }

    /// The first action, if its time is not after `until`.
    pub fn take(&mut self, until: True) -> Option<(True, A)> {
        if self.heap.peek()?.0.at > until {
            return None;
        }
        self.heap.pop().map(|Reverse(entry)| (entry.at, entry.action))
    }
}

impl<A> Entry<A> {
    fn key(&self) -> (True, u64) {
        (self.at, self.order)
    }
}

impl<A> PartialEq for Entry<A> {
    fn eq(&self, other: &Self) -> bool {
        self.key() == other.key()
    }
}
impl<A> Eq for Entry<A> {}
impl<A> PartialOrd for Entry<A> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl<A> Ord for Entry<A> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.key().cmp(&other.key())
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
        assert_eq!(agenda.take(9), Some((9, 'd')));
    }
}
