//! What the wires of a lab do to frames, as its scenario says: by programs at the ports of its bridge.

use std::collections::BTreeMap;

use anyhow::{Result, anyhow};
use rtnet::live::{Chances, Impaired, Impairment};
use rtnet::sim::Link;
use rtnet::wire::ethernet::{Address, Header};

use super::namespace::Segment;
use super::run::port_name;
use crate::judge::delivery::Meant;
use crate::judge::syncs::sync_of;
use crate::scenario::{Conditions, Happening, Scenario, Wire};
use crate::station::traffic::Tag;

/// One for each station; none at all where nothing is to become of any frame, or the host does not let us.
#[derive(Default)]
pub struct Wires {
    all: Vec<Impairment>,
    /// Test traffic that was lost on the way to each station: usual frames, and by priority what programs queue.
    meant: Vec<BTreeMap<Option<u8>, Meant>>,
    /// Whose address is which, by station.
    addresses: Vec<Address>,
    /// Who is on the other side of a cut.
    cut_off: Vec<usize>,
}

impl Wires {
    /// As a scenario begins; with a line that says so if the host does not let us.
    pub fn of(scenario: &Scenario, segment: &Segment) -> Result<(Self, Option<String>)> {
        if !are_impaired(&scenario.conditions) {
            return Ok((Self::default(), None));
        }
        let mut wires = Self::default();
        for station in 0..scenario.stations.len() {
            match attach(segment, station)? {
                Ok(wire) => wires.all.push(wire),
                Err(line) => return Ok((Self::default(), Some(line))),
            }
        }
        let all: Vec<usize> = (0..scenario.stations.len()).collect();
        wires.meant = vec![BTreeMap::new(); all.len()];
        wires.addresses = all.iter().map(|&station| scenario.address(station)).collect();
        wires.set(&scenario.conditions, &all, None);
        Ok((wires, None))
    }

    /// A station has another port: its wire does there what it did, and counts on.
    pub fn mend(&mut self, segment: &Segment, station: usize) -> Result<()> {
        let Some(wire) = self.all.get_mut(station) else { return Ok(()) };
        let port = port(segment, station)?;
        let attached = segment.namespace().run(|| wire.attach_anew(port))?;
        attached.map_err(|refused| anyhow!("its new wire loses nothing: {refused} ({})", refused.remedy()))
    }

    /// What the wires of these stations do from now on: as they do throughout, or as an event says besides.
    pub fn set(&self, conditions: &Conditions, stations: &[usize], event: Option<&Wire>) {
        for (station, [sends, hears]) in conditions.links(stations, event) {
            let Some(wire) = self.all.get(station) else { continue };
            wire.sends(&chances(&sends));
            wire.hears(&chances(&hears));
        }
    }

    /// These stations hear each other only, and the others each other; none: all do.
    pub fn cut_off(&mut self, stations: &[usize]) {
        self.cut_off = stations.to_vec();
        for (station, wire) in self.all.iter().enumerate() {
            wire.cut_off(stations.contains(&station));
        }
    }

    /// What became of the frames for a station.
    pub fn counts(&self, station: usize) -> Impaired {
        self.all.get(station).map_or(Impaired::default(), Impairment::counts)
    }

    /// Whether the kernel does to frames what a scenario says.
    pub fn are_there(&self) -> bool {
        !self.all.is_empty()
    }

    /// Which usual frames of test traffic, or of a priority, did not get to a station.
    pub fn meant(&self, station: usize, of: Option<u8>) -> &Meant {
        static NONE: Meant = Meant::NONE;
        self.meant.get(station).and_then(|meant| meant.get(&of)).unwrap_or(&NONE)
    }

    /// Takes down what was lost since the last time; hands over which Synchronisations stations did not get, or not as they
    /// were sent: the station, whose and of which cycle, and whether the medium is cut between the two.
    pub fn take_lost(&mut self, mut to: impl FnMut(usize, (Address, u32), bool)) {
        let Self { all, meant, addresses, cut_off } = self;
        let is_cut_off = |of: Option<usize>| of.is_some_and(|of| cut_off.contains(&of));
        for (station, (wire, meant)) in all.iter_mut().zip(meant).enumerate() {
            wire.take_lost(|frame| {
                let source = Header::parse(&frame).map(|(header, _)| header.source);
                let is_its = |tag: &Tag| addresses.get(tag.station()).copied() == source;
                if let Some((tag, _)) = Tag::read(&frame).filter(|(tag, _)| is_its(tag)) {
                    meant.entry(tag.priority()).or_default().note(tag.sequence());
                } else if let Some(sync @ (from, _)) = sync_of(&frame) {
                    let sender = addresses.iter().position(|address| *address == from);
                    to(station, sync, is_cut_off(sender) != is_cut_off(Some(station)));
                }
            });
        }
    }
}

fn are_impaired(conditions: &Conditions) -> bool {
    let is_of_wires = |what: &Happening| matches!(what, Happening::Wires(..) | Happening::Cut(..));
    !conditions.wires.is_empty() || conditions.events.iter().any(|event| is_of_wires(&event.what))
}

/// A station's wire, or the line that says why there is none.
fn attach(segment: &Segment, station: usize) -> Result<Result<Impairment, String>> {
    let port = port(segment, station)?;
    let attached = segment.namespace().run(|| Impairment::attach(port))?;
    Ok(attached.map_err(|refused| {
        format!("wires lose nothing, and none is cut off: {refused} ({})", refused.remedy())
    }))
}

fn port(segment: &Segment, station: usize) -> Result<u32> {
    segment.namespace().netlink()?.link_index(&port_name(station))
}

fn chances(link: &Link) -> Chances {
    let &Link { lose_control_ppm, lose_data_ppm, corrupt_ppm, duplicate_ppm, .. } = link;
    Chances { lose_control_ppm, lose_data_ppm, corrupt_ppm, duplicate_ppm }
}

#[cfg(test)]
mod tests;
