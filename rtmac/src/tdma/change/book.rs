//! A schedule as stations hold it: all slots of all stations, and the cycle.

use rtnet::counters::Refusal;
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::super::config::{Refused, check_cycle};
use super::super::joint;
use super::super::slot::SlotConfig;
use crate::wire::change::{Part, ScheduleId};

/// Most slots of a schedule: one part comes with each cycle, and a station that joins waits for all of them.
pub const MAX_PLANNED: usize = 1_024;
const WORDS: usize = MAX_PLANNED / 64;

/// A slot, and whose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Planned {
    /// Whose.
    pub station: Address,
    /// Which.
    pub slot: SlotConfig,
}

/// A whole schedule, or what has come of one.
#[derive(Clone, Debug)]
pub struct Book {
    id: ScheduleId,
    digest: u64,
    cycle: Span,
    /// As many places as it has slots; those that have not come are marked in `has`.
    planned: Vec<Planned>,
    has: [u64; WORDS],
    missing: usize,
    capacity: usize,
}

impl Book {
    /// Nothing, for so many slots. What comes later takes no memory if it is reserved.
    pub fn empty(capacity: usize, is_reserved: bool) -> Self {
        let capacity = capacity.min(MAX_PLANNED);
        Self {
            id: ScheduleId::default(),
            digest: 0,
            cycle: Span::ZERO,
            planned: Vec::with_capacity(if is_reserved { capacity } else { 0 }),
            has: [0; WORDS],
            missing: 0,
            capacity,
        }
    }

    /// A schedule, not numbered yet, from slots in any order. What no station could take is refused by name.
    pub fn of(cycle: Span, slots: impl IntoIterator<Item = (Address, SlotConfig)>) -> Result<Self, Refused> {
        check_cycle(cycle)?;
        let mut all: Vec<(Address, SlotConfig)> = slots.into_iter().collect();
        all.sort_by_key(|(station, _)| *station);
        let mut planned = Vec::with_capacity(all.len());
        for own in all.chunk_by(|a, b| a.0 == b.0) {
            let slots: Vec<SlotConfig> = own.iter().map(|&(_, slot)| slot).collect();
            let mut slots = joint::resolved(&slots)?;
            // Those that others are joined to come first.
            slots.sort_by_key(|slot| (slot.joint.is_some(), slot.id));
            planned.extend(slots.into_iter().map(|slot| Planned { station: own[0].0, slot }));
        }
        if !(1..=MAX_PLANNED).contains(&planned.len()) {
            return Err(Refused::ScheduleSize { slots: planned.len(), most: MAX_PLANNED });
        }
        let digest = digest(cycle, &planned);
        let capacity = planned.len();
        Ok(Self { id: ScheduleId::default(), digest, cycle, planned, has: [!0; WORDS], missing: 0, capacity })
    }

    /// The same schedule under this number.
    pub fn numbered(mut self, number: u16) -> Self {
        self.id = ScheduleId { number, sum: sum(self.digest) };
        self
    }

    /// Takes another's content and gives it a number; the memory stays.
    pub fn copy_from(&mut self, other: &Book, number: u16) -> Result<(), Refused> {
        if other.planned.len() > self.capacity {
            return Err(Refused::ScheduleSize { slots: other.planned.len(), most: self.capacity });
        }
        self.planned.clear();
        self.planned.extend_from_slice(&other.planned);
        (self.digest, self.cycle, self.has, self.missing) = (other.digest, other.cycle, [!0; WORDS], 0);
        self.id = ScheduleId { number, sum: sum(self.digest) };
        Ok(())
    }

    /// What comes from now on is of this schedule.
    pub fn begin(&mut self, id: ScheduleId) {
        self.planned.clear();
        (self.id, self.digest, self.has, self.missing) = (id, 0, [0; WORDS], usize::MAX);
    }

    /// For so many slots.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// One part of it has come; `true` if it is whole by that.
    pub fn take(&mut self, part: &Part) -> Result<bool, Refusal> {
        if part.id != self.id || self.missing == 0 {
            return if part.id == self.id { Ok(false) } else { Err(Refusal::ScheduleUnknown) };
        }
        let (slots, index) = (usize::from(part.slots), usize::from(part.index));
        if slots > self.capacity {
            return Err(Refusal::ScheduleTooLarge);
        }
        let is_another = (self.digest, self.cycle, self.planned.len()) != (part.digest, part.cycle, slots);
        if self.missing > slots || is_another {
            let nobody = Planned { station: Address::default(), slot: part.slot };
            self.planned.clear();
            self.planned.resize(slots, nobody);
            (self.digest, self.cycle, self.has, self.missing) = (part.digest, part.cycle, [0; WORDS], slots);
        }
        let (word, bit) = (index / 64, 1u64 << (index % 64));
        if self.has[word] & bit == 0 {
            self.planned[index] = Planned { station: part.station, slot: part.slot };
            self.has[word] |= bit;
            self.missing -= 1;
        }
        if self.missing > 0 {
            return Ok(false);
        }
        if digest(self.cycle, &self.planned) != self.digest || sum(self.digest) != self.id.sum {
            self.begin(self.id);
            return Err(Refusal::ScheduleFormat);
        }
        Ok(true)
    }

    /// Whether this schedule is here, and nothing of it is missing.
    pub fn holds(&self, id: ScheduleId) -> bool {
        self.id == id && self.missing == 0 && !self.planned.is_empty()
    }

    /// One part of it, as it is sent.
    pub fn part(&self, index: usize) -> Option<Part> {
        let Planned { station, slot } = *self.planned.get(index)?;
        let (slots, index) = (self.planned.len() as u16, index as u16);
        Some(Part { id: self.id, digest: self.digest, slots, index, cycle: self.cycle, station, slot })
    }

    /// Which it is.
    pub fn id(&self) -> ScheduleId {
        self.id
    }
    /// Over all of it.
    pub fn digest(&self) -> u64 {
        self.digest
    }
    /// From one cycle's start to the next.
    pub fn cycle(&self) -> Span {
        self.cycle
    }
    /// All slots, station by station.
    pub fn planned(&self) -> &[Planned] {
        &self.planned
    }
    /// One station's slots, those that others are joined to first.
    pub fn of_station(&self, station: Address) -> impl Iterator<Item = SlotConfig> + '_ {
        self.planned.iter().filter(move |planned| planned.station == station).map(|planned| planned.slot)
    }
    /// Every station that has slots, once.
    pub fn stations(&self) -> impl Iterator<Item = Address> + '_ {
        let is_first =
            |&(i, planned): &(usize, &Planned)| i == 0 || self.planned[i - 1].station != planned.station;
        self.planned.iter().enumerate().filter(is_first).map(|(_, planned)| planned.station)
    }
    /// The longest of all slots' periods.
    pub fn longest_period(&self) -> u32 {
        self.planned.iter().map(|planned| planned.slot.period).max().unwrap_or(1)
    }
}

/// FNV-1a over everything, in 64 bits.
fn digest(cycle: Span, planned: &[Planned]) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    let mut add = |bytes: &[u8]| {
        for &byte in bytes {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    };
    add(&cycle.nanos().to_be_bytes());
    for Planned { station, slot } in planned {
        add(&station.0);
        add(&[slot.id, slot.joint.map_or(0, |joint| joint.wrapping_add(1))]);
        add(&slot.offset.nanos().to_be_bytes());
        add(&slot.latest.nanos().to_be_bytes());
        add(&slot.phase.to_be_bytes());
        add(&slot.period.to_be_bytes());
        add(&(slot.size as u32).to_be_bytes());
    }
    hash
}

fn sum(digest: u64) -> u16 {
    (digest ^ digest >> 16 ^ digest >> 32 ^ digest >> 48) as u16
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn slot(id: u8, micros: i64, joint: Option<u8>) -> SlotConfig {
        let (offset, latest) = (Span::from_micros(micros), Span::from_micros(10));
        SlotConfig { id, offset, phase: 0, period: 1, size: 46, joint, latest }
    }

    fn book(stations: u8) -> Book {
        let of = |n: u8| [(Address([2, 0, 0, 0, 0, n]), slot(0, i64::from(n) * 100, None))];
        Book::of(Span::from_micros(1_000), (1..=stations).rev().flat_map(of)).unwrap().numbered(7)
    }

    proptest! {
        #[test]
        fn parts_in_any_order_and_number_make_the_whole(order in prop::collection::vec(0usize..9, 0..80)) {
            let whole = book(9);
            let mut other = Book::empty(16, true);
            other.begin(whole.id());
            let mut seen = std::collections::BTreeSet::new();
            for index in order {
                let is_whole = other.take(&whole.part(index).unwrap()).unwrap();
                prop_assert_eq!(is_whole, seen.insert(index) && seen.len() == 9);
                prop_assert_eq!(other.holds(whole.id()), seen.len() == 9);
            }
            if seen.len() == 9 {
                prop_assert_eq!(other.planned(), whole.planned());
            }
        }
    }

    #[test]
    fn a_part_that_was_changed_spoils_the_whole_which_is_collected_anew() {
        let whole = book(2);
        let mut other = Book::empty(16, true);
        other.begin(whole.id());
        let mut wrong = whole.part(0).unwrap();
        wrong.slot.size = 60;
        assert_eq!(other.take(&wrong), Ok(false));
        assert_eq!(other.take(&whole.part(1).unwrap()), Err(Refusal::ScheduleFormat));
        assert!(!other.holds(whole.id()));
        assert_eq!(other.take(&whole.part(0).unwrap()), Ok(false));
        assert_eq!(other.take(&whole.part(1).unwrap()), Ok(true));
        assert!(other.holds(whole.id()));
    }

    #[test]
    fn parts_of_another_schedule_and_of_one_without_room_are_refused() {
        let whole = book(3);
        let mut small = Book::empty(2, true);
        small.begin(whole.id());
        assert_eq!(small.take(&whole.part(0).unwrap()), Err(Refusal::ScheduleTooLarge));
        let mut unreserved = Book::empty(2, false);
        assert!(matches!(unreserved.copy_from(&whole, 1), Err(Refused::ScheduleSize { slots: 3, most: 2 })));
        let mut other = Book::empty(16, true);
        other.begin(ScheduleId { number: 8, sum: 1 });
        assert_eq!(other.take(&whole.part(0).unwrap()), Err(Refusal::ScheduleUnknown));
        assert!(matches!(small.copy_from(&whole, 1), Err(Refused::ScheduleSize { slots: 3, most: 2 })));
        assert!(matches!(
            Book::of(Span::from_micros(1_000), []),
            Err(Refused::ScheduleSize { slots: 0, .. })
        ));
    }

    #[test]
    fn book_that_is_not_reserved_takes_memory_when_slots_come() {
        let (whole, mut reserved, mut other) = (book(9), Book::empty(16, true), Book::empty(16, false));
        let memory = |book: &Book| book.planned.capacity();
        assert_eq!((memory(&reserved), memory(&other)), (16, 0));
        for book in [&mut reserved, &mut other] {
            book.copy_from(&whole, 1).unwrap();
            assert_eq!(book.planned(), whole.planned());
        }
        assert_eq!(memory(&reserved), 16);
    }

    #[test]
    fn slots_are_in_order_of_station_and_owners_of_queues_come_first() {
        let (a, b) = (Address([2, 0, 0, 0, 0, 1]), Address([2, 0, 0, 0, 0, 2]));
        let slots = [(b, slot(0, 300, None)), (a, slot(0, 200, Some(3))), (a, slot(3, 100, None))];
        let book = Book::of(Span::from_micros(1_000), slots).unwrap();
        assert_eq!(book.of_station(a).map(|slot| slot.id).collect::<Vec<_>>(), [3, 0]);
        assert_eq!(book.stations().collect::<Vec<_>>(), [a, b]);
    }
}
