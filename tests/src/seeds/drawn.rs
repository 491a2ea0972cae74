//! Seeds for a commit. Only `std`: tests of other crates include this file.

use std::process::Command;
use std::sync::OnceLock;

/// Seeds are drawn from 1 to this: of each file of `tests/sim`, `scripts/soak` runs them all.
pub const HIGHEST: u64 = 1_000;
/// The date where there is no git.
const WITHOUT_GIT: &str = "2026-01-01";

/// So many seeds of 1..=[`HIGHEST`] for what this name stands for, drawn from the commit's date: a commit's result never changes.
/// `RTNET_SEED=7` or `RTNET_SEED=1..100` runs those instead.
pub fn drawn(name: &str, count: usize) -> Vec<u64> {
    if let Some(asked) = asked() {
        return asked;
    }
    let date = date();
    let seeds = of_date(date, name, count);
    // Benchmarks answer on standard output.
    eprintln!("SEEDS {name}: {seeds:?}, drawn from {date}");
    seeds
}

/// Those that `RTNET_SEED` asks for.
pub fn asked() -> Option<Vec<u64>> {
    let text = std::env::var("RTNET_SEED").ok()?;
    let (first, last) = text.split_once("..").unwrap_or((&text, &text));
    let seeds: Option<Vec<u64>> =
        first.parse().ok().zip(last.parse().ok()).map(|(a, b): (u64, u64)| (a..=b).collect());
    let seeds = seeds.filter(|seeds| !seeds.is_empty());
    Some(seeds.unwrap_or_else(|| panic!("RTNET_SEED={text}: write one seed or a range, as in 7 or 1..100")))
}

/// The commit's date, as in 2026-11-26.
fn date() -> &'static str {
    static DATE: OnceLock<String> = OnceLock::new();
    DATE.get_or_init(|| {
        let mut git = Command::new("git");
        git.args(["log", "-1", "--format=%cs"]).current_dir(env!("CARGO_MANIFEST_DIR"));
        let date = git.output().ok().filter(|output| output.status.success());
        let date = date.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
        date.filter(|date| !date.is_empty()).unwrap_or_else(|| {
            eprintln!("SEEDS: git tells no commit's date here: drawn from {WITHOUT_GIT}");
            WITHOUT_GIT.to_owned()
        })
    })
}

/// The first different ones of a course of numbers (SplitMix64) that begins at a hash (FNV-1a) of both texts.
fn of_date(date: &str, name: &str, count: usize) -> Vec<u64> {
    assert!(count as u64 <= HIGHEST / 2, "{count} of {HIGHEST} seeds would be no choice");
    let octets = date.bytes().chain([0]).chain(name.bytes());
    let mut state = octets.fold(0xcbf2_9ce4_8422_2325, |hash: u64, octet| {
        (hash ^ u64::from(octet)).wrapping_mul(0x0000_0100_0000_01b3)
    });
    let mut seeds = Vec::new();
    while seeds.len() < count {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (state ^ state >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        let seed = (mixed ^ mixed >> 31) % HIGHEST + 1;
        if !seeds.contains(&seed) {
            seeds.push(seed);
        }
    }
    seeds
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_commit_has_the_same_seeds_and_another_day_has_others() {
        let seeds = of_date("2026-11-26", "a", 20);
        assert_eq!(seeds, of_date("2026-11-26", "a", 20));
        assert_eq!(seeds[..5], of_date("2026-11-26", "a", 5));
        assert_ne!(seeds, of_date("2026-11-27", "a", 20));
        assert_ne!(seeds, of_date("2026-11-26", "b", 20));
        assert!(seeds.iter().all(|seed| (1..=HIGHEST).contains(seed)));
    }

    #[test]
    fn seeds_differ_and_come_from_the_whole_range() {
        let mut seeds = of_date("2026-11-26", "a", 500);
        seeds.sort_unstable();
        seeds.dedup();
        assert_eq!(seeds.len(), 500);
        assert!(seeds[0] < 20 && seeds[499] > HIGHEST - 20, "{} {}", seeds[0], seeds[499]);
    }

    #[test]
    fn the_date_is_one() {
        let digits = date().bytes().filter(u8::is_ascii_digit).count();
        assert_eq!((date().len(), digits), (10, 8), "{}", date());
    }
}
