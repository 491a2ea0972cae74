//! A bounded ring of records in memory that two processes share and neither trusts.
//!
//! ```text
//! words   ┌──────┬───────────┬─────────────┬──────┬───
//!         │ len  │ meta x 6  │ content ... │ len  │       each record begins at a word; all are whole words
//!         └──────┴───────────┴─────────────┴──────┴───
//!         ^ tail: the reader's, words read so far   ^ head: the writer's, words written so far
//! ```
//!
//! Each side keeps its own count to itself and only shows it; the other's it reads, and believes only if it can be. So
//! whatever a hostile program writes there, the worst that comes of it is a record of nonsense, or none at all: never a
//! place outside the ring. Every word is read and written atomically, once.

use core::ops::Range;
use core::sync::atomic::{AtomicU64, Ordering};
use std::sync::Arc;

use super::memory::Memory;

/// Words in front of a record's content, besides its length.
pub const META: usize = 6;
const HEAD: usize = 1 + META;
const WORD: usize = size_of::<u64>();

/// What comes with a record.
pub type Meta = [u64; META];

/// Where a ring lies in shared memory, in words.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The writer's count.
    pub head: usize,
    /// The reader's count.
    pub tail: usize,
    /// The records: a power of two.
    pub records: Range<usize>,
}

/// The other side has written what cannot be: it is not to be dealt with any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the other side of a shared ring has written what cannot be")]
pub struct Nonsense;

/// The side that writes.
pub struct Writer {
    ring: Ring,
    head: u64,
}

/// The side that reads.
pub struct Reader {
    ring: Ring,
    tail: u64,
}

/// The oldest record, as it was looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// What came with it.
    pub meta: Meta,
    /// Bytes of its content.
    pub len: usize,
    /// Of these, how many were copied.
    pub copied: usize,
    next: u64,
}

struct Ring {
    memory: Arc<Memory>,
    place: Place,
}

impl Writer {
    /// The writer of an empty ring.
    pub fn new(memory: Arc<Memory>, place: Place) -> Self {
        Self { ring: Ring::new(memory, place), head: 0 }
    }

    /// Appends a record made of these parts, `len` bytes in all; `false`: there is no room yet.
    pub fn write<'a>(
        &mut self,
        meta: Meta,
        len: usize,
        parts: impl Iterator<Item = &'a [u8]>,
    ) -> Result<bool, Nonsense> {
        let capacity = self.ring.capacity();
        let used = self.head.wrapping_sub(self.ring.load(self.ring.place.tail));
        if used > capacity {
            return Err(Nonsense);
        }
        let words = words_of(len);
        if words > capacity - used {
            return Ok(false);
        }
        let mut at = self.head;
        for word in [len as u64].into_iter().chain(meta) {
            self.ring.word(at).store(word, Ordering::Relaxed);
            at += 1;
        }
        let mut carry = Carry::default();
        for part in parts {
            carry.add(part, |word| {
                self.ring.word(at).store(word, Ordering::Relaxed);
                at += 1;
            });
        }
        carry.finish(|word| self.ring.word(at).store(word, Ordering::Relaxed));
        self.head += words;
        self.ring.store(self.ring.place.head, self.head);
        Ok(true)
    }

    /// Whether a record of so many bytes could ever be written.
    pub fn could_take(&self, len: usize) -> bool {
        words_of(len) <= self.ring.capacity()
    }

    /// Whether the other side has read everything.
    pub fn is_drained(&self) -> bool {
        self.read() == self.head
    }

    /// What the other side says that it has read so far, in words: to be compared with what it said before, and nothing else.
    pub fn read(&self) -> u64 {
        self.ring.load(self.ring.place.tail)
    }
}

impl Reader {
    /// The reader of an empty ring.
    pub fn new(memory: Arc<Memory>, place: Place) -> Self {
        Self { ring: Ring::new(memory, place), tail: 0 }
    }

    /// Whether there is anything to read.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.ring.load(self.ring.place.head) == self.tail
    }

    /// The oldest record, copied as far as it fits. It stays until it is [taken](Self::take).
    pub fn peek(&self, into: &mut [u8]) -> Result<Option<Record>, Nonsense> {
        let Some(record) = self.front()? else { return Ok(None) };
        let copied = self.copy(&record, into);
        Ok(Some(Record { copied, ..record }))
    }

    /// The oldest record, without its content.
    pub fn front(&self) -> Result<Option<Record>, Nonsense> {
        let used = self.ring.load(self.ring.place.head).wrapping_sub(self.tail);
        match used {
            0 => return Ok(None),
            used if used > self.ring.capacity() || used < HEAD as u64 => return Err(Nonsense),
            _ => {}
        }
        // Read once: it may be another the next time.
        let len = self.ring.word(self.tail).load(Ordering::Relaxed);
        let whole = usize::try_from(len).ok().filter(|_| len <= used * WORD as u64).ok_or(Nonsense)?;
        let words = words_of(whole);
        if words > used {
            return Err(Nonsense);
        }
        let mut meta = Meta::default();
        for (word, at) in meta.iter_mut().zip(self.tail + 1..) {
            *word = self.ring.word(at).load(Ordering::Relaxed);
        }
        Ok(Some(Record { meta, len: whole, copied: 0, next: self.tail + words }))
    }

    /// Copies the content of the oldest record as far as it fits: how many bytes.
    pub fn copy(&self, record: &Record, into: &mut [u8]) -> usize {
        let copied = record.len.min(into.len());
        for (bytes, at) in into[..copied].chunks_mut(WORD).zip(self.tail + HEAD as u64..) {
            let word = self.ring.word(at).load(Ordering::Relaxed).to_ne_bytes();
            bytes.copy_from_slice(&word[..bytes.len()]);
        }
        copied
    }

    /// Done with a record: its place is the writer's again.
    pub fn take(&mut self, record: Record) {
        self.tail = record.next;
        self.ring.store(self.ring.place.tail, self.tail);
    }
}

impl Ring {
    fn new(memory: Arc<Memory>, place: Place) -> Self {
        let Place { head, tail, records } = &place;
        let fits = records.end <= memory.len() && *head.max(tail) < memory.len();
        assert!(fits && records.len().is_power_of_two(), "a ring lies in its memory, and has 2^n words");
        Self { memory, place }
    }

    fn capacity(&self) -> u64 {
        self.place.records.len() as u64
    }

    /// The word that many words from the begin of all that was ever written.
    #[inline]
    fn word(&self, at: u64) -> &AtomicU64 {
        &self.memory[self.place.records.start + (at & (self.capacity() - 1)) as usize]
    }

    fn load(&self, count: usize) -> u64 {
        self.memory[count].load(Ordering::Acquire)
    }

    fn store(&self, count: usize, value: u64) {
        self.memory[count].store(value, Ordering::Release);
    }
}

const fn words_of(len: usize) -> u64 {
    (HEAD + len.div_ceil(WORD)) as u64
}

/// Bytes that do not fill a word yet.
#[derive(Default)]
struct Carry {
    bytes: [u8; WORD],
    len: usize,
}

impl Carry {
    fn add(&mut self, mut part: &[u8], mut to: impl FnMut(u64)) {
        if self.len > 0 {
            let n = part.len().min(WORD - self.len);
            let (of_word, rest) = part.split_at(n);
            self.bytes[self.len..self.len + n].copy_from_slice(of_word);
            (self.len, part) = (self.len + n, rest);
            if self.len < WORD {
                return;
            }
            to(u64::from_ne_bytes(self.bytes));
            self.len = 0;
        }
        let (words, rest) = part.as_chunks::<WORD>();
        words.iter().for_each(|word| to(u64::from_ne_bytes(*word)));
        self.bytes[..rest.len()].copy_from_slice(rest);
        self.len = rest.len();
    }

    fn finish(&self, to: impl FnOnce(u64)) {
        if self.len > 0 {
            let mut last = [0; WORD];
            last[..self.len].copy_from_slice(&self.bytes[..self.len]);
            to(u64::from_ne_bytes(last));
        }
    }
}

#[cfg(test)]
mod tests {
    use core::sync::atomic::AtomicBool;

    use super::*;
    use proptest::collection::vec;
    use proptest::prelude::*;

    const PLACE: Place = Place { head: 0, tail: 8, records: 16..16 + 64 };

    fn ring() -> (Arc<Memory>, Writer, Reader) {
        let memory = Arc::new(Memory::new(4096).unwrap());
        (memory.clone(), Writer::new(memory.clone(), PLACE), Reader::new(memory, PLACE))
    }

    fn read(reader: &mut Reader) -> Option<(Meta, Vec<u8>)> {
        let mut room = [0; 512];
        let record = reader.peek(&mut room).unwrap()?;
        reader.take(record);
        Some((record.meta, room[..record.len].to_vec()))
    }

    #[test]
    fn a_full_ring_takes_no_more_until_something_was_read() {
        let (_memory, mut writer, mut reader) = ring();
        let content = [7; 8 * 9];
        let mut write =
            || writer.write([1, 2, 3, 4, 5, 6], content.len(), [&content[..]].into_iter()).unwrap();
        let written = (0..9).filter(|_| write()).count();
        assert_eq!(written, 4, "16 words each, in 64");
        assert_eq!(read(&mut reader), Some(([1, 2, 3, 4, 5, 6], content.to_vec())));
        assert!(write());
        assert!(!write());
        assert_eq!(std::iter::from_fn(|| read(&mut reader)).count(), 4);
        assert!(reader.is_empty() && writer.is_drained());
        assert!(writer.could_take(57 * 8) && !writer.could_take(57 * 8 + 1));
    }

    #[test]
    fn what_is_only_looked_at_stays() {
        let (_memory, mut writer, mut reader) = ring();
        writer.write([0; META], 5, [&b"he"[..], b"llo"].into_iter()).unwrap();
        let mut room = [0; 3];
        let record = reader.peek(&mut room).unwrap().unwrap();
        assert_eq!((record.len, record.copied, &room), (5, 3, b"hel"));
        assert_eq!(read(&mut reader).unwrap().1, b"hello");
        assert_eq!(read(&mut reader), None);
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_in_its_order(
            records in vec((any::<Meta>(), vec(vec(any::<u8>(), 0..40), 0..4)), 1..60),
            at_once in 1..6usize,
        ) {
            let (_memory, mut writer, mut reader) = ring();
            let mut waiting = records.iter().map(|(meta, parts)| (*meta, parts.concat()));
            for group in records.chunks(at_once) {
                for (meta, parts) in group {
                    let len = parts.iter().map(Vec::len).sum();
                    while !writer.write(*meta, len, parts.iter().map(|part| &part[..])).unwrap() {
                        prop_assert_eq!(read(&mut reader), waiting.next());
                    }
                }
            }
            for expected in waiting {
                prop_assert_eq!(read(&mut reader), Some(expected));
            }
        }

        /// Whatever the other side writes anywhere: each side goes on, or says that it is nonsense.
        #[test]
        fn a_hostile_other_side_harms_nobody(
            writes in vec((0..80usize, prop_oneof![any::<u64>(), 0..100u64, (0..100u64).prop_map(|n| n.wrapping_neg())], any::<bool>()), 1..200),
        ) {
            let (memory, mut writer, mut reader) = ring();
            let mut room = [0; 600];
            for (at, word, reads) in writes {
                memory[at].store(word, Ordering::Relaxed);
                if reads {
                    if let Ok(Some(record)) = reader.peek(&mut room) {
                        prop_assert!(record.copied <= record.len && record.len <= 64 * WORD);
                        reader.take(record);
                    }
                } else {
                    let _ = writer.write([0; META], 20, [&[0; 20][..]].into_iter());
                }
            }
        }
    }

    #[test]
    fn nothing_of_a_record_is_there_to_be_read_before_all_of_it_is() {
        let (_memory, mut writer, mut reader) = ring();
        for records in 0..20 {
            // Whoever writes is between any two of these when the reader looks.
            let parts = [&[records; 3][..], &[records; 8], &[records; 13], &[]];
            let looked = parts.iter().map(|part| {
                assert!(reader.is_empty() && reader.front() == Ok(None), "{records}");
                *part
            });
            assert!(writer.write([records.into(); META], 24, looked).unwrap());
            assert_eq!(read(&mut reader), Some(([records.into(); META], vec![records; 24])));
        }
    }

    /// Records of several words, and their last word alone, which is written behind all parts.
    #[test]
    fn two_threads_pass_whole_records_without_a_lock() {
        let (_memory, mut writer, mut reader) = ring();
        let (sent, is_over) = (100_000u64, AtomicBool::new(false));
        let record = |n: u64| ([n; META], vec![n as u8; (n % 50) as usize + 1]);
        let torn = std::thread::scope(|scope| {
            scope.spawn(|| {
                for (meta, content) in (0..sent).map(record) {
                    while !writer.write(meta, content.len(), [&content[..]].into_iter()).unwrap() {
                        // A reader that gives up makes no room.
                        if is_over.load(Ordering::Relaxed) {
                            return;
                        }
                        std::thread::yield_now();
                    }
                }
            });
            let mut room = [0; 512];
            let mut next = || loop {
                match reader.peek(&mut room) {
                    Ok(Some(record)) => {
                        reader.take(record);
                        return Ok((record.meta, room[..record.copied].to_vec()));
                    }
                    Ok(None) => std::thread::yield_now(),
                    Err(nonsense) => return Err(nonsense),
                }
            };
            let torn = (0..sent).find_map(|n| {
                let came = next();
                (came != Ok(record(n))).then_some((n, came))
            });
            is_over.store(true, Ordering::Relaxed);
            torn
        });
        assert_eq!(torn, None);
    }
}
