//! What a control frame from the medium means to a station, by its role.

use rtnet::counters::Refusal;
use rtnet::discipline::EventKind;
use rtnet::time::{GlobalTime, Instant};
use rtnet::wire::ethernet::{Address, Header};

use super::line::LINE_GOOD_FOR;
use super::slave::Followed;
use super::{Role, Tdma};
use crate::wire::Message;
use crate::wire::change::Status;

impl Tdma {
    pub(super) fn on_message(
        &mut self,
        rx: Instant,
        header: &Header,
        message: Message,
        status: Option<Status>,
    ) -> Result<(), Refusal> {
        // Whom a station answers, it finds in the source.
        if header.source.is_group() || header.source == self.address {
            return Err(Refusal::ForgedSource);
        }
        match (message, &mut self.role) {
            (_, Role::Detached) => Err(Refusal::Detached),
            (Message::Sync { cycle, xmit, sched }, _) => {
                self.on_sync(rx, header.source, (cycle, xmit, sched), status)
            }
            (Message::Request { .. }, _) if header.destination != self.address => Err(Refusal::NotMaster),
            (Message::Request { xmit, reply_cycle, reply_offset }, Role::Master(master)) => {
                master.on_request(rx, header.source, xmit, reply_cycle, reply_offset)
            }
            (Message::Request { .. }, Role::Slave(_)) => Err(Refusal::NotMaster),
            (Message::Reply { .. }, _) if header.destination != self.address => Err(Refusal::UnexpectedReply),
            (Message::Reply { request_xmit, reception, xmit }, _) => {
                self.leave_turn_to_reply(rx);
                let Some(follower) = self.role.follower_mut() else { return Err(Refusal::UnexpectedReply) };
                let done = follower.on_reply(rx, request_xmit, reception, xmit, &mut self.events)?;
                // A turn that is still to come stays the master's: a reply that came before it may be forged.
                self.reply_turn = self.reply_turn.filter(|turn| turn.is_later_than(rx + self.lead));
                if done {
                    // The reply has had its slot's turn, which a line that is a little late has still to come.
                    self.begins = Some(rx + self.lead);
                }
                Ok(())
            }
        }
    }

    /// A Synchronisation: whoever does not give the time follows it.
    fn on_sync(
        &mut self,
        rx: Instant,
        from: Address,
        (cycle, xmit, sched): (u32, GlobalTime, GlobalTime),
        status: Option<Status>,
    ) -> Result<(), Refusal> {
        self.miss_syncs_before(rx);
        let events = &mut self.events;
        if let Role::Master(master) = &mut self.role
            && !master.on_foreign_sync(rx, (from, self.address), xmit - sched, events)
        {
            self.overhear(status);
            return Err(Refusal::ForeignSync);
        }
        let Some(slave) = self.role.follower_mut() else { return Err(Refusal::Detached) };
        self.counters.syncs_received += 1;
        // Another schedule may have another cycle: what comes on that is heard on it.
        let is_next = slave.line().is_some_and(|line| (1..=LINE_GOOD_FOR).contains(&line.ahead(cycle)));
        if is_next {
            self.hear(rx, cycle, status);
        }
        let events = &mut self.events;
        let Some(slave) = self.role.follower_mut() else { return Err(Refusal::Detached) };
        let left = slave.line().copied();
        let followed = slave.on_sync(rx, from, cycle, xmit, sched, events);
        self.doubt_line(rx, from, cycle, followed);
        let says_nothing = matches!(followed, Ok(Followed::Late) | Err(Refusal::ImplausibleSync));
        if !is_next && !says_nothing {
            self.hear(rx, cycle, status);
        }
        let followed = followed?;
        match self.silent {
            Some((silent, at)) if cycle.wrapping_sub(silent) as i32 <= 0 => {
                self.counters.syncs_late += 1;
                self.events.note(cycle, EventKind::SyncLate, at - rx);
            }
            // What was overtaken for so long does not come any more, and numbers start over.
            Some((silent, _))
                if followed == Followed::Agrees && cycle.wrapping_sub(silent) as i32 > LINE_GOOD_FOR =>
            {
                self.silent = None;
            }
            _ => {}
        }
        if let (Followed::NewLine, Some(line)) = (followed, self.line().copied()) {
            if let Some(left) = self.left_when_it_made_way() {
                self.leave(&left, &line, rx, true);
            } else if let (Some(left), false) = (left, self.calibrates()) {
                self.leave(&left, &line, rx, false);
            }
            self.silent = None;
            self.slots.align(&line, rx);
            if let Role::Master(master) = &mut self.role {
                master.follows_another_line();
            }
            if let Some(beyond) = self.slots.longest_offset().filter(|offset| *offset >= line.period) {
                self.events.note(cycle, EventKind::SlotBeyondCycle, beyond - line.period);
            }
        }
        Ok(())
    }

    /// A backup hesitates if what it has heard at `rx` was beside its line, or came after it would have spoken itself: the
    /// longer if both have spoken in that cycle, and the other goes before it.
    fn doubt_line(&mut self, rx: Instant, from: Address, cycle: u32, followed: Result<Followed, Refusal>) {
        let Role::Master(master) = &mut self.role else { return };
        let Some(follower) = master.follower() else { return };
        let is_twice = followed == Err(Refusal::DuplicateCycle);
        let is_beside = match followed {
            Ok(Followed::Pending | Followed::Late) => follower.line().is_some(),
            Ok(Followed::Agrees) => master.would_have_spoken(rx),
            Err(Refusal::DuplicateCycle) => follower.doubts(cycle) || master.has_sent(cycle),
            _ => false,
        };
        if is_beside {
            master.doubts_line(rx, is_twice && from < self.address);
        }
    }
}
