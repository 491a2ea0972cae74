//! Packages on their way through the router.

use super::{Connection, Counters, Router};
use crate::name::MailboxName;
use crate::tcp::outgoing::Full;
use crate::wire::{self, Endian, Head};

impl Router {
    pub(super) fn forward(&mut self, from: Connection, head: &Head, body: &[u8], now: u64) {
        if !self.is_sender(from, head.from) {
            return self.refuse(from, head, now, |counters| &mut counters.foreign_senders);
        }
        if !self.rules.may_send(head) {
            return self.refuse(from, head, now, |counters| &mut counters.forbidden);
        }
        let to = self.table.get(&head.to).copied().or_else(|| self.way_out(from, head.to));
        let Some(to) = to else {
            return self.refuse(from, head, now, |counters| &mut counters.nobody_there);
        };
        let head = Head { head_order: Endian::Little, ..*head };
        if self.enqueue(to, &head, body, now).is_err() {
            return self.refuse(from, &head, now, |counters| &mut counters.receiver_full);
        }
        if let Some(sender) = self.client(from) {
            sender.counters.packages_in += 1;
            sender.counters.bytes_in += u64::from(head.len);
        }
    }

    /// Queues a package for a connection. A displaced package is counted at its sender.
    fn enqueue(&mut self, to: Connection, head: &Head, body: &[u8], now: u64) -> Result<(), Full> {
        let has_memory = self.held + head.len as usize <= self.limits.memory;
        let Some(receiver) = self.client(to) else { return Err(Full) };
        let (mut displaced, before) = (Vec::new(), receiver.outgoing.bytes());
        let pushed = match has_memory {
            true => receiver.outgoing.push(head, body, now, |dropped| displaced.push(dropped)),
            false => Err(Full),
        };
        let after = receiver.outgoing.bytes();
        match pushed {
            Ok(()) => {
                receiver.counters.packages_out += 1;
                receiver.counters.bytes_out += u64::from(head.len);
                receiver.counters.displaced += displaced.len() as u64;
                self.wake(to);
            }
            Err(Full) => receiver.counters.queue_full += 1,
        }
        self.held = self.held + after - before;
        for dropped in displaced {
            // Its answer is less urgent than what displaced it, so that this ends.
            if let Some(&sender) = self.table.get(&dropped.from) {
                self.refuse(sender, &dropped, now, |counters| &mut counters.overtaken);
            }
        }
        pushed
    }

    /// Whether a connection may send in this name: no other connection has it, and it may be its own.
    fn is_sender(&self, from: Connection, name: MailboxName) -> bool {
        let client = self.clients.get(from.0 as usize).and_then(Option::as_ref);
        let may_be_its_own = client.is_some_and(|client| client.role.may_have(name, self.system));
        may_be_its_own && self.table.get(&name).is_none_or(|owner| *owner == from)
    }

    /// A package does not go on: that is counted at its sender, which is answered if it was a command.
    fn refuse(
        &mut self,
        sender: Connection,
        head: &Head,
        now: u64,
        reason: impl FnOnce(&mut Counters) -> &mut u64,
    ) {
        let Some(client) = self.client(sender) else { return };
        *reason(&mut client.counters) += 1;
        if head.is_command() && self.enqueue(sender, &head.answer(wire::NOT_AVAILABLE), &[], now).is_err() {
            self.client(sender).into_iter().for_each(|client| client.counters.answers_lost += 1);
        }
    }

    /// Sends an answer or a question of the router.
    pub(super) fn own(&mut self, to: Connection, head: &Head, now: u64) {
        self.own_with(to, head, &[], now);
    }

    pub(super) fn own_with(&mut self, to: Connection, head: &Head, body: &[u8], now: u64) {
        let Some(client) = self.client(to) else { return };
        match client.outgoing.push_own(head, body, now) {
            Ok(()) => self.wake(to),
            Err(Full) => client.counters.answers_lost += 1,
        }
    }

    fn wake(&mut self, whom: Connection) {
        if let Some(client) = self.client(whom)
            && !core::mem::replace(&mut client.is_awake, true)
        {
            self.awake.push_back(whom);
        }
    }
}
