//! Packages on their way through the router.

use super::links::Role;
use super::{Connection, Counters, Router};
use crate::name::MailboxName;
use crate::tcp::outgoing::{Full, Outgoing, Source};
use crate::tcp::rules::Rules;
use crate::wire::{self, Endian, HEAD_LEN, Head};

/// The counter of what became of a package, at its sender.
type Reason = fn(&mut Counters) -> &mut u64;

/// Its receiver's connection has ended.
const RECEIVER_GONE: Reason = |counters| &mut counters.receiver_gone;

impl Router {
    /// Passes a package on, and those right behind it that go the same way; returns the bytes of these.
    pub(super) fn forward(
        &mut self,
        from: Connection,
        head: &Head,
        (body, rest): (&[u8], &[u8]),
        now: u64,
    ) -> usize {
        let to = match self.way(from, head) {
            Ok(to) => to,
            Err(reason) => {
                self.refuse(from, head, now, reason);
                return 0;
            }
        };
        let sent = Head { head_order: Endian::Little, ..*head };
        let source = self
            .client(from)
            .map_or(Source::ROUTER, |client| Source { place: from.0, number: client.number });
        if self.enqueue(to, &sent, body, (source, now)).is_err() {
            self.refuse(from, &sent, now, |counters| &mut counters.receiver_full);
            return 0;
        }
        let (packages, bytes) = self.enqueue_run(from, to, (head, rest), (source, now));
        if let Some(sender) = self.client(from) {
            sender.waits += 1 + packages;
            sender.counters.packages_in += 1 + packages;
            sender.counters.bytes_in += u64::from(head.len) + bytes as u64;
        }
        bytes
    }

    /// The connection that a package leaves by, if it may.
    fn way(&self, from: Connection, head: &Head) -> Result<Connection, Reason> {
        if !self.is_sender(from, head.from) {
            return Err(|counters| &mut counters.foreign_senders);
        }
        if !self.rules.may_send(head) {
            return Err(|counters| &mut counters.forbidden);
        }
        self.receiver(from, head.to).ok_or(|counters| &mut counters.nobody_there)
    }

    /// Queues packages in front of `rest` that go the way of `first`, as long as there is room without any that are displaced; returns how
    /// many, and their bytes.
    fn enqueue_run(
        &mut self,
        from: Connection,
        to: Connection,
        (first, rest): (&Head, &[u8]),
        at: (Source, u64),
    ) -> (u64, usize) {
        let room = self.limits.memory.saturating_sub(self.held);
        // Memory for `first` may have been made of the sender's.
        if self.client(from).is_none_or(|sender| sender.is_ending) {
            return (0, 0);
        }
        let Some(receiver) = self.client(to).filter(|receiver| !receiver.is_ending) else { return (0, 0) };
        let room = room.min(receiver.outgoing.room()).min(rest.len());
        let packages = run(first, &rest[..room]);
        if packages.is_empty() {
            return (0, 0);
        }
        let (count, bytes) = (receiver.outgoing.push_run(first.priority, packages, at), packages.len());
        receiver.counters.packages_out += count;
        receiver.counters.bytes_out += bytes as u64;
        self.held += bytes;
        (count, bytes)
    }

    /// The connection that a package leaves by. A package of another system goes to clients of this one only.
    fn receiver(&self, from: Connection, to: MailboxName) -> Option<Connection> {
        let is_client = |of: Connection| {
            self.clients
                .get(of.0 as usize)
                .and_then(Option::as_ref)
                .is_some_and(|client| client.role == Role::Client)
        };
        let to = self.table.get(&to).copied().or_else(|| self.way_out(to))?;
        (is_client(from) || is_client(to)).then_some(to)
    }

    /// Queues a package for a connection. A displaced package is counted at the connection that it came by.
    fn enqueue(&mut self, to: Connection, head: &Head, body: &[u8], at: (Source, u64)) -> Result<(), Full> {
        self.make_memory(head.len as usize, at.1);
        let Some(receiver) = self.client(to) else { return Err(Full) };
        let (mut displaced, before) = (Vec::new(), receiver.outgoing.bytes());
        let pushed = match receiver.is_ending {
            false => {
                receiver.outgoing.push(head, body, at, |dropped, source| displaced.push((dropped, source)))
            }
            true => Err(Full),
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
        for (dropped, source) in displaced {
            let Some(sender) = self.source(source) else { continue };
            sender.waits -= 1;
            // Its answer is less urgent than what displaced it, so that this ends.
            self.refuse(Connection(source.place), &dropped, at.1, |counters| &mut counters.overtaken);
        }
        pushed
    }

    /// Whether a connection may send in this name: it owns the name, or the name is free and it may register it. Where two routers have
    /// a link to each other, names of a system come by the link of its router, and packages by either, if this router's names that system.
    fn is_sender(&self, from: Connection, name: MailboxName) -> bool {
        let client = |of: Connection| self.clients.get(of.0 as usize).and_then(Option::as_ref);
        let is_of_router = |owner| client(owner).is_some_and(|owner| owner.role == Role::Peer(name.system()));
        let Some(client) = client(from) else { return false };
        let is_link = matches!(client.role, Role::Link(_));
        let is_its_link = client.role.is_link_of(name.system());
        let might_have =
            || name == MailboxName::NOBODY || is_link || self.rules.may_register(client.peer.ip(), name);
        let is_owner = |owner: &Connection| *owner == from || is_its_link && is_of_router(*owner);
        client.role.may_have(name, self.system) && self.table.get(&name).map_or_else(might_have, is_owner)
    }

    /// Drops all that waits for a receiver that is gone: it is counted at its senders, and commands are answered.
    pub(super) fn give_up(&mut self, outgoing: Outgoing, now: u64) {
        let mut dropped = Vec::new();
        outgoing.drop_all(|head, source| dropped.push((head, source)));
        for (head, source) in dropped {
            let Some(sender) = self.source(source) else { continue };
            sender.waits -= 1;
            self.refuse(Connection(source.place), &head, now, RECEIVER_GONE);
        }
    }

    /// A package does not go on: that is counted at its sender, which is answered if it was a command.
    fn refuse(&mut self, sender: Connection, head: &Head, now: u64, reason: Reason) {
        let Some(client) = self.client(sender) else { return };
        *reason(&mut client.counters) += 1;
        if head.is_command()
            && self.enqueue(sender, &head.answer(wire::NOT_AVAILABLE), &[], (Source::ROUTER, now)).is_err()
        {
            self.client(sender).into_iter().for_each(|client| client.counters.answers_lost += 1);
        }
    }

    /// Sends an answer or a question of the router; returns whether there was room for it.
    pub(super) fn own(&mut self, to: Connection, head: &Head, now: u64) -> bool {
        self.own_with(to, head, &[], now)
    }

    /// The same with a body.
    pub(super) fn own_with(&mut self, to: Connection, head: &Head, body: &[u8], now: u64) -> bool {
        let Some(client) = self.client(to).filter(|client| !client.is_ending) else { return false };
        match client.outgoing.push_own(head, body, now) {
            Ok(()) => {
                self.held += HEAD_LEN + body.len();
                self.wake(to);
                true
            }
            Err(Full) => {
                client.counters.answers_lost += 1;
                false
            }
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

/// Whole packages in front of `rest` that go the way of `first` and are as urgent, as they are to be sent.
fn run<'a>(first: &Head, rest: &'a [u8]) -> &'a [u8] {
    let mut bytes = 0;
    while let Ok(next) = Head::parse(&rest[bytes..])
        && next.head_order == Endian::Little
        && next.priority == first.priority
        && Rules::are_alike(first, &next)
        && bytes + next.len as usize <= rest.len()
    {
        bytes += next.len as usize;
    }
    &rest[..bytes]
}
