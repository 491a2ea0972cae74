//! `rtnet slot`.

use anyhow::Result;
use serde::Serialize;

use super::Failure;
use super::tdma::{applied, by_lab, found_of, slots, status, told};
use super::waits;
use crate::cli::{SlotArgs, SlotVerb, Which};
use crate::control::{LabRequest, Request, SlotChange, SlotShown, StationStatus};
use crate::report::document::document;

/// A slot as it is listed.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct Listed {
    #[serde(flatten)]
    shown: SlotShown,
    /// How long a frame waits for it at the worst, if none is ahead; for whichever comes first, where slots are joint.
    worst_wait_ns: Option<i64>,
}

document!(Listed, "slot", slot_has_its_schema);

fn listed(status: &StationStatus) -> Vec<Listed> {
    let listed = |shown: &SlotShown| Listed {
        shown: *shown,
        worst_wait_ns: waits::worst(status, shown.slot.id).map(|wait| wait.nanos()),
    };
    status.slots.iter().map(listed).collect()
}

/// Looks at a station's slots, or changes them.
pub fn slot(args: &SlotArgs) -> Result<u8, Failure> {
    let which = &found_of(&args.which)?;
    let (from, what) = match &args.verb {
        SlotVerb::List => {
            let status = status(which).map_err(Failure::Usage)?;
            let table = |_: &[_]| slots(&status);
            super::print_all(which.json, &listed(&status), table).map_err(Failure::Run)?;
            return Ok(0);
        }
        SlotVerb::Set { slot } => (set(which, *slot), format!("{}: slot {} is set", which.place, slot.id)),
        SlotVerb::Remove { id } => (remove(which, *id), format!("{}: slot {id} is removed", which.place)),
    };
    let only_its_own = matches!(args.verb, SlotVerb::Set { .. }) && which.place.lab.is_none();
    let so_far = if only_its_own { "; other stations' slots it does not know" } else { "" };
    told(which, from.map_err(Failure::Usage)?, &what, so_far)
}

fn set(which: &Which, slot: SlotChange) -> Result<u32> {
    match &which.place.lab {
        None => applied(which, Request::SetSlot(slot)),
        Some(lab) => by_lab(lab, LabRequest::SetSlot { station: which.place.station.clone(), slot }),
    }
}

fn remove(which: &Which, id: u8) -> Result<u32> {
    match &which.place.lab {
        None => applied(which, Request::RemoveSlot(id)),
        Some(lab) => by_lab(lab, LabRequest::RemoveSlot { station: which.place.station.clone(), id }),
    }
}
