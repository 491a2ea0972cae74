//! Sockets of other programs: what they ask goes to the station's thread as visitors do.

use std::any::Any;
use std::io;
use std::sync::Arc;

use nix::errno::Errno;
use nix::sys::epoll::Epoll;
use rtnet::api::door::{Attached, Descriptors, Door, Visit};
use rtnet::api::handshake::{Answer, Ask};
use rtnet::live::Visitor;

use super::sockets::Sockets;

/// The control thread's side of all programs.
pub struct Programs {
    door: Door,
    /// What programs have left whose sockets could not be closed yet.
    leaving: Vec<Visit>,
}

impl Programs {
    /// None has come yet.
    pub fn new() -> io::Result<Self> {
        Ok(Self { door: Door::new()?, leaving: Vec::new() })
    }

    /// What they ring when the station sleeps.
    pub fn doorbells(&self) -> Arc<Epoll> {
        self.door.doorbells()
    }

    /// What a program asks.
    pub fn ask(
        &mut self,
        sockets: &Sockets,
        ask: Ask,
        of: Option<&Attached>,
    ) -> (Answer, Option<(Attached, Descriptors)>) {
        // Whoever comes finds what those who went have left.
        self.close_what_is_left(sockets);
        let visit = match self.door.prepare(ask, of) {
            Ok(visit) => visit,
            Err(answer) => return (answer, None),
        };
        match carry_out(sockets, visit) {
            Ok(visit) => self.door.finish(visit),
            Err(visit) => {
                // What it brought is there for the next.
                visit.into_iter().for_each(|visit| drop(self.door.finish(visit)));
                (Answer::refused(Errno::ENODEV as i32), None)
            }
        }
    }

    /// A program has gone.
    pub fn leave(&mut self, sockets: &Sockets, left: Attached) {
        let visit = self.door.leave(left);
        self.leaving.push(visit);
        self.close_what_is_left(sockets);
    }

    /// Closes the sockets of programs that have gone; those of a station that is held up, later.
    pub fn close_what_is_left(&mut self, sockets: &Sockets) {
        while let Some(visit) = self.leaving.pop() {
            match carry_out(sockets, visit) {
                Ok(visit) => drop(self.door.finish(visit)),
                Err(visit) => return self.leaving.extend(visit),
            }
        }
    }
}

/// The visit as it has come back, or, as it was, if it was not let in.
fn carry_out(sockets: &Sockets, visit: Visit) -> Result<Visit, Option<Visit>> {
    match sockets.let_in(Box::new(visit)) {
        Ok(visitor) => known(visitor).ok_or(None),
        Err((_, visitor)) => Err(visitor.and_then(known)),
    }
}

fn known(visitor: Box<dyn Visitor>) -> Option<Visit> {
    let visitor: Box<dyn Any> = visitor;
    visitor.downcast::<Visit>().ok().map(|visit| *visit)
}
