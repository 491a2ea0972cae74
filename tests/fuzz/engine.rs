//! Runs a target: what is stored first, then mutations of it.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};
use std::sync::Once;
use std::time::{Duration, Instant};

use nix::time::{ClockId, clock_gettime};
use rtnet::sim::Random;
use tests::seeds;

/// What is fuzzed.
pub struct Target {
    /// Its name, also of its directory in `corpus`.
    pub name: &'static str,
    /// Inputs to begin with, beside those of the corpus.
    pub seeds: Vec<Vec<u8>>,
    /// Whether there must be a corpus: not where all seeds are files of their own.
    pub has_corpus: bool,
    /// Changes an input a little, perhaps by means of another one.
    pub mutate: fn(&mut Random, &mut Vec<u8>, &[u8]),
    /// Panics if something is not as it must be; tells what came of the input, roughly: one of which something came that had
    /// not come of any before is worth to be changed further.
    pub run: fn(&[u8]) -> Vec<u64>,
}

const SECONDS: u64 = 2;
/// Inputs that are kept at the most: mutations of the first ones are to be found among them, too.
const MOST_KEPT: usize = 4_096;
/// No input takes as long unless something does not end: that of the largest scenario takes a hundredth.
const SLOW: Duration = Duration::from_secs(2);
/// How often a failing input is made shorter at the most.
const SHORTENED: usize = 2_000;

/// Runs a target for its time, or the one input that was asked for.
pub fn fuzz(target: &Target) {
    be_quiet_while_shortening();
    if let Ok(hex) = std::env::var("RTNET_FUZZ_INPUT") {
        let input = unhex(&hex).unwrap_or_else(|| panic!("RTNET_FUZZ_INPUT: pairs of hexadecimal digits"));
        return println!("{}: {:x?}", target.name, (target.run)(&input));
    }
    let (seconds, seed) =
        (number("RTNET_FUZZ_SECONDS", SECONDS), number("RTNET_FUZZ_SEED", seeds::one(target.name)));
    let until = Instant::now() + Duration::from_secs(seconds);
    let (mut kept, mut known, mut random) = (Vec::new(), BTreeSet::new(), Random::new(seed));
    let stored = if target.has_corpus { stored(target.name) } else { Vec::new() };
    for input in target.seeds.iter().cloned().chain(stored) {
        known.extend(once(target, &input));
        kept.push(input);
    }
    let mut inputs = kept.len();
    while Instant::now() < until {
        let [one, other] = [(); 2].map(|()| random.below(kept.len() as u64) as usize);
        let mut input = kept[one].clone();
        for _ in 0..=random.below(4) {
            (target.mutate)(&mut random, &mut input, &kept[other]);
        }
        let before = known.len();
        known.extend(once(target, &input));
        if known.len() > before && kept.len() < MOST_KEPT {
            kept.push(input);
        }
        inputs += 1;
    }
    println!("{}: seed {seed}, {inputs} inputs, {} outcomes", target.name, known.len());
}

/// Folds what came of an input into one number.
pub fn outcome(parts: impl IntoIterator<Item = u64>) -> u64 {
    parts.into_iter().fold(0xcbf2_9ce4_8422_2325, |sum, part| (sum ^ part).wrapping_mul(0x0100_0000_01b3))
}

/// What came of each step of an input, and after which: there are not too many such pairs for each to be worth keeping.
pub fn in_turn(steps: &[u64]) -> Vec<u64> {
    steps.iter().copied().chain(steps.windows(2).map(|two| outcome(two.iter().copied()))).collect()
}

fn once(target: &Target, input: &[u8]) -> Vec<u64> {
    match run(target, input) {
        Ok((outcome, took)) if took < SLOW => outcome,
        Ok((_, took)) => {
            show(target, input);
            panic!("an input took {took:?}");
        }
        Err(panic) => {
            show(target, &shortened(target, input));
            resume_unwind(panic);
        }
    }
}

fn run(target: &Target, input: &[u8]) -> std::thread::Result<(Vec<u64>, Duration)> {
    let spent = || clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from);
    let begin = spent();
    let outcome = catch_unwind(AssertUnwindSafe(|| (target.run)(input)))?;
    Ok((outcome, spent() - begin))
}

fn show(target: &Target, input: &[u8]) {
    let (name, hex) = (target.name, hex(input));
    let file =
        format!("tests/fuzz/corpus/{name}/{:016x}.hex", outcome(input.iter().map(|&byte| byte.into())));
    println!("{name} fails on {} bytes: {hex}", input.len());
    println!("  again: RTNET_FUZZ_INPUT={hex} scripts/fuzz {name}");
    println!("  keep:  mkdir -p tests/fuzz/corpus/{name} && echo {hex} >{file}");
}

/// As much of an input as it takes to fail: ever smaller pieces are left out.
fn shortened(target: &Target, input: &[u8]) -> Vec<u8> {
    SHORTENING.set(true);
    let (mut shortest, mut piece, mut tries) = (input.to_vec(), input.len() / 2, 0);
    while piece > 0 && tries < SHORTENED {
        let mut from = 0;
        while from < shortest.len() && tries < SHORTENED {
            let mut shorter = shortest.clone();
            shorter.drain(from..(from + piece).min(shortest.len()));
            tries += 1;
            match run(target, &shorter) {
                Err(_) => shortest = shorter,
                Ok(_) => from += piece,
            }
        }
        piece /= 2;
    }
    SHORTENING.set(false);
    shortest
}

thread_local! {
    static SHORTENING: Cell<bool> = const { Cell::new(false) };
}

fn be_quiet_while_shortening() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let usual = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if !SHORTENING.get() {
                usual(panic);
            }
        }));
    });
}

/// The inputs of `corpus/NAME`, by the names of their files.
fn stored(name: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(name);
    let entries = std::fs::read_dir(&folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display()));
    let paths: BTreeSet<PathBuf> = entries.map(|entry| entry.expect("a directory entry").path()).collect();
    let read = |path: &PathBuf| {
        let text =
            std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        unhex(&text).unwrap_or_else(|| panic!("{}: no pairs of hexadecimal digits", path.display()))
    };
    assert!(!paths.is_empty(), "{}: it is empty", folder.display());
    paths.iter().map(read).collect()
}

fn number(variable: &str, default: u64) -> u64 {
    let Ok(value) = std::env::var(variable) else { return default };
    value.parse().unwrap_or_else(|_| panic!("{variable}={value}: it must be a number"))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Option<Vec<u8>> {
    let (pairs, rest) = text.trim().as_bytes().as_chunks::<2>();
    let digits = |pair: &[u8; 2]| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok();
    pairs.iter().filter(|_| rest.is_empty()).map(digits).collect::<Option<_>>().filter(|_| rest.is_empty())
}

#[test]
#[should_panic(expected = "corpus/nosuch: No such file or directory")]
fn a_corpus_that_is_missing_is_not_taken_for_an_empty_one() {
    stored("nosuch");
}

#[test]
fn what_fails_is_found_and_made_as_short_as_it_can_be() {
    let target = Target {
        name: "itself",
        seeds: vec![b"some bytes, of which one is changed".to_vec()],
        has_corpus: false,
        mutate: super::mutate::bytes,
        run: |input| {
            assert!(!input.contains(&b'!'), "found");
            Vec::new()
        },
    };
    be_quiet_while_shortening();
    assert_eq!(shortened(&target, b"a needle! in a haystack"), b"!");
    let mut random = Random::new(1);
    let found = (0..100_000).find(|_| {
        let mut input = target.seeds[0].clone();
        (target.mutate)(&mut random, &mut input, b"another");
        SHORTENING.set(true);
        let failed = run(&target, &input).is_err();
        SHORTENING.set(false);
        failed
    });
    assert!(found.is_some());
    assert_eq!(unhex(&hex(b"\x00\xffa")), Some(b"\x00\xffa".to_vec()));
    assert_eq!((unhex("0"), unhex("0g")), (None, None));
}
