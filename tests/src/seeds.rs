//! With which seeds a test runs, and how it tells of those that fail.

mod drawn;

use std::any::type_name;

use tools::sim::seeds::{start, usual_jobs};

pub use drawn::{HIGHEST, asked, drawn};

/// Each seed with which a test failed once.
const KEPT: &str = include_str!("seeds/kept.txt");

/// Runs a test's closure, which asserts, on all CPUs: with `count` seeds drawn from the commit's date, and with its seeds of
/// `seeds/kept.txt`.
#[track_caller]
pub fn each<F: Fn(u64) + Send + Sync + 'static>(count: usize, test: F) {
    // `sim::holdover::in_holdover_...::{{closure}}`
    let path = type_name::<F>().trim_end_matches("::{{closure}}");
    let (binary, name) = path.split_once("::").unwrap_or((path, path));
    let run = move |seed| {
        test(seed);
        Ok(())
    };
    let command = |seed| format!("RTNET_SEED={seed} cargo test --workspace --test {binary} {name}");
    let mut seeds = drawn(path, count);
    if asked().is_none() {
        seeds.extend(kept(name));
    }
    hold(&seeds, run, command);
}

/// One seed, drawn from the commit's date.
pub fn one(name: &str) -> u64 {
    drawn(name, 1)[0]
}

/// So many seeds in a row, from a drawn one on.
pub fn in_a_row(name: &str, count: u64) -> Vec<u64> {
    asked().unwrap_or_else(|| {
        let first = one(name);
        (first..first + count).collect()
    })
}

/// The seeds with which this test failed once, as `seeds/kept.txt` keeps them.
pub fn kept(test: &str) -> Vec<u64> {
    kept_in(KEPT, test).unwrap_or_else(|why| panic!("tests/src/seeds/kept.txt: {why}"))
}

fn kept_in(text: &str, test: &str) -> Result<Vec<u64>, String> {
    let mut seeds = Vec::new();
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let (of, seed) = line.split_once(' ').ok_or_else(|| format!("'{line}': write TEST SEED"))?;
        let seed: u64 = seed.parse().map_err(|_| format!("'{line}': '{seed}' is no seed"))?;
        seeds.extend((of == test).then_some(seed));
    }
    Ok(seeds)
}

/// Runs on all CPUs with each of these seeds; if some fail or panic, panics with the reasons and the command that repeats each.
#[track_caller]
pub fn hold(
    seeds: &[u64],
    run: impl Fn(u64) -> Result<(), String> + Send + Sync + 'static,
    command: impl Fn(u64) -> String,
) {
    let failed = failures(seeds, run);
    let told: Vec<String> =
        failed.iter().map(|(seed, why)| format!("seed {seed}: {why}\n  $ {}\n", command(*seed))).collect();
    assert!(failed.is_empty(), "{} of {} seeds fail\n{}", failed.len(), seeds.len(), told.concat());
}

/// Those of the seeds that fail, and why.
fn failures(
    seeds: &[u64],
    run: impl Fn(u64) -> Result<(), String> + Send + Sync + 'static,
) -> Vec<(u64, String)> {
    let of_runs = seeds.to_vec();
    let runs = start(seeds.len(), usual_jobs(), move |place| run(of_runs[place])).expect("a thread");
    let mut outcomes: Vec<_> = runs.into_iter().collect();
    assert_eq!(outcomes.len(), seeds.len(), "all came to an end");
    outcomes.sort_by_key(|(place, _)| *place);
    let failed = |(place, outcome): (usize, Result<Result<(), String>, String>)| {
        let why = outcome.and_then(|outcome| outcome).err()?;
        Some((seeds[place], why))
    };
    outcomes.into_iter().filter_map(failed).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_test_has_the_seeds_that_are_kept_of_it() {
        let text = "# TEST SEED\nlate::a 3\nearly::a 5\nlate::a 7\n";
        assert_eq!(kept_in(text, "late::a"), Ok(vec![3, 7]));
        assert_eq!(kept_in(text, "late"), Ok(vec![]));
        assert_eq!(kept_in("late::a x", "early::a"), Err("'late::a x': 'x' is no seed".into()));
        assert_eq!(kept_in("late::a", "late::a"), Err("'late::a': write TEST SEED".into()));
        assert!(kept("").is_empty(), "and the file can be read");
    }

    #[test]
    fn a_seed_that_fails_or_panics_is_named_with_its_reason() {
        let run = |seed| match seed {
            3 => Err("it is odd".to_owned()),
            5 => panic!("it breaks"),
            _ => Ok(()),
        };
        let failed = failures(&[1, 3, 4, 5], run);
        assert_eq!(failed.len(), 2);
        assert_eq!(failed[0], (3, "it is odd".to_owned()));
        assert!(failed[1].0 == 5 && failed[1].1.ends_with("it breaks"), "{failed:?}");
    }

    #[test]
    #[should_panic(expected = "1 of 2 seeds fail\nseed 8: no\n  $ try 8\n")]
    fn a_command_repeats_each_seed_that_failed() {
        let run = |seed| if seed == 8 { Err("no".to_owned()) } else { Ok(()) };
        hold(&[7, 8], run, |seed| format!("try {seed}"));
    }
}
