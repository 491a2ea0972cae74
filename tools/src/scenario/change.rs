//! A network's slots as a schedule that can be changed while it runs.

use std::sync::Arc;

use rtmac::tdma::change::{Book, ChangeConfig, MAX_PLANNED};
use rtmac::tdma::schedule::Rate;
use rtmac::tdma::{BehindSync, Refused};
use rtmac::wire::change::PART_LEN;
use rtnet::time::Span;
use rtnet::wire::ethernet::{self, Address};

use super::{Role, Scenario};

/// Between a Synchronisation and what follows it.
const GAP: Span = Span::from_micros(1);
/// A part of a schedule may be late by so much at the least: else it would hardly ever be sent.
const LATE_AT_LEAST: Span = Span::from_micros(1);
/// Of what is left of the sync window, so much may pass before a part of a schedule is begun.
const LATE_PARTS: (i64, i64) = (2, 3);
/// A schedule may have so many times the slots of the first, or so many at the least.
const GROWS: usize = 2;
const SLOTS_AT_LEAST: usize = 64;

/// How long after a Synchronisation a part of a schedule is sent, and how long after that it still may be, so that both end in the
/// sync window. `None`: they do not.
pub fn room_for_parts(window: Span, rate: Rate) -> Option<(Span, Span)> {
    let behind = rate.air_time(ethernet::MIN_FRAME) + GAP;
    // A part of it is left for what a host takes from its last look at the clock to the wire.
    let latest = (window - behind - rate.air_time(PART_LEN)) * LATE_PARTS.0 / LATE_PARTS.1;
    (latest >= LATE_AT_LEAST).then_some((behind, latest))
}

/// The same for a calibration reply that a master without slots is late with, which is no longer.
pub fn room_for_replies(window: Span, rate: Rate) -> Option<BehindSync> {
    room_for_parts(window, rate).map(|(after, latest)| BehindSync { after, latest })
}

impl Scenario {
    /// All slots of all stations.
    pub fn book(&self) -> Result<Book, Refused> {
        let of = |(id, station): (usize, &super::StationPlan)| {
            let address = self.address(id);
            station.slots.iter().map(|slot| (address, self.slot_config(slot))).collect::<Vec<_>>()
        };
        Book::of(self.cycle, self.stations.iter().enumerate().flat_map(of))
    }

    /// Who may give the time.
    pub fn masters(&self) -> Vec<Address> {
        let may = |&id: &usize| self.stations[id].role != Role::Slave;
        (0..self.stations.len()).filter(may).map(|id| self.address(id)).collect()
    }

    /// What stations are told so that the schedule can be changed; `None`: there is no room for parts of one behind the
    /// Synchronisations, or more slots than a schedule can have.
    pub fn change_config(&self) -> Option<ChangeConfig> {
        let slots: usize = self.stations.iter().map(|station| station.slots.len()).sum();
        let (behind, latest) = room_for_parts(self.sync_window, self.rate)?;
        if slots > MAX_PLANNED {
            return None;
        }
        let first = Some(Arc::new(self.book().ok()?));
        let capacity = (slots * GROWS).clamp(SLOTS_AT_LEAST, MAX_PLANNED);
        Some(ChangeConfig { capacity, is_reserved: true, first, masters: self.masters(), behind, latest })
    }
}
