//! A way to a mailbox, and questions that go there.

use std::time::{Duration, Instant};

use anyhow::anyhow;
use nix::errno::Errno;
use package_router::component::{Component, Mailbox, ReceiveError, SendError, Sender};
use package_router::mailbox::{self, Shape};
use package_router::name::MailboxName;
use package_router::wire::{Head, NOT_AVAILABLE};

use super::usage;
use crate::cmd::Failure;

/// Until who found no room tries again.
pub(super) const REST: Duration = Duration::from_micros(50);

/// A mailbox for a while, and a way from there to another.
pub(super) struct Way {
    pub mailbox: Mailbox,
    pub sender: Sender,
}

/// An answer.
pub(super) struct Told {
    /// How long after the question was asked it came.
    pub took: Duration,
    pub head: Head,
    pub body: Vec<u8>,
}

impl Way {
    /// From a mailbox with room for answers of so many bytes.
    pub fn of(
        component: &Component,
        from: MailboxName,
        to: MailboxName,
        body: usize,
    ) -> Result<Self, Failure> {
        let mailbox = component.mailbox(from, Shape::new(8, body)).map_err(usage)?;
        let sender = mailbox.sender(to).map_err(usage)?;
        Ok(Self { mailbox, sender })
    }

    /// A command, and its answer; none: it did not come in time.
    pub fn ask(&mut self, kind: i8, body: &[u8], timeout: Duration) -> Result<Option<Told>, Failure> {
        let to = self.sender.to();
        let begun = Instant::now();
        let id = loop {
            match self.sender.send(kind, body) {
                Ok(id) => break id,
                Err(error) if lacks_room(&error) && begun.elapsed() < timeout => std::thread::sleep(REST),
                Err(error) => return Err(self.failed(&error)),
            }
        };
        while let Some(left) = timeout.checked_sub(begun.elapsed()) {
            let package = match self.mailbox.receive(Some(left)) {
                Ok(package) => package,
                Err(ReceiveError::TimedOut) => break,
                Err(error) => return Err(Failure::Run(anyhow!(error))),
            };
            let took = begun.elapsed();
            let head = *package.head();
            // One to an earlier question is too late.
            if head.id != id || head.from != to {
                continue;
            }
            if head.kind == NOT_AVAILABLE {
                return Err(Failure::Run(anyhow!("{to} is not available: nobody has it, or it has no room")));
            }
            return Ok(Some(Told { took, head, body: package.body().to_vec() }));
        }
        Ok(None)
    }

    /// What could not be sent, and where.
    pub fn failed(&self, error: &SendError) -> Failure {
        Failure::Run(anyhow!("{}: {error}", self.sender.to()))
    }
}

/// Whether it is only not taken now: the mailbox is full, or what was sent before has not left.
pub(super) fn lacks_room(error: &SendError) -> bool {
    match error {
        SendError::Mailbox(error) => matches!(error, mailbox::SendError::Full(_)),
        SendError::Station(errno) => *errno == Errno::ENOBUFS as i32,
        SendError::NoMailbox(_) | SendError::Unbound(_) | SendError::LongerThanTcpTakes { .. } => false,
    }
}
