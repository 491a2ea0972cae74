//! `rtnet station`.

use std::str::FromStr;

use anyhow::{Context, anyhow};
use rtmac::tdma::{LatePolicy, MasterConfig, RoleConfig, SlaveConfig, SlotConfig, Tdma, TdmaConfig};
use rtnet::live::clock::{monotonic, realtime};
use rtnet::time::{GlobalTime, Offset, Span};
use rtnet::wire::ethernet::{Address, MTU};

use super::Failure;
use crate::cli::{Late, StationArgs};
use crate::scenario::{default_sync_window, parse_phase};
use crate::station::link::{self, LabOptions};
use crate::station::{self, Options};
use crate::units::parse_nonnegative_span;

/// Part of the sync window in which a Synchronisation may be begun; the rest is for its time on the air.
const SYNC_LATEST_PARTS: (i64, i64) = (3, 4);

/// `ID=OFFSET[,phase=P/N][,size=B]`
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlotArg {
    id: u8,
    offset: Span,
    phase: u32,
    period: u32,
    size: usize,
}

/// Reads a slot from the command line.
pub fn parse_slot(text: &str) -> Result<SlotArg, String> {
    let mut parts = text.split(',');
    let first = parts.next().unwrap_or_default();
    let (id, offset) = first.split_once('=').ok_or("write ID=OFFSET, as in 0=100us")?;
    let id = u8::from_str(id).map_err(|_| format!("'{id}' is no slot id: write a number from 0 on"))?;
    let offset = parse_nonnegative_span(offset).map_err(|error| error.to_string())?;
    let mut slot = SlotArg { id, offset, phase: 0, period: 1, size: MTU };
    for part in parts {
        match part.split_once('=') {
            Some(("phase", phase)) => (slot.phase, slot.period) = parse_phase(phase)?,
            Some(("size", size)) => {
                slot.size = size.parse().map_err(|_| format!("'{size}' is no size in bytes"))?;
            }
            _ => return Err(format!("'{part}' means nothing here: only phase=P/N and size=B do")),
        }
    }
    Ok(slot)
}

/// Runs a station until it is told to stop.
pub fn station(args: &StationArgs) -> Result<u8, Failure> {
    let options = options(args).map_err(Failure::Usage)?;
    let station = station::set_up(options).map_err(Failure::Usage)?;
    station.run().map(|()| 0).map_err(Failure::Run)
}

fn options(args: &StationArgs) -> anyhow::Result<Options> {
    let lab: Option<LabOptions> =
        args.lab.as_deref().map(serde_json::from_str).transpose().context("--lab is set by a lab only")?;
    let role = match args.cycle.filter(|_| args.master) {
        Some(cycle) => {
            let window = args.sync_window.unwrap_or(default_sync_window(cycle));
            RoleConfig::Master(MasterConfig {
                cycle,
                sync_latest: window * SYNC_LATEST_PARTS.0 / SYNC_LATEST_PARTS.1,
                reply_latest: args.latest,
                epoch: lab.as_ref().map_or_else(epoch, |lab| link::offset(lab.epoch)),
            })
        }
        None => RoleConfig::Slave(SlaveConfig {
            rounds: args.rounds,
            step_limit: lab.as_ref().map(|lab| Span::from_nanos(lab.step_limit_ns)),
        }),
    };
    let slots = args.slots.iter().map(|&SlotArg { id, offset, phase, period, size }| SlotConfig {
        id,
        offset,
        phase,
        period,
        size,
        latest: args.latest,
    });
    let tdma = TdmaConfig {
        address: Address::default(),
        role,
        slots: slots.collect(),
        max_slot_id: args.max_slot_id,
        lead: args.lead,
        late: if args.late == Late::Send { LatePolicy::Send } else { LatePolicy::Skip },
    };
    // What cannot be is refused before anything is opened.
    Tdma::new(&tdma).map_err(|refused| anyhow!(refused))?;
    Ok(Options {
        interface: args.interface.clone(),
        name: args.name.clone(),
        tdma,
        cpu: args.cpu,
        spin: args.lead,
        lab,
    })
}

/// Global time is the wall clock's once, at the start, and from then on the monotonic clock's.
fn epoch() -> Offset {
    Offset::between(rtnet::Instant::from_nanos(monotonic()), GlobalTime::from_nanos(realtime()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_are_read_as_the_help_says() {
        let slot = parse_slot("2=250us,phase=2/4,size=128").unwrap();
        assert_eq!(slot, SlotArg { id: 2, offset: Span::from_micros(250), phase: 1, period: 4, size: 128 });
        assert_eq!(parse_slot("0=0us").unwrap().size, 1500);
    }

    #[test]
    fn what_is_no_slot_says_what_to_write() {
        for (text, expected) in [
            ("100us", "write ID=OFFSET"),
            ("x=100us", "'x' is no slot id"),
            ("0=100", "no unit"),
            ("0=100us,phase=0/2", "'0/2' is no phase"),
            ("0=100us,size=big", "'big' is no size"),
            ("0=100us,joint=1", "'joint=1' means nothing here"),
        ] {
            let error = parse_slot(text).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
