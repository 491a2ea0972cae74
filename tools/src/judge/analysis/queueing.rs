//! Frames that programs queue: in which slot each left, and how long it had waited.

use std::collections::BTreeMap;

use rtnet::clock::True;
use rtnet::time::Span;

use super::{Analysis, Seen};
use crate::judge::delivery::BEYOND;
use crate::judge::findings::Author;
use crate::judge::worst::Worst;
use crate::report::histogram::SignedHistogram;
use crate::scenario::StationPlan;
use crate::station::traffic::{Tag, step};

/// What was seen of a station's traffic of one priority.
#[derive(Default)]
pub struct Queueing {
    /// From when each frame was queued until it was on the wire.
    pub delay: SignedHistogram,
    /// The longest.
    pub worst: Worst,
    /// The number of its newest frame, in a cycle that counts or not.
    newest: Option<u64>,
}

/// Of each priority that a station has traffic of, nothing yet.
pub(super) fn of_station(plan: &StationPlan) -> BTreeMap<u8, Queueing> {
    plan.flows.iter().map(|flow| (flow.priority, Queueing::default())).collect()
}

impl Seen {
    /// A number that the station has not come to in any of its traffic, however much of it has not been seen yet.
    pub fn beyond(&self) -> u64 {
        let newest = self.queueing.values().filter_map(|seen| seen.newest);
        newest.map(|number| number + BEYOND).fold(self.passed.beyond(), u64::max)
    }
}

impl Analysis {
    /// Whose frame it is, and of which slot of which cycle: it says so, unless it was queued for whatever slot its
    /// priority brings it to. None if its station queues none of that priority.
    pub fn author_of(&self, at: True, tag: &Tag, len: usize) -> Option<Author> {
        let (station, air) = (tag.station(), self.rate.air_time(len));
        let seen = self.stations.get(station)?;
        let Some(priority) = tag.priority() else {
            return Some(Author { station, cycle: tag.cycle(), slot: Some(tag.slot) });
        };
        seen.queueing.contains_key(&priority).then_some(())?;
        let (cycle, slot) = self.turn_of(station, at, air).unwrap_or((tag.cycle(), tag.slot));
        Some(Author { station, cycle, slot: Some(slot) })
    }

    /// The turn of a station to which a frame belongs that is on the medium then: the newest, if it is within its slot;
    /// else it was held up, in the oldest of which no frame was seen.
    fn turn_of(&self, station: usize, at: True, air: Span) -> Option<(u32, u8)> {
        let cycle = self.cycle_at(at + self.clock_share.nanos() as u64)?;
        let ids = self.timetable.ids(station);
        let error = |(cycle, id)| self.slot_error(at, Author { station, cycle, slot: Some(id) });
        let begun = |&turn: &(u32, u8)| error(turn).is_some_and(|error| error >= -self.clock_share);
        let newest = ids.iter().filter_map(|&id| {
            let back = self.timetable.at(station, id, cycle)?.period;
            let turns = self.timetable.turns(station, id, cycle.wrapping_sub(back), cycle.wrapping_add(1));
            turns.map(|cycle| (cycle, id)).filter(begun).last()
        });
        let newest = newest.min_by_key(|&turn| error(turn))?;
        let length = self.length(self.timetable.at(station, newest.1, newest.0)?.size);
        if error(newest).is_some_and(|error| error + air <= length - self.clock_share) {
            return Some(newest);
        }
        let from = self.window.map_or(cycle, |(from, _)| from);
        let unseen = ids.iter().filter_map(|&id| {
            let next = self.next_turn(station, id, from);
            let mut turns = self.timetable.turns(station, id, next, cycle.wrapping_add(1));
            turns.next().map(|cycle| (cycle, id)).filter(begun)
        });
        unseen.max_by_key(|&turn| error(turn)).or(Some(newest))
    }

    /// A queued frame is on the wire, in a cycle that counts or not.
    pub(super) fn note_queued(&mut self, at: True, tag: &Tag, author: Author) {
        let (waited, counts) = (self.error(at, tag.scheduled()), self.counts(author.cycle));
        let queueing = &mut self.stations[author.station].queueing;
        let Some(seen) = tag.priority().and_then(|priority| queueing.get_mut(&priority)) else { return };
        // What a receiver does not believe is not believed here.
        if step(seen.newest, tag.sequence()).is_some() {
            seen.newest = Some(tag.sequence());
        }
        if counts {
            seen.delay.record(waited.nanos());
            seen.worst.note(waited.nanos(), author.cycle);
        }
    }
}

#[cfg(test)]
mod tests {
    use rtmac::wire::Message;
    use rtnet::buf::Pool;
    use rtnet::clock::EmulatedClock;
    use rtnet::discipline::{Opportunity, Service};
    use rtnet::time::{GlobalTime, Instant, Offset};
    use rtnet::wire::ethernet::Address;

    use super::*;
    use crate::judge::findings::FindingKind;
    use crate::judge::givers::TrueMaster;
    use crate::scenario::{Scenario, Source};
    use crate::station::traffic::{Traffic, TrafficPlan};

    const NETWORK: &str = r#"
cycle = "1ms"
rate = "100M"
[[station]]
name = "master"
role = "master"
slots = [{ id = 0, offset = "100us" }]
[[station]]
name = "arm"
role = "slave"
slots = [{ id = 0, offset = "500us", size = 64 }]
[[station.traffic]]
priority = 3
every = "2ms"
"#;
    const ARM: usize = 1;
    const SLOT: u64 = 500_000;

    /// The frames of an arm whose clock is the true one, in cycles 10 to 14; in cycle 12 there is one that was queued, this
    /// much late.
    fn seen(late: u64) -> (Scenario, Analysis) {
        let scenario = Source { file: "net.toml", text: NETWORK }.parse().unwrap().with_ideal_clocks();
        let master = TrueMaster { clock: EmulatedClock::default(), epoch: Offset::default() };
        let mut analysis = Analysis::new(&scenario, master);
        analysis.begin(10, 5);
        let nobody = Address::default();
        let plan = TrafficPlan {
            station: ARM as u16,
            source: nobody,
            destination: nobody,
            from: 0,
            payload: 64,
            from_payload: 64,
            first: 0,
        };
        let mut traffic = Traffic::new(plan, Default::default()).with_flows(scenario.flow_plan(ARM));
        let mut held_up: Option<(u64, Vec<u8>)> = None;
        for cycle in 9..=15_u32 {
            let start = u64::from(cycle) * 1_000_000;
            let (begin, scheduled) =
                (Instant::from_nanos(start + SLOT), GlobalTime::from_nanos(start + SLOT));
            let mut frame = None;
            traffic.poll(&Opportunity { channel: 0, cycle, begin, scheduled }, &mut |made, _, _| {
                frame = Some(made);
                Ok(())
            });
            if let Some((at, frame)) = held_up.take_if(|(at, _)| *at < start) {
                analysis.frame(at, &frame);
            }
            let (sched, mut sync) = (GlobalTime::from_nanos(start), Pool::new(1).take().unwrap());
            Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, nobody, &mut sync);
            analysis.frame(start, &sync);
            if let (12, Some(frame)) = (cycle, &frame) {
                assert_eq!(Tag::read(frame).unwrap().0.priority(), Some(3));
                held_up = Some((start + SLOT + late, frame.to_vec()));
            } else if let Some(frame) = frame {
                // Who is held up sends nothing else.
                let is_held_up = held_up.as_ref().is_some_and(|(at, _)| *at > start + SLOT);
                if let Some((at, frame)) = held_up.take_if(|_| !is_held_up) {
                    analysis.frame(at, &frame);
                }
                if !is_held_up {
                    analysis.frame(start + SLOT, &frame);
                }
            }
        }
        analysis.finish();
        (scenario, analysis)
    }

    fn of_the_arm(analysis: &Analysis) -> Vec<(FindingKind, u32, Span)> {
        let of = analysis.findings.iter().filter(|of| of.authors[0].is_some_and(|a| a.station == ARM));
        of.map(|of| (of.kind, of.cycle, of.span)).collect()
    }

    #[test]
    fn a_slot_that_a_queued_frame_takes_is_not_missed_and_its_delay_is_known() {
        let (_, analysis) = seen(0);
        let arm = &analysis.stations[ARM];
        assert_eq!((of_the_arm(&analysis), arm.frames, analysis.expected(ARM)), (vec![], 5, 5));
        let [(3, queueing)] = &arm.queueing.iter().map(|(p, of)| (*p, of)).collect::<Vec<_>>()[..] else {
            panic!()
        };
        // Those of cycles 10, 12 and 14 are queued at their starts.
        assert_eq!((queueing.delay.len(), queueing.delay.min(), queueing.delay.max()), (3, 500_000, 500_000));
        assert_eq!((queueing.worst.cycle(), queueing.newest), (Some(10), Some(2)));
    }

    #[test]
    fn a_queued_frame_that_is_held_up_is_of_the_turn_that_it_was_chosen_for() {
        let missed = (FindingKind::SlotMissed, 13, Span::ZERO);
        for (late, missed) in [(430_000, None), (700_000, None), (1_430_000, Some(missed))] {
            let (_, analysis) = seen(late);
            let held_up = (FindingKind::OutOfSlot, 12, Span::from_nanos(late as i64));
            let expected: Vec<_> = [Some(held_up), missed].into_iter().flatten().collect();
            assert_eq!(of_the_arm(&analysis), expected, "{late}");
            let worst = &analysis.stations[ARM].queueing[&3].worst;
            assert_eq!((worst.cycle(), worst.value()), (Some(12), Some(500_000 + late as i64)));
        }
    }

    #[test]
    fn traffic_of_a_priority_that_nobody_has_is_nobodys() {
        let (scenario, analysis) = seen(0);
        let mut plan = scenario.flow_plan(ARM);
        plan.flows[0].priority = 4;
        let of = |flows| {
            let address = Address::default();
            let plan = TrafficPlan {
                station: ARM as u16,
                source: address,
                destination: address,
                from: 0,
                payload: 64,
                from_payload: 64,
                first: 0,
            };
            let mut made = None;
            let mut traffic = Traffic::new(plan, Default::default()).with_flows(flows);
            for cycle in [10_u32, 12] {
                let at = u64::from(cycle) * 1_000_000 + SLOT;
                let (begin, scheduled) = (Instant::from_nanos(at), GlobalTime::from_nanos(at));
                traffic.poll(&Opportunity { channel: 0, cycle, begin, scheduled }, &mut |frame, _, _| {
                    made = Some(frame.to_vec());
                    Ok(())
                });
            }
            let frame = made.unwrap();
            analysis.author_of(12_500_000, Tag::read(&frame).unwrap().0, frame.len())
        };
        assert_eq!(of(plan), None);
        let author = Author { station: ARM, cycle: 12, slot: Some(0) };
        assert_eq!(of(scenario.flow_plan(ARM)), Some(author));
    }
}
