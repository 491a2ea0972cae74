//! What only the whole of a network shows: events that are in each other's way, slots that do not go together, stations that
//! could never calibrate.

use rtmac::tdma::check_rounds;
use rtmac::tdma::schedule::{self, Conflict};
use rtnet::sim::Joint;
use rtnet::time::Span;
use rtnet::wire::ethernet;
use toml::Spanned;

use super::stations::StationFile;
use super::{FileError, NetworkFile, Source};
use crate::scenario::clashes::{self, Clash};
use crate::scenario::{Conditions, Measure, Place, Scenario, SlotPlan, StationPlan, Unfit, divide};

impl Source<'_> {
    /// What happens does so while somebody measures, and no end of one event is the end of another; what is expected can
    /// be.
    pub(super) fn check_events(&self, scenario: &Scenario) -> Result<(), FileError> {
        let Conditions { events, expectations, joint, .. } = &scenario.conditions;
        let refuse = |place: Place, what: String| Err(self.refused(place, what));
        for event in events {
            if event.is_over() >= scenario.duration {
                let (over, duration) = (event.is_over(), scenario.duration);
                return refuse(
                    event.place,
                    format!("over after {over}, and the measurement lasts {duration}: make that longer"),
                );
            }
        }
        if let Some(Clash { events: [before, behind], kind }) = clashes::first(events) {
            let what = format!(
                "at once with the {kind} of line {}: when one of them is over, so is the other; part them",
                events[before].place.line
            );
            return refuse(events[behind].place, what);
        }
        for expected in expectations {
            let is_measured = match expected.measure {
                Measure::Collisions => *joint == Joint::Hub,
                Measure::QueueFull => matches!(joint, Joint::Switch { .. }),
                _ => true,
            };
            if !is_measured {
                let name = expected.measure.name();
                return refuse(
                    expected.place,
                    format!("{name}: this medium has none; see joint of [medium]"),
                );
            }
        }
        Ok(())
    }

    /// A sync has left the air when its window ends, and a backup sends within the cycle.
    pub(super) fn check_syncs(&self, network: &NetworkFile, scenario: &Scenario) -> Result<(), FileError> {
        let air = scenario.rate.air_time(ethernet::MIN_FRAME);
        if let Some(window) = &network.sync_window
            && window.get_ref().0 < air
        {
            let what = format!(
                "a sync window of {}: at this rate a sync is on the air for {air}; make it that long, or longer",
                window.get_ref().0
            );
            return Err(self.impossible(window.span().start, what));
        }
        for StationFile { name, backup, .. } in network.station.iter().map(Spanned::get_ref) {
            let Some(backup) = backup.as_ref().filter(|backup| backup.get_ref().0 >= scenario.cycle) else {
                continue;
            };
            let (at, cycle) = (backup.get_ref().0, scenario.cycle);
            let what = format!(
                "backup {} sends {at} after a cycle's start, and a cycle lasts {cycle}: let it send before all slots",
                name.get_ref()
            );
            return Err(self.impossible(backup.span().start, what));
        }
        Ok(())
    }

    /// No station says where its slots are: the cycle is divided evenly, in the order of the file.
    pub(super) fn divide(&self, network: &NetworkFile, scenario: &mut Scenario) -> Result<(), FileError> {
        let Scenario { cycle, rate, .. } = *scenario;
        let asked = network.sync_window.as_ref().map(|window| window.get_ref().0);
        let guard = network.guard.map(|guard| guard.0);
        let size = scenario.stations.iter().map(StationPlan::usual_size).max().unwrap_or_default();
        // Slots begin when the last backup may send no more; a window that is longer than need be is in its way.
        let last = scenario.stations.iter().filter_map(|station| station.backup).max();
        let window = asked.or(last.map(|_| scenario.sync_window));
        let behind = last.unwrap_or(Span::ZERO);
        let (start, length) = divide(cycle - behind, window, rate, scenario.stations.len(), size, guard)
            .map_err(|conflict| self.does_not_fit(network, last, &conflict, size))?;
        scenario.sync_window = start;
        for (k, station) in scenario.stations.iter_mut().enumerate() {
            let offset = behind + start + length * k as i64;
            let size = station.usual_size();
            station.slots = vec![SlotPlan { id: 0, offset, phase: 0, period: 1, size, joint: None }];
        }
        Ok(())
    }

    /// The last backup is in the way, or the cycle is too short for what is in it.
    fn does_not_fit(
        &self,
        network: &NetworkFile,
        last: Option<Span>,
        conflict: &Conflict,
        size: usize,
    ) -> FileError {
        let cycle = &network.cycle;
        let backups = network.station.iter().filter_map(|entry| entry.get_ref().backup.as_ref());
        let backup = backups.max_by_key(|backup| backup.get_ref().0);
        match (conflict, last, backup) {
            (&Conflict::DoesNotFit { slots, sum, .. }, Some(last), Some(backup))
                if sum < cycle.get_ref().0 =>
            {
                let (cycle, latest) = (cycle.get_ref().0, cycle.get_ref().0 - sum);
                let what = format!(
                    "{slots} slots do not fit a cycle of {cycle} behind a backup that sends {last} after its start: they \
                     take {sum} with the sync window; let it send {latest} after it, or earlier, or lengthen the cycle"
                );
                self.impossible(backup.span().start, what)
            }
            _ if has_addresses(network) => {
                let what = format!(
                    "{conflict}; slots of stations with an address hold {size} bytes: give all slots a size, or leave it out"
                );
                self.impossible(cycle.span().start, what)
            }
            _ => self.impossible(cycle.span().start, conflict),
        }
    }

    /// Who follows calibrates, unless it has no rounds to do so.
    pub(super) fn check_calibration(
        &self,
        network: &NetworkFile,
        scenario: &Scenario,
    ) -> Result<(), FileError> {
        for slave in scenario.calibrating() {
            let slots = || slave.slots.iter().map(|slot| (slot.id, slot.period));
            check_rounds(slave.rounds, slots()).map_err(|refused| {
                let first = slots().min().map_or(0, |(id, _)| id);
                self.impossible(place_of_slot(network, &slave.name, first), refused)
            })?;
            if let Some((id, period)) = slots().min() {
                self.check_reach(network, scenario, &slave.name, id, period)?;
            }
        }
        let refuse =
            |unfit: Unfit| self.impossible(place_of_slot(network, &unfit.station, unfit.slot), unfit);
        scenario.check_fit().map_err(refuse)
    }

    /// A reply comes before its slot does for the next time, and no delay is longer than a cycle.
    fn check_reach(
        &self,
        network: &NetworkFile,
        scenario: &Scenario,
        name: &str,
        id: u8,
        period: u32,
    ) -> Result<(), FileError> {
        let way = scenario.conditions.way();
        let every = scenario.cycle * i64::from(period);
        if way <= scenario.cycle && way * 2 < every {
            return Ok(());
        }
        let what = format!(
            "a frame is on its way for {way}: '{name}' would never be locked, since it calibrates in its slot {id}, every \
             {every}, and a round takes that way forth and back; let it be less than {}",
            scenario.cycle.min(every / 2)
        );
        let at = network.medium.as_ref().map_or(0, |medium| medium.place_of_way());
        Err(self.impossible(at, what))
    }
}

fn has_addresses(network: &NetworkFile) -> bool {
    network.network.is_some() || network.station.iter().any(|entry| entry.get_ref().ip.is_some())
}

/// Where the slot stands that a conflict names last.
pub(super) fn place_of(network: &NetworkFile, conflict: &Conflict) -> usize {
    match conflict {
        Conflict::Overlap { b, b_id, .. } => place_of_slot(network, b, *b_id),
        Conflict::InSyncWindow { owner, id, .. }
        | Conflict::BeyondCycle { owner, id, .. }
        | Conflict::BeforeBackup { owner, id, .. } => place_of_slot(network, owner, *id),
        Conflict::BackupTooEarly { owner, .. } => {
            let station = station(network, owner);
            let backup = station.and_then(|entry| entry.get_ref().backup.as_ref());
            backup.map_or_else(|| place_of_slot(network, owner, u8::MAX), |backup| backup.span().start)
        }
        Conflict::DoesNotFit { .. } => network.cycle.span().start,
    }
}

fn station<'a>(network: &'a NetworkFile, name: &str) -> Option<&'a Spanned<StationFile>> {
    network.station.iter().find(|entry| entry.get_ref().name.get_ref() == name)
}

/// Where a slot stands, or else its station.
fn place_of_slot(network: &NetworkFile, owner: &str, id: u8) -> usize {
    let station = station(network, owner);
    let slots = station.and_then(|entry| entry.get_ref().slots.as_ref());
    let slot = slots.and_then(|slots| slots.iter().find(|slot| slot.get_ref().id == id));
    slot.map(|slot| slot.span().start).or(station.map(|entry| entry.span().start)).unwrap_or(0)
}

/// What the closest slots, or the last and the cycle's end, leave free behind a frame.
pub(super) fn widest_guard(scenario: &Scenario) -> Span {
    let schedule = scenario.schedule();
    let fits = |guard: Span| schedule::Schedule { guard, ..schedule.clone() }.conflicts().is_empty();
    // The largest that fits, by halving the interval: conflicts only grow with the guard band.
    let (mut low, mut high) = (0, scenario.cycle.nanos());
    while high - low > 1 {
        let middle = (low + high) / 2;
        if fits(Span::from_nanos(middle)) { low = middle } else { high = middle }
    }
    Span::from_nanos(low)
}
