//! Another schedule for all stations of a running lab: judged as a whole, proposed by the acting master, and known to whoever
//! judges frames, who sees on the medium when it is switched to.

use anyhow::{Result, bail, ensure};
use rtmac::tdma::joint;
use rtnet::time::Span;

use super::Keeper;
use super::changes::Change;
use crate::control::{ActivationSaid, Request, ScheduleRequest, ScheduleSaid, SlotOf};
use crate::judge::analysis::Known;
use crate::lab::load::{load, too_much};
use crate::scenario::{Scenario, SlotPlan};

impl Keeper {
    /// Proposes a schedule in which stations are named as in the lab's file.
    pub(super) fn try_propose(
        &mut self,
        name: &str,
        said: &ScheduleSaid,
        activate: Option<ActivationSaid>,
    ) -> Result<u32> {
        let master = self.station(name)?;
        let changed = self.as_said(said)?;
        if let Some(conflict) = changed.schedule().conflicts().first() {
            bail!("{conflict}");
        }
        let load = load(&changed, self.lab.launch.lead);
        let too_much = too_much(self.lab.cpu, load, self.lab.declared.as_ref());
        if let (Some(why), true) = (too_much, self.lab.declared.is_some() && load > self.lab.load) {
            bail!("{why}: give slots longer periods, or take another lab down");
        }
        let by_address = |of: &SlotOf| -> Result<SlotOf> {
            let station = self.scenario.address(self.station(&of.station)?).to_string();
            Ok(SlotOf { station, slot: of.slot })
        };
        let slots: Result<Vec<SlotOf>> = said.slots.iter().map(by_address).collect();
        let latest_ns = self.scenario.latest().nanos();
        let schedule = ScheduleSaid { slots: slots?, latest_ns, ..said.clone() };
        let book = schedule.book().map_err(|why| anyhow::anyhow!(why))?.numbered(1);
        let slots = changed.stations.iter().map(|station| station.slots.clone());
        let known = Known { cycle: changed.cycle, slots: slots.collect() };
        self.lab.analysis.may_switch(book.id().sum, known);
        let request = ScheduleRequest::Propose { schedule: Box::new(schedule), activate };
        self.ask(master, Request::Schedule(request), Change::Nothing)
    }

    /// The lab with the slots that are said; what cannot be is refused by name.
    fn as_said(&self, said: &ScheduleSaid) -> Result<Scenario> {
        let mut changed = self.scenario.clone();
        changed.cycle = Span::from_nanos(said.cycle_ns);
        changed.stations.iter_mut().for_each(|station| station.slots.clear());
        for SlotOf { station, slot } in &said.slots {
            let station = &mut changed.stations[self.station(station)?];
            let config = slot.config(self.scenario.latest());
            ensure!(
                config.size >= station.largest_payload(),
                "slot {} of '{}' takes {} bytes, and its test traffic has {}: make it larger",
                config.id,
                station.name,
                config.size,
                station.largest_payload()
            );
            station.slots.push(SlotPlan::from(config));
        }
        for station in &mut changed.stations {
            let slots: Vec<_> =
                station.slots.iter().map(|slot| slot.config(self.scenario.latest())).collect();
            station.slots = joint::resolved(&slots)?.into_iter().map(SlotPlan::from).collect();
            ensure!(
                !station.slots.is_empty(),
                "the file gives station '{}' of the lab no slot",
                station.name
            );
        }
        Ok(changed)
    }

    /// Stations have switched: whoever asks is told of the slots that there are now.
    pub(super) fn note_switch(&mut self) {
        let Some(Known { cycle, slots }) = self.lab.analysis.take_switch() else { return };
        self.scenario.cycle = cycle;
        for (station, slots) in self.scenario.stations.iter_mut().zip(slots) {
            station.slots = slots;
        }
        self.lab.records.follow(&self.scenario);
        self.lab.members.iter_mut().for_each(|member| member.cycle = cycle);
        self.lab.load = load(&self.scenario, self.lab.launch.lead);
        if let Some(declared) = &mut self.lab.declared {
            // Where it cannot be written, others see what it took before.
            let _ = declared.change(self.lab.load);
        }
    }
}
