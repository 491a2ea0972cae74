//! A station's own slots, their queues, and which comes next.

use rtnet::buf::Buf;
use rtnet::discipline::{Channel, Refused, Returned, SendError};
use rtnet::queue::{Priority, PriorityQueue};
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet;

use super::line::{TimeLine, next_cycle};
use crate::wire;

/// Highest slot id unless configured otherwise, as in RTnet.
pub const DEFAULT_MAX_SLOT_ID: u8 = 7;
/// The id of the slot for everything that is not real-time; an alias of 0 while undefined.
pub const NON_RT_SLOT: Channel = 1;
/// Smallest slot: the payload of the smallest frame.
pub const MIN_SIZE: usize = ethernet::MIN_FRAME - ethernet::HEADER_LEN;
/// Frames that wait in a slot at the most: as many as RTnet's socket pool holds, twice.
const QUEUE_CAPACITY: u16 = 32;

/// What is configured of a slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlotConfig {
    /// 0 real-time, 1 non-real-time, 2.. the user's.
    pub id: Channel,
    /// Begin, from the cycle's start.
    pub offset: Span,
    /// Used in cycles with `cycle mod period == phase`; counts from 0.
    pub phase: u32,
    /// See `phase`; 1 is every cycle.
    pub period: u32,
    /// Largest payload behind the Ethernet header, bytes.
    pub size: usize,
    /// How long after its begin a transmission may still start.
    pub latest: Span,
}

impl SlotConfig {
    fn check(&self, max_id: u8) -> Result<(), Refused> {
        let id = self.id;
        let refuse = |why: String| Err(Refused(format!("slot {id}: {why}")));
        if id > max_id {
            return refuse(format!("ids go from 0 to {max_id}"));
        }
        if self.offset < Span::ZERO {
            return refuse(format!("the offset {} is before the cycle's start", self.offset));
        }
        if self.period == 0 || self.phase >= self.period {
            return refuse(format!("phase {} of {} does not exist", self.phase + 1, self.period));
        }
        if !(MIN_SIZE..=ethernet::MTU).contains(&self.size) {
            return refuse(format!("a size of {} is not within {MIN_SIZE} to {}", self.size, ethernet::MTU));
        }
        Ok(())
    }
}

struct Slot {
    config: SlotConfig,
    queue: PriorityQueue<Buf>,
    /// The cycle it is used in next.
    next: u32,
}

/// The slots of one station.
pub struct Slots {
    table: Vec<Option<Slot>>,
}

/// A slot whose turn comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Turn {
    pub id: Channel,
    pub cycle: u32,
    pub at: Instant,
    pub latest: Instant,
}

impl Slots {
    pub fn new(max_id: u8) -> Self {
        Self { table: (0..=max_id).map(|_| None).collect() }
    }

    /// Defines or changes a slot, from the cycle after `cycle` on. Queued frames that still fit stay;
    /// tells how many did not.
    pub fn set(&mut self, config: SlotConfig, cycle: u32) -> Result<u64, Refused> {
        config.check((self.table.len() - 1) as u8)?;
        let next = next_cycle(cycle.wrapping_add(1), config.phase, config.period);
        let place = &mut self.table[usize::from(config.id)];
        let mut queue = PriorityQueue::new(QUEUE_CAPACITY);
        let mut dropped = 0;
        if let Some(mut old) = place.take() {
            while let Some((priority, frame)) = old.queue.pop() {
                let fits = payload_of(&frame) <= config.size.max(MIN_SIZE);
                // As many places as before: what fits the slot fits the queue.
                dropped += u64::from(!fits || queue.push(priority, frame).is_err());
            }
        }
        *place = Some(Slot { config, queue, next });
        Ok(dropped)
    }

    pub fn remove(&mut self, id: Channel) -> Result<(), Refused> {
        let place = self.table.get_mut(usize::from(id));
        match place.and_then(Option::take) {
            Some(_) => Ok(()),
            None => Err(Refused(format!("slot {id} is not defined"))),
        }
    }

    /// The first slot: the one that calibration uses.
    pub fn first(&self) -> Option<&SlotConfig> {
        self.iter().next().map(|slot| &slot.config)
    }

    /// Where the last slot begins.
    pub fn longest_offset(&self) -> Option<Span> {
        self.iter().map(|slot| slot.config.offset).max()
    }

    pub fn get(&self, id: Channel) -> Option<&SlotConfig> {
        self.table.get(usize::from(id))?.as_ref().map(|slot| &slot.config)
    }

    /// Lets every slot begin with its first turn on `line` that is not before `from`.
    pub fn align(&mut self, line: &TimeLine, from: Instant) {
        for slot in self.table.iter_mut().flatten() {
            let SlotConfig { phase, period, offset, .. } = slot.config;
            let gone = (from - (line.start + offset)).nanos();
            let passed = if gone > 0 { (gone - 1) / line.period.nanos() + 1 } else { 0 };
            slot.next = next_cycle(line.cycle.wrapping_add(passed as u32), phase, period);
        }
    }

    /// The slot whose turn is first, among all or only the one with `only`.
    pub fn next_turn(&self, line: &TimeLine, only: Option<Channel>) -> Option<Turn> {
        let turns = self.iter().filter(|slot| only.is_none_or(|id| id == slot.config.id)).map(|slot| {
            let at = line.start_of(slot.next) + slot.config.offset;
            Turn { id: slot.config.id, cycle: slot.next, at, latest: at + slot.config.latest }
        });
        turns.min_by_key(|turn| (turn.at - line.start, turn.id))
    }

    /// This slot's turn in `cycle` is over.
    pub fn pass(&mut self, turn: &Turn) {
        if let Some(slot) = &mut self.table[usize::from(turn.id)] {
            slot.next = next_cycle(turn.cycle.wrapping_add(1), slot.config.phase, slot.config.period);
        }
    }

    /// This slot is not used before `cycle`.
    pub fn pass_until(&mut self, id: Channel, cycle: u32) {
        if let Some(slot) = &mut self.table[usize::from(id)] {
            slot.next = next_cycle(cycle, slot.config.phase, slot.config.period);
        }
    }

    pub fn enqueue(&mut self, frame: Buf, priority: Priority, ch: Channel) -> Result<(), (SendError, Buf)> {
        let Some(slot) = self.resolve(ch) else { return Err((SendError::NoSlot(ch), frame)) };
        let (got, limit) = (payload_of(&frame), slot.config.size);
        // A frame padded to the Ethernet minimum fits every slot.
        if got > limit.max(MIN_SIZE) {
            return Err((SendError::TooLong { channel: ch, got, limit }, frame));
        }
        if wire::is_lethal(&frame) {
            return Err((SendError::Lethal, frame));
        }
        slot.queue.push(priority, frame).map_err(|frame| (SendError::QueueFull(ch), frame))
    }

    pub fn put_back(&mut self, frame: Returned) -> Result<(), Buf> {
        match self.resolve(frame.channel) {
            Some(slot) => slot.queue.push_front(frame.priority, frame.frame),
            None => Err(frame.frame),
        }
    }

    pub fn dequeue(&mut self, id: Channel) -> Option<(Priority, Buf)> {
        self.table[usize::from(id)].as_mut()?.queue.pop()
    }

    pub fn payload_limit(&self, ch: Channel) -> Result<usize, SendError> {
        let alias = if self.get(ch).is_none() && ch == NON_RT_SLOT { 0 } else { ch };
        self.get(alias).map(|config| config.size).ok_or(SendError::NoSlot(ch))
    }

    fn resolve(&mut self, ch: Channel) -> Option<&mut Slot> {
        let alias = if self.get(ch).is_none() && ch == NON_RT_SLOT { 0 } else { ch };
        self.table.get_mut(usize::from(alias))?.as_mut()
    }

    fn iter(&self) -> impl Iterator<Item = &Slot> {
        self.table.iter().flatten()
    }
}

fn payload_of(frame: &[u8]) -> usize {
    frame.len().saturating_sub(ethernet::HEADER_LEN)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtnet::buf::Pool;
    use rtnet::time::{GlobalTime, Offset};

    fn config(id: u8, offset: i64, phase: u32, period: u32) -> SlotConfig {
        let (offset, latest) = (Span::from_micros(offset), Span::from_micros(10));
        SlotConfig { id, offset, phase, period, size: 100, latest }
    }

    fn line() -> TimeLine {
        TimeLine {
            cycle: 0,
            start: Instant::from_nanos(0),
            sched: GlobalTime::default(),
            period: Span::from_millis(1),
            offset: Offset::default(),
        }
    }

    #[test]
    fn slots_take_turns_by_time_and_phase() {
        let mut slots = Slots::new(7);
        for slot in [config(0, 300, 0, 1), config(2, 100, 1, 2), config(3, 300, 0, 2)] {
            slots.set(slot, 0).unwrap();
        }
        slots.align(&line(), Instant::from_nanos(1_000_000));
        let order: Vec<_> = (0..6)
            .map(|_| {
                let turn = slots.next_turn(&line(), None).unwrap();
                slots.pass(&turn);
                (turn.cycle, turn.id, turn.at.nanos() / 1000)
            })
            .collect();
        assert_eq!(
            order,
            [(1, 2, 1100), (1, 0, 1300), (2, 0, 2300), (2, 3, 2300), (3, 2, 3100), (3, 0, 3300)]
        );
    }

    #[test]
    fn slot_1_is_slot_0_until_it_is_defined() {
        let pool = Pool::new(3);
        let frame = || {
            let mut frame = pool.take().unwrap();
            frame.fill(&[0; 60]);
            frame
        };
        let mut slots = Slots::new(7);
        assert!(matches!(slots.enqueue(frame(), Priority::NON_RT, 1), Err((SendError::NoSlot(1), _))));
        slots.set(config(0, 100, 0, 1), 0).unwrap();
        slots.enqueue(frame(), Priority::NON_RT, 1).unwrap();
        slots.enqueue(frame(), Priority::FIRST, 0).unwrap();
        assert_eq!(slots.dequeue(0).unwrap().0, Priority::FIRST);
        assert_eq!(slots.dequeue(0).unwrap().0, Priority::NON_RT);
        slots.set(config(1, 200, 0, 1), 0).unwrap();
        slots.enqueue(frame(), Priority::NON_RT, 1).unwrap();
        assert!(slots.dequeue(0).is_none() && slots.dequeue(1).is_some());
    }

    #[test]
    fn what_is_no_slot_is_refused_by_name() {
        let mut slots = Slots::new(7);
        let refused = |slots: &mut Slots, slot| slots.set(slot, 0).unwrap_err().to_string();
        assert!(refused(&mut slots, config(8, 0, 0, 1)).contains("ids go from 0 to 7"));
        assert!(refused(&mut slots, config(0, 0, 2, 2)).contains("phase 3 of 2"));
        assert!(refused(&mut slots, config(0, -1, 0, 1)).contains("before the cycle"));
        assert!(refused(&mut slots, SlotConfig { size: 1501, ..config(0, 0, 0, 1) }).contains("1501"));
        assert!(slots.remove(3).unwrap_err().to_string().contains("slot 3 is not defined"));
    }

    #[test]
    fn the_lethal_frame_never_gets_into_a_queue() {
        let pool = Pool::new(1);
        let mut slots = Slots::new(7);
        slots.set(config(0, 100, 0, 1), 0).unwrap();
        let mut frame = pool.take().unwrap();
        frame.fill(&[0; 60]);
        frame[12..18].copy_from_slice(&[0x90, 0x21, 0x00, 0x42, 2, 0]);
        let (error, mut frame) = slots.enqueue(frame, Priority::DEFAULT, 0).unwrap_err();
        assert_eq!(error, SendError::Lethal);
        frame[17] = 1;
        slots.enqueue(frame, Priority::DEFAULT, 0).unwrap();
    }
}
