//! What waits in a mailbox, the most urgent first, first in first out among equals. Every place of every lane is a node
//! here, so nothing is ever taken or freed.
//!
//! ```text
//! occupied  4 x 64 bits, one for each priority       highest set bit = most urgent that waits
//! first     [231] ─► node ─► node ─► none            linked by their numbers, the oldest first
//! last      [231] ──────────┘
//! ```

/// A place of a lane, by its number among all places of the mailbox.
pub type Node = u32;

const NONE: Node = Node::MAX;
const PRIORITIES: usize = 256;
const BITS: usize = u64::BITS as usize;

/// All nodes, and in which order those that wait come out.
pub struct Urgency {
    occupied: [u64; PRIORITIES / BITS],
    first: [Node; PRIORITIES],
    last: [Node; PRIORITIES],
    links: Box<[Link]>,
    len: usize,
}

#[derive(Clone, Copy)]
struct Link {
    before: Node,
    behind: Node,
    priority: u8,
    waits: bool,
}

impl Urgency {
    /// Room for so many nodes, of which none waits.
    pub fn new(nodes: usize) -> Self {
        let link = Link { before: NONE, behind: NONE, priority: 0, waits: false };
        Self {
            occupied: [0; PRIORITIES / BITS],
            first: [NONE; PRIORITIES],
            last: [NONE; PRIORITIES],
            links: vec![link; nodes].into_boxed_slice(),
            len: 0,
        }
    }

    /// Lets a node wait, behind all of its priority. One that waits already moves.
    #[inline]
    pub fn push(&mut self, node: Node, priority: u8) {
        self.remove(node);
        let level = usize::from(priority);
        let before = core::mem::replace(&mut self.last[level], node);
        *self.link_mut(node) = Link { before, behind: NONE, priority, waits: true };
        match before {
            NONE => self.first[level] = node,
            before => self.link_mut(before).behind = node,
        }
        self.occupied[level / BITS] |= 1 << (level % BITS);
        self.len += 1;
    }

    /// Lets a node wait, before all of its priority.
    pub fn push_front(&mut self, node: Node, priority: u8) {
        self.remove(node);
        let level = usize::from(priority);
        let behind = core::mem::replace(&mut self.first[level], node);
        *self.link_mut(node) = Link { before: NONE, behind, priority, waits: true };
        match behind {
            NONE => self.last[level] = node,
            behind => self.link_mut(behind).before = node,
        }
        self.occupied[level / BITS] |= 1 << (level % BITS);
        self.len += 1;
    }

    /// Takes a node out, if it waits.
    #[inline]
    pub fn remove(&mut self, node: Node) {
        let Link { before, behind, priority, waits, .. } = *self.link(node);
        if !waits {
            return;
        }
        let level = usize::from(priority);
        match before {
            NONE => self.first[level] = behind,
            before => self.link_mut(before).behind = behind,
        }
        match behind {
            NONE => self.last[level] = before,
            behind => self.link_mut(behind).before = before,
        }
        if self.first[level] == NONE {
            self.occupied[level / BITS] &= !(1 << (level % BITS));
        }
        self.link_mut(node).waits = false;
        self.len -= 1;
    }

    /// The oldest of the most urgent.
    #[inline]
    pub fn first(&self) -> Option<Node> {
        let word = (0..self.occupied.len()).rev().find(|&word| self.occupied[word] != 0)?;
        let level = word * BITS + (BITS - 1 - self.occupied[word].leading_zeros() as usize);
        Some(self.first[level])
    }

    /// Whether a node waits.
    pub fn waits(&self, node: Node) -> bool {
        self.link(node).waits
    }
    /// How many wait.
    pub fn len(&self) -> usize {
        self.len
    }

    #[inline]
    fn link(&self, node: Node) -> &Link {
        &self.links[node as usize]
    }
    #[inline]
    fn link_mut(&mut self, node: Node) -> &mut Link {
        &mut self.links[node as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::collection::vec;
    use proptest::prelude::*;

    fn drained(urgency: &mut Urgency) -> Vec<Node> {
        std::iter::from_fn(|| urgency.first().inspect(|&node| urgency.remove(node))).collect()
    }

    #[test]
    fn the_most_urgent_comes_first_and_of_equals_who_came_first() {
        let mut urgency = Urgency::new(6);
        for (node, priority) in [(2, 7), (0, 7), (1, 255), (3, 0), (4, 255), (5, 64)] {
            urgency.push(node, priority);
        }
        assert_eq!(urgency.len(), 6);
        assert_eq!(drained(&mut urgency), [1, 4, 5, 2, 0, 3]);
        assert_eq!((urgency.len(), urgency.first()), (0, None));
    }

    #[test]
    fn who_waits_already_moves() {
        let mut urgency = Urgency::new(3);
        (0..3).for_each(|node| urgency.push(node, 5));
        urgency.push(0, 5);
        urgency.push(1, 6);
        urgency.push_front(0, 5);
        assert_eq!(drained(&mut urgency), [1, 0, 2]);
    }

    proptest! {
        /// Appended, moved and taken out in any order: as lists.
        #[test]
        fn it_is_what_lists_are(
            steps in vec((0..12u32, prop_oneof![Just(0u8), Just(63), Just(64), any::<u8>()], 0..4u8), 1..200),
        ) {
            let mut urgency = Urgency::new(12);
            let mut model: Vec<(Node, u8)> = Vec::new();
            for (node, priority, step) in steps {
                model.retain(|&(other, _)| other != node);
                match step {
                    0 => urgency.remove(node),
                    1 => {
                        urgency.push_front(node, priority);
                        model.insert(0, (node, priority));
                    }
                    _ => {
                        urgency.push(node, priority);
                        model.push((node, priority));
                    }
                }
                prop_assert_eq!(urgency.len(), model.len());
                let first = model.iter().min_by_key(|(_, priority)| u8::MAX - priority);
                prop_assert_eq!(urgency.first(), first.map(|&(node, _)| node));
            }
            model.sort_by_key(|&(_, priority)| u8::MAX - priority);
            let nodes: Vec<_> = model.iter().map(|&(node, _)| node).collect();
            prop_assert_eq!(drained(&mut urgency), nodes);
        }
    }
}
