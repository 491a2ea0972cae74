//! The station's part in packages from elsewhere: a program in its thread, which brings what comes by the LAN into mailboxes.
//! What goes to the LAN does not come by here: components hand it to the stack themselves.
//!
//! ```text
//!   UDP port 8192 ─ peek at the head ─► whose? ─► a slot of the router's lane there ─ receive straight into it ─► wake, after
//!                                         └─ nobody's: counted, and a command is answered                       the slot's send
//! ```

mod way;

use core::net::SocketAddrV4;

use rtnet::discipline::SendError;
use rtnet::room;
use rtnet::socket::{Access, Flags, Options, Program, Received, Sender, SocketError, SocketId};

use crate::mailbox::Segment;
use crate::name::MailboxName;
use crate::priority::{Priorities, level_of};
use crate::registry::MOST_MAILBOXES;
use crate::wire::{ERROR, HEAD_LEN, Head, NOT_AVAILABLE, Part};

use way::{JOIN_TIMEOUT, Outcome};
pub use way::{Wake, Way};

/// Where real-time stations hear packages.
pub const LAN_PORT: u16 = 0x2000;
/// Packages that are taken at a time: a slot may be about to come.
const PACKAGES_AT_ONCE: usize = 8;
/// Bytes that are copied at a time, or one package more.
const WORK_AT_ONCE: usize = 16 * 1024;
/// What a package costs besides its bytes takes as long as copying so many.
const EACH: usize = 256;
/// Takes packages out of a socket of the station's and brings them into mailboxes. `Own` are segments of its lanes, `Theirs` the owners'.
pub struct Router<Own: Segment, Theirs: Segment> {
    socket: Option<SocketId>,
    /// By name. Each in the box that it came in: out of it that would be freed in the station's thread.
    #[allow(clippy::vec_box)]
    ways: Vec<Box<Way<Own, Theirs>>>,
    host: Host,
    /// How many ways have somebody to be woken.
    sleepers: usize,
    /// Packages of which more is to come, and since when the oldest may wait.
    joins: usize,
    oldest: u64,
    counters: RouterCounters,
}

/// What the router needs of the world.
pub struct Host {
    /// The clock of mailboxes, nanoseconds.
    pub clock: fn() -> u64,
    /// Of whom it answers for: in the slot of their packages.
    pub priorities: Priorities,
}

/// What became of what came by the LAN.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RouterCounters {
    /// Packages that were brought into mailboxes.
    pub delivered: u64,
    /// Such as no mailbox here is for.
    pub no_route: u64,
    /// Commands without a mailbox, or too large for it, that were answered: not available, or an error.
    pub answered: u64,
    /// Such that found the mailbox full.
    pub full: u64,
    /// Such that no slot of it takes.
    pub too_large: u64,
    /// Such that said to be from a mailbox of this station.
    pub forged: u64,
    /// Datagrams that are no package, or lie about their length.
    pub malformed: u64,
    /// Parts that fit no package, and packages whose next part was another, or did not come.
    pub incomplete: u64,
    /// Readers that were woken: each cost a system call.
    pub wakes: u64,
}

impl<Own: Segment, Theirs: Segment> Router<Own, Theirs> {
    /// One that knows no mailbox yet.
    pub fn new(host: Host) -> Self {
        let ways = room::vec(MOST_MAILBOXES);
        Self {
            socket: None,
            ways,
            host,
            sleepers: 0,
            joins: 0,
            oldest: 0,
            counters: RouterCounters::default(),
        }
    }

    /// From now on it reads there.
    pub fn reads(&mut self, socket: SocketId) {
        self.socket = Some(socket);
    }

    /// Knows another mailbox. A way comes back where there is no room, or one of that name.
    pub fn add(&mut self, way: Box<Way<Own, Theirs>>) -> Result<(), Box<Way<Own, Theirs>>> {
        match self.place(way.name) {
            Err(place) if self.ways.len() < self.ways.capacity() => self.ways.insert(place, way),
            _ => return Err(way),
        }
        Ok(())
    }

    /// A mailbox is gone. What it had is to be freed where memory may be.
    pub fn remove(&mut self, name: MailboxName) -> Option<Box<Way<Own, Theirs>>> {
        let way = self.place(name).ok().map(|place| self.ways.remove(place))?;
        self.sleepers -= usize::from(way.wakes);
        self.joins -= way.joins();
        Some(way)
    }

    /// What became of what came.
    pub fn counters(&self) -> RouterCounters {
        self.counters
    }

    fn place(&self, name: MailboxName) -> Result<usize, usize> {
        self.ways.binary_search_by_key(&name.0, |way| way.name.0)
    }

    /// The oldest datagram: how many bytes it had.
    fn take_in(&mut self, socket: SocketId, sockets: &mut Access<'_>) -> Option<usize> {
        let mut bytes = [0; HEAD_LEN];
        let received = sockets.receive(socket, &mut bytes, Flags::PEEK).ok()?;
        let head = Head::parse(&bytes[..received.len]).ok().filter(|head| fits(head, received.whole));
        let mut taken = Outcome::Malformed;
        if let Some(head) = head {
            taken = match self.place(head.to) {
                Ok(_) if self.place(head.from).is_ok() => Outcome::Forged,
                Ok(place) => self.bring(place, &head, socket, sockets, &received),
                Err(_) => Outcome::NoRoute,
            };
            let answer = match taken {
                Outcome::NoRoute => Some(NOT_AVAILABLE),
                Outcome::TooLarge => Some(ERROR),
                _ => None,
            };
            if let Some(kind) = answer.filter(|_| head.is_command() && head.begins()) {
                self.answer(kind, &head, socket, sockets, &received);
            }
        }
        if !taken.is_consumed() {
            let _ = sockets.pass_on(socket, |_, _| true);
        }
        self.note(taken, head.map(|head| head.to));
        Some(received.whole)
    }

    /// Into a mailbox.
    fn bring(
        &mut self,
        place: usize,
        head: &Head,
        socket: SocketId,
        sockets: &mut Access<'_>,
        received: &Received,
    ) -> Outcome {
        let now = (self.host.clock)();
        let way = &mut self.ways[place];
        let (before, given_up) = (way.joins(), way.given_up);
        let outcome = way.receive(head, now, socket, sockets, received);
        self.counters.incomplete += way.given_up - given_up;
        if self.joins == 0 {
            self.oldest = now;
        }
        self.joins = self.joins + way.joins() - before;
        outcome
    }

    /// Answers a command that no mailbox here takes, in the slot in which its owner would answer.
    fn answer(
        &mut self,
        kind: i8,
        head: &Head,
        socket: SocketId,
        sockets: &mut Access<'_>,
        received: &Received,
    ) {
        let Sender::Udp(to) = received.from else { return };
        let to = SocketAddrV4::new(*to.ip(), LAN_PORT);
        // The slots of those who are elsewhere may be none of this station's: then it is the first.
        for channel in [self.host.priorities.channel(head.to.class()), 0] {
            let _ =
                sockets.set_options(socket, Options { priority: level_of(head.priority), channel, tos: 0 });
            let sent = sockets.send_to(socket, &head.answer(kind).to_bytes(), to);
            if !sent.is_err_and(has_no_such_slot) {
                self.counters.answered += u64::from(sent.is_ok());
                return;
            }
        }
    }

    fn note(&mut self, taken: Outcome, to: Option<MailboxName>) {
        let counters = &mut self.counters;
        match taken {
            Outcome::Delivered(sleeps) => {
                counters.delivered += 1;
                if sleeps && let Some(Ok(place)) = to.map(|to| self.place(to)) {
                    self.sleepers += usize::from(!core::mem::replace(&mut self.ways[place].wakes, true));
                }
            }
            Outcome::Begun => {}
            Outcome::NoRoute => counters.no_route += 1,
            Outcome::Full => counters.full += 1,
            Outcome::TooLarge => counters.too_large += 1,
            Outcome::Forged => counters.forged += 1,
            Outcome::Malformed => counters.malformed += 1,
            Outcome::Incomplete => counters.incomplete += 1,
        }
    }

    /// Gives up packages of which nothing has come for so long. All are looked through no more often than that.
    fn give_up_old(&mut self) {
        let now = (self.host.clock)();
        if now.saturating_sub(self.oldest) <= JOIN_TIMEOUT {
            return;
        }
        self.oldest = now;
        for way in &mut self.ways {
            let (given_up, oldest) = way.give_up_old(now);
            self.counters.incomplete += given_up as u64;
            self.joins -= given_up;
            self.oldest = self.oldest.min(oldest);
        }
    }
}

fn has_no_such_slot(error: SocketError) -> bool {
    matches!(error, SocketError::Discipline(SendError::NoSlot(_) | SendError::UnknownChannel { .. }))
}

/// A datagram is a package, or a part of it: the first part says how long the whole is.
fn fits(head: &Head, datagram: usize) -> bool {
    match head.part {
        Part::First => head.len as usize > datagram,
        _ => head.len as usize == datagram,
    }
}

impl<Own, Theirs> Program for Router<Own, Theirs>
where
    Own: Segment + Send + 'static,
    Theirs: Segment + Send + 'static,
{
    fn run(&mut self, sockets: &mut Access<'_>) {
        let Some(socket) = self.socket else { return };
        if self.joins > 0 {
            self.give_up_old();
        }
        let mut work = WORK_AT_ONCE;
        for _ in 0..PACKAGES_AT_ONCE {
            let Some(bytes) = self.take_in(socket, sockets) else { return };
            work = work.saturating_sub(EACH + bytes);
            if work == 0 {
                return;
            }
        }
    }

    /// Who sleeps is woken after the slot's send.
    fn rest(&mut self) {
        if self.sleepers == 0 {
            return;
        }
        self.sleepers = 0;
        for way in self.ways.iter_mut().filter(|way| way.wakes) {
            way.wakes = false;
            self.counters.wakes += 1;
            (way.wake)();
        }
    }
}
