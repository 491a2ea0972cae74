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

mod bytes;

use std::collections::VecDeque;
use std::io::{self, IoSlice};

use bytes::Bytes;

use super::account::Account;
use super::requests::OPEN_AT_MOST;
use crate::wire::{HEAD_LEN, Head};

/// The level of the router's own answers and questions, above all packages.
const OWN: u16 = 256;
/// Slices that one write takes: more levels wait for the next.
const SLICES: usize = 8;
/// Levels, and bytes of each, that stay when nothing waits in them.
const LEVELS_KEPT: usize = 2;
const BYTES_KEPT: usize = 2 << 10;
/// Bytes of a level up to which its memory stays until then: of few levels, and of each of many.
const TRIMMED_AT: [usize; 2] = [256 << 10, 16 << 10];
/// Bytes of the router's own answers that may wait besides: those to as many requests as one read holds.
const OWN_AT_MOST: usize = 64 << 10;
const _: () = assert!(OWN_AT_MOST > (OPEN_AT_MOST + 3) * HEAD_LEN + Account::LEN);

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
    /// Its head.
    begun_head: Option<Head>,
}

#[derive(Debug)]
struct Level {
    priority: u16,
    bytes: Bytes,
    waiting: VecDeque<Waiting>,
}

#[derive(Clone, Copy, Debug)]
struct Waiting {
    len: u32,
    /// When it came, in milliseconds: the low bits.
    since: u32,
    source: Source,
}

/// The connection that a package came by. Its place is another's once it has been closed; its number is not.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Source {
    /// Its place.
    pub place: u32,
    /// Its number among all connections so far.
    pub number: u32,
}

impl Source {
    /// The router itself.
    pub const ROUTER: Self = Self { place: u32::MAX, number: 0 };
}

/// A queue has no room for a package, nor anything less urgent in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Full;

impl Outgoing {
    /// An empty queue for `most` bytes.
    pub fn new(most: usize) -> Self {
        let own_most = OWN_AT_MOST;
        Self { levels: Vec::new(), most, bytes: 0, packages: 0, own_most, begun: None, begun_head: None }
    }

    /// Lets more of the router's own wait, for a connection to which it has much to say.
    pub fn let_own_wait(&mut self, most: usize) {
        self.own_most = self.own_most.max(most);
    }

    /// Appends a package to those of its priority. The heads of packages that make room for it go to `dropped`, with their sources.
    pub fn push(
        &mut self,
        head: &Head,
        body: &[u8],
        (source, now): (Source, u64),
        dropped: impl FnMut(Head, Source),
    ) -> Result<(), Full> {
        let priority = u16::from(head.priority);
        let len = HEAD_LEN + body.len();
        if self.bytes + len > self.most {
            self.make_room(self.bytes + len - self.most, priority, dropped)?;
        }
        self.append(priority, head, body, (source, now));
        self.bytes += len;
        self.packages += 1;
        Ok(())
    }

    /// Bytes of packages that it takes without dropping any.
    pub fn room(&self) -> usize {
        self.most.saturating_sub(self.bytes)
    }

    /// Appends whole packages of one priority, one behind the other and as they are sent; returns how many. There is [room](Self::room)
    /// for them.
    pub fn push_run(&mut self, priority: u8, packages: &[u8], (source, now): (Source, u64)) -> u64 {
        let place = self.level(priority.into());
        let level = &mut self.levels[place];
        let (mut at, before) = (0, level.waiting.len());
        while let Ok(Head { len, .. }) = Head::parse(&packages[at..]) {
            level.waiting.push_back(Waiting { len, since: now as u32, source });
            at += len as usize;
        }
        level.bytes.push(packages, &[]);
        let count = level.waiting.len() - before;
        self.bytes += packages.len();
        self.packages += count;
        count as u64
    }

    /// Appends an answer or a question of the router: it overtakes all packages. A peer that asks and does not read gets no more answers.
    pub fn push_own(&mut self, head: &Head, body: &[u8], now: u64) -> Result<(), Full> {
        let level = self.level(OWN);
        if self.levels[level].bytes.len() + HEAD_LEN + body.len() > self.own_most {
            return Err(Full);
        }
        self.append(OWN, head, body, (Source::ROUTER, now));
        Ok(())
    }

    /// Hands bytes to `send` until it takes no more; returns whether the queue is empty. Appends to `gone` how many packages of which
    /// sources have left.
    pub fn write(
        &mut self,
        mut send: impl FnMut(&[IoSlice<'_>]) -> io::Result<usize>,
        gone: &mut Vec<(Source, u64)>,
    ) -> io::Result<bool> {
        while !self.is_empty() {
            let mut slices = [IoSlice::new(&[]); SLICES];
            let (count, all) = self.next(&mut slices);
            match send(&slices[..count]) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(sent) => {
                    self.left(sent, gone);
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

    /// Bytes that it holds, the router's own included.
    pub fn held(&self) -> usize {
        let own = self.levels.first().filter(|level| level.priority == OWN);
        self.bytes + own.map_or(0, |level| level.bytes.len())
    }

    /// Drops all that waits. The heads of packages go to `dropped`, with their sources.
    pub fn drop_all(self, mut dropped: impl FnMut(Head, Source)) {
        for level in self.levels {
            let mut begun = self.begun.filter(|(priority, _)| *priority == level.priority);
            let mut at = 0;
            for Waiting { len, source, .. } in level.waiting {
                let (head, left) = match begun.take() {
                    Some((_, rest)) => (self.begun_head, rest),
                    None => (Head::parse(&level.bytes.as_slice()[at..]).ok(), len as usize),
                };
                at += left;
                head.into_iter().for_each(|head| dropped(head, source));
            }
        }
    }

    /// Milliseconds that the oldest of them has waited.
    pub fn oldest(&self, now: u64) -> Option<u64> {
        self.levels
            .iter()
            .filter(|level| level.priority < OWN)
            .filter_map(|level| level.waiting.front())
            .map(|of| u64::from((now as u32).wrapping_sub(of.since)))
            .max()
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

    fn trimmed_at(&self) -> usize {
        TRIMMED_AT[usize::from(self.levels.len() > LEVELS_KEPT)]
    }

    /// The place of a level, which is there from then on.
    fn level(&mut self, priority: u16) -> usize {
        match self.levels.iter().position(|level| level.priority <= priority) {
            Some(place) if self.levels[place].priority == priority => place,
            place => {
                let place = place.unwrap_or(self.levels.len());
                self.levels
                    .insert(place, Level { priority, bytes: Bytes::default(), waiting: VecDeque::new() });
                place
            }
        }
    }

    fn append(&mut self, priority: u16, head: &Head, body: &[u8], (source, now): (Source, u64)) {
        let place = self.level(priority);
        let level = &mut self.levels[place];
        level.bytes.push(&head.to_bytes(), body);
        level.waiting.push_back(Waiting { len: (HEAD_LEN + body.len()) as u32, since: now as u32, source });
    }

    /// Drops less urgent packages until `bytes` are free. Drops nothing if that is not enough.
    fn make_room(
        &mut self,
        bytes: usize,
        priority: u16,
        mut dropped: impl FnMut(Head, Source),
    ) -> Result<(), Full> {
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
        let (mut freed, trimmed_at) = (0, self.trimmed_at());
        while freed < bytes {
            let begun = self.begun;
            // A package that has partly left stays.
            let kept = |level: &Level| usize::from(begun.is_some_and(|(of, _)| of == level.priority));
            let Some(level) = self.levels.iter_mut().rfind(|level| level.waiting.len() > kept(level)) else {
                break;
            };
            let kept = kept(level);
            let first = if kept == 1 { begun.map_or(0, |(_, rest)| rest) } else { 0 };
            let Some(Waiting { len, source, .. }) = level.waiting.remove(kept) else { break };
            let head = Head::parse(&level.bytes.as_slice()[first..]);
            level.bytes.remove(first, len as usize);
            level.trim(trimmed_at);
            freed += len as usize;
            self.bytes -= len as usize;
            self.packages -= 1;
            if let Ok(head) = head {
                dropped(head, source);
            }
        }
        Ok(())
    }

    /// Collects the bytes that leave next; returns the number of slices and of bytes.
    fn next<'a>(&'a self, slices: &mut [IoSlice<'a>; SLICES]) -> (usize, usize) {
        let (mut count, mut all) = (0, 0);
        let mut add = |level: &'a Level, from: usize, to: usize| {
            let part = &level.bytes.as_slice()[from..to];
            if !part.is_empty() && count < SLICES {
                slices[count] = IoSlice::new(part);
                (count, all) = (count + 1, all + part.len());
            }
        };
        let rest_of =
            |level: &Level| self.begun.filter(|(of, _)| *of == level.priority).map_or(0, |(_, rest)| rest);
        self.levels.iter().for_each(|level| add(level, 0, rest_of(level)));
        self.levels.iter().for_each(|level| add(level, rest_of(level), level.bytes.len()));
        (count, all)
    }

    /// Removes bytes that have left.
    fn left(&mut self, mut sent: usize, gone: &mut Vec<(Source, u64)>) {
        if let Some((priority, rest)) = self.begun.take() {
            let place = self.level(priority);
            sent -= self.left_of(place, rest, sent.min(rest), gone);
        }
        for place in 0..self.levels.len() {
            if let Some(first) = self.levels[place].waiting.front().filter(|_| sent > 0) {
                sent -= self.left_of(place, first.len as usize, sent, gone);
            }
        }
    }

    /// Removes bytes that have left from a level, of whose first package `rest` were there; returns how many of `sent` these are.
    fn left_of(
        &mut self,
        place: usize,
        mut rest: usize,
        sent: usize,
        gone: &mut Vec<(Source, u64)>,
    ) -> usize {
        let trimmed_at = self.trimmed_at();
        let level = &mut self.levels[place];
        let all = sent.min(level.bytes.len());
        let (mut left, mut packages, mut bytes) = (all, 0, 0);
        // Whether a part of the first had left before.
        let mut has_begun = level.waiting.front().is_some_and(|first| rest < first.len as usize);
        while left >= rest
            && let Some(first) = level.waiting.pop_front()
        {
            left -= rest;
            has_begun = false;
            (packages, bytes) = (packages + 1, bytes + first.len as usize);
            match gone.last_mut() {
                Some((source, count)) if *source == first.source => *count += 1,
                _ => gone.push((first.source, 1)),
            }
            rest = level.waiting.front().map_or(usize::MAX, |next| next.len as usize);
        }
        if left > 0 {
            self.begun = Some((level.priority, rest - left));
            if !has_begun {
                self.begun_head = Head::parse(&level.bytes.as_slice()[all - left..]).ok();
            }
        }
        level.bytes.remove(0, all);
        if level.priority < OWN {
            self.bytes -= bytes;
            self.packages -= packages;
        }
        level.trim(trimmed_at);
        all
    }
}

impl Level {
    /// Gives memory back where four times as much is held as waits.
    fn trim(&mut self, at: usize) {
        let (bytes, waiting) = (self.bytes.len(), self.waiting.len());
        if self.bytes.capacity() > at && bytes < self.bytes.capacity() / 4 {
            self.bytes.shrink_to(at.max(2 * bytes));
        }
        if self.waiting.capacity() > at / size_of::<Waiting>() && waiting < self.waiting.capacity() / 4 {
            self.waiting.shrink_to((at / size_of::<Waiting>()).max(2 * waiting));
        }
    }
}

#[cfg(test)]
mod tests;
