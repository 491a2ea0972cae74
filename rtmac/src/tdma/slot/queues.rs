//! Which queue serves a channel and a slot's turn, and what becomes of frames whose slot changes or goes.

use rtnet::buf::Buf;
use rtnet::discipline::{Channel, Returned, SendError};
use rtnet::queue::Priority;
use rtnet::wire::ethernet;

use super::{MIN_SIZE, NON_RT_SLOT, RT_SLOT, SlotConfig, Slots};
use crate::wire;

impl Slots {
    pub fn enqueue(&mut self, frame: Buf, priority: Priority, ch: Channel) -> Result<(), (SendError, Buf)> {
        let (queue, limit) = match self.resolve(ch) {
            Ok(place) => place,
            Err(error) => return Err((error, frame)),
        };
        if !fits(&frame, limit) {
            return Err((SendError::TooLong { channel: ch, got: payload_of(&frame), limit }, frame));
        }
        if wire::is_lethal(&frame) {
            return Err((SendError::Lethal, frame));
        }
        self.table[usize::from(queue)].queue.push(priority, frame);
        Ok(())
    }

    /// A frame that was taken for a slot's turn goes back to where it was taken from, as long as the slot takes from
    /// there and its size allows it; else to where its channel is served now, or, where the slot is gone with that turn, to
    /// where what waited in it went.
    pub fn put_back(&mut self, Returned { frame, priority, channel }: Returned) -> Result<(), Buf> {
        let queue = self.table[usize::from(channel)].taken_from;
        let place = match self.get(channel) {
            Some(config) if [config.id, config.queue()].contains(&queue) => Ok((queue, config.size)),
            Some(_) => self.resolve(channel),
            None => self.resolve(queue),
        };
        match place {
            Ok((queue, size)) if fits(&frame, size) => {
                self.table[usize::from(queue)].queue.push_front(priority, frame);
                Ok(())
            }
            _ => Err(frame),
        }
    }

    /// The most urgent frame of a slot's queue. One that is joined to another may have some that are older than that.
    pub fn dequeue(&mut self, id: Channel) -> Option<(Priority, Buf)> {
        let shared = self.get(id)?.queue();
        let first = |queue: Channel| self.table[usize::from(queue)].queue.first();
        let is_shared = first(shared).is_some_and(|urgent| first(id).is_none_or(|own| urgent < own));
        let from = if is_shared { shared } else { id };
        let frame = self.table[usize::from(from)].queue.pop();
        let slot = &mut self.table[usize::from(id)];
        (slot.used, slot.taken_from) = (slot.used | frame.is_some(), from);
        frame
    }

    /// The priority of the frame that a slot would take.
    pub fn first_for(&self, id: Channel) -> Option<Priority> {
        let shared = self.get(id)?.queue();
        [id, shared].iter().filter_map(|&queue| self.table[usize::from(queue)].queue.first()).min()
    }

    /// Whether what is queued for the slot of everything that is not real-time leaves in this one.
    pub fn takes_non_rt(&self, slot: &SlotConfig) -> bool {
        let non_rt = self.get(NON_RT_SLOT).or_else(|| self.get(RT_SLOT));
        non_rt.is_some_and(|non_rt| non_rt.queue() == slot.queue())
    }

    /// Whether a slot that is empty was used in its turn before this one.
    pub fn was_used(&mut self, id: Channel) -> bool {
        std::mem::take(&mut self.table[usize::from(id)].used)
    }

    pub fn payload_limit(&self, ch: Channel) -> Result<usize, SendError> {
        self.resolve(ch).map(|(_, limit)| limit)
    }

    /// The queue that serves a channel, and the largest payload that every slot takes that takes from it: while a change
    /// of joint slots is under way they may differ.
    pub(super) fn resolve(&self, ch: Channel) -> Result<(Channel, usize), SendError> {
        let max = self.max_id.max(NON_RT_SLOT);
        if ch > max {
            return Err(SendError::UnknownChannel { channel: ch, max });
        }
        let is_alias = ch == NON_RT_SLOT && self.get(ch).is_none();
        let slot = self.get(if is_alias { RT_SLOT } else { ch }).ok_or(SendError::NoSlot(ch))?;
        let queue = slot.queue();
        let own = self.get(queue).ok_or(SendError::NoSlot(ch))?;
        let sharing = self.defined().map(|(config, _)| config).filter(|config| config.queue() == queue);
        Ok((queue, sharing.fold(own.size, |limit, config| limit.min(config.size))))
    }

    /// Who takes from now on what waits for a slot that goes: the one that it is joined to; or the first that is still joined
    /// to it, for its last turn before it parts, and has the queue for its own.
    pub(super) fn heir(&mut self, gone: &SlotConfig) -> Channel {
        if let Some(owner) = gone.joint {
            return owner;
        }
        let mut heir = None;
        for slot in &mut self.table {
            if let Some(config) = slot.config.as_mut().filter(|config| config.joint == Some(gone.id)) {
                let first = *heir.get_or_insert(config.id);
                config.joint = (first != config.id).then_some(first);
            }
        }
        heir.unwrap_or(gone.id)
    }

    /// What waits in a slot's queue goes to another, or the same one, if there is one; counts what has no place any more.
    pub(super) fn requeue(&mut self, id: Channel, to: Option<(Channel, usize)>) {
        let mut waiting = core::mem::take(&mut self.table[usize::from(id)].queue);
        while let Some((priority, frame)) = waiting.pop() {
            match to {
                Some((queue, size)) if fits(&frame, size) => {
                    self.table[usize::from(queue)].queue.push(priority, frame);
                }
                _ => self.dropped += 1,
            }
        }
    }
}

/// A frame padded to the Ethernet minimum fits every slot.
pub(super) fn fits(frame: &[u8], size: usize) -> bool {
    payload_of(frame) <= size.max(MIN_SIZE)
}

pub(super) fn payload_of(frame: &[u8]) -> usize {
    frame.len().saturating_sub(ethernet::HEADER_LEN)
}
