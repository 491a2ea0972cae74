//! The bounded queue of a connection: the most urgent package leaves first.
//!
//! ```text
//! lifesigns, answers of the router   ─┐
//! packages of priority 255           ─┤   the rest of a package that has partly left
//! ...                                 ├──────────────────────────────────────────────► the connection
//! packages of priority 0             ─┘   goes before anything else
//! ```
//!
//! A full queue takes a package only where less urgent ones wait: the oldest of the least urgent make room for it. All that is
//! dropped is handed back, so that a command's sender is answered.

use std::collections::VecDeque;
use std::io::{self, IoSlice};

use crate::wire::{HEAD_LEN, Head};

/// The level of the router's own answers and questions, above all packages.
const OWN: u16 = 256;
/// Slices that one write takes: more levels wait for the next.
const SLICES: usize = 8;
/// Levels, and bytes of each, that stay when nothing waits in them.
const LEVELS_KEPT: usize = 2;
const BYTES_KEPT: usize = 2 << 10;
/// Bytes of the router's own answers that may wait besides.
const OWN_AT_MOST: usize = 4 << 10;

/// The packages that wait for one connection.
#[derive(Debug)]
pub struct Outgoing {
    /// The most urgent first; some may be empty.
    levels: Vec<Level>,
    /// Bytes that may wait.
    most: usize,
    /// Bytes that wait, without the router's own.
    bytes: usize,
    packages: usize,
    /// Bytes of the router's own that may wait besides.
    own_most: usize,
    /// Priority of the package that has partly left, and its bytes that have not.
    begun: Option<(u16, usize)>,
}

#[derive(Debug)]
struct Level {
    priority: u16,
    bytes: VecDeque<u8>,
    waiting: VecDeque<Waiting>,
}

#[derive(Clone, Copy, Debug)]
struct Waiting {
    len: u32,
    /// When it came, in milliseconds.
    since: u64,
}

/// A queue has no room for a package, nor anything less urgent in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Full;

impl Outgoing {
    /// An empty queue for `most` bytes.
    pub fn new(most: usize) -> Self {
        Self { levels: Vec::new(), most, bytes: 0, packages: 0, own_most: OWN_AT_MOST, begun: None }
    }

    /// Lets more of the router's own wait, for a connection to which it has much to say.
    pub fn let_own_wait(&mut self, most: usize) {
        self.own_most = self.own_most.max(most);
    }

    /// Appends a package to those of its priority. The heads of packages that make room for it go to `dropped`.
    pub fn push(
        &mut self,
        head: &Head,
        body: &[u8],
        now: u64,
        dropped: impl FnMut(Head),
    ) -> Result<(), Full> {
        let priority = u16::from(head.priority);
        let len = HEAD_LEN + body.len();
        if self.bytes + len > self.most {
            self.make_room(self.bytes + len - self.most, priority, dropped)?;
        }
        self.append(priority, head, body, now);
        self.bytes += len;
        self.packages += 1;
        Ok(())
    }

    /// Appends an answer or a question of the router: it overtakes all packages. A peer that asks and does not read gets no more answers.
    pub fn push_own(&mut self, head: &Head, body: &[u8], now: u64) -> Result<(), Full> {
        let level = self.level(OWN);
        if self.levels[level].bytes.len() + HEAD_LEN + body.len() > self.own_most {
            return Err(Full);
        }
        self.append(OWN, head, body, now);
        Ok(())
    }

    /// Hands bytes to `send` until it takes no more; returns whether the queue is empty.
    pub fn write(&mut self, mut send: impl FnMut(&[IoSlice<'_>]) -> io::Result<usize>) -> io::Result<bool> {
        while !self.is_empty() {
            let mut slices = [IoSlice::new(&[]); SLICES];
            let (count, all) = self.next(&mut slices);
            match send(&slices[..count]) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(sent) => {
                    self.left(sent);
                    if sent < all {
                        return Ok(false);
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Ok(false),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(true)
    }

    /// Whether nothing waits.
    pub fn is_empty(&self) -> bool {
        self.levels.iter().all(|level| level.waiting.is_empty())
    }

    /// Packages that wait.
    pub fn packages(&self) -> usize {
        self.packages
    }

    /// Their bytes.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// When the oldest of them came.
    pub fn oldest(&self) -> Option<u64> {
        self.levels
            .iter()
            .filter(|level| level.priority < OWN)
            .filter_map(|level| level.waiting.front())
            .map(|of| of.since)
            .min()
    }

    /// Frees memory of levels without packages.
    pub fn shrink(&mut self) {
        if self.levels.len() > LEVELS_KEPT {
            self.levels.retain(|level| !level.waiting.is_empty());
        }
        for level in self.levels.iter_mut().filter(|level| level.waiting.is_empty()) {
            level.bytes.shrink_to(BYTES_KEPT);
            level.waiting.shrink_to(BYTES_KEPT / size_of::<Waiting>());
        }
    }

    /// The place of a level, which is there from then on.
    fn level(&mut self, priority: u16) -> usize {
        match self.levels.iter().position(|level| level.priority <= priority) {
            Some(place) if self.levels[place].priority == priority => place,
            place => {
                let place = place.unwrap_or(self.levels.len());
                self.levels
                    .insert(place, Level { priority, bytes: VecDeque::new(), waiting: VecDeque::new() });
                place
            }
        }
    }

    fn append(&mut self, priority: u16, head: &Head, body: &[u8], now: u64) {
        let place = self.level(priority);
        let level = &mut self.levels[place];
        level.bytes.extend(head.to_bytes());
        level.bytes.extend(body);
        level.waiting.push_back(Waiting { len: (HEAD_LEN + body.len()) as u32, since: now });
    }

    /// Drops less urgent packages until `bytes` are free. Drops nothing if that is not enough.
    fn make_room(&mut self, bytes: usize, priority: u16, mut dropped: impl FnMut(Head)) -> Result<(), Full> {
        let below = |level: &&Level| level.priority < priority;
        let mut there: usize = self.levels.iter().filter(below).map(|level| level.bytes.len()).sum();
        if let Some((begun, rest)) = self.begun
            && begun < priority
        {
            there -= rest;
        }
        if there < bytes {
            return Err(Full);
        }
        let mut freed = 0;
        while freed < bytes {
            let begun = self.begun;
            // A package that has partly left stays.
            let kept = |level: &Level| usize::from(begun.is_some_and(|(of, _)| of == level.priority));
            let Some(level) = self.levels.iter_mut().rfind(|level| level.waiting.len() > kept(level)) else {
                break;
            };
            let kept = kept(level);
            let first = if kept == 1 { begun.map_or(0, |(_, rest)| rest) } else { 0 };
            let Some(Waiting { len, .. }) = level.waiting.remove(kept) else { break };
            let mut head = [0; HEAD_LEN];
            head.iter_mut().zip(level.bytes.range(first..)).for_each(|(to, from)| *to = *from);
            level.bytes.drain(first..first + len as usize);
            freed += len as usize;
            self.bytes -= len as usize;
            self.packages -= 1;
            if let Ok(head) = Head::parse(&head) {
                dropped(head);
            }
        }
        Ok(())
    }

    /// Collects the bytes that leave next; returns the number of slices and of bytes.
    fn next<'a>(&'a self, slices: &mut [IoSlice<'a>; SLICES]) -> (usize, usize) {
        let (mut count, mut all) = (0, 0);
        let mut add = |level: &'a Level, from: usize, to: usize| {
            let (front, back) = level.bytes.as_slices();
            let split = front.len();
            for part in [
                &front[from.min(split)..to.min(split)],
                &back[from.max(split) - split..to.max(split) - split],
            ] {
                if !part.is_empty() && count < SLICES {
                    slices[count] = IoSlice::new(part);
                    (count, all) = (count + 1, all + part.len());
                }
            }
        };
        let rest_of =
            |level: &Level| self.begun.filter(|(of, _)| *of == level.priority).map_or(0, |(_, rest)| rest);
        self.levels.iter().for_each(|level| add(level, 0, rest_of(level)));
        self.levels.iter().for_each(|level| add(level, rest_of(level), level.bytes.len()));
        (count, all)
    }

    /// Removes bytes that have left.
    fn left(&mut self, mut sent: usize) {
        if let Some((priority, rest)) = self.begun.take() {
            sent = self.left_of(priority, rest, sent);
        }
        for place in 0..self.levels.len() {
            while sent > 0
                && let Some(first) = self.levels[place].waiting.front()
            {
                sent = self.left_of(self.levels[place].priority, first.len as usize, sent);
            }
        }
    }

    /// Removes the bytes of a level's first package, of which `rest` were left, out of `sent`; returns how many of `sent` belong to
    /// later packages.
    fn left_of(&mut self, priority: u16, rest: usize, sent: usize) -> usize {
        let place = self.level(priority);
        let level = &mut self.levels[place];
        let now = rest.min(sent);
        level.bytes.drain(..now);
        if now < rest {
            self.begun = Some((priority, rest - now));
        } else if let Some(gone) = level.waiting.pop_front()
            && priority < OWN
        {
            self.bytes -= gone.len as usize;
            self.packages -= 1;
        }
        sent - now
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::name::MailboxName;
    use crate::wire::Endian;

    fn head(priority: u8, id: u8, body: usize) -> Head {
        Head { priority, id, ..Head::new(1, MailboxName(1), MailboxName(2)) }.with_body(body).unwrap()
    }

    /// Priority and id of each package that leaves, if each write takes `at_once` bytes.
    fn leaves(queue: &mut Outgoing, at_once: usize) -> Vec<(u8, u8)> {
        let mut bytes = Vec::new();
        while !queue.is_empty() {
            queue.write(|slices| Ok(taken(&mut bytes, slices, at_once))).unwrap();
        }
        let mut seen = Vec::new();
        super::super::frames::Frames::default()
            .cut(&bytes, |head, _| seen.push((head.priority, head.id)))
            .unwrap();
        assert_eq!((queue.bytes(), queue.packages(), queue.oldest()), (0, 0, None));
        seen
    }

    fn taken(bytes: &mut Vec<u8>, slices: &[IoSlice<'_>], at_once: usize) -> usize {
        let all: Vec<u8> = slices.iter().flat_map(|slice| slice.iter().copied()).take(at_once).collect();
        bytes.extend(&all);
        all.len()
    }

    #[test]
    fn the_most_urgent_leaves_first_and_of_equals_the_oldest() {
        for at_once in 1..200 {
            let mut queue = Outgoing::new(1 << 16);
            for (id, priority) in (0..).zip([5, 200, 5, 0, 255, 200]) {
                queue.push(&head(priority, id, 20), &[id; 20], 7, |_| ()).unwrap();
            }
            assert_eq!((queue.oldest(), queue.packages(), queue.bytes()), (Some(7), 6, 6 * 36));
            let own = Head { id: 99, ..Head::new(17, MailboxName::NOBODY, MailboxName::NOBODY) };
            queue.push_own(&own, &[], 8).unwrap();
            let order = [(0, 99), (255, 4), (200, 1), (200, 5), (5, 0), (5, 2), (0, 3)];
            assert_eq!(leaves(&mut queue, at_once), order, "{at_once} bytes at once");
        }
    }

    #[test]
    fn a_package_that_has_begun_is_ended_before_what_is_more_urgent() {
        for begun in 1..40 {
            let mut queue = Outgoing::new(1 << 16);
            queue.push(&head(1, 0, 24), &[0; 24], 0, |_| ()).unwrap();
            queue.push(&head(1, 1, 24), &[0; 24], 0, |_| ()).unwrap();
            let (mut bytes, mut first) = (Vec::new(), true);
            let once = |slices: &[IoSlice<'_>]| match core::mem::take(&mut first) {
                true => Ok(taken(&mut bytes, slices, begun)),
                false => Err(io::ErrorKind::WouldBlock.into()),
            };
            assert!(!queue.write(once).unwrap());
            queue.push(&head(9, 2, 24), &[0; 24], 0, |_| ()).unwrap();
            assert!(queue.write(|slices| Ok(taken(&mut bytes, slices, 7).max(1))).is_ok());
            while !queue.is_empty() {
                queue.write(|slices| Ok(taken(&mut bytes, slices, 7))).unwrap();
            }
            let mut seen = Vec::new();
            super::super::frames::Frames::default().cut(&bytes, |head, _| seen.push(head.id)).unwrap();
            assert_eq!(seen, [0, 2, 1], "{begun} bytes had left");
        }
    }

    #[test]
    fn the_oldest_of_the_least_urgent_makes_room() {
        let mut queue = Outgoing::new(3 * 36);
        let mut push = |priority, id, body: usize| {
            let mut dropped = Vec::new();
            let pushed =
                queue.push(&head(priority, id, body), &vec![0; body], 0, |head| dropped.push(head.id));
            pushed.map(|()| dropped)
        };
        assert_eq!(push(3, 0, 20), Ok(vec![]));
        assert_eq!(push(1, 1, 20), Ok(vec![]));
        assert_eq!(push(1, 2, 20), Ok(vec![]));
        assert_eq!(push(1, 3, 20), Err(Full), "none of its own priority makes room");
        assert_eq!(push(2, 4, 20), Ok(vec![1]));
        assert_eq!(push(3, 5, 56), Ok(vec![2, 4]));
        assert_eq!(push(9, 6, 200), Err(Full), "it is longer than the queue");
        assert_eq!(push(3, 7, 0), Err(Full));
        assert_eq!(leaves(&mut queue, 1_000), [(3, 0), (3, 5)], "what could not help was not dropped");
    }

    #[test]
    fn what_has_begun_is_not_dropped() {
        let mut queue = Outgoing::new(3 * 36);
        for id in 0..3 {
            queue.push(&head(1, id, 20), &[id; 20], 0, |_| ()).unwrap();
        }
        let (mut bytes, mut first) = (Vec::new(), true);
        let once = |slices: &[IoSlice<'_>]| match core::mem::take(&mut first) {
            true => Ok(taken(&mut bytes, slices, 10)),
            false => Err(io::ErrorKind::WouldBlock.into()),
        };
        assert!(!queue.write(once).unwrap());
        let mut dropped = Vec::new();
        queue.push(&head(2, 8, 20), &[8; 20], 0, |head| dropped.push(head.id)).unwrap();
        queue.push(&head(2, 9, 20), &[9; 20], 0, |head| dropped.push(head.id)).unwrap();
        assert_eq!(dropped, [1, 2]);
        assert_eq!(queue.push(&head(3, 10, 20), &[0; 20], 0, |_| ()), Ok(()), "one of priority 2 goes");
        while !queue.is_empty() {
            queue.write(|slices| Ok(taken(&mut bytes, slices, 1_000))).unwrap();
        }
        let mut seen = Vec::new();
        let frames = &mut super::super::frames::Frames::default();
        frames
            .cut(&bytes, |head, body| seen.push((head.id, body.iter().all(|byte| *byte == head.id % 10))))
            .unwrap();
        assert_eq!(seen, [(0, true), (10, true), (9, true)]);
        assert_eq!(head(1, 0, 0).head_order, Endian::Little);
    }

    #[test]
    fn answers_to_a_peer_that_does_not_read_are_bounded() {
        let mut queue = Outgoing::new(100);
        let own = Head::new(0, MailboxName::NOBODY, MailboxName::NOBODY);
        let taken = (0..10_000).filter(|_| queue.push_own(&own, &[], 0).is_ok()).count();
        assert_eq!(taken, OWN_AT_MOST / HEAD_LEN);
        assert_eq!((queue.bytes(), queue.oldest()), (0, None), "they are not packages");
    }

    #[test]
    fn memory_is_given_back() {
        let mut queue = Outgoing::new(1 << 20);
        for priority in 0..=255 {
            queue.push(&head(priority, 0, 2_000), &[0; 2_000], 0, |_| ()).unwrap();
        }
        leaves(&mut queue, 1 << 20);
        queue.shrink();
        let kept: usize = queue.levels.iter().map(|level| level.bytes.capacity()).sum();
        assert!(kept <= LEVELS_KEPT * BYTES_KEPT, "{kept}");
    }
}
