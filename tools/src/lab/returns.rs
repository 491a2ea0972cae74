//! Stations that leave a running lab, and come back.

use anyhow::Result;
use rtnet::live::clock::monotonic;

use super::absences::Absence;
use super::members::{Resume, arguments};
use super::processes::Process;
use super::run::{INTERFACE, Lab, port_name};
use crate::scenario::Scenario;
use crate::station::link::Report;

impl Lab {
    /// A station's wire was cut or mended, or its process has ended: what that had to tell of later than its last
    /// words went with it.
    pub(super) fn note_absence(&mut self, station: usize, report: Option<&Report>) {
        let (why, from) = match report {
            Some(&Report::Link { carrier: true, .. }) => {
                if let Some(now) = self.analysis.cycle_at(monotonic()) {
                    self.records.absences.end(station, Absence::NoCarrier, now.wrapping_add(1));
                }
                return;
            }
            Some(&Report::Link { at, carrier: false }) => (Absence::NoCarrier, at),
            Some(_) => return,
            None => {
                let standing = self.members[station].standing.as_ref();
                (Absence::Down, standing.map_or(monotonic(), |standing| standing.at))
            }
        };
        if let Some(from) = self.analysis.cycle_at(from) {
            self.records.absences.begin(station, why, from);
        }
    }

    /// Who was restarted is there again from its first frame on.
    pub(super) fn note_returns(&mut self) {
        for (station, member) in self.members.iter().enumerate() {
            if !member.silent
                && self.records.absences.is_open(station, Absence::Down)
                && let Some(cycle) = self.analysis.heard_again(station)
            {
                self.records.absences.end(station, Absence::Down, cycle);
            }
        }
    }

    /// Starts a station anew whose process has ended. A master goes on with its predecessor's grid.
    pub(super) fn restart(&mut self, scenario: &Scenario, station: usize) -> Result<()> {
        let sender = &self.analysis.stations[station].passed;
        let resume = Resume { grid: self.analysis.grid(), first: sender.beyond() };
        let arguments = arguments(scenario, station, &self.launch, &resume)?;
        let member = &mut self.members[station];
        // Somebody may have taken its interface away.
        if member.namespace.netlink()?.link_index(INTERFACE).is_err() {
            self.segment.attach(
                &member.namespace,
                &port_name(station),
                INTERFACE,
                scenario.address(station).0,
            )?;
        }
        let process = Process::start(&member.namespace, station, &arguments, self.teller.clone())?;
        member.restart(process);
        // Of the wire it tells anew.
        self.note_absence(station, Some(&Report::Link { at: 0, carrier: true }));
        if let Some(now) = self.analysis.cycle_at(monotonic()) {
            self.analysis.await_again(station, now);
        }
        Ok(())
    }
}
