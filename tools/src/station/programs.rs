//! Sockets of other programs: what they ask goes to the station's thread as visitors do.

use std::any::Any;
use std::collections::VecDeque;
use std::io;

use nix::errno::Errno;
use rtnet::api::door::{Attached, Descriptors, Door, Visit};
use rtnet::api::handshake::{Answer, Ask};
use rtnet::api::{memory, segment};
use rtnet::ip::{Exit, Stack};
use rtnet::live::{Bells, Visitor};

use super::echoes::Echoes;
use super::limits;
use super::sockets::Sockets;

/// Sockets that are closed in one visit: each is a wake-up for who waits at it, after a slot's send.
const CLOSED_AT_ONCE: usize = 8;

/// The control thread's side of all programs.
pub struct Programs {
    door: Door,
    /// What `rtnet ping` asks for.
    pub echoes: Echoes,
    /// What programs have left, the oldest first.
    leaving: VecDeque<Visit>,
    /// Buffers of a socket that does not say how many it wants.
    buffers: u32,
    /// What there is to be told, once: whether it was.
    holes: Option<bool>,
}

/// Visitors that come together.
struct Party(Vec<Visit>);

impl Visitor for Party {
    fn visit(&mut self, stack: &mut Stack, exit: &mut dyn Exit) {
        self.0.iter_mut().for_each(|visit| visit.visit(stack, exit));
    }
}

impl Programs {
    /// None has come yet; sockets have so many buffers unless their programs ask for others. There the station hears who rings.
    pub fn new(buffers: u32, bells: &Bells) -> io::Result<Self> {
        let echoes = Echoes::new(bells)?;
        Ok(Self { door: Door::new(bells.clone()), echoes, leaving: VecDeque::new(), buffers, holes: None })
    }

    /// What a program asks.
    pub fn ask(
        &mut self,
        sockets: &Sockets,
        ask: Ask,
        of: Option<&Attached>,
    ) -> (Answer, Option<(Attached, Descriptors)>) {
        // Whoever comes finds what those who went have left.
        self.close_some(sockets);
        let ask = match ask {
            Ask::OpenUdp(0) => Ask::OpenUdp(self.buffers),
            Ask::OpenPacket(mode, link_type, 0) => Ask::OpenPacket(mode, link_type, self.buffers),
            ask => ask,
        };
        let visit = match self.door.prepare(ask, of) {
            Ok(visit) => visit,
            Err(answer) => return (answer, None),
        };
        let answered = match carry_out(sockets, visit) {
            Ok(visit) => self.door.finish(visit),
            Err(visit) => {
                // What it brought is there for the next.
                visit.into_iter().for_each(|visit| drop(self.door.finish(visit)));
                (Answer::refused(Errno::ENODEV as i32), None)
            }
        };
        if let (_, Some((_, [memory, ..]))) = &answered
            && !memory::is_whole(memory)
        {
            self.holes.get_or_insert(false);
        }
        answered
    }

    /// What should be known of the host, and was not told.
    pub fn news(&mut self) -> Option<String> {
        let was_told = self.holes.as_mut().filter(|was_told| !**was_told)?;
        *was_told = true;
        memory::why_not_whole(segment::bytes()).map(|why| limits::holey_memory(&why))
    }

    /// A program has gone: its socket is closed later, since that waits for the station's thread.
    pub fn leave(&mut self, left: Attached) {
        self.leaving.push_back(self.door.leave(left));
    }

    /// Closes some of the sockets of programs that have gone, in one visit: however many went, whoever serves the others does
    /// not wait longer. Those of a station that is held up stay.
    pub fn close_some(&mut self, sockets: &Sockets) {
        if self.leaving.is_empty() {
            return;
        }
        let some = self.leaving.len().min(CLOSED_AT_ONCE);
        let party = Party(self.leaving.drain(..some).collect());
        match sockets.let_in(Box::new(party)) {
            Ok(party) => {
                let Some(Party(closed)) = known(party) else { return };
                closed.into_iter().for_each(|visit| drop(self.door.finish(visit)));
            }
            Err((_, party)) => {
                let left = party.and_then(known).into_iter().flat_map(|Party(left)| left);
                left.rev().for_each(|visit| self.leaving.push_front(visit));
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

fn known<V: Visitor>(visitor: Box<dyn Visitor>) -> Option<V> {
    let visitor: Box<dyn Any> = visitor;
    visitor.downcast::<V>().ok().map(|visitor| *visitor)
}
