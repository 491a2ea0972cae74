//! Proxies: what another component does, called as if it were here, and how who is asked answers.
//!
//! ```text
//!   Proxy ── command, id n ──► a sender ──► the server's mailbox ──► Clients::reply, by a sender bound once
//!     ▲                                                                  │
//!     └─ Calls: the call of id n ◄── the proxy's own mailbox ◄── reply, id n ┘
//! ```
//!
//! A server is a loop, and a proxy a handle on it:
//!
//! ```no_run
//! use package_router::component::Component;
//! use package_router::mailbox::Shape;
//! use package_router::name::{Class, MailboxName};
//! use package_router::rpc::{Clients, Proxy};
//! use package_router::wire;
//! use std::path::Path;
//! use std::time::Duration;
//!
//! const PARAMETER: i8 = 21;
//! let (odometry, pilot) = (MailboxName::new(0, Class::ODOMETRY, 0, 0), MailboxName::new(0, Class::PILOT, 0, 1));
//!
//! fn serve(component: &Component, name: MailboxName) -> Result<(), Box<dyn std::error::Error>> {
//!     let mut mailbox = component.mailbox(name, Shape::new(8, 240))?;
//!     let mut clients = Clients::new();
//!     let mut room = [0; 240];
//!     loop {
//!         let (command, len) = mailbox.receive_into(&mut room, None)?;
//!         let kind = if command.kind == PARAMETER { wire::OK } else { wire::ERROR };
//!         if let Err(error) = clients.reply(&mailbox, &command, kind, &room[..len]) {
//!             eprintln!("{} is not answered: {error}", command.from);
//!         }
//!     }
//! }
//!
//! let component = Component::attach(Path::new("/run/rtnet/arm.packages"))?;
//! let mut proxy = Proxy::new(&component, pilot, Shape::new(8, 240), odometry)?;
//! let wheel_base: f32 = proxy.call_typed(PARAMETER, &0.48f32, Duration::from_millis(10))?;
//!
//! // Two at a time.
//! let (first, second) = (proxy.begin(PARAMETER, b"first")?, proxy.begin(PARAMETER, b"second")?);
//! assert_eq!(proxy.finish(second, Duration::from_millis(10))?.body(), b"second");
//! assert_eq!(proxy.finish(first, Duration::from_millis(10))?.body(), b"first");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod calls;
mod serve;

use core::time::Duration;

use rtnet::live::clock::{later, monotonic};
use zerocopy::IntoBytes;
use zerocopy::byteorder::LittleEndian;

use crate::body::{self, BodyError, Record};
use crate::component::{self, Component, Mailbox, ReceiveError, SendError, Sender};
use crate::mailbox::Shape;
use crate::name::MailboxName;
use crate::priority;
use crate::wire::Head;

pub use calls::{Call, Dropped, MOST_CALLS};
use calls::{Calls, Next};
pub use serve::{Clients, MOST_CLIENTS, ReplyError};

/// A server, and the mailbox in which its replies come. All memory that calls take is taken when it is made.
pub struct Proxy {
    mailbox: Mailbox,
    /// `None`: it was lost when it was to be bound anew.
    server: Option<Sender>,
    calls: Calls,
    priority: u8,
}

/// What the server has answered, as long as nothing else is asked of its proxy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply<'a> {
    head: Head,
    body: &'a [u8],
    took: u64,
}

/// Why a call has no reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CallError {
    /// The server answers ERROR, -1.
    #[error("{0} answers that it could not")]
    Failed(MailboxName),
    /// The server answers TIMEOUT, -2: what it waited for itself did not come.
    #[error("{0} answers that it was not done in time")]
    NotInTime(MailboxName),
    /// The answer is NOT_AVAILABLE, -3: no component has the server's mailbox, or a queue on the way there is full.
    #[error(
        "{0} is not available: start its component, or send less if the queue to the router is full (`rtnet stat`)"
    )]
    NotAvailable(MailboxName),
    /// The server has not answered so long; the call is given up.
    #[error("{0} has not answered in time")]
    TimedOut(MailboxName),
    /// As many calls as there may be have not been finished.
    #[error("{0} calls are in flight, no more fit: finish one, or give it up")]
    TooMany(usize),
    /// The command was not sent.
    #[error(transparent)]
    Send(#[from] SendError),
    /// There is no mailbox any more in which replies come.
    #[error("the proxy's mailbox is there no more: its station has ended")]
    Gone,
    /// The reply does not hold the record.
    #[error("the reply: {0}")]
    Body(#[from] BodyError),
    /// It is another proxy's call.
    #[error("that is no call of this proxy's")]
    NotOpen,
}

impl Proxy {
    /// A proxy of a server, with a mailbox of its own for the replies: `own`, of that shape.
    ///
    /// As many calls are in flight at a time as it has slots, [`MOST_CALLS`] at the most: so each reply finds one, but for what
    /// answers calls that were given up. Besides the server others may send to it, and take a place among its senders: the
    /// server's is free only if there is one for each of them.
    pub fn new(
        component: &Component,
        own: MailboxName,
        shape: Shape,
        server: MailboxName,
    ) -> Result<Self, component::Error> {
        let mailbox = component.mailbox(own, shape)?;
        let bound = mailbox.sender(server)?;
        let calls = Calls::new(own, server, shape.slots.min(MOST_CALLS), shape.largest_body);
        Ok(Self { mailbox, server: Some(bound), calls, priority: priority::of_class(own.class()) })
    }

    /// Where replies come.
    pub fn name(&self) -> MailboxName {
        self.mailbox.name()
    }
    /// Whose proxy it is.
    pub fn server(&self) -> MailboxName {
        self.calls.server()
    }
    /// What came and answered no call that was open.
    pub fn dropped(&self) -> Dropped {
        self.calls.dropped()
    }
    /// How many calls are in flight, or answered and not finished.
    pub fn in_flight(&self) -> usize {
        self.calls.open()
    }
    /// How urgent its commands are from now on, and so the replies: larger is more urgent. At first by its own class.
    pub fn set_priority(&mut self, priority: u8) {
        self.priority = priority;
    }

    /// Binds to a server anew that was gone and is there again: see [`SendError::NoMailbox`]. Calls to the one before stay open
    /// until they are finished. It asks the broker.
    pub fn rebind(&mut self) -> Result<(), component::Error> {
        // First the old one goes: it takes a place among the server's senders.
        self.server = None;
        self.server = Some(self.mailbox.sender(self.server())?);
        Ok(())
    }

    /// Sends a command, 1 to 127, with a body, and waits for the reply, so long at the most.
    pub fn call(&mut self, command: i8, body: &[u8], timeout: Duration) -> Result<Reply<'_>, CallError> {
        let call = self.begin(command, body)?;
        self.finish(call, timeout)
    }

    /// The same with records: a reply that is not exactly the one that is expected is an error. Nothing is the record `()`.
    pub fn call_typed<C: Record, R: Record>(
        &mut self,
        command: i8,
        body: &C,
        timeout: Duration,
    ) -> Result<R, CallError> {
        let call = self.begin_typed(command, body)?;
        Ok(self.finish(call, timeout)?.record()?)
    }

    /// Sends a command without waiting for its reply. It does not wait at all.
    ///
    /// Other than 1 to 127 is no command, and no server answers it.
    pub fn begin(&mut self, command: i8, body: &[u8]) -> Result<Call, CallError> {
        let Some(server) = &mut self.server else {
            return Err(SendError::NoMailbox(self.calls.server()).into());
        };
        let call = self.calls.begin(monotonic())?;
        let head = Head { kind: command, priority: self.priority, id: call.id(), ..Head::default() };
        match server.send_with(&head, body) {
            Ok(()) => Ok(call),
            Err(error) => {
                self.calls.give_up(&call);
                Err(error.into())
            }
        }
    }

    /// The same with a record.
    pub fn begin_typed<C: Record>(&mut self, command: i8, body: &C) -> Result<Call, CallError> {
        // In our order, as the head says.
        self.begin(command, body.to_wire::<LittleEndian>().as_bytes())
    }

    /// Waits for the reply to a call, so long at the most; replies to others that come meanwhile are kept until they are asked
    /// for. The call is over then, in whatever way.
    pub fn finish(&mut self, call: Call, timeout: Duration) -> Result<Reply<'_>, CallError> {
        let until = later(monotonic(), timeout);
        let told = self.wait(&call, until);
        if told.is_err() {
            self.calls.give_up(&call);
        }
        told?;
        self.calls.reply(call)
    }

    /// Whether the reply to a call has come: it does not wait.
    pub fn is_answered(&mut self, call: &Call) -> Result<bool, CallError> {
        let told = self.look(call, 0)?;
        Ok(told == Next::Answered)
    }

    /// Does not wait for the reply to a call. If it comes nevertheless, it is dropped.
    pub fn give_up(&mut self, call: Call) {
        self.calls.give_up(&call);
    }

    fn wait(&mut self, call: &Call, until: u64) -> Result<(), CallError> {
        loop {
            match self.calls.next(call, until, monotonic())? {
                Next::Answered => return Ok(()),
                Next::Wait(left) => match self.mailbox.receive(Some(left)) {
                    Ok(package) => {
                        let body = package.body();
                        self.calls.on_package(package.head(), monotonic(), |room| body.copy_to(0, room));
                    }
                    Err(ReceiveError::TimedOut | ReceiveError::TooSmall(_)) => {}
                    Err(ReceiveError::Gone) => return Err(CallError::Gone),
                },
                Next::Over => {
                    return match self.look(call, until)? {
                        Next::Answered => Ok(()),
                        _ => Err(CallError::TimedOut(self.server())),
                    };
                }
            }
        }
    }

    /// Takes in what waits in the mailbox, and no more than that: somebody who fills it as fast as it is read delays nobody.
    fn look(&mut self, call: &Call, until: u64) -> Result<Next, CallError> {
        let gone = |_| CallError::Gone;
        for _ in 0..self.mailbox.depth().map_err(gone)? {
            let Some(package) = self.mailbox.try_receive().map_err(gone)? else { break };
            let body = package.body();
            self.calls.on_package(package.head(), monotonic(), |room| body.copy_to(0, room));
        }
        self.calls.next(call, until, monotonic())
    }
}

impl<'a> Reply<'a> {
    /// Its head: of the command's id and priority.
    pub fn head(&self) -> &Head {
        &self.head
    }
    /// What it says: 0, OK, or what the command is answered with, less than -3.
    pub fn kind(&self) -> i8 {
        self.head.kind
    }
    /// Its body.
    pub fn body(&self) -> &'a [u8] {
        self.body
    }
    /// Nanoseconds from when the command was sent to when the reply was seen in the mailbox.
    pub fn took(&self) -> u64 {
        self.took
    }
    /// The record that its body is, whichever order its server writes.
    pub fn record<R: Record>(&self) -> Result<R, BodyError> {
        body::read(self.body, self.head.body_order)
    }
}

#[cfg(test)]
mod tests;
