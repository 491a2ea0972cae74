//! `rtnet package bench`: what a way to a mailbox takes.

mod scheduled;
mod shown;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use package_router::body;
use package_router::component::{Component, SendError};
use package_router::wire::Head;
use rtnet::live::clock::monotonic;

use super::check_size;
use super::counts::{COUNT, COUNTED, Counted};
use super::way::{REST, Told, Way, lacks_room};
use crate::cli::{BenchArgs, WhichOf, duration};
use crate::cmd::Failure;
use crate::cmd::tdma::found_of;
use crate::report::histogram::SignedHistogram;
use scheduled::Scheduled;
use shown::{Long, Stream, Trips};

/// Of a question.
const ASKS: i8 = 1;
/// Of a package that nobody answers.
const DATA: i8 = -6;
/// Multiples of the golden ratio, their whole parts left out, lie as far apart as can be, however many there are.
const GOLDEN: f64 = 0.618_033_988_749_894_9;
/// Who finds no room tries again at once so often, which is enough where who reads has another core, and then sleeps.
const AT_ONCE: u32 = 100;
/// Round trips that are shown with when they were asked for.
const LONGEST: usize = 10;
/// How often it is asked how many have come.
const ASKED_AT_MOST: u32 = 3;
/// How long it is waited at the most until what was sent has left: who sends one package a turn has thousands to send then.
const LEFT_WITHIN: Duration = Duration::from_secs(60);

/// Measures a way, and shows what came of it.
pub(super) fn bench(component: &Component, which: &WhichOf, args: &BenchArgs) -> Result<u8, Failure> {
    check_size(args.size)?;
    let which = found_of(which)?;
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, stop.clone())
        .map_err(|error| Failure::Run(error.into()))?;
    // Answers are as long as their questions, but for the one that tells how many came.
    let way = Way::of(component, args.from, args.to, args.size.max(body::len::<Counted>()))?;
    let mut scheduled = Scheduled::of(&which, &way.sender);
    let mut bench = Bench { way, args, stop, timeout: duration(args.timeout) };
    if args.stream {
        let mut stream = bench.stream()?;
        if let Some(scheduled) = &mut scheduled {
            scheduled.end(&SignedHistogram::new());
            stream.turns = scheduled.turns(args.size, stream.took_ns);
        }
        stream.scheduled = scheduled;
        crate::cmd::print(which.json, &stream, Stream::describe).map_err(Failure::Run)?;
        return Ok(u8::from(stream.came.is_none_or(|came| came == 0)));
    }
    let (mut trips, times) = bench.trips()?;
    if let Some(scheduled) = &mut scheduled {
        scheduled.end(&times);
    }
    trips.scheduled = scheduled;
    crate::cmd::print(which.json, &trips, Trips::describe).map_err(Failure::Run)?;
    Ok(u8::from(trips.came == 0))
}

struct Bench<'a> {
    way: Way,
    args: &'a BenchArgs,
    stop: Arc<AtomicBool>,
    timeout: Duration,
}

impl Bench<'_> {
    fn is_over(&self, begun: Instant) -> bool {
        begun.elapsed() >= duration(self.args.time) || self.stop.load(Ordering::Relaxed)
    }

    /// One question after the other.
    fn trips(&mut self) -> Result<(Trips, SignedHistogram), Failure> {
        let body = vec![0x55; self.args.size];
        self.way.ask(ASKS, &body, self.timeout)?;
        let (mut asked, mut times, mut longest) = (0u64, SignedHistogram::new(), Vec::<Long>::new());
        let begun = Instant::now();
        while !self.is_over(begun) {
            let pause = duration(self.args.pause).mul_f64((asked as f64 * GOLDEN).fract());
            if !pause.is_zero() {
                std::thread::sleep(pause);
            }
            asked += 1;
            let asked_at_ns = monotonic();
            if let Some(Told { took, .. }) = self.way.ask(ASKS, &body, self.timeout)? {
                let took_ns = took.as_nanos() as u64;
                times.record(took_ns as i64);
                note(&mut longest, Long { took_ns, asked_at_ns });
            }
        }
        let trips = Trips {
            to: self.args.to.to_string(),
            bytes: self.args.size,
            asked,
            came: times.len(),
            lost: asked - times.len(),
            took_ns: begun.elapsed().as_nanos() as u64,
            round_trip_ns: times.summary().with_gaps(asked - times.len()),
            longest,
            scheduled: None,
        };
        Ok((trips, times))
    }

    /// As many as the way takes.
    fn stream(&mut self) -> Result<Stream, Failure> {
        let body = vec![0x55; self.args.size];
        self.way.ask(COUNT, &[], self.timeout)?;
        let mut stream = Stream::of(self.args);
        let (begun, mut in_vain) = (Instant::now(), 0);
        let head = Head { kind: DATA, priority: self.way.sender.priority(), ..Head::default() };
        while !self.is_over(begun) {
            match self.way.sender.send_with(&head, &body) {
                Ok(()) => {
                    stream.sent += 1;
                    in_vain = 0;
                    continue;
                }
                Err(error) if lacks_room(&error) => match error {
                    SendError::Mailbox(_) => stream.full += 1,
                    _ => stream.no_buffers += 1,
                },
                Err(error) => return Err(self.way.failed(&error)),
            }
            in_vain += 1;
            match in_vain < AT_ONCE {
                true => std::hint::spin_loop(),
                false => std::thread::sleep(REST),
            }
        }
        stream.sent_for_ns = begun.elapsed().as_nanos() as u64;
        stream.all_left = self.has_left()?;
        if !stream.all_left {
            return Ok(stream);
        }
        if let Some(Counted { packages, bytes: _, took }) = self.counted()? {
            (stream.came, stream.took_ns) = (Some(packages), Some(took));
            stream.lost = Some(stream.sent.saturating_sub(packages));
        }
        Ok(stream)
    }

    /// Whether all that was sent has been taken by the station, which is waited for as long as it takes any.
    fn has_left(&self) -> Result<bool, Failure> {
        let (begun, mut taken) = (Instant::now(), None);
        while let Err(error) = self.way.sender.drained() {
            if error != SendError::Station(Errno::ETIMEDOUT as i32) {
                return Err(self.way.failed(&error));
            }
            let now = self.way.sender.taken();
            let is_stuck = taken.replace(now) == Some(now);
            if is_stuck || begun.elapsed() >= LEFT_WITHIN || self.stop.load(Ordering::Relaxed) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// How many came, once those that were sent have had their turns: the question is behind them.
    fn counted(&mut self) -> Result<Option<Counted>, Failure> {
        for _ in 0..ASKED_AT_MOST {
            if let Some(Told { head, body, .. }) = self.way.ask(COUNTED, &[], self.timeout)? {
                return Ok(body::read(&body, head.body_order).ok());
            }
        }
        Ok(None)
    }
}

/// Keeps the longest, longest first.
fn note(longest: &mut Vec<Long>, trip: Long) {
    if longest.len() == LONGEST && longest.last().is_some_and(|least| trip.took_ns <= least.took_ns) {
        return;
    }
    let place = longest.partition_point(|longer| longer.took_ns >= trip.took_ns);
    longest.insert(place, trip);
    longest.truncate(LONGEST);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_are_kept_with_when_they_were_asked_for_longest_first() {
        let mut longest = Vec::new();
        for n in 0..100u64 {
            let took_ns = n * 37 % 100;
            note(&mut longest, Long { took_ns, asked_at_ns: n });
        }
        let took: Vec<_> = longest.iter().map(|trip| trip.took_ns).collect();
        assert_eq!(took, (90..100).rev().collect::<Vec<_>>());
        assert!(longest.iter().all(|trip| trip.asked_at_ns * 37 % 100 == trip.took_ns));
    }
}
