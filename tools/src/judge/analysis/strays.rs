//! Who sends outside its slots: whatever it is that no program of a lab's stations tells the slot of.

use std::collections::BTreeMap;

use rtmac::wire::change::Extension;
use rtmac::wire::{Message, Rtmac};
use rtnet::clock::True;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType, Header};

use super::Analysis;
use crate::judge::findings::Author;

/// Addresses of no station that are counted one by one.
const STRANGERS_AT_MOST: usize = 8;
/// All others.
const OTHERS: &str = "others";

/// Frames of those who are no station.
#[derive(Debug, Default)]
pub struct Strangers(Vec<(Address, u64)>, u64);

impl Strangers {
    fn note(&mut self, from: Address) {
        let Self(known, others) = self;
        match known.iter().position(|(address, _)| *address == from) {
            Some(place) => known[place].1 += 1,
            None if known.len() < STRANGERS_AT_MOST => known.push((from, 1)),
            None => *others += 1,
        }
    }

    /// By address, and how many all the others have sent.
    pub fn named(&self) -> BTreeMap<String, u64> {
        let others = (OTHERS.to_owned(), self.1);
        let known = self.0.iter().map(|(address, frames)| (address.to_string(), *frames));
        known.chain([others]).filter(|&(_, frames)| frames > 0).collect()
    }
}

impl Analysis {
    /// An RTmac frame that is no Synchronisation: a reply is sent in a slot of who asked, or, late, in one of the master's own,
    /// or behind its Synchronisation. For a stranger, who has none, it is that one who is out of its slot.
    pub(super) fn judge_rtmac(&mut self, at: True, header: &Header, rtmac: Option<Rtmac>, air: Span) {
        let Header { source, destination, .. } = *header;
        let is_reply = matches!(rtmac, Some(Rtmac::Tdma(Message::Reply { .. })));
        let may_follow_sync = is_reply || matches!(rtmac, Some(Rtmac::Extension(Extension::Part(_))));
        if may_follow_sync && self.is_behind_sync(at, source, air) {
            return;
        }
        match self.station_of(destination).is_some() {
            _ if !is_reply => self.stray(at, source, &[source], air),
            true => self.stray(at, source, &[destination, source], air),
            false if self.givers.has(source) => {}
            false => self.stray(at, source, &[source], air),
        }
    }

    /// A part of a schedule, or a late reply, is in the sync window of whoever gives the time.
    fn is_behind_sync(&self, at: True, source: Address, air: Span) -> bool {
        let start = self.cycle_at(at).and_then(|cycle| self.start_of(cycle));
        let since = start.map(|start| self.error(at, start + self.givers.after(source)));
        self.givers.has(source)
            && since.is_some_and(|since| since >= Span::ZERO && since + air <= self.sync_window)
    }

    /// In which turn a frame of a station's sockets, or of its VNIC, left. It does not say so, as test traffic does: in the last one that has
    /// come, unless that is longer ago than a cycle.
    pub(super) fn turn_of(&self, at: True, header: &Header) -> Option<Author> {
        let sends = |of: &usize| match header.ether_type() {
            EtherType::EXPERIMENTAL => false,
            EtherType::RTMAC => self.has_tunnel[*of],
            _ => self.has_sockets[*of],
        };
        let station = self.station_of(header.source).filter(sends)?;
        // One that is a little early is of the turn that is about to come.
        let by = at.saturating_add_signed(self.clock_share.nanos());
        let now = self.cycle_at(by)?;
        let turns = [now, now.wrapping_sub(1)].into_iter().flat_map(|cycle| {
            let start = self.start_of(cycle);
            let begun = move |offset| start.filter(|&start| self.error(by, start + offset) >= Span::ZERO);
            let slots = self.timetable.usable(station, cycle);
            let slots =
                slots.filter_map(move |slot| Some((begun(slot.offset)? + slot.offset, cycle, slot.id)));
            slots.max_by_key(|(begin, ..)| begin.nanos())
        });
        turns.map(|(_, cycle, slot)| Author { station, cycle, slot: Some(slot) }).next()
    }

    /// A frame that is no test traffic is in a slot of a station that may use it, or its sender babbles.
    pub(super) fn stray(&mut self, at: True, source: Address, users: &[Address], air: Span) {
        let Some(cycle) = self.cycle_at(at).filter(|&cycle| self.counts(cycle)) else { return };
        let Some(start) = self.start_of(cycle) else { return };
        let is_in = |offset: Span, size| {
            let error = self.error(at, start + offset);
            -self.clock_share <= error && error + air <= self.length(size) - self.clock_share
        };
        let users = users.iter().filter_map(|&user| self.station_of(user));
        let mut slots = users.flat_map(|station| self.timetable.usable(station, cycle));
        let is_stray = !slots.any(|slot| is_in(slot.offset, slot.size));
        drop(slots);
        if is_stray {
            self.strays(source, cycle);
        }
    }

    /// A frame is outside its sender's slots.
    pub(super) fn strays(&mut self, source: Address, cycle: u32) {
        match self.station_of(source) {
            Some(station) => self.stations[station].strays(cycle),
            None => self.strangers.note(source),
        }
    }

    fn station_of(&self, address: Address) -> Option<usize> {
        self.addresses.iter().position(|&of| of == address)
    }
}
