//! `rtnet ping`.

pub(super) mod plan;

use std::collections::{BTreeMap, VecDeque};
use std::net::Ipv4Addr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use rtnet::api::place::is_served;
use serde::Serialize;

use super::Failure;
use super::interface::{asked, of_interface, unasked, with_place};
use super::tdma::found;
use crate::cli::{PingArgs, Which};
use crate::control::{Directory, EchoRequest, EchoShown, EchoesShown, Place, StackReply, StackRequest};
use crate::report::document::document;
use crate::report::text::micros;
use plan::Plan;

/// How often to look for answers, and how long after a question: as long as RTnet's.
const LOOK_EVERY: Duration = Duration::from_millis(2);
const DUE_WITHIN: Duration = Duration::from_millis(500);
/// How long an answer that comes later than that is still taken for what it is: slots may be seconds away.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(10);
/// Stations tell what they have missed twenty times a second.
const TOLD_WITHIN: Duration = Duration::from_millis(100);
/// Answers that are remembered, the newest: whoever asks for days has figures of the last hours.
const ANSWERS_AT_MOST: usize = 100_000;
/// Reasons why questions fail that are told apart.
const REASONS_AT_MOST: usize = 16;
/// Why questions wait at a station that could send.
const SLOT_NOT_COME: &str = "their slot has not come yet, or was removed (`rtnet slot list`)";
/// Multiples of the golden ratio, their whole parts left out, lie as far apart as can be, however many there are.
const GOLDEN: f64 = 0.618_033_988_749_894_9;

/// What came of a round of questions.
#[derive(Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct Round {
    /// The address that was asked.
    to: Ipv4Addr,
    /// Questions that the station took.
    sent: u64,
    /// Answers.
    received: u64,
    /// Questions that could not be asked, and why.
    failed: u64,
    /// Why they could not be asked, and how often.
    failures: BTreeMap<String, u64>,
    /// Questions that the station took, without an answer.
    lost: u64,
    /// Their share of those that the station took.
    loss: f64,
    /// Of all, questions that had not left by the end, or for which those had taken the room.
    never_left: u64,
    /// Why, as far as the station knows.
    #[serde(skip_serializing_if = "Option::is_none")]
    why_never_left: Option<String>,
    /// From asking until the answer came.
    round_trip_ns: Option<Spread>,
    /// How much of it the question waited for its slot, unless it needed none.
    #[serde(skip_serializing_if = "Option::is_none")]
    waited_ns: Option<Spread>,
    /// The rest: on the way, and at the other station.
    #[serde(skip_serializing_if = "Option::is_none")]
    rest_ns: Option<Spread>,
    /// What the schedule says of it, in a lab.
    schedule: Option<Scheduled>,
    /// The newest, if there are more than can be remembered.
    answers: VecDeque<Answer>,
}

document!(Round, "ping", ping_has_its_schema);

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct Answer {
    /// The number of its question.
    sequence: u16,
    /// Length of the echo's data.
    bytes: usize,
    /// From asking until the answer came.
    round_trip_ns: Option<u64>,
    /// How much of it the question waited for its slot.
    #[serde(skip_serializing_if = "Option::is_none")]
    waited_ns: Option<u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct Spread {
    /// The shortest, nanoseconds.
    min: u64,
    /// Median.
    p50: u64,
    /// 99th percentile.
    p99: u64,
    /// The longest.
    max: u64,
    /// Of so many answers.
    n: u64,
    /// Questions of which there is no such time: they were not asked, or lost, or are no longer remembered.
    gaps: u64,
}

/// A round beside what its stations' slots say.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct Scheduled {
    /// The shortest round trip that the slots of both allow.
    best_ns: u64,
    /// The longest.
    worst_ns: u64,
    /// A frame is chosen by so much before its slot at the most: chosen later, both are quicker.
    lead_ns: u64,
    /// By how much 19 of 20 rests are beside their middle at the most: what is no waiting for the slot takes always the
    /// same time by the schedule.
    jitter_ns: u64,
    /// Round trips quicker than the best by more than lead and jitter.
    quicker: u64,
    /// Round trips longer than the worst and the jitter.
    longer: u64,
    /// Slots that the two have missed meanwhile: each may be the reason of one of those.
    slots_missed: u64,
}

impl Spread {
    fn of(mut values: Vec<u64>, tried: u64) -> Option<Self> {
        values.sort_unstable();
        (!values.is_empty()).then(|| Self {
            min: at(&values, 0.0),
            p50: at(&values, 0.5),
            p99: at(&values, 0.99),
            max: at(&values, 1.0),
            n: values.len() as u64,
            gaps: tried.saturating_sub(values.len() as u64),
        })
    }
}

/// The value below which such a part lies, of some in order.
fn at(values: &[u64], part: f64) -> u64 {
    values[((values.len() as f64 * part).ceil() as usize).clamp(1, values.len()) - 1]
}

/// Asks a station for echoes.
pub fn ping(args: &PingArgs) -> Result<u8, Failure> {
    let which = &found(&args.which)?;
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, stop.clone())
        .map_err(|error| Failure::Run(error.into()))?;
    let own = of_interface(which)?;
    let plan = Plan::of(which, args.ip, args.channel);
    plan.check(which, args, &own)?;
    let mut run = Run::new(which, args);
    let mut begun = Instant::now();
    while !stop.load(Ordering::Relaxed) && args.count.is_none_or(|count| run.tried < count) {
        let moment = begun + due(run.tried, args, plan.cycle);
        run.listen(moment, &stop, |_| false)?;
        if stop.load(Ordering::Relaxed) {
            break;
        }
        run.ask()?;
        begun += held_up(moment.elapsed(), args, plan.cycle);
    }
    run.listen(Instant::now() + DUE_WITHIN, &stop, |run| !run.is_due(Instant::now()))?;
    // Without slots whatever is sent leaves.
    let left = if own.discipline == "tdma" { run.left() } else { None };
    let schedule = plan.wait().map(|wait| {
        std::thread::sleep(TOLD_WITHIN);
        let said = [wait.best, wait.worst, plan.lead];
        run.beside(said.map(|span| span.nanos().unsigned_abs()), plan.missed())
    });
    let (tried, has_gone) = (run.tried, run.has_gone);
    let round = run.round(left, schedule);
    super::print(which.json, &round, |round| summary(&which.place, round)).map_err(Failure::Run)?;
    Ok(u8::from(round.received == 0 || has_gone && round.received < tried))
}

/// When a question is asked, from the begin on. Where there is a cycle they are spread over it: all asked in the same
/// moment of a cycle would wait equally long for their slot, and show neither the best case nor the worst.
fn due(question: u64, args: &PingArgs, cycle: Option<Duration>) -> Duration {
    let interval = Duration::from_nanos(args.interval.nanos().unsigned_abs());
    let spread = cycle.map_or(Duration::ZERO, |cycle| cycle.mul_f64((question as f64 * GOLDEN).fract()));
    let whole = interval.as_nanos().saturating_mul(question.into());
    Duration::from_nanos(u64::try_from(whole).unwrap_or(u64::MAX / 2)) + spread
}

/// By how much all later questions are put off after one that was so late: on a busy host it, too, waits to run. Several that
/// are asked at once wait for each other's slots, not only for their own.
fn held_up(late: Duration, args: &PingArgs, cycle: Option<Duration>) -> Duration {
    let interval = Duration::from_nanos(args.interval.nanos().unsigned_abs());
    // Two that follow each other are so far apart in a cycle that this brings them to the same slot seldom.
    let at_most = cycle.unwrap_or(interval).min(interval) / 4;
    if late > at_most { late } else { Duration::ZERO }
}

/// A round under way.
struct Run<'a> {
    which: &'a Which,
    args: &'a PingArgs,
    identifier: u16,
    /// Questions so far, also those that could not be asked.
    tried: u64,
    received: u64,
    /// Whether the station was not there at a time.
    has_gone: bool,
    failures: BTreeMap<String, u64>,
    /// Those that failed since others before them had not left.
    behind: u64,
    /// Why nothing left when a question last waited for that, and whether it is so still.
    silent: Option<(String, bool)>,
    /// Questions without an answer.
    open: BTreeMap<u16, Open>,
    answers: VecDeque<Answer>,
}

/// When a question was asked: by the station's clock, and by ours.
struct Open {
    asked: u64,
    since: Instant,
}

impl<'a> Run<'a> {
    fn new(which: &'a Which, args: &'a PingArgs) -> Self {
        let (failures, open, answers) = Default::default();
        let (identifier, tried, received, behind, silent) = (identifier(), 0, 0, 0, None);
        let has_gone = false;
        Self { which, args, identifier, tried, received, has_gone, failures, behind, silent, open, answers }
    }

    /// Asks the next question. Where not even the first can be asked, there is nothing to be measured.
    fn ask(&mut self) -> Result<(), Failure> {
        let &PingArgs { ip: to, size, priority, channel, .. } = self.args;
        let (identifier, sequence, size) = (self.identifier, (self.tried + 1) as u16, size.into());
        let echo = EchoRequest { to, identifier, sequence, size, priority, channel };
        match asked(self.which, StackRequest::Echo(echo)) {
            Ok(StackReply::Asked(at)) => {
                self.tried += 1;
                self.open.insert(sequence, Open { asked: at, since: Instant::now() });
                Ok(())
            }
            Ok(_) => Err(unasked(self.which)),
            Err(error) if self.tried == 0 => Err(error),
            Err(error) => {
                self.tried += 1;
                self.look_for_station();
                self.fails(sequence, &format!("{:#}", error.into_error()))
            }
        }
    }

    /// One that is stopped, or has too much to do, is there.
    fn look_for_station(&mut self) {
        let is_there = |directory: Directory| is_served(&directory.station(&self.which.place));
        self.has_gone |= !Directory::of_user().is_ok_and(is_there);
    }

    fn fails(&mut self, sequence: u16, why: &str) -> Result<(), Failure> {
        let why = &with_place(self.which, why);
        if !self.which.json {
            super::say(&format!("seq={sequence} was not asked: {why}\n")).map_err(Failure::Run)?;
        }
        let is_known = self.failures.contains_key(why) || self.failures.len() < REASONS_AT_MOST;
        *self.failures.entry(if is_known { why } else { "another reason" }.to_owned()).or_default() += 1;
        Ok(())
    }

    /// Takes answers until then, or until it is done.
    fn listen(
        &mut self,
        until: Instant,
        stop: &AtomicBool,
        is_done: impl Fn(&Self) -> bool,
    ) -> Result<(), Failure> {
        loop {
            self.forget(Instant::now());
            if !self.open.is_empty() {
                self.look()?;
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() || is_done(self) || stop.load(Ordering::Relaxed) {
                return Ok(());
            }
            // While no answer is due, nobody is asked for one; but what is late is not lost yet.
            let pause = if self.is_due(Instant::now()) { LOOK_EVERY } else { DUE_WITHIN };
            std::thread::sleep(left.min(pause));
        }
    }

    /// Whether an answer may come now that is not late.
    fn is_due(&self, now: Instant) -> bool {
        self.open.values().any(|open| now < open.since + DUE_WITHIN)
    }

    fn forget(&mut self, now: Instant) {
        self.open.retain(|_, open| now < open.since + FORGOTTEN_AFTER);
    }

    fn look(&mut self) -> Result<(), Failure> {
        let EchoesShown { came, failed, silent } =
            match asked(self.which, StackRequest::Echoes(self.identifier)) {
                Ok(StackReply::Echoes(echoes)) => echoes,
                Ok(_) => return Err(unasked(self.which)),
                // Who does not answer now may do so the next time; its questions count as lost.
                Err(_) => {
                    self.look_for_station();
                    return Ok(());
                }
            };
        for failed in failed {
            if self.open.remove(&failed.sequence).is_some() {
                self.behind += u64::from(failed.is_behind);
                let why = failed.why;
                let why = match silent.as_ref().filter(|_| failed.is_behind) {
                    Some(silent) => format!("{why}: {silent}"),
                    None => why,
                };
                self.fails(failed.sequence, &why)?;
            }
        }
        let before = || self.silent.take().map(|(why, _)| (why, false));
        self.silent = silent.map(|why| (why, true)).or_else(before);
        for echo in came {
            let Some(Open { asked, .. }) = self.open.remove(&echo.sequence) else { continue };
            let answer = answer(&echo, asked);
            if !self.which.json {
                super::say(&line(echo.from, &answer)).map_err(Failure::Run)?;
            }
            self.received += 1;
            if self.answers.len() == ANSWERS_AT_MOST {
                self.answers.pop_front();
            }
            self.answers.push_back(answer);
        }
        Ok(())
    }

    /// How many questions have left, where that is the question.
    fn left(&self) -> Option<u64> {
        if self.open.is_empty() && self.behind == 0 {
            return None;
        }
        match asked(self.which, StackRequest::EchoesLeft(self.identifier)) {
            Ok(StackReply::EchoesLeft(left)) => Some(left),
            // One that is gone, or of another version: nobody knows.
            _ => None,
        }
    }

    /// What the schedule says, for frames that are chosen by such a lead, and how much of it is otherwise.
    fn beside(&self, [best_ns, worst_ns, lead_ns]: [u64; 3], slots_missed: u64) -> Scheduled {
        let jitter_ns = jitter(self.answers.iter().filter_map(Answer::rest).collect());
        let trips = || self.answers.iter().filter_map(|answer| answer.round_trip_ns);
        let quicker = trips().filter(|&trip| trip + lead_ns + jitter_ns < best_ns).count() as u64;
        let longer = trips().filter(|&trip| trip > worst_ns + jitter_ns).count() as u64;
        Scheduled { best_ns, worst_ns, lead_ns, jitter_ns, quicker, longer, slots_missed }
    }

    fn round(self, left: Option<u64>, schedule: Option<Scheduled>) -> Round {
        let Self { tried, received, failures, behind, silent, answers, .. } = self;
        let failed = failures.values().sum();
        let sent = tried.saturating_sub(failed);
        let lost = sent.saturating_sub(received);
        let never_left = left.map_or(0, |left| behind + sent.saturating_sub(left).min(lost));
        let why_never_left = (never_left > 0).then(|| {
            let why = match silent {
                Some((why, true)) => why,
                Some((why, false)) => format!("for a while nothing did: {why}"),
                None => SLOT_NOT_COME.into(),
            };
            with_place(self.which, &why)
        });
        let spread =
            |of: fn(&Answer) -> Option<u64>| Spread::of(answers.iter().filter_map(of).collect(), tried);
        Round {
            to: self.args.ip,
            sent,
            received,
            failed,
            failures,
            lost,
            loss: if sent == 0 { 0.0 } else { lost as f64 / sent as f64 },
            never_left,
            why_never_left,
            round_trip_ns: spread(|answer| answer.round_trip_ns),
            waited_ns: spread(|answer| answer.waited_ns),
            rest_ns: spread(Answer::rest),
            schedule,
            answers,
        }
    }
}

impl Answer {
    /// What is no waiting for the slot.
    fn rest(&self) -> Option<u64> {
        self.round_trip_ns?.checked_sub(self.waited_ns?)
    }
}

/// By how much 19 of 20 are beside their middle at the most.
fn jitter(mut values: Vec<u64>) -> u64 {
    values.sort_unstable();
    let Some(middle) = (!values.is_empty()).then(|| at(&values, 0.5)) else { return 0 };
    let mut beside: Vec<u64> = values.iter().map(|value| value.abs_diff(middle)).collect();
    beside.sort_unstable();
    at(&beside, 0.95)
}

/// As RTnet's: of the start in microseconds; and of the process, since two may start at once.
fn identifier() -> u16 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    (since.as_micros() as u16).wrapping_add((std::process::id() as u16).wrapping_mul(7_919))
}

fn answer(echo: &EchoShown, asked: u64) -> Answer {
    let since = |at: Option<u64>| at.map(|at| at.saturating_sub(asked));
    let (round_trip_ns, waited_ns) = (since(echo.came), since(echo.left));
    Answer { sequence: echo.sequence, bytes: echo.size, round_trip_ns, waited_ns }
}

fn line(from: Ipv4Addr, answer: &Answer) -> String {
    let Answer { sequence, bytes, round_trip_ns, waited_ns } = *answer;
    let us = |ns: u64| micros(ns as i64);
    let all = round_trip_ns.map_or("?".into(), us);
    let waited = waited_ns.map_or(String::new(), |ns| format!(", of which {} waiting for the slot", us(ns)));
    format!("{bytes} bytes from {from}: seq={sequence} time={all} us{waited}\n")
}

fn summary(place: &Place, round: &Round) -> String {
    let Round { to, sent, received, failed, failures, loss, .. } = round;
    let mut text = format!("{to}: {sent} sent, {received} came back, {:.1} % lost", loss * 100.0);
    text += &if *failed > 0 { format!(", {failed} were not asked:\n") } else { "\n".into() };
    failures.iter().for_each(|(why, n)| text += &format!("  {n} times: {why}\n"));
    if let Some(why) = &round.why_never_left {
        let (never, all) = (round.never_left, sent + failed);
        text += &format!("station '{place}': {never} of {all} questions never left: {why}\n");
    }
    for (what, spread) in [
        ("round trip", round.round_trip_ns),
        ("waiting for the slot", round.waited_ns),
        ("on the way and at the other station", round.rest_ns),
    ] {
        let Some(Spread { min, p50, p99, max, n, gaps }) = spread else { continue };
        let [min, p50, p99, max] = [min, p50, p99, max].map(|ns| micros(ns as i64));
        text +=
            &format!("{what}: min {min}, p50 {p50}, p99 {p99}, max {max} us; n {n}, {gaps} more without\n");
    }
    if let Some(scheduled) = round.schedule {
        let Scheduled { best_ns, worst_ns, lead_ns, jitter_ns, quicker, longer, slots_missed } = scheduled;
        let [best, worst, lead, jitter] = [best_ns, worst_ns, lead_ns, jitter_ns].map(|ns| micros(ns as i64));
        text += &format!(
            "schedule: best {best}, worst {worst} us, or up to {lead} us less; by more than the jitter of {jitter} us {quicker} \
             were quicker and {longer} took longer, while the two stations missed {slots_missed} slots\n"
        );
    }
    text
}

#[cfg(test)]
mod tests;
