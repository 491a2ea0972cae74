//! One station of a ring, seen from its lab: what it has told.

use std::time::Duration;

use rtnet::clock::EmulatedClock;
use rtnet::time::Span;

use super::super::figures::Known;
use super::super::verdict::no_part;
use crate::judge::delivery::{Delivery, Heard, Meant};
use crate::judge::verdict::{Reason, Weight};
use crate::lab::namespace::Namespace;
use crate::lab::processes::{END_WITHIN, Process};
use crate::lab::run::INTERFACE;
use crate::scenario::{Happening, RingScenario};
use crate::station::link::{LabOptions, Order, Report, Standing};

/// A station takes part once the token has come so often.
const VISITS: u32 = 3;

pub struct Member {
    // Dropped before the namespace it lives in.
    pub process: Option<Process>,
    pub namespace: Namespace,
    pub clock: EmulatedClock,
    /// Why it could not go on.
    pub failed: Option<String>,
    /// Nothing more will come from it.
    pub silent: bool,
    standing: Option<Standing>,
    at_begin: Option<Standing>,
    refused: Vec<String>,
    /// It was ended because its scenario says so, or because it is over.
    is_meant_to_end: bool,
    told_to_end: bool,
    /// It was stopped by somebody, so that there was no other way.
    was_killed: bool,
    /// Its process is not the first.
    anew: bool,
    /// Test traffic that was not what was sent, in those before.
    former_errors: u64,
}

impl Member {
    pub fn new(namespace: Namespace, clock: EmulatedClock) -> Self {
        Self {
            process: None,
            namespace,
            clock,
            failed: None,
            silent: false,
            standing: None,
            at_begin: None,
            refused: Vec::new(),
            is_meant_to_end: false,
            told_to_end: false,
            was_killed: false,
            anew: false,
            former_errors: 0,
        }
    }

    pub fn pid(&self) -> u32 {
        self.process.as_ref().map_or(0, Process::pid)
    }

    /// The token comes to it.
    pub fn takes_part(&self) -> bool {
        self.standing.as_ref().is_some_and(|standing| standing.cycle >= VISITS)
    }

    /// Steps that it has taken: it reports, and takes part.
    pub fn steps(&self) -> usize {
        usize::from(self.standing.is_some()) + usize::from(self.takes_part())
    }

    /// From here on all counts.
    pub fn begin(&mut self) {
        self.at_begin = self.standing.clone();
    }

    /// Its process has ended, and nobody meant it to.
    pub fn is_lost(&self) -> bool {
        self.silent && !self.is_meant_to_end && !self.told_to_end
    }

    /// Whether it can tell what it has heard.
    pub fn can_tell(&self) -> bool {
        self.told_to_end
    }

    /// Ends it at once, as its scenario says.
    pub fn kill(&mut self) {
        self.is_meant_to_end = true;
        self.process.iter_mut().for_each(Process::kill);
    }

    /// Another process is to come in the place of one that has ended.
    pub fn begins_anew(&mut self) {
        self.former_errors = self.payload_errors();
        (self.standing, self.at_begin, self.failed) = (None, None, None);
        (self.silent, self.is_meant_to_end, self.anew) = (false, false, true);
    }

    /// Does to it what its scenario says.
    pub fn order(&mut self, order: Order) {
        if let Some(process) = &mut self.process
            && !process.order(order)
        {
            self.refused.push("it was told of more events than it could take: some did not happen".into());
        }
    }

    pub fn tell_to_end(&mut self) {
        self.told_to_end = !self.silent && !self.is_meant_to_end;
        self.process.iter_mut().for_each(Process::tell_to_end);
    }

    /// Who is stopped cannot do as it is told.
    pub fn end_if_stopped(&mut self) {
        if let Some(process) = self.process.as_mut().filter(|process| process.is_stopped()) {
            self.was_killed = true;
            process.kill();
        }
    }

    /// It was told to end: whether it did, and well.
    pub fn see_it_end(&mut self) {
        if let Some(process) = self.process.as_mut().filter(|_| self.told_to_end && !self.was_killed) {
            self.failed = process.outcome(if self.silent { END_WITHIN } else { Duration::ZERO }).err();
        }
    }

    /// Takes a line, or the end.
    pub fn take(&mut self, report: Option<Report>) {
        match report {
            None => self.silent = true,
            Some(Report::Started { refused, .. }) => self.refused = refused,
            Some(Report::Failed(why)) => self.failed = Some(why),
            Some(Report::Standing(standing)) => self.standing = Some(*standing),
            Some(Report::Events(_) | Report::Times(_) | Report::Late(_) | Report::Link { .. }) => {}
        }
    }

    fn payload_errors(&self) -> u64 {
        let count = |of: &Option<Standing>| {
            of.as_ref().and_then(|of| of.refusals.get("bad_payload").copied()).unwrap_or(0)
        };
        self.former_errors + count(&self.standing).saturating_sub(count(&self.at_begin))
    }

    /// Test traffic that it has heard since the begin.
    fn heard(&self, of: Option<u8>) -> Heard {
        let arrived = |standing: &Option<Standing>| {
            standing.as_ref().map(|of_it| of_it.arrived(of)).unwrap_or_default()
        };
        let before = arrived(&self.at_begin);
        let next = if before.received > 0 { before.first + before.received + before.missing } else { 0 };
        Heard::of(arrived(&self.standing), self.anew).within(next..u64::MAX, before.received)
    }

    /// What the report says of it, and of these kinds of frames that came to it, some of which were meant to be lost.
    pub fn known(
        &self,
        name: &str,
        streams: impl Iterator<Item = Option<u8>>,
        meant: impl Fn(Option<u8>) -> Meant,
    ) -> Known {
        let standing = self.standing.as_ref();
        let wrong = |what| Reason::new(Weight::Wrong, what);
        let failed = self.failed.as_ref().map(|why| wrong(format!("station '{name}' failed: {why}")));
        let lost = self.is_lost().then(|| {
            let remedy = "its last words, if any, are above";
            wrong(format!("station '{name}' (process {}) was lost: {remedy}", self.pid()))
        });
        let had_no_part = self.can_tell() && !self.takes_part();
        let apart = had_no_part.then(|| no_part(name));
        Known {
            state: if self.told_to_end { standing.map_or("", |standing| &standing.state) } else { "down" }
                .into(),
            throughout: self.told_to_end && !self.anew,
            deliveries: streams
                .map(|of| (of, Delivery { heard: self.heard(of), meant: meant(of) }))
                .collect(),
            payload_errors: self.payload_errors(),
            refusals: standing.map(|standing| standing.refusals.clone()).unwrap_or_default(),
            queue_refused: standing.map(|standing| standing.queue_refused.clone()).unwrap_or_default(),
            notes: self.refused.clone(),
            reproach: failed.or(lost).or(apart),
        }
    }
}

/// The command line of a station's process, behind the verb.
pub fn arguments(
    scenario: &RingScenario,
    station: usize,
    clock: EmulatedClock,
    (cpu, fifo): (usize, bool),
    first: u64,
) -> anyhow::Result<Vec<String>> {
    let RingScenario { ring, network } = scenario;
    let addresses: Vec<String> = ring.stations.iter().map(ToString::to_string).collect();
    let mut line: Vec<String> = Vec::new();
    let mut add = |option: &str, value: String| line.extend([option.to_owned(), value]);
    add("--interface", INTERFACE.into());
    add("--cpu", cpu.to_string());
    if !fifo {
        add("--scheduling", "other".into());
    }
    add("--discipline", "token".into());
    add("--ring", addresses.join(","));
    add("--rate", format!("{}k", ring.rate.bits_per_second() as f64 / 1e3));
    let times = [("hold", ring.hold), ("rest", ring.rest), ("late", ring.late), ("delay", ring.delay)];
    times.iter().for_each(|(name, span): &(&str, Span)| add(&format!("--token-{name}"), span.to_string()));
    add("--token-invite", ring.invite_every.to_string());
    let plan = &network.stations[station];
    let stalls = |event: &crate::scenario::Event| matches!(event.what, Happening::Stall(..));
    let lab = LabOptions {
        station: station as u16,
        name: plan.name.clone(),
        control: None,
        anchor: clock.anchor,
        offset_ns: clock.offset.nanos(),
        drift_ppb: clock.drift_ppb,
        epoch: 0,
        destination: network.address(network.receiver(station)).0,
        from: network.sender(station) as u16,
        payload: plan.payload,
        from_payload: network.stations[network.sender(station)].payload,
        step_limit_ns: 0,
        resume: None,
        first,
        flows: network.flow_plan(station),
        may_stall: network.conditions.events.iter().any(stalls),
        changes: None,
    };
    add("--lab", serde_json::to_string(&lab)?);
    line.push("--exclusive".into());
    Ok(line)
}
