//! `rtnet ping`.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde::Serialize;

use super::Failure;
use super::interface::{asked, unasked};
use super::tdma::found;
use crate::cli::{PingArgs, Which};
use crate::control::{EchoRequest, EchoShown, StackReply, StackRequest};
use crate::report::text::micros;

/// How often to look for answers, and how long for those to the last questions: as long as RTnet's.
const LOOK_EVERY: Duration = Duration::from_millis(2);
const LAST_WITHIN: Duration = Duration::from_millis(500);

/// What came of a round of questions.
#[derive(Debug, Serialize)]
struct Round {
    to: Ipv4Addr,
    sent: u64,
    received: u64,
    lost: u64,
    loss: f64,
    /// From asking until the answer came.
    round_trip_ns: Option<Spread>,
    /// How much of it the question waited for its slot.
    waited_ns: Option<Spread>,
    /// The rest: on the way, and at the other station.
    rest_ns: Option<Spread>,
    answers: Vec<Answer>,
}

#[derive(Clone, Copy, Debug, Serialize)]
struct Answer {
    sequence: u16,
    bytes: usize,
    round_trip_ns: Option<u64>,
    waited_ns: Option<u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
struct Spread {
    min: u64,
    p50: u64,
    p99: u64,
    max: u64,
}

impl Spread {
    fn of(mut values: Vec<u64>) -> Option<Self> {
        values.sort_unstable();
        let at =
            |part: f64| values[((values.len() as f64 * part).ceil() as usize).clamp(1, values.len()) - 1];
        (!values.is_empty()).then(|| Self { min: at(0.0), p50: at(0.5), p99: at(0.99), max: at(1.0) })
    }
}

/// Asks a station for echoes.
pub fn ping(args: &PingArgs) -> Result<u8, Failure> {
    let which = &found(&args.which)?;
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, stop.clone())
        .map_err(|error| Failure::Run(error.into()))?;
    let mut run = Run { which, args, identifier: identifier(), open: BTreeMap::new(), answers: Vec::new() };
    let interval = Duration::from_nanos(args.interval.nanos().unsigned_abs());
    let (begun, mut sent) = (Instant::now(), 0);
    while !stop.load(Ordering::Relaxed) && args.count.is_none_or(|count| sent < count) {
        sent += 1;
        run.ask(sent as u16)?;
        let next = begun + interval * u32::try_from(sent).unwrap_or(u32::MAX);
        let is_last = args.count == Some(sent);
        let until = if is_last { Instant::now() + LAST_WITHIN } else { next };
        run.listen(until, is_last, &stop)?;
    }
    let round = run.round(sent);
    super::print(which.json, &round, summary).map_err(Failure::Run)?;
    Ok(u8::from(round.received == 0))
}

/// A round under way.
struct Run<'a> {
    which: &'a Which,
    args: &'a PingArgs,
    identifier: u16,
    /// Questions without an answer, and when they were asked.
    open: BTreeMap<u16, u64>,
    answers: Vec<Answer>,
}

impl Run<'_> {
    fn ask(&mut self, sequence: u16) -> Result<(), Failure> {
        let &PingArgs { ip: to, size, priority, channel, .. } = self.args;
        let (identifier, size) = (self.identifier, size.into());
        let echo = EchoRequest { to, identifier, sequence, size, priority, channel };
        match asked(self.which, StackRequest::Echo(echo)).map_err(|error| Failure::Run(into_error(error)))? {
            StackReply::Asked(at) => {
                self.open.insert(sequence, at);
                Ok(())
            }
            _ => Err(unasked(self.which)),
        }
    }

    /// Takes answers until then; or, for the last question, until all are there.
    fn listen(&mut self, until: Instant, is_last: bool, stop: &AtomicBool) -> Result<(), Failure> {
        loop {
            self.look()?;
            let left = until.saturating_duration_since(Instant::now());
            let done = is_last && self.open.is_empty();
            if left.is_zero() || done || stop.load(Ordering::Relaxed) {
                return Ok(());
            }
            // While no answer is due, nobody is asked for one.
            std::thread::sleep(if self.open.is_empty() {
                left.min(LAST_WITHIN)
            } else {
                left.min(LOOK_EVERY)
            });
        }
    }

    fn look(&mut self) -> Result<(), Failure> {
        let StackReply::Echoes(echoes) = asked(self.which, StackRequest::Echoes)? else {
            return Err(unasked(self.which));
        };
        for echo in echoes.iter().filter(|echo| echo.identifier == self.identifier) {
            let Some(asked) = self.open.remove(&echo.sequence) else { continue };
            let answer = answer(echo, asked);
            if !self.which.json {
                super::say(&line(echo.from, &answer)).map_err(Failure::Run)?;
            }
            self.answers.push(answer);
        }
        Ok(())
    }

    fn round(self, sent: u64) -> Round {
        let answers = self.answers;
        let received = answers.len() as u64;
        let spread = |of: fn(&Answer) -> Option<u64>| Spread::of(answers.iter().filter_map(of).collect());
        Round {
            to: self.args.ip,
            sent,
            received,
            lost: sent - received,
            loss: if sent == 0 { 0.0 } else { (sent - received) as f64 / sent as f64 },
            round_trip_ns: spread(|answer| answer.round_trip_ns),
            waited_ns: spread(|answer| answer.waited_ns),
            rest_ns: spread(|answer| answer.round_trip_ns?.checked_sub(answer.waited_ns?)),
            answers,
        }
    }
}

fn into_error(failure: Failure) -> anyhow::Error {
    match failure {
        Failure::Usage(error) | Failure::Run(error) => error,
    }
}

/// As RTnet's: of the start in microseconds.
fn identifier() -> u16 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    since.as_micros() as u16
}

fn answer(echo: &EchoShown, asked: u64) -> Answer {
    let since = |at: Option<u64>| at.map(|at| at.saturating_sub(asked));
    let (round_trip_ns, waited_ns) = (since(echo.came), since(echo.left));
    Answer { sequence: echo.sequence, bytes: echo.size, round_trip_ns, waited_ns }
}

fn line(from: Ipv4Addr, answer: &Answer) -> String {
    let us = |ns: Option<u64>| ns.map_or("?".into(), |ns| micros(ns as i64));
    let (all, waited) = (us(answer.round_trip_ns), us(answer.waited_ns));
    format!(
        "{} bytes from {from}: seq={} time={all} us, of which {waited} waiting for the slot\n",
        answer.bytes, answer.sequence
    )
}

fn summary(round: &Round) -> String {
    let Round { to, sent, received, loss, .. } = round;
    let mut text = format!("{to}: {sent} sent, {received} came back, {:.1} % lost\n", loss * 100.0);
    for (what, spread) in [
        ("round trip", round.round_trip_ns),
        ("waiting for the slot", round.waited_ns),
        ("on the way and at the other station", round.rest_ns),
    ] {
        let Some(Spread { min, p50, p99, max }) = spread else { continue };
        let [min, p50, p99, max] = [min, p50, p99, max].map(|ns| micros(ns as i64));
        text += &format!("{what}: min {min}, p50 {p50}, p99 {p99}, max {max} us\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_is_of_values_that_occurred() {
        assert_eq!(Spread::of(Vec::new()), None);
        let all = Spread::of((1..=200).rev().collect());
        assert_eq!(all, Some(Spread { min: 1, p50: 100, p99: 198, max: 200 }));
        assert_eq!(Spread::of(vec![7]), Some(Spread { min: 7, p50: 7, p99: 7, max: 7 }));
    }
}
