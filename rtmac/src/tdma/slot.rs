//! A station's own slots, their queues, and which comes next.

use arrayvec::ArrayVec;
use rtnet::buf::Buf;
use rtnet::discipline::{Channel, Returned, SendError};
use rtnet::queue::{Priority, PriorityQueue};
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet;

use super::config::Refused;
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
    /// Whether it is a slot at all, ids going up to `max`: what goes with other slots is for a schedule to say.
    pub fn check(&self, max: u8) -> Result<(), Refused> {
        let SlotConfig { id, offset, phase, period, size, .. } = *self;
        if id > max {
            return Err(Refused::SlotId { id, max });
        }
        if offset < Span::ZERO {
            return Err(Refused::BeforeCycle { id, offset });
        }
        if period == 0 || phase >= period {
            return Err(Refused::Phase { id, phase, period });
        }
        if !(MIN_SIZE..=ethernet::MTU).contains(&size) {
            return Err(Refused::Size { id, size });
        }
        Ok(())
    }
}

/// A place for a slot. Its queue is there from the start, so that a slot can be defined while others are used.
struct Slot {
    /// `None`: not defined.
    config: Option<SlotConfig>,
    queue: PriorityQueue<Buf>,
    /// The cycle it is used in next.
    next: u32,
    /// What becomes of it once its turn in the cycle in which that was asked for has passed, and from which
    /// cycle on.
    change: Option<(Change, u32)>,
    sent: u64,
    /// Whether a frame was taken for its last turn.
    used: bool,
}

#[derive(Clone, Copy)]
enum Change {
    Set(SlotConfig),
    Remove,
}

/// The slots of one station.
pub struct Slots {
    table: Vec<Slot>,
    /// Queued frames whose slot was removed or became too small for them.
    dropped: u64,
}

/// A slot as others see it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlotStatus {
    /// What is configured of it.
    pub config: SlotConfig,
    /// Frames that wait for it.
    pub queued: usize,
    /// Frames sent in it.
    pub sent: u64,
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
        let place = |_| Slot {
            config: None,
            queue: PriorityQueue::new(QUEUE_CAPACITY),
            next: 0,
            change: None,
            sent: 0,
            used: false,
        };
        Self { table: (0..=max_id).map(place).collect(), dropped: 0 }
    }

    /// Defines or changes a slot, from the cycle after `cycle` on; a turn that it still has in `cycle` it
    /// takes as it was. Queued frames that still fit stay.
    pub fn set(&mut self, config: SlotConfig, cycle: u32) -> Result<(), Refused> {
        config.check((self.table.len() - 1) as u8)?;
        self.change(config.id, Change::Set(config), cycle);
        Ok(())
    }

    /// Removes a slot, from the cycle after `cycle` on.
    pub fn remove(&mut self, id: Channel, cycle: u32) -> Result<(), Refused> {
        if self.get(id).is_none() {
            return Err(Refused::NotDefined { id });
        }
        self.change(id, Change::Remove, cycle);
        Ok(())
    }

    fn change(&mut self, id: Channel, change: Change, cycle: u32) {
        let slot = &mut self.table[usize::from(id)];
        let from = cycle.wrapping_add(1);
        if slot.config.is_some() && cycle.wrapping_sub(slot.next) as i32 >= 0 {
            slot.change = Some((change, from));
        } else {
            self.dropped += slot.apply(change, from);
        }
    }

    /// What is configured of every slot, with the changes that are still to come.
    pub fn planned(&self) -> impl Iterator<Item = SlotConfig> {
        self.table.iter().filter_map(|slot| match slot.change {
            Some((Change::Set(config), _)) => Some(config),
            Some((Change::Remove, _)) => None,
            None => slot.config,
        })
    }

    /// Queued frames whose slot was removed or became too small for them.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Every slot, by id.
    pub fn statuses(&self) -> impl Iterator<Item = SlotStatus> {
        self.table.iter().filter_map(|slot| {
            let config = slot.config?;
            Some(SlotStatus { config, queued: slot.queue.len(), sent: slot.sent })
        })
    }

    /// A frame was sent in it.
    pub fn count_sent(&mut self, id: Channel) {
        self.table[usize::from(id)].sent += 1;
    }

    /// The first slot: the one that calibration uses.
    pub fn first(&self) -> Option<&SlotConfig> {
        self.defined().next().map(|(config, _)| config)
    }

    /// Where the last slot begins.
    pub fn longest_offset(&self) -> Option<Span> {
        self.defined().map(|(config, _)| config.offset).max()
    }

    pub fn get(&self, id: Channel) -> Option<&SlotConfig> {
        self.table.get(usize::from(id))?.config.as_ref()
    }

    /// Lets every slot begin with its first turn on `line` that is not before `from`.
    pub fn align(&mut self, line: &TimeLine, from: Instant) {
        for slot in &mut self.table {
            if let Some((change, _)) = slot.change.take() {
                self.dropped += slot.apply(change, line.cycle);
            }
            let Some(SlotConfig { phase, period, offset, .. }) = slot.config else { continue };
            let gone = (from - (line.start + offset)).nanos();
            let passed = if gone > 0 { (gone - 1) / line.period.nanos() + 1 } else { 0 };
            slot.next = next_cycle(line.cycle.wrapping_add(passed as u32), phase, period);
        }
    }

    /// The slot whose turn is first, among all or only the one with `only`.
    pub fn next_turn(&self, line: &TimeLine, only: Option<Channel>) -> Option<Turn> {
        let turns = self.defined().filter(|(config, _)| only.is_none_or(|id| id == config.id));
        let turns = turns.map(|(config, next)| {
            let at = line.start_of(next) + config.offset;
            Turn { id: config.id, cycle: next, at, latest: at + config.latest }
        });
        turns.min_by_key(|turn| (turn.at - line.start, turn.id))
    }

    /// This slot's turn in `cycle` is over.
    pub fn pass(&mut self, turn: &Turn) {
        self.pass_until(turn.id, turn.cycle.wrapping_add(1));
    }

    /// This slot is not used before `cycle`.
    pub fn pass_until(&mut self, id: Channel, cycle: u32) {
        let slot = &mut self.table[usize::from(id)];
        match (slot.change.take(), slot.config) {
            // Where the turn was still due before the cycle in which the change was asked for, it is not yet over.
            (Some((change, from)), Some(config)) if (from.wrapping_sub(cycle) as i32) > 0 => {
                slot.next = next_cycle(cycle, config.phase, config.period);
                if (from.wrapping_sub(slot.next) as i32) > 0 {
                    slot.change = Some((change, from));
                } else {
                    self.dropped += slot.apply(change, from);
                }
            }
            (Some((change, _)), _) => self.dropped += slot.apply(change, cycle),
            (None, Some(config)) => slot.next = next_cycle(cycle, config.phase, config.period),
            (None, None) => {}
        }
    }

    pub fn enqueue(&mut self, frame: Buf, priority: Priority, ch: Channel) -> Result<(), (SendError, Buf)> {
        let Some((id, limit)) = self.resolve(ch) else { return Err((SendError::NoSlot(ch), frame)) };
        let got = payload_of(&frame);
        // A frame padded to the Ethernet minimum fits every slot.
        if got > limit.max(MIN_SIZE) {
            return Err((SendError::TooLong { channel: ch, got, limit }, frame));
        }
        if wire::is_lethal(&frame) {
            return Err((SendError::Lethal, frame));
        }
        let queue = &mut self.table[usize::from(id)].queue;
        queue.push(priority, frame).map_err(|frame| (SendError::QueueFull(ch), frame))
    }

    pub fn put_back(&mut self, frame: Returned) -> Result<(), Buf> {
        match self.resolve(frame.channel) {
            Some((id, size)) if payload_of(&frame.frame) <= size.max(MIN_SIZE) => {
                self.table[usize::from(id)].queue.push_front(frame.priority, frame.frame)
            }
            _ => Err(frame.frame),
        }
    }

    pub fn dequeue(&mut self, id: Channel) -> Option<(Priority, Buf)> {
        let slot = &mut self.table[usize::from(id)];
        let frame = slot.queue.pop();
        slot.used |= frame.is_some();
        frame
    }

    /// Whether a slot that is empty was used in its turn before this one.
    pub fn was_used(&mut self, id: Channel) -> bool {
        std::mem::take(&mut self.table[usize::from(id)].used)
    }

    pub fn payload_limit(&self, ch: Channel) -> Result<usize, SendError> {
        self.resolve(ch).map(|(_, size)| size).ok_or(SendError::NoSlot(ch))
    }

    /// The slot that serves a channel, and its size.
    fn resolve(&self, ch: Channel) -> Option<(Channel, usize)> {
        let alias = if self.get(ch).is_none() && ch == NON_RT_SLOT { 0 } else { ch };
        self.get(alias).map(|config| (alias, config.size))
    }

    /// Every slot's configuration, and the cycle it is used in next.
    fn defined(&self) -> impl Iterator<Item = (&SlotConfig, u32)> {
        self.table.iter().filter_map(|slot| Some((slot.config.as_ref()?, slot.next)))
    }
}

impl Slot {
    /// Changes it now, to be used from `cycle` on; tells how many queued frames have no place any more.
    fn apply(&mut self, change: Change, cycle: u32) -> u64 {
        self.change = None;
        let waiting = self.queue.len();
        match change {
            Change::Remove => {
                self.config = None;
                while self.queue.pop().is_some() {}
            }
            Change::Set(config) => {
                self.config = Some(config);
                self.next = next_cycle(cycle, config.phase, config.period);
                let mut kept: ArrayVec<_, { QUEUE_CAPACITY as usize }> = ArrayVec::new();
                while let Some((priority, frame)) = self.queue.pop() {
                    if payload_of(&frame) <= config.size.max(MIN_SIZE) {
                        kept.push((priority, frame));
                    }
                }
                for (priority, frame) in kept {
                    // As many as were in it just now.
                    let _ = self.queue.push(priority, frame);
                }
            }
        }
        (waiting - self.queue.len()) as u64
    }
}

fn payload_of(frame: &[u8]) -> usize {
    frame.len().saturating_sub(ethernet::HEADER_LEN)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tdma::line::Drift;
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
            drift: Drift::NONE,
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
        assert!(slots.remove(3, 0).unwrap_err().to_string().contains("slot 3 is not defined"));
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
