//! A station's own slots, their queues, and which comes next.
//!
//! ```text
//! channel ──► slot ──► queue       channel 1 is slot 0 while there is no slot 1
//!    0          0        0 ◄┐
//!    2          2        2  │      what waited in a slot before it was joined to another stays there: that slot
//!               └─ joint ───┘      takes the more urgent of both, what has waited longer first
//! ```

mod queues;

use rtnet::discipline::{Channel, EventKind};
use rtnet::queue::PriorityQueue;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet;

use super::config::Refused;
use super::events::Events;
use super::joint;
use super::line::{TimeLine, next_cycle};

/// Highest slot id unless configured otherwise, as in RTnet.
pub const DEFAULT_MAX_SLOT_ID: u8 = 7;
/// The id of the slot for real-time traffic.
pub const RT_SLOT: Channel = 0;
/// The id of the slot for everything that is not real-time; another name of slot 0 while it is not defined.
pub const NON_RT_SLOT: Channel = 1;
/// Smallest slot: the payload of the smallest frame.
pub const MIN_SIZE: usize = ethernet::MIN_FRAME - ethernet::HEADER_LEN;

/// Longest period: two turns and the cycles between them are to be counted, and told of, without end or overflow.
pub const MAX_PERIOD: u32 = 1 << 16;

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
    /// The slot whose queue it takes from, if not its own.
    pub joint: Option<Channel>,
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
        if !(1..=MAX_PERIOD).contains(&period) || phase >= period {
            return Err(Refused::Phase { id, phase, period });
        }
        if !(MIN_SIZE..=ethernet::MTU).contains(&size) {
            return Err(Refused::Size { id, size });
        }
        Ok(())
    }

    /// Whose queue it takes from.
    pub(super) fn queue(&self) -> Channel {
        self.joint.unwrap_or(self.id)
    }
}

/// A place for a slot. What every turn looks at comes first, together.
#[repr(C)]
struct Slot {
    /// The cycle it is used in next.
    next: u32,
    /// Whether a frame was taken for its last turn.
    used: bool,
    /// From whose queue.
    taken_from: Channel,
    /// `None`: not defined.
    config: Option<SlotConfig>,
    sent: u64,
    /// What becomes of it once its turn in the cycle in which that was asked for has passed, and from which
    /// cycle on.
    change: Option<(Change, u32)>,
    /// Whether a schedule that is switched to has it, too.
    is_kept: bool,
    queue: PriorityQueue,
}

#[derive(Clone, Copy)]
enum Change {
    Set(SlotConfig),
    Remove,
}

/// The slots of one station. What every turn looks at comes first, together.
#[repr(C)]
pub struct Slots {
    /// The ids that are defined, in order: the table is looked at in every turn, and most of it is empty.
    in_use: Vec<Channel>,
    table: Vec<Slot>,
    max_id: u8,
    /// Queued frames whose slot was removed or became too small for them.
    dropped: u64,
    /// Joint slots that got a queue of their own because the one that they were joined to grew.
    detached: u64,
}

/// A slot as others see it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlotStatus {
    /// What is configured of it.
    pub config: SlotConfig,
    /// Frames that wait for it, or for another that takes from the same queue.
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
        let place = |id| Slot {
            config: None,
            queue: PriorityQueue::new(),
            next: 0,
            change: None,
            is_kept: false,
            sent: 0,
            used: false,
            taken_from: id,
        };
        // Slots are defined by the real-time thread, which makes no room.
        let in_use = Vec::with_capacity(usize::from(max_id) + 1);
        let table = (0..=max_id).map(place).collect();
        Self { table, in_use, max_id, dropped: 0, detached: 0 }
    }

    /// Defines or changes a slot, from the cycle after `cycle` on; a turn that it still has in `cycle` it
    /// takes as it was. Queued frames that still fit stay. What is joined to it follows, or is told of.
    pub fn set(&mut self, slot: SlotConfig, cycle: u32, events: &mut Events) -> Result<(), Refused> {
        slot.check(self.max_id)?;
        let joint = joint::owner(&slot, |id| self.plan_of(id))?;
        let slot = SlotConfig { joint, ..slot };
        self.change(slot.id, Change::Set(slot), cycle);
        for id in 0..=self.max_id {
            let follows = self.plan_of(id).and_then(|other| joint::follow(&other, &slot));
            let Some(followed) = follows else { continue };
            self.change(id, Change::Set(followed), cycle);
            if followed.joint.is_none() {
                self.detached += 1;
                events.note_slot(cycle.wrapping_add(1), id, EventKind::JointDetached);
            }
        }
        Ok(())
    }

    /// Removes a slot, from the cycle after `cycle` on. What is queued in it is dropped and counted, unless its channel
    /// has another slot then: 1 is slot 0 again, and a joint one's frames are the queue's that it was joined to.
    pub fn remove(&mut self, id: Channel, cycle: u32) -> Result<(), Refused> {
        if self.get(id).is_none() {
            let is_alias = id == NON_RT_SLOT && self.get(RT_SLOT).is_some();
            return Err(if is_alias { Refused::Alias } else { Refused::NotDefined { id } });
        }
        if let Some(joined) = self.planned().find(|slot| slot.joint == Some(id)) {
            return Err(Refused::JoinedTo { id, by: joined.id });
        }
        self.change(id, Change::Remove, cycle);
        Ok(())
    }

    /// All slots are these from the cycle after `cycle` on, those that others are joined to first; what was planned for
    /// before is not. Queued frames that still fit stay.
    pub fn replace(&mut self, slots: impl Iterator<Item = SlotConfig>, cycle: u32) {
        let from = cycle.wrapping_add(1);
        for slot in &mut self.table {
            (slot.change, slot.is_kept) = (None, false);
        }
        for slot in slots {
            let Some(place) = self.table.get_mut(usize::from(slot.id)) else { continue };
            place.is_kept = true;
            self.apply(slot.id, Change::Set(slot), from);
        }
        for id in 0..=self.max_id {
            let slot = &self.table[usize::from(id)];
            if slot.config.is_some() && !slot.is_kept {
                self.apply(id, Change::Remove, from);
            }
        }
    }

    /// The highest id that there is room for.
    pub fn max_id(&self) -> u8 {
        self.max_id
    }

    fn change(&mut self, id: Channel, change: Change, cycle: u32) {
        let slot = &mut self.table[usize::from(id)];
        let from = cycle.wrapping_add(1);
        if slot.config.is_some() && cycle.wrapping_sub(slot.next) as i32 >= 0 {
            slot.change = Some((change, from));
        } else {
            self.apply(id, change, from);
        }
    }

    /// What is configured of every slot, with the changes that are still to come.
    pub fn planned(&self) -> impl Iterator<Item = SlotConfig> {
        self.table.iter().filter_map(Slot::planned)
    }

    fn plan_of(&self, id: Channel) -> Option<SlotConfig> {
        self.table.get(usize::from(id))?.planned()
    }

    /// Queued frames whose slot was removed or became too small for them.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Joint slots that got a queue of their own because the one that they were joined to grew.
    pub fn detached(&self) -> u64 {
        self.detached
    }

    /// Every slot, by id.
    pub fn statuses(&self) -> impl Iterator<Item = SlotStatus> {
        self.table.iter().filter_map(|slot| {
            let config = slot.config?;
            let shared = config.joint.map_or(0, |joint| self.table[usize::from(joint)].queue.len());
            Some(SlotStatus { config, queued: slot.queue.len() + shared, sent: slot.sent })
        })
    }

    /// A frame was sent in it.
    pub fn count_sent(&mut self, id: Channel) {
        self.table[usize::from(id)].sent += 1;
    }

    /// Whether a slot is about to be another one, or gone, once its turn has passed.
    pub fn is_changing(&self, id: Channel) -> bool {
        self.table[usize::from(id)].change.is_some()
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
        for id in 0..=self.max_id {
            if let Some((change, _)) = self.table[usize::from(id)].change.take() {
                self.apply(id, change, line.cycle);
            }
            let slot = &mut self.table[usize::from(id)];
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
        let next = slot.config.as_ref().map(|config| next_cycle(cycle, config.phase, config.period));
        let is_before = |cycle: u32, from: u32| (from.wrapping_sub(cycle) as i32) > 0;
        match (&slot.change, next) {
            (None, next) => slot.next = next.unwrap_or(slot.next),
            // Where the turn was still due before the cycle in which the change was asked for, it is not yet over.
            (&Some((change, from)), Some(next)) if is_before(cycle, from) => {
                slot.next = next;
                if !is_before(next, from) {
                    self.apply(id, change, from);
                }
            }
            (&Some((change, _)), _) => self.apply(id, change, cycle),
        }
    }

    /// No slot is used before `cycle`. How many turns that leaves out.
    pub fn jump(&mut self, cycle: u32) -> u64 {
        let mut left_out = 0;
        for id in 0..=self.max_id {
            let slot = &self.table[usize::from(id)];
            let Some(config) = slot.config else { continue };
            let cycles = cycle.wrapping_sub(slot.next);
            if cycles as i32 > 0 {
                left_out += u64::from(cycles.div_ceil(config.period));
                self.pass_until(id, cycle);
            }
        }
        left_out
    }

    /// Every slot's configuration, and the cycle it is used in next.
    fn defined(&self) -> impl Iterator<Item = (&SlotConfig, u32)> {
        let slots = self.in_use.iter().map(|&id| &self.table[usize::from(id)]);
        slots.filter_map(|slot| Some((slot.config.as_ref()?, slot.next)))
    }

    /// Changes a slot now, to be used from `cycle` on; its queued frames go to where they have a place.
    fn apply(&mut self, id: Channel, change: Change, cycle: u32) {
        let slot = &mut self.table[usize::from(id)];
        slot.change = None;
        match change {
            Change::Set(config) => {
                let before = slot.config.replace(config);
                slot.next = next_cycle(cycle, config.phase, config.period);
                if let Err(place) = self.in_use.binary_search(&id) {
                    self.in_use.insert(place, id);
                }
                // What fitted before fits: thousands of frames may wait, and are not to be looked at for nothing.
                if before.is_none_or(|before| config.size < before.size) {
                    self.requeue(id, Some((id, config.size)));
                }
            }
            Change::Remove => {
                let config = slot.config.take();
                self.in_use.retain(|&of| of != id);
                let heir = config.map_or(id, |config| self.heir(&config));
                self.table[usize::from(id)].taken_from = heir;
                self.requeue(id, self.resolve(heir).ok());
            }
        }
    }
}

impl Slot {
    /// What is configured of it once the change that is to come, if any, has come.
    fn planned(&self) -> Option<SlotConfig> {
        match self.change {
            Some((Change::Set(config), _)) => Some(config),
            Some((Change::Remove, _)) => None,
            None => self.config,
        }
    }
}

#[cfg(test)]
mod tests;
