//! A station that is held up inside `send`, alone or with its host, where what it sends does not say of which of its turns
//! it is: they are so near to each other that a frame is soon taken for another's.

use super::*;
use crate::judge::explain::Records;
use crate::judge::syncs::sync_of;
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

/// Who is held up in which turn, and by how much.
#[derive(Clone, Copy)]
struct Pause {
    turn: Author,
    by: u64,
    /// Whether the other one stands still meanwhile, too.
    of_host: bool,
}

/// What two stations with much to send did, and told of it.
struct Course {
    scenario: Scenario,
    records: Records,
    /// When what was on the medium.
    frames: Vec<(u64, Vec<u8>)>,
}

impl Course {
    /// The frame that was held up was on the medium at the end of that.
    fn of(pause: Pause) -> Self {
        let scenario = Source::new("net.toml", NETWORK).parse().unwrap().with_ideal_clocks();
        let (records, frames) = (Records::new(&scenario), Vec::new());
        let mut course = Self { scenario, records, frames };
        (0..2).for_each(|station| course.station(station, pause));
        course.frames.sort();
        for (_, frame) in &course.frames {
            course.records.note_frame(frame);
        }
        course
    }

    /// When a turn is to begin, or the cycle's Synchronisation.
    fn due(&self, Author { station, cycle, slot }: Author) -> u64 {
        let its = self.scenario.stations[station].slots.iter().find(|its| Some(its.id) == slot);
        u64::from(cycle) * CYCLE + its.map_or(0, |its| its.offset.nanos() as u64)
    }

    /// All turns of one station, one after the other.
    fn turns(&self, station: usize) -> Vec<(u64, Author)> {
        let of_cycle = |cycle: u32| {
            let slots = self.scenario.stations[station].slots.iter();
            let slots = slots.filter(move |slot| cycle % slot.period == slot.phase);
            let slots = slots.map(move |slot| Author { station, cycle, slot: Some(slot.id) });
            (station == 0).then_some(Author::sync(0, cycle)).into_iter().chain(slots)
        };
        let all = (FIRST..=FIRST + CYCLES).flat_map(of_cycle);
        let mut turns: Vec<_> = all.map(|author| (self.due(author), author)).collect();
        turns.sort_by_key(|&(due, _)| due);
        turns
    }

    /// What one station made of its turns. The master comes first.
    fn station(&mut self, station: usize, Pause { turn, by, of_host }: Pause) {
        let stands_still = self.due(turn)..self.due(turn) + by;
        let mut free = 0;
        for (due, author) in self.turns(station) {
            let mut begin = due.max(free);
            if of_host && station != turn.station && stands_still.contains(&begin) {
                begin = stands_still.end;
            }
            let good_for =
                if author.slot.is_none() { self.scenario.sync_window } else { self.scenario.latest() };
            let latest = due + good_for.nanos() as u64;
            if begin > latest {
                let kind = if author.slot.is_none() { EventKind::SyncSkipped } else { EventKind::Overrun };
                self.tell(author, kind, begin - latest);
                continue;
            }
            if station != 0 && !self.has_sync(begin, author.cycle) {
                self.tell(author, EventKind::SlotSilent, 0);
                continue;
            }
            let on_the_medium = if author == turn { begin + by } else { begin };
            // It looks at its clock when the frame is out.
            free = on_the_medium + 2_000;
            if free > latest {
                self.tell(author, EventKind::StalledInSend, free - latest);
            }
            let frame = self.frame(author);
            self.frames.push((on_the_medium, frame));
        }
    }

    /// Whether a slave has had the Synchronisation of a cycle by then, or the one before.
    fn has_sync(&self, by: u64, cycle: u32) -> bool {
        let of = |frame: &[u8]| sync_of(frame).is_some_and(|(_, of)| cycle.wrapping_sub(of) <= 1);
        cycle == FIRST || self.frames.iter().any(|(at, frame)| *at <= by && of(frame))
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

/// What becomes of a frame that is held up for less than `longest`: how many findings there are of this kind.
fn all_is_explained(longest: u64, of_host: bool, counted: FindingKind) -> usize {
    let turns = [(0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3)];
    let turns = turns.map(|(station, slot)| Author { station, cycle: IN, slot: Some(slot) });
    let pauses = turns
        .iter()
        .flat_map(|&turn| (0..longest).step_by(10_000).map(move |by| Pause { turn, by, of_host }));
    let of_kind = pauses.map(|pause| {
        let course = Course::of(pause);
        let findings = course.judge().findings;
        let unexplained: Vec<_> = findings.iter().filter(|of| course.records.explain(of).is_none()).collect();
        assert!(unexplained.is_empty(), "{:?} by {} ns: {unexplained:?}", pause.turn, pause.by);
        findings.iter().filter(|of| of.kind == counted).count()
    });
    of_kind.sum()
}

#[test]
fn a_tunnelled_frame_that_is_held_up_for_however_long_leaves_nothing_unexplained() {
    let missed = all_is_explained(4 * CYCLE, false, FindingKind::SlotMissed);
    assert!(missed > 500, "{missed}");
}

#[test]
fn nor_does_one_whose_host_stands_still_meanwhile_and_sends_no_synchronisations() {
    let without_sync = all_is_explained(4 * CYCLE, true, FindingKind::WithoutSync);
    assert!(without_sync > 100, "{without_sync}");
}
