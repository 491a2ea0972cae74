//! Both ends of a shared ring against the other one's whims: words overwritten at any place, before or while they are read.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use rtnet::api::memory::Memory;
use rtnet::api::ring::{META, Nonsense, Place, Reader, Writer};
use rtnet::sim::Random;

use super::engine::{Target, fuzz, in_turn};
use super::mutate;

/// Words of a record besides its content: its length, and what comes with it.
const HEAD: usize = 1 + META;

const RECORDS: usize = 64;
/// Around it are words of somebody else's.
const PLACE: Place = Place { head: 16, tail: 24, records: 64..64 + RECORDS };
const WORDS: usize = 512;
const FOREIGN: u64 = 0x5a5a_5a5a_5a5a_5a5a;

/// Ten bytes each: what, where, and a word.
pub struct Whim {
    pub what: u8,
    pub at: usize,
    pub word: u64,
}

pub fn whims(input: &[u8]) -> impl Iterator<Item = Whim> {
    let (whims, _) = input.as_chunks::<10>();
    whims.iter().map(|&[what, at, word @ ..]| Whim { what, at: at.into(), word: u64::from_be_bytes(word) })
}

fn memory() -> Arc<Memory> {
    let memory = Arc::new(Memory::new(WORDS * 8).expect("memory"));
    (0..WORDS).filter(|at| !is_of_ring(*at)).for_each(|at| memory[at].store(FOREIGN, Relaxed));
    memory
}

fn is_of_ring(at: usize) -> bool {
    at == PLACE.head || at == PLACE.tail || PLACE.records.contains(&at)
}

/// Neither side has touched what is not the ring's.
fn check_foreign(memory: &Memory) {
    let touched = (0..WORDS).filter(|at| !is_of_ring(*at)).find(|&at| memory[at].load(Relaxed) != FOREIGN);
    assert_eq!(touched, None);
}

/// A word as the other side would like it: wild, or close to what is there.
pub fn wish(whim: &Whim, there: u64) -> u64 {
    match whim.what >> 4 {
        0..4 => whim.word % 128,
        4..8 => there.wrapping_add(whim.word % 16),
        8..10 => there.wrapping_sub(whim.word % 16),
        _ => whim.word,
    }
}

pub fn seeds() -> Vec<Vec<u8>> {
    let mut random = Random::new(7);
    (0..20).map(|len| (0..len * 10).map(|_| random.bits() as u8).collect()).collect()
}

#[test]
fn ring_reader_takes_any_words() {
    fuzz(&Target {
        name: "ring_reader",
        seeds: seeds(),
        has_corpus: true,
        mutate: mutate::bytes,
        run: reader,
    });
}

fn reader(input: &[u8]) -> Vec<u64> {
    let memory = memory();
    let mut reader = Reader::new(memory.clone(), PLACE);
    let (mut room, mut tail, mut outcomes) = ([0; 1024], 0, Vec::new());
    for whim in whims(input) {
        let at = [
            PLACE.head,
            PLACE.records.start + whim.at % RECORDS,
            (tail as usize % RECORDS) + PLACE.records.start,
        ][usize::from(whim.what) % 3];
        memory[at].store(wish(&whim, memory[at].load(Relaxed)), Relaxed);
        // As long as there is anything, as a reader would.
        let head = memory[PLACE.head].load(Relaxed);
        let mut records = 0;
        loop {
            let space = whim.at.min(room.len());
            let was = memory[PLACE.tail].load(Relaxed);
            let record = match reader.peek(&mut room[..space]) {
                Ok(Some(record)) => record,
                Ok(None) => {
                    assert_eq!(head, tail);
                    break outcomes.push(0);
                }
                Err(Nonsense) => {
                    assert_eq!(memory[PLACE.tail].load(Relaxed), was, "who is lied to takes nothing");
                    break outcomes.push(1);
                }
            };
            assert!(record.len <= RECORDS * 8 && record.copied == record.len.min(space));
            reader.take(record);
            let now = memory[PLACE.tail].load(Relaxed);
            let words = (HEAD + record.len.div_ceil(8)) as u64;
            assert_eq!(now.wrapping_sub(tail), words, "a record goes as a whole");
            assert!(head.wrapping_sub(now) <= RECORDS as u64, "and is never beyond what was written");
            (tail, records) = (now, records + 1);
            outcomes.push(2 + record.len as u64 / 8);
        }
        assert!(records <= RECORDS / HEAD);
    }
    check_foreign(&memory);
    in_turn(&outcomes)
}

#[test]
fn ring_writer_takes_any_words() {
    fuzz(&Target {
        name: "ring_writer",
        seeds: seeds(),
        has_corpus: true,
        mutate: mutate::bytes,
        run: writer,
    });
}

fn writer(input: &[u8]) -> Vec<u64> {
    let memory = memory();
    let mut writer = Writer::new(memory.clone(), PLACE);
    let (content, mut head, mut outcomes) = ([7; 600], 0u64, Vec::new());
    for whim in whims(input) {
        let at =
            [PLACE.tail, PLACE.head, PLACE.records.start + whim.at % RECORDS][usize::from(whim.what) % 3];
        memory[at].store(wish(&whim, memory[at].load(Relaxed)), Relaxed);
        let tail = memory[PLACE.tail].load(Relaxed);
        let len = whim.at * 2;
        let parts = content[..len].chunks(1 + whim.at % 50);
        let words = (HEAD + len.div_ceil(8)) as u64;
        let used = head.wrapping_sub(tail);
        let written = writer.write([1, 2, 3, 4, 5, 6], len, parts);
        match written {
            Ok(true) => {
                assert!(words <= RECORDS as u64 - used, "there was room");
                head += words;
                assert_eq!(memory[PLACE.head].load(Relaxed), head, "of its own counting");
            }
            Ok(false) => assert!(used <= RECORDS as u64 && words > RECORDS as u64 - used),
            Err(Nonsense) => assert!(used > RECORDS as u64),
        }
        assert_eq!(writer.is_drained(), tail == head);
        assert_eq!(writer.could_take(len), words <= RECORDS as u64);
        outcomes.push(written.map_or(9, u64::from));
    }
    check_foreign(&memory);
    in_turn(&outcomes)
}

#[test]
fn ring_threads_survive_a_third_who_writes_anywhere_meanwhile() {
    fuzz(&Target {
        name: "ring_threads",
        seeds: seeds(),
        has_corpus: true,
        mutate: mutate::bytes,
        run: threads,
    });
}

/// Both ends at work, while somebody who has the memory overwrites it word by word.
fn threads(input: &[u8]) -> Vec<u64> {
    let memory = memory();
    let (mut writer, mut reader) = (Writer::new(memory.clone(), PLACE), Reader::new(memory.clone(), PLACE));
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(Relaxed) {
                for whim in whims(input) {
                    let at = [PLACE.head, PLACE.tail, PLACE.records.start + whim.at % RECORDS];
                    let at = at[usize::from(whim.what) % 3];
                    memory[at].store(wish(&whim, memory[at].load(Relaxed)), Relaxed);
                }
            }
        });
        scope.spawn(|| {
            let content = [1; 200];
            for n in 0..500 {
                let len = n % content.len();
                let _ = writer.write([n as u64; META], len, [&content[..len]].into_iter());
            }
        });
        let mut room = [0; 100];
        for _ in 0..500 {
            if let Ok(Some(record)) = reader.peek(&mut room) {
                assert!(record.len <= RECORDS * 8 && record.copied == record.len.min(room.len()));
                reader.take(record);
            }
        }
        done.store(true, Relaxed);
    });
    check_foreign(&memory);
    // What comes of it is chance: nothing is learned from that.
    Vec::new()
}
