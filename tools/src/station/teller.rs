//! What a station says of itself: to its lab in JSON lines, to a person in sentences.

use std::io::Write;
use std::net::SocketAddr;

use anyhow::Result;
use rtmac::tdma::{Mastery, TdmaStatus};
use rtmac::token::TokenStatus;
use rtnet::at_once::AtOnceStatus;
use rtnet::discipline::{Event, EventKind, SyncState};
use rtnet::live::{Record, Snapshot};
use rtnet::wire::ethernet::Address;

use super::Options;
use super::access::{AccessConfig, AccessStatus};
use super::failures::Failures;
use super::link::{self, Report, Standing};
use super::traffic::TrafficCounts;
use super::wire::{Change, LinkState};

/// Tells the lab in JSON lines, or a person in sentences.
pub enum Teller {
    Lab,
    Person(Box<Person>),
}

/// What a person was told last.
pub struct Person {
    name: String,
    state: SyncState,
    last: Option<AccessStatus>,
    failures: Failures,
}

impl Teller {
    pub fn new(options: &Options, address: Address, guarded: bool) -> Self {
        match options.lab {
            Some(_) => Teller::Lab,
            None => {
                let name = options.name.clone().unwrap_or_else(|| options.interface.clone());
                let guard = if guarded { ", kernel guard" } else { "" };
                let discipline = match options.access {
                    AccessConfig::Tdma(_) => "",
                    AccessConfig::NoMac => ", nomac",
                    AccessConfig::Direct => ", direct",
                    AccessConfig::Token(_) => ", token",
                };
                let on = &options.interface;
                print(&format!("{name}: on {on} ({address}{discipline}{guard}); Ctrl-C ends it"));
                let (state, failures) = (SyncState::Waiting, Failures::default());
                Teller::Person(Box::new(Person { name, state, last: None, failures }))
            }
        }
    }

    pub fn started(&self, guarded: bool, refused: Vec<String>) -> Result<()> {
        match self {
            Teller::Lab => Report::Started { guarded, refused }.say(),
            Teller::Person(person) => {
                for line in &refused {
                    // Whoever has closed our standard error can ask for it.
                    let _ = writeln!(std::io::stderr(), "{}: {line}", person.name);
                }
                Ok(())
            }
        }
    }

    /// Tells a person where the station's figures are. No station of a lab has any.
    pub fn tell_of_figures(&self, at: SocketAddr) {
        if let Teller::Person(person) = self {
            person.say(&format!("figures for Prometheus are at http://{at}/metrics"));
        }
    }

    /// Tells what is new; a reason to end, if there is one.
    pub fn tell(
        &mut self,
        records: Vec<Record>,
        snapshot: Option<Snapshot<AccessStatus>>,
        counts: &TrafficCounts,
        link: LinkState,
    ) -> Result<Option<String>> {
        // Who was outlasted follows, and stays.
        let yielded_to = |snapshot: Snapshot<AccessStatus>| {
            let tdma = snapshot.status.tdma().filter(|tdma| tdma.mastery == Some(Mastery::Yielded))?;
            tdma.yielded_to
        };
        let yielded = snapshot.and_then(yielded_to).map(|other| {
            format!(
                "another master ({other}) is active on this medium: stop it, or run this station as --slave"
            )
        });
        match self {
            Teller::Lab => {
                link::reports(records.into_iter()).iter().try_for_each(Report::say)?;
                if let Some(snapshot) = snapshot {
                    Report::Standing(Box::new(Standing::of(&snapshot, counts, link))).say()?;
                }
                if let Some(why) = &yielded {
                    Report::Failed(why.clone()).say()?;
                }
            }
            Teller::Person(person) => person.tell(&records, snapshot.map(|snapshot| snapshot.status)),
        }
        Ok(yielded)
    }

    /// Tells what has become of the interface; a reason to end, if there is none any more.
    pub fn tell_of_wire(&self, changes: &[Change]) -> Result<Option<String>> {
        let mut gone = None;
        for change in changes {
            match (self, change) {
                (_, &Change::Gone { before, .. }) => gone = Some((before, change.to_string())),
                (Teller::Person(person), _) => person.say(&change.to_string()),
                (Teller::Lab, &Change::State { from, to, before, .. }) => {
                    let carrier = to == LinkState::Up;
                    if carrier || from == LinkState::Up {
                        Report::Link { at: before, carrier }.say()?;
                    }
                }
                // A lab has given its interfaces their names, and its stations do not go by them.
                (Teller::Lab, Change::Renamed { .. } | Change::Mtu { .. }) => {}
            }
        }
        if let (Teller::Lab, Some((before, why))) = (self, &gone) {
            Report::Link { at: *before, carrier: false }.say()?;
            Report::Failed(why.clone()).say()?;
        }
        Ok(gone.map(|(_, why)| why))
    }
}

impl Person {
    fn say(&self, line: &str) {
        print(&format!("{}: {line}", self.name));
    }

    fn tell(&mut self, records: &[Record], status: Option<AccessStatus>) {
        let mut failed = false;
        for record in records {
            let Record::Event(event, _) = record else { continue };
            match event.kind {
                EventKind::SlotSilent
                | EventKind::TurnLeft
                | EventKind::CalibrationTurn
                | EventKind::AnswerTurn
                | EventKind::ScheduleUnsure => {}
                EventKind::SendFailed | EventKind::ReplyFailed => {
                    failed = true;
                    let first = self.failures.note(event.cycle, event.span.nanos() as i32);
                    first.iter().for_each(|line| self.say(line));
                }
                kind => {
                    let of = if is_of_token(kind) { "visit" } else { "cycle" };
                    self.say(&format!("{of} {}: {}", event.cycle, event_line(event)));
                }
            }
        }
        let Some(status) = status else { return };
        if !failed {
            self.failures.sent(sent(&status)).iter().for_each(|line| self.say(line));
        }
        if let Some(tdma) = status.tdma().filter(|tdma| tdma.state != self.state) {
            self.state = tdma.state;
            self.say(&standing_line(tdma));
        }
        self.last = Some(status);
    }
}

impl Drop for Person {
    fn drop(&mut self) {
        self.failures.over().iter().for_each(|line| self.say(line));
        match &self.last {
            Some(AccessStatus::Tdma(status)) => self.say(&ended_line(status)),
            Some(AccessStatus::AtOnce(_, status)) => {
                let AtOnceStatus { frames_sent, send_failed, .. } = status;
                self.say(&format!("ended: {frames_sent} frames sent, {send_failed} refused by the kernel"));
            }
            Some(AccessStatus::Token(status)) => self.say(&ended_ring_line(status)),
            None => {}
        }
    }
}

fn ended_ring_line(status: &TokenStatus) -> String {
    let counters = &status.counters;
    format!(
        "ended as {} of {} in its ring: held the token {} times; {} frames sent, {} tokens repeated, {} stations \
         skipped, {} claims, {} overdue, {} given up",
        status.index,
        status.size,
        status.visits,
        counters.frames_sent,
        counters.repeats,
        counters.skips,
        counters.claims,
        counters.overdue,
        counters.given_up,
    )
}

fn ended_line(status: &TdmaStatus) -> String {
    let counters = &status.counters;
    format!(
        "ended in cycle {} ({}): {} syncs sent, {} skipped, {} received; {} frames sent, {} overruns, {} stalled \
         in send, {} dropped by the kernel guard",
        status.cycle,
        status.state.name(),
        counters.syncs_sent,
        counters.syncs_skipped,
        counters.syncs_received,
        counters.frames_sent,
        counters.overruns,
        counters.stalled_in_send,
        counters.guard_drops,
    )
}

/// A line for a person; one who does not listen any more misses nothing.
fn print(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// Frames of any kind that were sent.
fn sent(status: &AccessStatus) -> u64 {
    let control = status.tdma().map_or(0, |TdmaStatus { counters, .. }| {
        counters.syncs_sent + counters.replies_sent + counters.requests_sent
    });
    control + status.frames_sent()
}

/// What has no cycle goes by how often the token was here.
fn is_of_token(kind: EventKind) -> bool {
    use EventKind::*;
    matches!(kind, TokenRepeated | StationSkipped | TokenClaimed | TokenGivenUp | TokenOverdue)
}

fn event_line(event: &Event) -> String {
    let name = event.kind.name();
    match event.kind {
        EventKind::SlotBeyondCycle => {
            format!("{name}: a slot begins {} after the master's cycle ends; change its --slot", event.span)
        }
        EventKind::JointDetached => {
            let slot = event.slot.map_or("a slot".into(), |id| format!("slot {id}"));
            format!(
                "{name}: {slot} has a queue of its own now, since the slot that it was joined to has grown"
            )
        }
        EventKind::TokenRepeated => {
            format!("{name}: the next station showed no sign of the token: it was sent once more")
        }
        EventKind::StationSkipped => {
            let place = event.slot.map_or("a station".into(), |place| format!("station {place} of the ring"));
            format!("{name}: {place} showed no sign of the token: it is absent, and is invited later")
        }
        EventKind::TokenClaimed => format!("{name}: no token was heard: this station has claimed it"),
        EventKind::TokenGivenUp => format!("{name}: another token stays: the one here is void"),
        EventKind::TokenOverdue => {
            format!("{name}: {} too late to pass the token on: it is lost here", event.span)
        }
        EventKind::ScheduleSwitched => format!("{name}: schedule {} is in use", event.span.nanos()),
        _ => format!("{name} ({})", event.span),
    }
}

fn standing_line(status: &TdmaStatus) -> String {
    let period = status.period.map_or("unknown".into(), |period| period.to_string());
    let delay = status.delay.map_or("not measured".into(), |delay| delay.to_string());
    format!("{}, cycle {} of {period}, delay {delay}", status.state.name(), status.cycle)
}
