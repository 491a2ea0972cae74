//! What a station says of itself: to its lab in JSON lines, to a person in sentences.

use std::io::Write;

use anyhow::Result;
use rtmac::tdma::TdmaStatus;
use rtnet::discipline::{Event, EventKind, SyncState};
use rtnet::live::{Record, Snapshot};
use rtnet::wire::ethernet::Address;

use super::Options;
use super::link::{self, Report, Standing};
use super::traffic::TrafficCounts;

/// Tells the lab in JSON lines, or a person in sentences.
pub enum Teller {
    Lab,
    Person { name: String, state: SyncState, last: Option<Box<TdmaStatus>> },
}

impl Teller {
    pub fn new(options: &Options, address: Address, guarded: bool) -> Self {
        match options.lab {
            Some(_) => Teller::Lab,
            None => {
                let name = options.name.clone().unwrap_or_else(|| options.interface.clone());
                let guard = if guarded { ", kernel guard" } else { "" };
                print(&format!("{name}: on {} ({address}{guard}); Ctrl-C ends it", options.interface));
                Teller::Person { name, state: SyncState::Waiting, last: None }
            }
        }
    }

    pub fn started(&self, guarded: bool, refused: Vec<String>) -> Result<()> {
        match self {
            Teller::Lab => say(&Report::Started { guarded, refused }),
            Teller::Person { name, .. } => {
                refused.iter().for_each(|line| eprintln!("{name}: {line}"));
                Ok(())
            }
        }
    }

    /// Tells what is new; a reason to end, if there is one.
    pub fn tell(
        &mut self,
        records: Vec<Record>,
        snapshot: Option<Snapshot<TdmaStatus>>,
        counts: &TrafficCounts,
    ) -> Result<Option<String>> {
        let yielded = snapshot.and_then(|snapshot| snapshot.status.yielded_to).map(|other| {
            format!(
                "another master ({other}) is active on this medium: stop it, or run this station as --slave"
            )
        });
        match self {
            Teller::Lab => {
                link::reports(records.into_iter()).iter().try_for_each(say)?;
                if let Some(snapshot) = snapshot {
                    say(&Report::Standing(Box::new(Standing::of(&snapshot, counts))))?;
                }
                if let Some(why) = &yielded {
                    say(&Report::Failed(why.clone()))?;
                }
            }
            Teller::Person { name, state, last } => {
                for record in records {
                    if let Record::Event(event, _) = record
                        && event.kind != EventKind::SlotSilent
                    {
                        print(&format!("{name}: cycle {}: {}", event.cycle, event_line(&event)));
                    }
                }
                if let Some(Snapshot { status, .. }) = snapshot {
                    if status.state != *state {
                        *state = status.state;
                        print(&format!("{name}: {}", standing_line(&status)));
                    }
                    *last = Some(Box::new(status));
                }
            }
        }
        Ok(yielded)
    }
}

impl Drop for Teller {
    fn drop(&mut self) {
        if let Teller::Person { name, last: Some(status), .. } = self {
            let counters = &status.counters;
            print(&format!(
                "{name}: ended in cycle {} ({}): {} syncs sent, {} skipped, {} received; {} frames sent, {} \
                 overruns, {} stalled in send, {} dropped by the kernel guard",
                status.cycle,
                status.state.name(),
                counters.syncs_sent,
                counters.syncs_skipped,
                counters.syncs_received,
                counters.frames_sent,
                counters.overruns,
                counters.stalled_in_send,
                counters.guard_drops,
            ));
        }
    }
}

/// A line for a person; one who does not listen any more misses nothing.
fn print(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

fn event_line(event: &Event) -> String {
    let name = event.kind.name();
    match event.kind {
        EventKind::SendFailed => {
            format!("{name}: {}", std::io::Error::from_raw_os_error(event.span.nanos() as i32))
        }
        EventKind::SlotBeyondCycle => {
            format!("{name}: a slot begins {} after the master's cycle ends; change its --slot", event.span)
        }
        _ => format!("{name} ({})", event.span),
    }
}

fn standing_line(status: &TdmaStatus) -> String {
    let period = status.period.map_or("unknown".into(), |period| period.to_string());
    let delay = status.delay.map_or("not measured".into(), |delay| delay.to_string());
    format!("{}, cycle {} of {period}, delay {delay}", status.state.name(), status.cycle)
}

fn say(report: &Report) -> Result<()> {
    let mut line = serde_json::to_string(report)?;
    line.push('\n');
    let mut out = std::io::stdout().lock();
    out.write_all(line.as_bytes())?;
    Ok(out.flush()?)
}
