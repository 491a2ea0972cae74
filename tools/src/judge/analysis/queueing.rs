//! Frames that programs queue: which there were, and how long each had waited.

use std::collections::BTreeMap;

use rtnet::clock::True;
use rtnet::wire::ethernet::Header;

use super::{Analysis, Seen};
use crate::judge::delivery::Passed;
use crate::judge::findings::Author;
use crate::judge::worst::Worst;
use crate::report::histogram::SignedHistogram;
use crate::scenario::StationPlan;
use crate::station::traffic::Tag;

/// What was seen of a station's traffic of one priority.
#[derive(Default)]
pub struct Queueing {
    /// From when each frame was queued until it was on the wire.
    pub delay: SignedHistogram,
    /// The longest.
    pub worst: Worst,
    /// Which of its frames were on the medium.
    pub passed: Passed,
}

/// Of each priority that a station has traffic of, nothing yet.
pub(super) fn of_station(plan: &StationPlan) -> BTreeMap<u8, Queueing> {
    plan.flows.iter().map(|flow| (flow.priority, Queueing::default())).collect()
}

impl Seen {
    /// A number that the station has not come to in any of its traffic, however much of it has not been seen yet.
    pub fn beyond(&self) -> u64 {
        self.queueing.values().map(|seen| seen.passed.beyond()).fold(self.passed.beyond(), u64::max)
    }

    /// Which of its frames with this [`Tag::priority`] were on the medium; none if it has no such frames.
    pub fn passed(&self, of: Option<u8>) -> Option<&Passed> {
        of.map_or(Some(&self.passed), |priority| Some(&self.queueing.get(&priority)?.passed))
    }
}

impl Analysis {
    /// What a frame of test traffic says of itself, and whose it is, of which slot of which cycle. None if it only looks like
    /// one: it is not as its station made it, not from that one's address, or of a priority of which that one queues none.
    pub fn author_of<'a>(&self, frame: &'a [u8]) -> Option<(&'a Tag, Author)> {
        let tag = Tag::of_intact(frame)?;
        let (station, source) = (tag.station(), Header::parse(frame)?.0.source);
        self.addresses.get(station).filter(|&&address| address == source)?;
        self.stations.get(station)?.passed(tag.priority())?;
        Some((tag, Author { station, cycle: tag.cycle(), slot: Some(tag.slot) }))
    }

    /// A queued frame is on the wire, in a cycle that counts or not.
    pub(super) fn note_queued(&mut self, at: True, tag: &Tag, author: Author) {
        let (waited, counts) = (self.error(at, tag.scheduled()), self.counts(author.cycle));
        let queueing = &mut self.stations[author.station].queueing;
        let Some(seen) = tag.priority().and_then(|priority| queueing.get_mut(&priority)) else { return };
        seen.passed.note(tag.sequence(), at, counts);
        if counts {
            seen.delay.record(waited.nanos());
            seen.worst.note(waited.nanos(), author.cycle);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use rtmac::wire::Message;
    use rtnet::buf::Pool;
    use rtnet::clock::EmulatedClock;
    use rtnet::discipline::{Opportunity, Service};
    use rtnet::time::{GlobalTime, Instant, Offset, Span};
    use rtnet::wire::ethernet::Address;

    use super::*;
    use crate::judge::findings::FindingKind;
    use crate::judge::givers::TrueMaster;
    use crate::scenario::{Scenario, Source};
    use crate::station::traffic::SKIPPED;
    use crate::station::traffic::{FlowPlan, Traffic, TrafficCounts, TrafficPlan};

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

    fn with_flows(plan: TrafficPlan, flows: FlowPlan) -> Traffic {
        Traffic::new(plan, Arc::new(TrafficCounts::of(&flows))).with_flows(flows)
    }

    /// The frames of an arm whose clock is the true one, in cycles 10 to 14, but in one that it missed; in cycle 12 there is
    /// one that was queued, this much late.
    fn seen(late: u64, missed: Option<u32>) -> (Scenario, Analysis) {
        let scenario = Source::new("net.toml", NETWORK).parse().unwrap().with_ideal_clocks();
        let master = TrueMaster { clock: EmulatedClock::default(), epoch: Offset::default() };
        let mut analysis = Analysis::new(&scenario, master);
        analysis.begin(10, 5);
        let nobody = Address::default();
        let plan = TrafficPlan {
            station: ARM as u16,
            source: scenario.address(ARM),
            destination: nobody,
            from: 0,
            payload: 64,
            from_payload: 64,
            first: 0,
        };
        let mut traffic = with_flows(plan, scenario.flow_plan(ARM));
        let mut held_up: Option<(u64, Vec<u8>)> = None;
        for cycle in 9..=15_u32 {
            let start = u64::from(cycle) * 1_000_000;
            let (begin, scheduled) =
                (Instant::from_nanos(start + SLOT), GlobalTime::from_nanos(start + SLOT));
            let slot = Opportunity { channel: 0, cycle, begin, scheduled, non_rt: None };
            let mut frame = None;
            traffic.poll(&slot, &mut |made, _, _| {
                frame = Some(made);
                Ok(())
            });
            if frame.is_none() {
                traffic.fill(&slot, None, &mut |made, _, _| {
                    frame = Some(made);
                    Ok(())
                });
            }
            let mut frame = frame.filter(|_| missed != Some(cycle));
            if let Some(frame) = &mut frame {
                traffic.leaves(&slot, frame);
            }
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
        let (_, analysis) = seen(0, None);
        let arm = &analysis.stations[ARM];
        assert_eq!((of_the_arm(&analysis), arm.frames, analysis.expected(ARM)), (vec![], 5, 5));
        let [(3, queueing)] = &arm.queueing.iter().map(|(p, of)| (*p, of)).collect::<Vec<_>>()[..] else {
            panic!()
        };
        // Those of cycles 10, 12 and 14 are queued at their starts.
        assert_eq!((queueing.delay.len(), queueing.delay.min(), queueing.delay.max()), (3, 500_000, 500_000));
        assert_eq!((queueing.worst.cycle(), queueing.passed.beyond()), (Some(10), SKIPPED + 2));
    }

    #[test]
    fn a_queued_frame_that_is_held_up_is_of_the_turn_that_it_was_chosen_for() {
        let missed = (FindingKind::SlotMissed, 13, Span::ZERO);
        // The third one is where that of cycle 13 was to be.
        for (late, missed) in
            [(430_000, None), (700_000, None), (1_000_500, Some(missed)), (1_430_000, Some(missed))]
        {
            let (_, analysis) = seen(late, None);
            let held_up = (FindingKind::OutOfSlot, 12, Span::from_nanos(late as i64));
            let expected: Vec<_> = [Some(held_up), missed].into_iter().flatten().collect();
            assert_eq!(of_the_arm(&analysis), expected, "{late}");
            let worst = &analysis.stations[ARM].queueing[&3].worst;
            assert_eq!((worst.cycle(), worst.value()), (Some(12), Some(500_000 + late as i64)));
        }
    }

    #[test]
    fn a_queued_frame_that_is_held_up_right_behind_a_missed_turn_is_of_its_own() {
        let (_, analysis) = seen(700_000, Some(11));
        let held_up = (FindingKind::OutOfSlot, 12, Span::from_nanos(700_000));
        assert_eq!(of_the_arm(&analysis), [held_up, (FindingKind::SlotMissed, 11, Span::ZERO)]);
    }

    #[test]
    fn traffic_of_a_priority_that_nobody_has_is_nobodys() {
        let (scenario, analysis) = seen(0, None);
        let mut plan = scenario.flow_plan(ARM);
        plan.flows[0].priority = 4;
        let of = |flows| {
            let plan = TrafficPlan {
                station: ARM as u16,
                source: scenario.address(ARM),
                destination: Address::default(),
                from: 0,
                payload: 64,
                from_payload: 64,
                first: 0,
            };
            let mut made = None;
            let mut traffic = with_flows(plan, flows);
            for cycle in [10_u32, 12] {
                let at = u64::from(cycle) * 1_000_000 + SLOT;
                let (begin, scheduled) = (Instant::from_nanos(at), GlobalTime::from_nanos(at));
                traffic.poll(
                    &Opportunity { channel: 0, cycle, begin, scheduled, non_rt: None },
                    &mut |frame, _, _| {
                        made = Some(frame.to_vec());
                        Ok(())
                    },
                );
            }
            let frame = made.unwrap();
            analysis.author_of(&frame).map(|(_, author)| author)
        };
        assert_eq!(of(plan), None);
        let author = Author { station: ARM, cycle: 12, slot: Some(0) };
        assert_eq!(of(scenario.flow_plan(ARM)), Some(author));
    }
}
