//! Control packages: those to 0 from 0 are for the router itself.

use crate::name::MailboxName;
use crate::wire::{Endian, HEAD_LEN, Head};

/// Kind of the router's question whether a client is alive; the client answers 0.
pub const LIFESIGN: i8 = 17;
/// Kind of the request to be asked whether one is alive.
pub const WATCHED: i8 = 18;
/// Kind of the request not to be asked.
pub const UNWATCHED: i8 = 19;
/// Kind of the request to register a mailbox, which is answered.
pub const REGISTER: i8 = 13;
/// Kind of the request to delete a mailbox, which is not answered.
pub const UNREGISTER: i8 = 12;
/// Kind of the request to delete a mailbox, which is answered. Nobody has the name 0: the answer to a request with that name confirms that
/// the router has read every package before it.
pub const CONFIRM: i8 = 14;
/// Kind of the proof that a client knows the router's secret: the first package of a connection that has to give one.
pub const PROOF: i8 = 20;
/// Kind of the announcement of a router that it is one, and of which system; it is answered.
pub const ROUTER: i8 = 21;
/// Kind of the question what the router has not passed on of this connection: the answer's body is an [`Account`](super::account::Account).
pub const ACCOUNT: i8 = 22;
/// The head of a request to a router.
pub fn request(kind: i8, id: u8, body: &[u8]) -> Head {
    let len = (HEAD_LEN + body.len()) as u32;
    Head { id, len, ..Head::new(kind, MailboxName::NOBODY, MailboxName::NOBODY) }
}

/// The body of a proof.
pub type Proof = [u8; 32];

/// The request of a control package.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    /// A mailbox is there, from now on.
    Register {
        /// Its name.
        name: MailboxName,
        /// Whether an answer is waited for.
        is_answered: bool,
    },
    /// It is gone.
    Delete {
        /// Its name.
        name: MailboxName,
        /// Whether an answer is waited for.
        is_answered: bool,
    },
    /// All mailboxes of this connection are gone.
    Purge,
    /// The client lives.
    Alive,
    /// A proof, of a client that is trusted already.
    Proof,
    /// The client is the router of this system.
    Router(u32),
    /// The question for an account.
    Account,
    /// Whether the client is to be asked for signs of life.
    Watchdog(bool),
    /// Nothing that the router knows: ignored, as a login is.
    Unknown,
    /// A known kind whose body is not what it is to be. With an answer, that is an error.
    Malformed {
        /// Whether an answer is waited for.
        is_answered: bool,
    },
}

impl Control {
    /// The request in a package; `None` if the package is for another receiver.
    pub fn of(head: &Head, body: &[u8]) -> Option<Self> {
        if (head.to, head.from) != (MailboxName::NOBODY, MailboxName::NOBODY) {
            return None;
        }
        let is_answered = matches!(head.kind, REGISTER | CONFIRM | ROUTER | ACCOUNT);
        let name = || {
            let bytes = body.try_into().ok()?;
            Some(MailboxName(match head.body_order {
                Endian::Little => u32::from_le_bytes(bytes),
                Endian::Big => u32::from_be_bytes(bytes),
            }))
        };
        let malformed = Self::Malformed { is_answered };
        let bare = |control| if body.is_empty() { control } else { malformed };
        Some(match head.kind {
            11 | 13 => name().map_or(malformed, |name| Self::Register { name, is_answered }),
            12 | 14 => name().map_or(malformed, |name| Self::Delete { name, is_answered }),
            PROOF => Self::Proof,
            ROUTER => name().map_or(malformed, |system| Self::Router(system.0)),
            ACCOUNT => bare(Self::Account),
            15 => bare(Self::Purge),
            0 => bare(Self::Alive),
            WATCHED => bare(Self::Watchdog(true)),
            UNWATCHED => bare(Self::Watchdog(false)),
            _ => Self::Unknown,
        })
    }
}
