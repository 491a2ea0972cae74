//! The TCP client's part in its broker: its own mailbox, and its lanes into others'.

use std::collections::{BTreeMap, BTreeSet};

use crate::component::{Component, Mailbox, ReceiveError, SendError, Sender};
use crate::mailbox;
use crate::name::MailboxName;
use crate::wire::{ERROR, Head, NOT_AVAILABLE};

/// Packages that are refused at once while there is no router.
const REFUSED_AT_ONCE: usize = 256;

/// Counters of the mailboxes here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LocalCounters {
    /// Packages that were brought into mailboxes.
    pub delivered: u64,
    /// Packages from the router for a mailbox that is not here.
    pub no_mailbox: u64,
    /// Packages from the router that found their mailbox full.
    pub full: u64,
    /// Packages from the router that no slot of their mailbox holds.
    pub too_large: u64,
    /// Packages from the router in the name of a mailbox that is here.
    pub forged: u64,
    /// Packages for the router while there was no connection.
    pub not_connected: u64,
    /// Packages for the router that found its queue full.
    pub queue_full: u64,
    /// Packages that wait for the router.
    pub waiting: u64,
}

/// The mailboxes of a broker, as the TCP client has them.
pub(super) struct Local {
    component: Component,
    /// Packages for the router wait here.
    mailbox: Mailbox,
    names: BTreeSet<MailboxName>,
    /// The count of mailboxes that had come and gone when it was looked.
    seen: Option<u64>,
    /// Lanes into mailboxes that packages have come for.
    senders: BTreeMap<MailboxName, Sender>,
    /// The body of the package that was taken last.
    body: Vec<u8>,
    /// Commands that found the mailbox full, while they are answered.
    refused: Vec<Head>,
    counters: LocalCounters,
}

impl Local {
    pub fn new(component: Component, mailbox: Mailbox) -> Self {
        let (names, senders, counters) = (BTreeSet::new(), BTreeMap::new(), LocalCounters::default());
        let (body, refused) = (Vec::new(), Vec::new());
        Self { component, mailbox, names, seen: None, senders, body, refused, counters }
    }

    /// `true`: nothing waits, and its descriptor is readable once something does. Commands that found the queue full are answered.
    pub fn prepare_wait(&mut self) -> Result<bool, ReceiveError> {
        let is_empty = self.mailbox.prepare_wait()?;
        // A command that is refused from now on makes the mailbox readable, whatever waits.
        self.answer_refused()?;
        Ok(is_empty)
    }

    fn answer_refused(&mut self) -> Result<(), ReceiveError> {
        let mut refused = core::mem::take(&mut self.refused);
        self.mailbox.take_refused_commands(&mut refused)?;
        // The commands of a sender come one behind the other: for them the broker is asked once for a mailbox that has gone.
        let mut gone = MailboxName::NOBODY;
        for head in refused.drain(..) {
            if head.from != gone && self.answer(&head, NOT_AVAILABLE) == Err(SendError::NoMailbox(head.from))
            {
                gone = head.from;
            }
        }
        self.refused = refused;
        Ok(())
    }

    /// Ends that wait.
    pub fn end_wait(&mut self) -> Result<(), ReceiveError> {
        self.mailbox.end_wait()
    }

    /// The names of all mailboxes, if that has changed.
    pub fn follow(&mut self) -> Option<BTreeSet<MailboxName>> {
        let changes = self.component.name_changes();
        if self.seen == Some(changes) {
            return None;
        }
        // A broker that does not answer ends the connection to it, which the next wait shows.
        let mut names = self.component.names().ok()?;
        names.remove(&MailboxName::NOBODY);
        self.seen = Some(changes);
        self.senders.retain(|name, _| names.contains(name));
        self.names.clone_from(&names);
        Some(names)
    }

    /// Brings a package into its mailbox. Returns the answer to a command that none here takes.
    pub fn deliver(&mut self, head: &Head, body: &[u8]) -> Option<Head> {
        if self.names.contains(&head.from) {
            self.counters.forged += 1;
            return None;
        }
        self.bring(head, body).filter(|_| head.is_command()).map(|kind| head.answer(kind))
    }

    /// The kind of the answer, if it was not brought.
    fn bring(&mut self, head: &Head, body: &[u8]) -> Option<i8> {
        let sent = self.send(head, body);
        let (counter, kind) = match sent {
            Ok(()) => (&mut self.counters.delivered, None),
            Err(SendError::Mailbox(mailbox::SendError::TooLarge { .. })) => {
                (&mut self.counters.too_large, Some(ERROR))
            }
            Err(SendError::Mailbox(_)) => (&mut self.counters.full, Some(NOT_AVAILABLE)),
            Err(_) => (&mut self.counters.no_mailbox, Some(NOT_AVAILABLE)),
        };
        *counter += 1;
        kind
    }

    fn send(&mut self, head: &Head, body: &[u8]) -> Result<(), SendError> {
        if let Some(sender) = self.senders.get_mut(&head.to) {
            match sender.bring(head, body) {
                // Its mailbox is another by now, perhaps.
                Err(SendError::NoMailbox(_)) => drop(self.senders.remove(&head.to)),
                sent => return sent,
            }
        }
        if head.to == MailboxName::NOBODY {
            return Err(SendError::NoMailbox(head.to));
        }
        let mut sender = self.mailbox.sender(head.to).map_err(|_| SendError::NoMailbox(head.to))?;
        let sent = sender.bring(head, body);
        self.senders.insert(head.to, sender);
        sent
    }

    /// Appends the most urgent package for the router; `false`: there is none.
    pub fn next(&mut self, batch: &mut Vec<u8>) -> bool {
        let Some(head) = self.take() else { return false };
        batch.extend_from_slice(&head.to_bytes());
        batch.extend_from_slice(&self.body);
        true
    }

    /// Takes the most urgent package for the router, and leaves its body in `body`. A package for a mailbox that has come here since its
    /// sender was bound goes there.
    fn take(&mut self) -> Option<Head> {
        loop {
            // A broker that has ended is seen at the next wait.
            let package = self.mailbox.try_receive().ok()??;
            let head = *package.head();
            self.body.resize(package.body().len(), 0);
            package.body().copy_to(0, &mut self.body);
            drop(package);
            if !self.names.contains(&head.to) {
                return Some(head);
            }
            let body = core::mem::take(&mut self.body);
            self.bring_back(&head, &body);
            self.body = body;
        }
    }

    /// Brings a package of a sender here into a mailbox here. A command that it does not take is answered.
    fn bring_back(&mut self, head: &Head, body: &[u8]) {
        if let Some(kind) = self.bring(head, body).filter(|_| head.is_command()) {
            let _ = self.answer(head, kind);
        }
    }

    /// Answers a command of a mailbox here. An answer that the mailbox does not take is lost, and counted there.
    fn answer(&mut self, head: &Head, kind: i8) -> Result<(), SendError> {
        self.send(&head.answer(kind), &[])
    }

    /// Refuses packages for the router: commands are answered.
    pub fn refuse_all(&mut self) {
        for _ in 0..REFUSED_AT_ONCE {
            let Some(head) = self.take() else { return };
            self.counters.not_connected += 1;
            if head.is_command() {
                let _ = self.answer(&head, NOT_AVAILABLE);
            }
        }
    }

    /// Counts what its own mailbox has and has refused. Each sender's part is in memory that the sender writes with each package, so this is
    /// for moments at which nothing waits, or for one of many.
    pub fn look(&mut self) {
        // A broker that has ended is seen at the next wait.
        self.counters.waiting = self.mailbox.depth().unwrap_or(0) as u64;
        self.counters.queue_full = self.mailbox.refused();
    }

    pub fn counters(&self) -> LocalCounters {
        self.counters
    }
}
