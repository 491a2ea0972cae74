//! Networks by chance: what must be true of every one of them, whatever its schedule, clocks, hosts and faults.
//!
//! `RTNET_CASES=10000` runs so many, `RTNET_SEED=7` the one of a seed. Seeds that once found something are in
//! `seeds.txt`, and run first.

use std::panic::{AssertUnwindSafe, catch_unwind};

use tests::chance::Case;
use tests::course::Account;

const SEEDS: &str = include_str!("seeds.txt");
/// Cases that are run unless asked otherwise: some seconds.
const CASES: u64 = 2_000;
/// After so many that failed there is enough to look at.
const MOST_FAILURES: usize = 10;

fn number(variable: &str) -> Option<u64> {
    let value = std::env::var(variable).ok()?;
    Some(value.parse().unwrap_or_else(|_| panic!("{variable}={value}: it must be a number")))
}

/// Seeds that are known, one a line, behind which anything may be said of it.
fn known() -> impl Iterator<Item = u64> {
    let lines = SEEDS.lines().filter(|line| !line.starts_with('#') && !line.is_empty());
    lines.map(|line| line.split(' ').next().and_then(|seed| seed.parse().ok()).expect("a seed"))
}

fn run(seed: u64) -> Result<Account, String> {
    catch_unwind(AssertUnwindSafe(|| Case::of(seed).run())).unwrap_or_else(|_| Err("it panics".into()))
}

#[test]
fn networks_by_chance_overlap_for_a_cause_only_and_settle_in_time() {
    let seeds: Vec<u64> = match number("RTNET_SEED") {
        Some(seed) => vec![seed],
        None => known().chain(0..number("RTNET_CASES").unwrap_or(CASES)).collect(),
    };
    let (mut total, mut failed) = (Account::default(), Vec::new());
    for &seed in &seeds {
        match run(seed) {
            Ok(account) => total = total.with(account),
            Err(why) => {
                println!("seed {seed}: {why}\n  RTNET_SEED={seed} cargo test --workspace --test property");
                failed.push(seed);
            }
        }
        if failed.len() == MOST_FAILURES {
            break;
        }
    }
    println!("FIGURE networks_by_chance: {} networks: {total}", seeds.len());
    assert!(failed.is_empty(), "seeds that failed: {failed:?}");
}
