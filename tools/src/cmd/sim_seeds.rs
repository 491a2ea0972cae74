//! `rtnet sim run FILE.. --seeds A..B`.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, ensure};

use super::delivery::Delivery;
use super::lab_run::NO_MAX_MISS;
use super::{Failure, all_writable, is_same, screen_width};
use crate::cli::SimRunArgs;
use crate::report::junit::{self, Case, Outcome, Suite};
use crate::report::text::{about, grouped};
use crate::report::verdict::Word;
use crate::sim::Options;
use crate::sim::seeds::{self, Run, Seeds, SeedsReport, Subject, Tally};

/// How often progress is shown, and how soon an interruption is seen.
const TICK: Duration = Duration::from_millis(200);

/// Runs each file with each seed, and prints what was worst; the exit status is 1 if a run failed.
pub fn sim_seeds(args: &SimRunArgs, seeds: Seeds) -> Result<u8, Failure> {
    let subjects = subjects(args).map_err(Failure::Usage)?;
    let outputs = [args.json.as_ref(), args.junit.as_ref()];
    args.files.iter().try_for_each(|file| all_writable(&outputs, Some(file))).map_err(Failure::Usage)?;
    let begun = Instant::now();
    let (tallies, interrupted) = run_all(args, seeds, &subjects).map_err(Failure::Run)?;
    let files: Vec<_> = subjects.iter().zip(&tallies).collect();
    let report = SeedsReport::new(seeds, &files, interrupted, |file, seed| command(args, file, seed));
    let text = seeds::render(&report, screen_width()) + "\n" + &last_line(&report, begun.elapsed());
    let (json, junit) = (args.json.as_ref(), args.junit.as_ref());
    let mut delivery = Delivery::begin(&text, &[json, junit]);
    delivery.json(json, &report);
    delivery.text(junit, || {
        let suites: Vec<Suite> =
            tallies.iter().zip(&report.files).map(|(tally, of)| suite(tally, of)).collect();
        junit::render(&format!("rtnet sim run --seeds {seeds}"), &suites)
    });
    delivery.end_with(if interrupted { Word::Interrupted.exit_status() } else { u8::from(report.failed > 0) })
}

fn subjects(args: &SimRunArgs) -> anyhow::Result<Arc<[Subject]>> {
    let files = &args.files;
    for (i, file) in files.iter().enumerate() {
        let is_again = files[..i].iter().any(|other| is_same(file, other));
        ensure!(!is_again, "{} is named twice: its runs would be the same", file.display());
    }
    let load = |file: &PathBuf| {
        let mut subject = Subject::load(file)?;
        if let Some(max_miss_ppm) = args.max_miss {
            ensure!(subject.set_max_miss(max_miss_ppm), "{}: {NO_MAX_MISS}", file.display());
        }
        Ok(subject)
    };
    files.iter().map(load).collect()
}

/// Until all have run, or until it is interrupted: what is known of each file's runs, and whether it was.
fn run_all(args: &SimRunArgs, seeds: Seeds, subjects: &Arc<[Subject]>) -> anyhow::Result<(Vec<Tally>, bool)> {
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, interrupted.clone())?;
    }
    let mut tallies: Vec<Tally> = subjects.iter().map(|subject| Tally::new(subject.rows(), seeds)).collect();
    let options = Options { until: args.until, ..Options::default() };
    let jobs = args.jobs.map_or_else(seeds::usual_jobs, usize::from);
    let all = subjects.len() * seeds.len();
    let place = move |place: usize| (place / seeds.len(), seeds.first() + (place % seeds.len()) as u64);
    let shared = subjects.clone();
    let run = move |at| {
        let (file, seed) = place(at);
        shared[file].run(seed, &options)
    };
    let results = seeds::start(all, jobs, run).context("no run can be started")?;
    let mut shown = Shown::new(all as u64);
    loop {
        match results.recv_timeout(TICK) {
            Ok((at, result)) => {
                let (file, seed) = place(at);
                let run =
                    result.unwrap_or_else(|panic| Run::failed(format!("the simulation panics: {panic}")));
                shown.note(&run);
                tallies[file].note(seed, run);
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        // Runs that have begun end with the process: they write nothing.
        if interrupted.load(Ordering::Relaxed) {
            break;
        }
        shown.show();
    }
    let runs: u64 = tallies.iter().map(Tally::runs).sum();
    let interrupted = interrupted.load(Ordering::Relaxed) && runs < all as u64;
    ensure!(interrupted || runs == all as u64, "only {runs} of {all} runs came to an end");
    Ok((tallies, interrupted))
}

/// How far it is, on a terminal's last line.
struct Shown {
    wanted: bool,
    begun: Instant,
    last: Instant,
    all: u64,
    runs: u64,
    failed: u64,
}

impl Shown {
    fn new(all: u64) -> Self {
        let begun = Instant::now();
        Self { wanted: std::io::stderr().is_terminal(), begun, last: begun, all, runs: 0, failed: 0 }
    }

    fn note(&mut self, run: &Run) {
        self.runs += 1;
        self.failed += u64::from(!run.reasons.is_empty());
    }

    fn show(&mut self) {
        if self.last.elapsed() >= TICK {
            self.last = Instant::now();
            let seconds = self.begun.elapsed().as_secs();
            self.write(&format!("rtnet: {}", seeds::progress(self.runs, self.all, self.failed, seconds)));
        }
    }

    fn write(&self, line: &str) {
        if self.wanted {
            // Whoever closed our standard error does not want to read it.
            let _ = write!(std::io::stderr(), "\r{line}\x1b[K");
        }
    }
}

impl Drop for Shown {
    fn drop(&mut self) {
        self.write("");
    }
}

fn last_line(report: &SeedsReport, took: Duration) -> String {
    let SeedsReport { runs, failed, files, .. } = report;
    let files = if files.len() == 1 { "1 file".to_owned() } else { format!("{} files", files.len()) };
    let all = (report.last_seed - report.first_seed + 1) * report.files.len() as u64;
    let ended =
        if report.interrupted { format!("INTERRUPTED: {} of ", grouped(*runs)) } else { String::new() };
    let verdict = match failed {
        0 => "none failed".to_owned(),
        failed => format!("{} FAILED", grouped(*failed)),
    };
    format!("{ended}{} runs of {files} in {}: {verdict}\n", grouped(all), about(took.as_nanos() as u64))
}

/// What repeats a run.
fn command(args: &SimRunArgs, file: &str, seed: u64) -> String {
    let until = args.until.map_or(String::new(), |until| format!(" --until {until}"));
    let max_miss =
        args.max_miss.map_or(String::new(), |ppm| format!(" --max-miss {}%", f64::from(ppm) / 1e4));
    format!("rtnet sim run {} --seed {seed}{until}{max_miss}", quoted(file))
}

/// As a shell takes it for one word.
fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+,:@%=".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', "'\\''"))
    }
}

fn suite(tally: &Tally, of: &seeds::OfFile) -> Suite {
    let mut failures = of.failures.iter().peekable();
    let mut case = |(seed, has_ended)| {
        let failed = failures.next_if(|failed| failed.seed == seed);
        let outcome = match failed {
            Some(failed) => Outcome::Failed(failed.reasons.clone(), failed.command.clone()),
            None if has_ended => Outcome::Passed,
            None => Outcome::Skipped("interrupted".to_owned()),
        };
        Case { name: format!("seed {seed}"), outcome }
    };
    Suite { name: of.file.clone(), cases: tally.seeds().map(&mut case).collect() }
}

/// The only file: what else is asked for is of one run.
pub fn only(files: &[PathBuf]) -> Result<&Path, Failure> {
    let [file] = files else {
        let why = anyhow!("{} files: only with --seeds several are run, as in --seeds 1..20", files.len());
        return Err(Failure::Usage(why));
    };
    Ok(file)
}
