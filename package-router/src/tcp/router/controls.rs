//! Requests to the router itself: proofs, registrations, the watchdog.

use subtle::ConstantTimeEq;

use super::{Connection, Counters, Ending, Life, Router, Trust};
use crate::name::MailboxName;
use crate::tcp::account::Account;
use crate::tcp::control::{Control, PROOF};
use crate::wire::{self, HEAD_LEN, Head};

impl Router {
    /// Whether a connection is trusted; a package that is its proof makes it so, and any other ends it.
    pub(super) fn is_trusted(&mut self, from: Connection, head: &Head, body: &[u8]) -> bool {
        let Some(client) = self.client(from).filter(|client| !client.is_ending) else { return false };
        let Trust::Proof(proof) = client.trust else { return client.trust == Trust::Full };
        let is_control = (head.to, head.from, head.kind) == (MailboxName::NOBODY, MailboxName::NOBODY, PROOF);
        // The time says nothing of the place where they differ.
        if is_control && bool::from(proof.ct_eq(body)) {
            self.trust(from);
        } else {
            client.trust = Trust::Handshake;
            self.end(from, Ending::Stranger);
        }
        false
    }

    pub(super) fn control(&mut self, from: Connection, head: &Head, control: Control, now: u64) {
        let answer = match control {
            Control::Register { name, is_answered } => {
                let is_done = self.register(from, name, is_answered, now);
                is_answered.then_some(is_done)
            }
            Control::Delete { name, is_answered } => {
                let is_done = self.delete(from, name, now);
                is_answered.then_some(is_done)
            }
            Control::Purge => {
                self.purge(from, now);
                None
            }
            Control::Router(system) => Some(self.announced(from, system)),
            Control::Account => {
                self.answer_account(from, head, now);
                None
            }
            Control::Alive => None,
            // A client with a certificate may send one, too.
            Control::Proof if self.client(from).is_some_and(|client| client.is_by_tls) => None,
            Control::Watchdog(on) => {
                self.client(from)
                    .into_iter()
                    .for_each(|client| (client.watchdog, client.life) = (on, Life::Shown));
                None
            }
            Control::Proof | Control::Unknown => {
                self.count(from, |counters| &mut counters.controls_ignored);
                None
            }
            Control::Malformed { is_answered } => {
                self.count(from, |counters| &mut counters.controls_malformed);
                is_answered.then_some(false)
            }
        };
        if let Some(is_done) = answer {
            self.own(from, &head.answer(if is_done { wire::OK } else { wire::ERROR }), now);
        }
    }

    /// Registers a name. Returns whether this connection owns it from now on, or it is 0, which no connection owns. Without an answer, a
    /// second registration is not counted as refused.
    fn register(&mut self, from: Connection, name: MailboxName, is_answered: bool, now: u64) -> bool {
        if name == MailboxName::NOBODY {
            return true;
        }
        let owner = self.table.get(&name).copied();
        let has_room = self.table.len() < self.limits.all_names;
        let (system, most) = (self.system, self.limits.names);
        let Some(client) = self.clients.get_mut(from.0 as usize).and_then(Option::as_mut) else {
            return false;
        };
        let is_new = self.rules.may_register(client.peer.ip(), name)
            && client.role.may_have(name, system)
            && has_room
            && owner.is_none()
            && client.names.len() < most;
        let is_idle = !is_answered && owner == Some(from);
        if is_new {
            client.names.insert(name);
            self.table.insert(name, from);
            self.tell_links(name, true, now);
        } else if !is_idle {
            client.counters.names_refused += 1;
        }
        is_new
    }

    /// Whether the name is not this connection's any more: not so if it is another's.
    fn delete(&mut self, from: Connection, name: MailboxName, now: u64) -> bool {
        if self.table.get(&name).is_some_and(|owner| *owner != from) {
            self.count(from, |counters| &mut counters.names_refused);
            return false;
        }
        if self.client(from).is_some_and(|client| client.names.remove(&name)) {
            self.table.remove(&name);
            self.tell_links(name, false, now);
        }
        true
    }

    /// Answers what of this connection was not passed on so far.
    fn answer_account(&mut self, from: Connection, head: &Head, now: u64) {
        let Some(client) = self.client(from) else { return };
        let body = Account { lost: client.counters.lost(), waiting: client.waits }.to_bytes();
        let answer = Head { len: (HEAD_LEN + body.len()) as u32, ..head.answer(wire::OK) };
        self.own_with(from, &answer, &body, now);
    }

    fn purge(&mut self, from: Connection, now: u64) {
        let names = self.client(from).map(|client| core::mem::take(&mut client.names));
        for name in names.unwrap_or_default() {
            self.table.remove(&name);
            self.tell_links(name, false, now);
        }
    }

    fn count(&mut self, of: Connection, which: impl Fn(&mut Counters) -> &mut u64) {
        self.client(of).into_iter().for_each(|client| *which(&mut client.counters) += 1);
    }
}
