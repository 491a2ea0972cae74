//! The transmit queue: 32 levels, 0 most urgent, first in first out within a level.
//!
//! ```text
//! occupied  0b…0000_0010_0000_0001      lowest set bit = most urgent level that holds something
//! levels    [0] frame ─► frame ─► frame   linked through their buffers: it needs no room of its own, and is never full
//!           [9] frame
//! ```

use core::fmt;

use crate::buf::{Buf, Chain};

/// An urgency: 0 first, 31 last.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Priority(u8);

impl Priority {
    /// How many there are, one bit each in the queue's occupancy word.
    pub const LEVELS: usize = 32;
    /// The most urgent.
    pub const FIRST: Priority = Priority(0);
    /// What a socket sends with unless it says otherwise.
    pub const DEFAULT: Priority = Priority(15);
    /// The last level of real-time traffic.
    pub const LAST_REAL_TIME: Priority = Priority(30);
    /// Everything that is not real-time; only the VNIC sends with it.
    pub const NON_RT: Priority = Priority(31);

    /// Level `level`, or an error above 31.
    pub fn new(level: u8) -> Result<Self, PriorityOutOfRange> {
        if usize::from(level) < Self::LEVELS { Ok(Self(level)) } else { Err(PriorityOutOfRange(level)) }
    }
    /// 0 to 31.
    pub const fn level(self) -> u8 {
        self.0
    }
}

impl fmt::Debug for Priority {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Priority({})", self.0)
    }
}

/// A priority above 31.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("priority {0} is out of range: 0 is the most urgent, 31 the least")]
pub struct PriorityOutOfRange(pub u8);

/// Frames of 32 priorities, as many as there are buffers: what may wait, pools bound, each what its owner sends. Every
/// operation takes constant time and no memory.
#[derive(Default)]
pub struct PriorityQueue {
    occupied: u32,
    len: u32,
    levels: [Chain; Priority::LEVELS],
}

impl PriorityQueue {
    /// An empty queue.
    pub fn new() -> Self {
        Self::default()
    }

    /// Appends behind everything of the same priority.
    #[inline]
    pub fn push(&mut self, priority: Priority, frame: Buf) {
        self.level(priority).push(frame);
    }

    /// Puts a frame that was taken out back before everything of the same priority.
    pub fn push_front(&mut self, priority: Priority, frame: Buf) {
        self.level(priority).push_front(frame);
    }

    /// Takes the oldest frame of the most urgent level.
    #[inline]
    pub fn pop(&mut self) -> Option<(Priority, Buf)> {
        let priority = self.first()?;
        let level = &mut self.levels[usize::from(priority.0)];
        let frame = level.pop_front()?;
        if level.is_empty() {
            self.occupied &= self.occupied - 1;
        }
        self.len -= 1;
        Some((priority, frame))
    }

    /// The most urgent level that holds something.
    pub fn first(&self) -> Option<Priority> {
        (self.occupied != 0).then(|| Priority(self.occupied.trailing_zeros() as u8))
    }

    /// How many frames wait.
    pub fn len(&self) -> usize {
        self.len as usize
    }
    /// Whether none waits.
    pub fn is_empty(&self) -> bool {
        self.occupied == 0
    }

    /// The level to which one more comes.
    #[inline]
    fn level(&mut self, priority: Priority) -> &mut Chain {
        self.occupied |= 1 << priority.0;
        self.len += 1;
        &mut self.levels[usize::from(priority.0)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::buf::Pool;
    use proptest::prelude::*;
    use std::collections::VecDeque;

    fn p(level: u8) -> Priority {
        Priority::new(level).unwrap()
    }

    fn marked(pool: &Pool, mark: u16) -> Buf {
        let mut buf = pool.take().unwrap();
        buf.fill(&mark.to_be_bytes());
        buf
    }

    fn next(queue: &mut PriorityQueue) -> Option<(Priority, u16)> {
        queue.pop().map(|(priority, buf)| (priority, u16::from_be_bytes([buf[0], buf[1]])))
    }

    #[test]
    fn a_priority_above_31_is_an_error() {
        assert_eq!(Priority::new(31), Ok(Priority::NON_RT));
        assert_eq!(Priority::new(32), Err(PriorityOutOfRange(32)));
    }

    #[test]
    fn what_is_put_back_is_the_next_of_its_level() {
        let pool = Pool::new(3);
        let mut queue = PriorityQueue::new();
        queue.push(p(7), marked(&pool, 2));
        queue.push_front(p(7), marked(&pool, 1));
        queue.push_front(p(9), marked(&pool, 3));
        let order: Vec<_> = core::iter::from_fn(|| next(&mut queue)).map(|(_, mark)| mark).collect();
        assert_eq!(order, [1, 2, 3]);
    }

    #[test]
    fn what_waits_goes_home_with_the_queue() {
        let pool = Pool::new(100);
        let mut queue = PriorityQueue::new();
        (0..100).for_each(|mark| queue.push(p((mark % 32) as u8), marked(&pool, mark)));
        assert_eq!((pool.available(), queue.len()), (0, 100), "all that a pool has");
        drop(queue);
        assert_eq!(pool.available(), 100);
    }

    proptest! {
        #[test]
        fn behaves_like_32_lists(steps in prop::collection::vec((0u8..32, 0u8..4), 0..300)) {
            let pool = Pool::new(300);
            let mut queue = PriorityQueue::new();
            let mut lists: Vec<VecDeque<u16>> = vec![VecDeque::new(); 32];
            for (mark, (level, step)) in (0..).zip(steps) {
                let waiting: usize = lists.iter().map(VecDeque::len).sum();
                prop_assert_eq!(queue.len(), waiting);
                let list = &mut lists[usize::from(level)];
                match step {
                    0 | 1 => {
                        queue.push(p(level), marked(&pool, mark));
                        list.push_back(mark);
                    }
                    2 => {
                        queue.push_front(p(level), marked(&pool, mark));
                        list.push_front(mark);
                    }
                    _ => {
                        let first = lists.iter().position(|list| !list.is_empty()).map(|level| p(level as u8));
                        prop_assert_eq!(queue.first(), first);
                        let expected = (0..32).find_map(|l| lists[l].pop_front().map(|i| (p(l as u8), i)));
                        prop_assert_eq!(next(&mut queue), expected);
                    }
                }
            }
        }
    }
}
