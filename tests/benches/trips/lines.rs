//! What a benchmark is asked, and what it answers: a line each.

use std::io::{BufRead, Write};
use std::time::Duration;

use anyhow::{Context, Result};
use serde_json::{Value, json};

/// Two cores, of the one who asks and of the one who answers.
pub type Cores = [usize; 2];

/// Answers every line of standard input with one of JSON; what goes wrong is an answer, too.
pub fn answer_all(answer: impl Fn(&str) -> Result<Value>) -> Result<()> {
    for line in std::io::stdin().lock().lines() {
        let answer = answer(&line?).unwrap_or_else(|why| json!({ "error": format!("{why:#}") }));
        println!("{answer}");
        std::io::stdout().flush()?;
    }
    Ok(())
}

/// The arguments of a program that was started by `cargo bench`, or by itself.
pub fn arguments() -> Vec<String> {
    std::env::args().skip(1).filter(|argument| argument != "--bench").collect()
}

/// Two cores, as `0,1`.
pub fn two(text: &str) -> Result<Cores> {
    let (one, other) = text.split_once(',').context("write cores as 0,1")?;
    Ok([one.parse()?, other.parse()?])
}

/// Of time, with fractions.
pub fn seconds(text: &str) -> Result<Duration> {
    Ok(Duration::try_from_secs_f64(text.parse()?)?)
}
