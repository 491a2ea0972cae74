//! A station that is held up inside `send`, where what it sends does not say of which of its turns it is: they are so
//! near to each other that a frame is soon taken for another's.

use super::*;
use crate::judge::explain::Records;
use crate::scenario::SlotPlan;
use crate::scenario::Source;
use rtmac::wire::{FLAG_TUNNEL, RTMAC_VERSION};
use rtnet::discipline::{Cause, EventKind};
use zerocopy::IntoBytes;

const NETWORK: &str = r#"
cycle = "1ms"
[[station]]
name = "serves"
role = "master"
vnic = "10.1.0.1/24"
slots = [
    { id = 0, offset = "75us", phase = "1/2", size = 64 },
    { id = 1, offset = "150us" },
    { id = 2, offset = "300us", joint = 1 },
    { id = 3, offset = "450us", joint = 1 },
]
[[station]]
name = "fetches"
role = "slave"
vnic = "10.1.0.2/24"
slots = [{ id = 1, offset = "225us" }, { id = 2, offset = "375us", joint = 1 }, { id = 3, offset = "900us", joint = 1 }]
"#;
/// In this one somebody is held up.
const IN: u32 = FIRST + 1;

/// What two stations with much to send did, and told of it.
struct Course {
    scenario: Scenario,
    records: Records,
    /// When what was on the medium.
    frames: Vec<(u64, Vec<u8>)>,
}

impl Course {
    /// One of them was held up in a turn, by so much, if any: its frame was on the medium at the end of that.
    fn of(held_up: Author, by: u64) -> Self {
        let scenario = Source::new("net.toml", NETWORK).parse().unwrap().with_ideal_clocks();
        let (records, frames) = (Records::new(&scenario), Vec::new());
        let mut course = Self { scenario, records, frames };
        (0..2).for_each(|station| course.station(station, held_up, by));
        course.frames.sort();
        course
    }

    /// All turns of one station, one after the other.
    fn station(&mut self, station: usize, held_up: Author, by: u64) {
        let mut turns: Vec<(u64, Author)> = (FIRST..=FIRST + CYCLES)
            .flat_map(|cycle| {
                let at = move |offset: i64| u64::from(cycle) * CYCLE + offset as u64;
                let sync = Some((at(0), Author::sync(0, cycle))).filter(|_| station == 0);
                let of = |slot: &SlotPlan| {
                    let author = Author { station, cycle, slot: Some(slot.id) };
                    (cycle % slot.period == slot.phase).then_some((at(slot.offset.nanos()), author))
                };
                sync.into_iter()
                    .chain(self.scenario.stations[station].slots.iter().filter_map(of))
                    .collect::<Vec<_>>()
            })
            .collect();
        turns.sort_by_key(|&(at, _)| at);
        let mut free = 0;
        for (due, author) in turns {
            let begin = due.max(free);
            let good_for =
                if author.slot.is_none() { self.scenario.sync_window } else { self.scenario.latest() };
            let latest = due + good_for.nanos() as u64;
            if begin > latest {
                let kind = if author.slot.is_none() { EventKind::SyncSkipped } else { EventKind::Overrun };
                self.tell(author, kind, begin - latest);
                continue;
            }
            let on_the_medium = if author == held_up { begin + by } else { begin };
            // It looks at its clock when the frame is out.
            free = on_the_medium + 2_000;
            if free > latest {
                self.tell(author, EventKind::StalledInSend, free - latest);
            }
            let frame = self.frame(author);
            self.frames.push((on_the_medium, frame));
        }
    }

    fn tell(&mut self, author: Author, kind: EventKind, by: u64) {
        self.records.note(author, kind, Span::from_nanos(by as i64), Some(Cause::Preempted));
    }

    /// Its Synchronisation, or as large a tunnelled frame as fits.
    fn frame(&self, author: Author) -> Vec<u8> {
        let from = self.scenario.address(author.station);
        if author.slot.is_some() {
            let header = Header::new(Address::BROADCAST, from, EtherType::RTMAC);
            let [high, low] = EtherType::IPV4.0.to_be_bytes();
            let mut frame = [header.as_bytes(), &[high, low, RTMAC_VERSION, FLAG_TUNNEL]].concat();
            frame.resize(1_514, 0);
            return frame;
        }
        let sched = GlobalTime::from_nanos(u64::from(author.cycle) * CYCLE);
        let mut frame = Pool::new(1).take().unwrap();
        Message::Sync { cycle: author.cycle, xmit: sched, sched }.write(Address::BROADCAST, from, &mut frame);
        frame.to_vec()
    }

    fn judge(&self) -> Analysis {
        let master = TrueMaster { clock: EmulatedClock::default(), epoch: Offset::default() };
        let mut analysis = Analysis::new(&self.scenario, master);
        analysis.begin(FIRST, CYCLES);
        self.frames.iter().for_each(|(at, frame)| analysis.frame(*at, frame));
        analysis.finish();
        analysis
    }
}

#[test]
fn a_tunnelled_frame_that_is_held_up_for_however_long_leaves_nothing_unexplained() {
    let turns = [(0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3)];
    let mut taken_for_anothers = 0;
    for (station, slot) in turns {
        // For longer, and the slave would be without two Synchronisations, and silent.
        for by in (0..3 * CYCLE / 2).step_by(10_000) {
            let held_up = Author { station, cycle: IN, slot: Some(slot) };
            let course = Course::of(held_up, by);
            let findings = course.judge().findings;
            let unexplained: Vec<_> =
                findings.iter().filter(|of| course.records.explain(of).is_none()).collect();
            assert!(unexplained.is_empty(), "{held_up:?} by {by} ns: {unexplained:?}");
            let is_missed =
                |of: &&Finding| of.kind == FindingKind::SlotMissed && of.authors[0] == Some(held_up);
            taken_for_anothers += findings.iter().filter(is_missed).count();
        }
    }
    assert!(taken_for_anothers > 500, "{taken_for_anothers}");
}
