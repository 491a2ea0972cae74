//! A server's side: it answers whoever asks, by a sender that is bound once.

use crate::component::{self, Mailbox, SendError, Sender};
use crate::mailbox::MOST_SENDERS;
use crate::name::MailboxName;
use crate::wire::Head;

/// Clients that a server remembers how to answer: as many as can have a place in its mailbox at a time.
pub const MOST_CLIENTS: usize = MOST_SENDERS;

/// The ways back to those who ask. One more than [`MOST_CLIENTS`] takes the place of who has not asked for the longest time.
pub struct Clients {
    senders: Recent<Sender>,
}

/// Why a command is not answered.
#[derive(Debug, thiserror::Error)]
pub enum ReplyError {
    /// It was none: what is 0 or less asks for nothing, and replies that were answered would be so for ever.
    #[error("kind {0} is no command: only commands are answered")]
    NoCommand(i8),
    /// There is no way to who asks.
    #[error("the way back: {0}")]
    Bind(#[from] component::Error),
    /// The reply was not taken.
    #[error(transparent)]
    Send(#[from] SendError),
}

impl Clients {
    /// Nobody has asked yet. Room for all is there from the beginning.
    pub fn new() -> Self {
        Self { senders: Recent::with_room(MOST_CLIENTS) }
    }

    /// How many have a way back.
    pub fn known(&self) -> usize {
        self.senders.all.len()
    }

    /// Answers a command that came to `own`, a server's mailbox: with its id and its priority, to who has sent it.
    ///
    /// It does not wait for the client, whatever that does. The first reply to each binds a sender, and so asks the broker; so
    /// does the first to a client that has come again under its name. All later ones ask nobody.
    pub fn reply(&mut self, own: &Mailbox, command: &Head, kind: i8, body: &[u8]) -> Result<(), ReplyError> {
        if !command.is_command() {
            return Err(ReplyError::NoCommand(command.kind));
        }
        let reply = command.answer(kind);
        if let Some(sender) = self.senders.find(command.from) {
            match sender.send_with(&reply, body) {
                Err(SendError::NoMailbox(_) | SendError::Unbound(_)) => {}
                told => return Ok(told?),
            }
            // That one is gone; another may have its name by now, and it is bound only after the old way was given back.
            self.senders.remove(command.from);
        }
        let mut sender = own.sender(command.from)?;
        let told = sender.send_with(&reply, body);
        self.senders.insert(command.from, sender);
        Ok(told?)
    }

    /// Forgets the way to a client, and gives back its place there: whether there was one.
    pub fn forget(&mut self, client: MailboxName) -> bool {
        self.senders.remove(client)
    }
}

impl Default for Clients {
    fn default() -> Self {
        Self::new()
    }
}

/// A table with a bound, of which who was not looked for the longest time goes first.
struct Recent<T> {
    all: Vec<Entry<T>>,
    most: usize,
    /// How often something was looked for.
    looked: u64,
}

struct Entry<T> {
    name: MailboxName,
    looked: u64,
    what: T,
}

impl<T> Recent<T> {
    fn with_room(most: usize) -> Self {
        Self { all: Vec::with_capacity(most), most, looked: 0 }
    }

    fn find(&mut self, name: MailboxName) -> Option<&mut T> {
        self.looked += 1;
        let entry = self.all.iter_mut().find(|entry| entry.name == name)?;
        entry.looked = self.looked;
        Some(&mut entry.what)
    }

    /// One that is not in it yet.
    fn insert(&mut self, name: MailboxName, what: T) {
        if self.all.len() == self.most {
            let oldest = self.all.iter().enumerate().min_by_key(|(_, entry)| entry.looked);
            if let Some((at, _)) = oldest {
                self.all.swap_remove(at);
            }
        }
        self.looked += 1;
        self.all.push(Entry { name, looked: self.looked, what });
    }

    fn remove(&mut self, name: MailboxName) -> bool {
        let at = self.all.iter().position(|entry| entry.name == name);
        at.map(|at| self.all.swap_remove(at)).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_client_too_many_takes_the_place_of_who_has_not_asked_for_longest() {
        let name = MailboxName;
        let mut recent = Recent::with_room(3);
        for client in 1..=3 {
            recent.insert(name(client), client);
        }
        assert_eq!(recent.find(name(1)).copied(), Some(1));
        recent.insert(name(4), 4);
        assert_eq!(recent.find(name(2)), None, "it was the oldest");
        assert_eq!(recent.find(name(3)).copied(), Some(3));
        recent.insert(name(5), 5);
        let mut left: Vec<_> = recent.all.iter().map(|entry| entry.what).collect();
        left.sort_unstable();
        assert_eq!(left, [3, 4, 5], "1 was looked for before 4 came");
        assert!(recent.remove(name(4)) && !recent.remove(name(4)));
        recent.insert(name(6), 6);
        assert_eq!(recent.all.len(), 3, "nobody had to go");
    }
}
