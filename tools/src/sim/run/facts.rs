//! What is known of the stations at the end of a run.

use rtnet::time::Span;

use super::Run;
use super::at_end::AtEnd;
use crate::judge::delivery::{Delivery, Heard};
use crate::judge::outcome::{Facts, not_synchronised};
use crate::scenario::Scenario;
use crate::sim::figures::SimStation;
use crate::station::link::PORT_POOL_EMPTY;

impl Run<'_> {
    pub(super) fn relock_cycles(&self) -> Option<i64> {
        let is_back = |run: &Self, id: usize| run.at_end[id].synchronised.is_some();
        if !self.all(is_back) || self.over > self.now() {
            return None;
        }
        Some(self.unlocked.saturating_sub(self.over).div_ceil(self.cycle) as i64)
    }

    pub(super) fn station(&self, id: usize) -> SimStation {
        let AtEnd { gives_time, synchronised } = self.at_end[id];
        let state = synchronised.unwrap_or_else(|| self.status(id).state);
        SimStation {
            name: self.scenario.stations[id].name.clone(),
            state: if self.present[id] { state.name() } else { "down" }.into(),
            gives_time,
            dropped: self.world.network.dropped(id),
        }
    }

    pub(super) fn facts(&self, id: usize) -> Facts {
        let (status, counts) = (self.status(id), &self.world.counts[id]);
        let counted = self.world.counted(id) - &self.before[id];
        let refusals = self.world.network.member(id).station.refusals();
        let refusals = refusals.nonzero().map(|(why, n)| (why.name(), n));
        // As a live station counts it, frame by frame.
        let no_room = Some((PORT_POOL_EMPTY, self.world.network.dropped(id))).filter(|&(_, n)| n > 0);
        let watch = &mut *self.watch.borrow_mut();
        let mut delivery = |of| {
            let (numbers, others) = counts.counted(of);
            let heard = Heard::of(counts.arrived(of), self.anew[id]).within(numbers, others);
            let meant = watch.meant[id].remove(&of).unwrap_or_default();
            (of, Delivery { heard, meant })
        };
        let over_time = watch.sync_error_over_time.as_mut().map(|all| std::mem::take(&mut all[id]));
        // What a process that was ended would have heard since, nobody knows.
        let streams = self.scenario.streams(self.scenario.sender(id)).filter(|_| self.present[id]);
        let name = &self.scenario.stations[id].name;
        let is_lost = self.present[id] && self.at_end[id].synchronised.is_none();
        Facts {
            guarded: self.scenario.is_guarded(),
            delay_ns: status.delay.map(Span::nanos),
            payload_errors: counted.payload_errors.max(0) as u64,
            sync_error: std::mem::take(&mut watch.sync_error[id]),
            sync_error_over_time: over_time.unwrap_or_default(),
            sequence_gaps: counted.missing.max(0) as u64,
            deliveries: streams.map(&mut delivery).collect(),
            refusals: refusals.chain(no_room).map(|(why, n)| (why.to_owned(), n)).collect(),
            notes: watch.noteworthy[id].lines().collect(),
            lost_records: counted.events_lost.max(0) as u64,
            queue_refused: counted.refused().collect(),
            reproach: is_lost.then(|| not_synchronised(name)),
            ..Facts::default()
        }
    }
}

/// What of a scenario a simulation has not, in lines for the reader.
pub(super) fn only_in_labs(scenario: &Scenario) -> Vec<String> {
    let has_addresses = scenario.stations.iter().any(|station| station.ip.is_some());
    let has_vnics = scenario.stations.iter().any(|station| station.vnic.is_some());
    let only = [
        (has_addresses, "network and ip: stations have no sockets"),
        (has_vnics, "vnic and vnic_proxy: stations have no devices"),
        (scenario.packages.is_some(), "packages: stations have no programs"),
    ];
    let only = only.into_iter().filter(|(is_said, _)| *is_said);
    only.map(|(_, what)| format!("only in a lab (rtnet lab up), and not here: {what}")).collect()
}
