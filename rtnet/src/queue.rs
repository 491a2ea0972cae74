//! The transmit queue: 32 levels, 0 most urgent, first in first out within a level.
//!
//! ```text
//! occupied  0b…0000_0010_0000_0001      lowest set bit = most urgent level that holds something
//! levels    [0] head ─► node ─► node    nodes come from one array of `capacity`, linked by index
//!           [5] head ─► node
//! ```

use core::fmt;

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

/// End of a list: no node has this index.
const NIL: u16 = u16::MAX;

/// A bounded queue of 32 priorities; every operation takes constant time and allocates nothing.
pub struct PriorityQueue<T> {
    occupied: u32,
    levels: [Level; Priority::LEVELS],
    nodes: Box<[Node<T>]>,
    free: u16,
    len: usize,
}

#[derive(Clone, Copy)]
struct Level {
    head: u16,
    tail: u16,
}

struct Node<T> {
    item: Option<T>,
    next: u16,
}

impl<T> PriorityQueue<T> {
    /// An empty queue for at most `capacity` items (1 to 65 535) over all levels together.
    pub fn new(capacity: u16) -> Self {
        assert!(capacity > 0, "a queue needs room for at least one item");
        let last = capacity - 1;
        let next = |i| if i == last { NIL } else { i + 1 };
        let nodes = (0..capacity).map(|i| Node { item: None, next: next(i) }).collect();
        Self { nodes, free: 0, ..Self::without_room() }
    }

    /// A queue that gives every item back, in the place of one that is still to come; it takes no memory of its own.
    pub fn without_room() -> Self {
        Self {
            occupied: 0,
            levels: [Level { head: NIL, tail: NIL }; Priority::LEVELS],
            nodes: Box::default(),
            free: NIL,
            len: 0,
        }
    }

    /// How many items it has room for.
    pub fn capacity(&self) -> usize {
        self.nodes.len()
    }

    /// Appends behind everything of the same priority; a full queue gives the item back.
    #[inline]
    pub fn push(&mut self, priority: Priority, item: T) -> Result<(), T> {
        let index = self.fill_free_node(item)?;
        self.nodes[usize::from(index)].next = NIL;
        let level = &mut self.levels[usize::from(priority.0)];
        let tail = core::mem::replace(&mut level.tail, index);
        if tail == NIL {
            level.head = index;
            self.occupied |= 1 << priority.0;
        } else {
            self.nodes[usize::from(tail)].next = index;
        }
        Ok(())
    }

    /// Puts an item that was taken out back before everything of the same priority.
    pub fn push_front(&mut self, priority: Priority, item: T) -> Result<(), T> {
        let index = self.fill_free_node(item)?;
        let level = &mut self.levels[usize::from(priority.0)];
        let head = core::mem::replace(&mut level.head, index);
        self.nodes[usize::from(index)].next = head;
        if head == NIL {
            level.tail = index;
            self.occupied |= 1 << priority.0;
        }
        Ok(())
    }

    /// Takes the oldest item of the most urgent level.
    #[inline]
    pub fn pop(&mut self) -> Option<(Priority, T)> {
        let priority = self.first()?;
        let level = &mut self.levels[usize::from(priority.0)];
        let index = level.head;
        let node = &mut self.nodes[usize::from(index)];
        level.head = node.next;
        if level.head == NIL {
            level.tail = NIL;
            self.occupied &= self.occupied - 1;
        }
        node.next = self.free;
        self.free = index;
        self.len -= 1;
        node.item.take().map(|item| (priority, item))
    }

    /// The most urgent level that holds something.
    pub fn first(&self) -> Option<Priority> {
        (self.occupied != 0).then(|| Priority(self.occupied.trailing_zeros() as u8))
    }

    /// How many items wait.
    pub fn len(&self) -> usize {
        self.len
    }
    /// Whether none waits.
    pub fn is_empty(&self) -> bool {
        self.occupied == 0
    }

    #[inline]
    fn fill_free_node(&mut self, item: T) -> Result<u16, T> {
        if self.free == NIL {
            return Err(item);
        }
        let index = self.free;
        let node = &mut self.nodes[usize::from(index)];
        self.free = node.next;
        node.item = Some(item);
        self.len += 1;
        Ok(index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::VecDeque;

    fn p(level: u8) -> Priority {
        Priority::new(level).unwrap()
    }

    #[test]
    fn a_priority_above_31_is_an_error() {
        assert_eq!(Priority::new(31), Ok(Priority::NON_RT));
        assert_eq!(Priority::new(32), Err(PriorityOutOfRange(32)));
    }

    #[test]
    fn a_full_queue_gives_the_item_back() {
        let mut queue = PriorityQueue::new(1);
        assert_eq!(queue.push(p(3), 'a'), Ok(()));
        assert_eq!(queue.push(p(0), 'b'), Err('b'));
        assert_eq!(queue.pop(), Some((p(3), 'a')));
        assert_eq!(queue.push(p(0), 'b'), Ok(()));
    }

    #[test]
    fn a_queue_without_room_gives_every_item_back() {
        let mut queue = PriorityQueue::without_room();
        assert_eq!((queue.push(p(3), 'a'), queue.push_front(p(3), 'b')), (Err('a'), Err('b')));
        assert_eq!((queue.pop(), queue.capacity()), (None, 0));
    }

    #[test]
    fn what_is_put_back_is_the_next_of_its_level() {
        let mut queue = PriorityQueue::new(4);
        queue.push(p(7), 2).unwrap();
        queue.push_front(p(7), 1).unwrap();
        queue.push_front(p(9), 3).unwrap();
        let order: Vec<_> = core::iter::from_fn(|| queue.pop()).map(|(_, item)| item).collect();
        assert_eq!(order, [1, 2, 3]);
    }

    proptest! {
        #[test]
        fn behaves_like_32_lists(steps in prop::collection::vec((0u8..32, 0u8..4), 0..300)) {
            let mut queue = PriorityQueue::new(40);
            let mut lists: Vec<VecDeque<usize>> = vec![VecDeque::new(); 32];
            for (i, (level, step)) in steps.into_iter().enumerate() {
                let waiting: usize = lists.iter().map(VecDeque::len).sum();
                prop_assert_eq!(queue.len(), waiting);
                match step {
                    0 | 1 => {
                        let pushed = queue.push(p(level), i).is_ok();
                        prop_assert_eq!(pushed, waiting < 40);
                        if pushed { lists[usize::from(level)].push_back(i); }
                    }
                    2 => {
                        if queue.push_front(p(level), i).is_ok() {
                            lists[usize::from(level)].push_front(i);
                        }
                    }
                    _ => {
                        let first = lists.iter().position(|list| !list.is_empty()).map(|level| p(level as u8));
                        prop_assert_eq!(queue.first(), first);
                        let expected = (0..32).find_map(|l| lists[l].pop_front().map(|i| (p(l as u8), i)));
                        prop_assert_eq!(queue.pop(), expected);
                    }
                }
            }
        }
    }
}
