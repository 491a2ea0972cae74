//! What a control frame from the medium means to a station, by its role.

use rtnet::counters::Refusal;
use rtnet::discipline::EventKind;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Header;

use super::slave::Followed;
use super::{Role, Tdma};
use crate::wire::Message;

impl Tdma {
    pub(super) fn on_message(
        &mut self,
        rx: Instant,
        header: &Header,
        message: Message,
    ) -> Result<(), Refusal> {
        // Whom a station answers, it finds in the source.
        if header.source.is_group() || header.source == self.address {
            return Err(Refusal::ForgedSource);
        }
        let events = &mut self.events;
        match (message, &mut self.role) {
            (_, Role::Detached) => Err(Refusal::Detached),
            (Message::Sync { .. }, Role::Master(master)) => {
                if master.on_foreign_sync(header.source) || master.line().is_some() {
                    let cycle = master.line().map_or(0, |line| line.cycle);
                    events.note(cycle, EventKind::OtherMaster, Span::ZERO);
                }
                Err(Refusal::ForeignSync)
            }
            (Message::Sync { cycle, xmit, sched }, Role::Slave(slave)) => {
                self.counters.syncs_received += 1;
                let left = slave.line().copied();
                let followed = slave.on_sync(rx, header.source, cycle, xmit, sched, events)?;
                if let Some((silent, at)) = self.silent
                    && cycle.wrapping_sub(silent) as i32 <= 0
                {
                    self.counters.syncs_late += 1;
                    events.note(cycle, EventKind::SyncLate, at - rx);
                }
                if let (Followed::NewLine, Some(&line)) = (followed, slave.line()) {
                    if let (Some(left), Some(_)) = (left, slave.calibration().delay()) {
                        self.leave(&left, &line, rx);
                    }
                    self.silent = None;
                    self.slots.align(&line, rx);
                    if let Some(beyond) = self.slots.longest_offset().filter(|offset| *offset >= line.period)
                    {
                        self.events.note(cycle, EventKind::SlotBeyondCycle, beyond - line.period);
                    }
                }
                Ok(())
            }
            (Message::Request { .. }, _) if header.destination != self.address => Err(Refusal::NotMaster),
            (Message::Request { xmit, reply_cycle, reply_offset }, Role::Master(master)) => {
                master.on_request(rx, header.source, xmit, reply_cycle, reply_offset)
            }
            (Message::Request { .. }, Role::Slave(_)) => Err(Refusal::NotMaster),
            (Message::Reply { request_xmit, reception, xmit }, Role::Slave(slave)) => {
                if header.destination != self.address {
                    return Err(Refusal::UnexpectedReply);
                }
                let done = slave.on_reply(rx, request_xmit, reception, xmit, events)?;
                if let (true, Some(line)) = (done, slave.line()) {
                    self.slots.align(line, rx);
                }
                Ok(())
            }
            (Message::Reply { .. }, Role::Master(_)) => Err(Refusal::UnexpectedReply),
        }
    }
}
