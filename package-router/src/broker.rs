//! Where components of a station meet: the broker knows names, and hands out files. No package goes through it, and nobody who
//! sends or receives ever waits for it.
//!
//! ```text
//!   component ─ ask, files ─► Broker ─► Registry: may it?
//!             ◄ answer, files ─┘  └───► board: everybody sees what has changed
//! ```

mod memory;
mod process;

use core::time::Duration;
use std::io::{self, ErrorKind};
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use rtnet::api::letters;
use rtnet::api::listener::Listener;
use socket2::Socket;

use memory::Memory;
use process::{has_ended, process_of};

use crate::bells::Bell;
use crate::board::Shown;
use crate::handshake::{ASK_LEN, Answer, Ask};
use crate::mailbox::{Layout, Segment, Shape, Word};
use crate::name::MailboxName;
use crate::priority::Priorities;
use crate::registry::{ComponentId, Refused, Registered, Registry};
use crate::route::{RouteError, Routes};

/// Components at a time.
pub const MOST_COMPONENTS: usize = 256;
/// New ones that are let in before those that are there get their turn.
const ACCEPT_AT_ONCE: usize = 16;
const BACKLOG: i32 = 64;

/// A station's broker; its socket's file goes with it.
pub struct Broker {
    listener: Listener,
    /// Whether somebody waits who could not be let in: to be told of that again and again would keep it from waiting.
    is_full: bool,
    board: Shown,
    registry: Registry,
    /// Of each place: what comes with its mailbox.
    memories: Vec<Option<Memory>>,
    seats: Vec<Seat>,
    /// Those that have hung up, and whose processes may still write to their lanes.
    lingering: Vec<Lingering>,
    components: u64,
    priorities: Priorities,
    beyond: Option<Box<dyn Beyond>>,
    /// Whether a TCP client of this process may have the mailbox of name 0.
    has_tcp: bool,
    /// Whether all are served: not before a TCP client that is to come has its mailbox. Until then there would be no way to it.
    is_open: bool,
}

/// What is beyond a station's own mailboxes.
pub trait Beyond: Send {
    /// A mailbox is there, of that owner, who is woken by that bell: what of it comes from beyond lies in the file that this gives.
    fn created(
        &mut self,
        name: MailboxName,
        layout: &Layout,
        owner: OwnedFd,
        bell: Bell,
    ) -> io::Result<OwnedFd>;
    /// It is there no more: nobody waits until that is known beyond.
    fn deleted(&mut self, name: MailboxName);
    /// Sees to what was not waited for.
    fn tend(&mut self);
    /// Which station has which mailboxes.
    fn routes(&mut self) -> &mut Routes;
}

/// A component that is there.
struct Seat {
    id: ComponentId,
    socket: Socket,
    /// Its process, and what becomes readable when that has ended, as far as it can be seen from here.
    pid: u32,
    process: Option<OwnedFd>,
}

/// One that has hung up, and whose process may still write to its lanes.
struct Lingering {
    id: ComponentId,
    pid: u32,
    process: OwnedFd,
}

impl Broker {
    /// Listens there. A file that is there is taken for that of a broker that is dead: names of stations are locked elsewhere.
    pub fn bind(path: &Path) -> io::Result<Self> {
        Ok(Self {
            listener: Listener::bind(path, BACKLOG)?,
            is_full: false,
            board: Shown::new()?,
            memories: (0..crate::registry::MOST_MAILBOXES).map(|_| None).collect(),
            registry: Registry::new(),
            seats: Vec::new(),
            lingering: Vec::new(),
            components: 0,
            priorities: Priorities::default(),
            beyond: None,
            has_tcp: false,
            is_open: true,
        })
    }

    /// The same for a system whose packages are as urgent as that.
    pub fn with_priorities(mut self, priorities: Priorities) -> Self {
        self.priorities = priorities;
        self
    }

    /// The same with a way to and from elsewhere.
    pub fn with_beyond(mut self, beyond: Box<dyn Beyond>) -> Self {
        self.beyond = Some(beyond);
        self
    }

    /// The same with a way to a TCP router, by a client in this process.
    pub fn with_tcp(mut self) -> Self {
        (self.has_tcp, self.is_open) = (true, false);
        self
    }

    /// Waits for asks, at most so long, and answers one of each component.
    pub fn serve(&mut self, at_most: Duration) {
        let ready = self.wait(at_most);
        let (seats, lingering) = (std::mem::take(&mut self.seats), std::mem::take(&mut self.lingering));
        let (of_seats, of_lingering) = ready.split_at(seats.len());
        // Who comes in place of one that has ended finds its names free.
        for (gone, has_ended) in lingering.into_iter().zip(of_lingering) {
            // One whose lanes went with their mailboxes writes nowhere any more.
            if *has_ended || !self.registry.has_lanes(gone.id) {
                self.ended(gone.id);
            } else {
                self.lingering.push(gone);
            }
        }
        for (seat, is_ready) in seats.into_iter().zip(of_seats) {
            if !is_ready || self.is_held(&seat) || self.answer(&seat) {
                self.seats.push(seat);
            } else {
                self.left(seat);
            }
        }
        self.admit();
        self.beyond.iter_mut().for_each(|beyond| beyond.tend());
    }

    /// Which mailboxes there are.
    pub fn registry(&self) -> &Registry {
        &self.registry
    }

    /// How many components are there.
    pub fn components(&self) -> usize {
        self.seats.len()
    }

    fn wait(&self, at_most: Duration) -> Vec<bool> {
        let asks = |seat| if self.is_held(seat) { PollFlags::empty() } else { PollFlags::POLLIN };
        let seats = self.seats.iter().map(|seat| PollFd::new(seat.socket.as_fd(), asks(seat)));
        let others = self.lingering.iter().map(|gone| gone.process.as_fd());
        let others = others.chain((!self.is_full).then_some(self.listener.as_fd()));
        let mut fds: Vec<_> = seats.chain(others.map(|fd| PollFd::new(fd, PollFlags::POLLIN))).collect();
        // Interrupted, or nothing came: nobody is ready.
        let _ = poll(&mut fds, PollTimeout::try_from(at_most).unwrap_or(PollTimeout::MAX));
        fds.iter().map(|fd| fd.revents().is_some_and(|events| !events.is_empty())).collect()
    }

    /// Whether a component waits until the TCP client of this process is there.
    fn is_held(&self, seat: &Seat) -> bool {
        !self.is_open && seat.pid != std::process::id()
    }

    fn admit(&mut self) {
        self.is_full = false;
        for _ in 0..ACCEPT_AT_ONCE {
            let socket = match self.listener.accept() {
                Ok(Some(socket)) => socket,
                Ok(None) => return,
                Err(_) => {
                    self.is_full = true;
                    return;
                }
            };
            // One more than there may be is hung up on: that is an answer.
            if self.seats.len() + self.lingering.len() >= MOST_COMPONENTS {
                continue;
            }
            self.components += 1;
            let (pid, process) = process_of(&socket);
            self.seats.push(Seat { id: ComponentId(self.components), socket, pid, process });
        }
    }

    /// `false`: it has gone, or has to.
    fn answer(&mut self, seat: &Seat) -> bool {
        let mut packet = [0; ASK_LEN + 1];
        let (length, files) = match letters::receive(&seat.socket, &mut packet) {
            Ok((0, _)) => return false,
            Ok(letter) => letter,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {
                return true;
            }
            Err(_) => return false,
        };
        let (answer, files) = match Ask::parse(&packet[..length]) {
            Some(ask) => self.carry_out(seat, ask, files),
            None => (Answer::Failed(libc::EPROTO), Vec::new()),
        };
        let files: Vec<_> = files.iter().map(AsFd::as_fd).collect();
        // Who does not take its answer has to go.
        letters::send(&seat.socket, &answer.to_bytes(), &files).is_ok()
    }

    fn carry_out(&mut self, seat: &Seat, ask: Ask, files: Vec<OwnedFd>) -> (Answer, Vec<OwnedFd>) {
        let by = seat.id;
        let nothing = Vec::new;
        let done = match ask {
            Ask::Attach => match self.board.as_fd().try_clone_to_owned() {
                Ok(board) => return (Answer::Done, vec![board]),
                Err(error) => return (failed(&error), nothing()),
            },
            Ask::Bind { from, to } => match self.bind_lane(by, from, to) {
                Ok((answer, files)) => return (answer, files),
                Err(refused) => refused,
            },
            Ask::Create(name, shape) => return self.create(seat, name, shape, files),
            Ask::Look(place) => return self.look(place).unwrap_or((Answer::NoMore, Vec::new())),
            Ask::Way(to) => self.way(to),
            Ask::RouteAt(_) | Ask::AddRoute(..) | Ask::DeleteRoute(_) => self.routed(ask),
            Ask::Delete(name) => match self.registry.delete(by, name) {
                Ok(place) => {
                    self.gone(place);
                    Answer::Done
                }
                Err(refused) => Answer::Refused(refused),
            },
            Ask::Ready(lane) => self.changed(lane.place, |registry| registry.ready(by, lane)),
            Ask::Unbind(lane) => self.changed(lane.place, |registry| registry.unbind(by, lane)),
        };
        (done, nothing())
    }

    fn changed(&mut self, place: usize, change: impl FnOnce(&mut Registry) -> bool) -> Answer {
        if !change(&mut self.registry) {
            return Answer::Failed(libc::EINVAL);
        }
        self.show(place);
        Answer::Done
    }

    fn create(
        &mut self,
        by: &Seat,
        name: MailboxName,
        shape: Shape,
        files: Vec<OwnedFd>,
    ) -> (Answer, Vec<OwnedFd>) {
        // A process that has come again may have its own names again.
        let is_former = |id| self.lingering.iter().any(|gone| gone.id == id && gone.pid == by.pid);
        let is_tcp = self.has_tcp && name == MailboxName::NOBODY && by.pid == std::process::id();
        let created = match is_tcp {
            true => self.registry.create_tcp(by.id, shape),
            false => self.registry.create_beside(by.id, is_former, name, shape),
        };
        let place = match created {
            Ok(place) => place,
            Err(refused) => return (Answer::Refused(refused), Vec::new()),
        };
        let made = Memory::new(name, &shape, by.pid, files).and_then(|memory| {
            let Some(beyond) = self.beyond.as_mut().filter(|_| !is_tcp) else { return Ok((memory, None)) };
            let owner = memory.owner.as_fd().try_clone_to_owned()?;
            let file = beyond.created(name, &memory.layout, owner, memory.bells.hang()?)?;
            Ok((memory, Some(file)))
        });
        match made {
            Ok((memory, of_router)) => {
                self.memories[place] = Some(memory);
                self.is_open |= is_tcp;
                self.show(place);
                self.board.moved();
                self.tell_tcp();
                let generation = self.registry.get(place).map_or(0, |mailbox| mailbox.generation);
                (Answer::Created { place, generation }, of_router.into_iter().collect())
            }
            Err(error) => {
                // It was never shown.
                let _ = self.registry.delete(by.id, name);
                (failed(&error), Vec::new())
            }
        }
    }

    fn bind_lane(
        &mut self,
        by: ComponentId,
        from: MailboxName,
        to: MailboxName,
    ) -> Result<(Answer, Vec<OwnedFd>), Answer> {
        let priority = self.priorities.package(from.class());
        self.registry.check_own(by, from).map_err(Answer::Refused)?;
        let (to, is_tcp) = match self.way(to) {
            Answer::Mailbox { .. } => (to, false),
            Answer::Route(_, station) if from != MailboxName::NOBODY => {
                let channel = self.priorities.channel(from.class());
                return Ok((Answer::Away { station, priority, channel }, Vec::new()));
            }
            Answer::ByTcp { .. } if from != MailboxName::NOBODY => (MailboxName::NOBODY, true),
            _ => return Err(Answer::Refused(Refused::NoMailbox(to))),
        };
        let memory = self.registry.find(to).and_then(|place| self.memories[place].as_ref());
        let memory = memory.ok_or(Answer::Refused(Refused::NoMailbox(to)))?;
        let drained = |at, generation| {
            memory.owner.at(memory.layout.drained(at)).get_acquire() == u64::from(generation)
        };
        let lane = self.registry.bind(by, from, to, drained).map_err(Answer::Refused)?;
        let files = memory.for_a_sender().map_err(|error| failed(&error));
        if files.is_err() {
            self.registry.unbind(by, lane);
        }
        let Some(mailbox) = self.registry.get(lane.place) else { return Err(Answer::Failed(libc::EINVAL)) };
        Ok((Answer::Reserved { lane, shape: mailbox.shape, priority, is_tcp }, files?))
    }

    /// The way of packages for a mailbox: that mailbox here, else the station to which a route leads, else the TCP router.
    fn way(&mut self, to: MailboxName) -> Answer {
        let nowhere = Answer::Refused(Refused::NoMailbox(to));
        if to == MailboxName::NOBODY {
            return nowhere;
        }
        let here = self.registry.find(to).and_then(|place| {
            let memory = self.memories[place].as_ref()?;
            Some(seen(place, self.registry.get(place)?, memory))
        });
        if let Some(mailbox) = here {
            return mailbox;
        }
        let mut is_of_other_system = false;
        if let Some(routes) = self.beyond.as_mut().map(|beyond| beyond.routes()) {
            if let Some(route) = routes.of(to) {
                return Answer::Route(route.to, route.station);
            }
            is_of_other_system = routes.is_of_other_system(to);
        }
        self.registry.find(MailboxName::NOBODY).map_or(nowhere, |_| Answer::ByTcp { is_of_other_system })
    }

    /// A component has hung up.
    fn left(&mut self, seat: Seat) {
        self.registry.left(seat.id).into_iter().for_each(|place| self.gone(place));
        match seat.process {
            Some(process) if self.registry.has_lanes(seat.id) && !has_ended(process.as_fd()) => {
                self.lingering.push(Lingering { id: seat.id, pid: seat.pid, process });
            }
            _ => self.ended(seat.id),
        }
    }

    fn ended(&mut self, id: ComponentId) {
        self.registry.ended(id).into_iter().for_each(|place| self.show(place));
    }

    /// The first mailbox from there on, with its memory to be read.
    fn look(&self, from: usize) -> Option<(Answer, Vec<OwnedFd>)> {
        let (place, mailbox) = self.registry.all().find(|(place, _)| *place >= from)?;
        let memory = self.memories[place].as_ref()?;
        let files = [memory.owner.as_fd().try_clone_to_owned().ok()?, memory.lanes.try_clone().ok()?];
        Some((seen(place, mailbox, memory), files.into()))
    }

    fn routed(&mut self, ask: Ask) -> Answer {
        let Some(beyond) = &mut self.beyond else { return Answer::Failed(libc::EOPNOTSUPP) };
        let done = match ask {
            Ask::RouteAt(n) => {
                let route = beyond.routes().iter().nth(n);
                return route.map_or(Answer::NoMore, |route| Answer::Route(route.to, route.station));
            }
            Ask::AddRoute(to, station) => beyond.routes().add(to, station).map(drop),
            Ask::DeleteRoute(to) => beyond.routes().remove(to).map(drop),
            _ => return Answer::Failed(libc::EINVAL),
        };
        match done {
            Ok(()) => {
                self.board.moved();
                Answer::Done
            }
            Err(RouteError::Full) => Answer::Failed(libc::ENOSPC),
            Err(RouteError::NotAStation(..)) => Answer::Failed(libc::EADDRNOTAVAIL),
            Err(RouteError::OtherSystem(_)) => Answer::Failed(libc::EXDEV),
            Err(RouteError::Unknown(_)) => Answer::Failed(libc::ENOENT),
        }
    }

    /// Everybody sees what has changed, and the owner wakes up for it.
    fn show(&self, place: usize) {
        self.board.show(place, self.registry.get(place));
        self.memories[place].iter().for_each(|memory| memory.bell.ring());
    }

    /// A mailbox is there no more.
    fn gone(&mut self, place: usize) {
        self.show(place);
        let memory = self.memories[place].take();
        if let (Some(memory), Some(beyond)) = (memory, &mut self.beyond) {
            beyond.deleted(memory.name);
        }
        self.tell_tcp();
    }

    /// The TCP client looks which mailboxes there are.
    fn tell_tcp(&self) {
        self.board.came_or_went();
        let memory = self.registry.find(MailboxName::NOBODY).and_then(|place| self.memories[place].as_ref());
        memory.iter().for_each(|memory| memory.bell.ring());
    }
}

impl Drop for Broker {
    /// Nobody sends to what is there no more; who waits hears that its connection is over.
    fn drop(&mut self) {
        let places: Vec<_> = self.registry.all().map(|(place, _)| place).collect();
        places.into_iter().for_each(|place| self.board.show(place, None));
    }
}

fn seen(place: usize, mailbox: &Registered, memory: &Memory) -> Answer {
    Answer::Mailbox { place, name: mailbox.name, shape: mailbox.shape, process: memory.process }
}

fn failed(error: &io::Error) -> Answer {
    Answer::Failed(error.raw_os_error().unwrap_or(libc::EINVAL))
}
