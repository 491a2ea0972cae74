//! A component's side: its mailboxes, and its ways to others'.

use core::time::Duration;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use rtnet::live::clock::{later, monotonic};
use rtnet::live::sealed::Sealed;
use socket2::{Domain, SockAddr, Socket, Type};

use crate::board::{Board, LaneShown};
use crate::handshake::{ANSWER_LEN, Answer, Ask, Lane};
use crate::letters;
use crate::mailbox::{self, Inbox, LaneSender, Layout, MOST_SENDERS, Segment, Shape, Stamps, TooSmall, Word};
use crate::name::MailboxName;
use crate::priority;

use crate::registry::Refused;
use crate::shared::{Room, View, lane_at, lanes_file};
use crate::wait::{self, Waits};
use crate::wire::Head;

/// How long a broker may take to answer.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);
/// How often who waits for ever looks whether there is a broker still.
const STATION_EVERY: u64 = 500_000_000;
/// How long who waits looks for himself before he sleeps: as long as it takes to be woken by another core.
const SPIN: u64 = 20_000;
/// After that was in vain, how often he sleeps at once.
const SPINS_EVERY: u32 = 32;

/// A program that has come to a station's broker.
pub struct Component {
    link: Arc<Link>,
}

struct Link {
    socket: Mutex<Socket>,
    board: Board,
}

/// A mailbox of this component. It is there as long as this is.
pub struct Mailbox {
    link: Arc<Link>,
    name: MailboxName,
    place: usize,
    generation: u64,
    inbox: Inbox<Sealed, View>,
    lanes: Arc<Sealed>,
    /// Of each lane, who has it, as it was last seen.
    attached: Box<[u32]>,
    /// What of the board was seen.
    changes: u64,
    /// Lanes whose senders have gone, and that are not all read.
    leaving: usize,
    waits: Waits,
    patience: Patience,
}

/// A way from a mailbox of this component to another of the station.
pub struct Sender {
    link: Arc<Link>,
    lane: Option<LaneSender<Room, Sealed>>,
    which: Lane,
    generation: u64,
    from: MailboxName,
    to: MailboxName,
    priority: u8,
    id: u8,
}

/// A package that was received, as it lies in its slot.
pub type Package<'a> = mailbox::Package<'a, Sealed, View>;

/// What goes wrong between a component and its station.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The broker does not do it.
    #[error(transparent)]
    Refused(#[from] Refused),
    /// There is no broker, or no memory.
    #[error("the station's broker: {0}")]
    Io(#[from] io::Error),
}

/// Why a package was not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// The mailbox takes none.
    #[error(transparent)]
    Mailbox(#[from] mailbox::SendError),
    /// It is there no more.
    #[error("{0} is there no more: bind to it anew once it is there again")]
    NoMailbox(MailboxName),
}

/// Why nothing was received.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ReceiveError {
    /// Nothing came in time.
    #[error("nothing came in time")]
    TimedOut,
    /// The station has ended, or deleted the mailbox.
    #[error("the mailbox is there no more: its station has ended")]
    Gone,
    /// There is too little room for it.
    #[error(transparent)]
    TooSmall(#[from] TooSmall),
}

impl Component {
    /// Comes to the broker that listens there.
    pub fn attach(path: &Path) -> Result<Self, Error> {
        let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
        socket.connect(&SockAddr::unix(path)?)?;
        socket.set_read_timeout(Some(ANSWER_WITHIN))?;
        let (answer, files) = exchange(&socket, Ask::Attach, &[])?;
        let [board] = files.try_into().map_err(|_| odd(&answer))?;
        Ok(Self { link: Arc::new(Link { socket: Mutex::new(socket), board: Board::open(board)? }) })
    }

    /// A mailbox of this name. All memory that it will ever take is taken now.
    pub fn mailbox(&self, name: MailboxName, shape: Shape) -> Result<Mailbox, Error> {
        shape.check().map_err(Refused::Shape)?;
        // The router has a lane, too.
        let shape_of_lanes = shape.senders(shape.senders + 1);
        let layout = Layout::of(&shape_of_lanes);
        let own = Sealed::new(c"rtnet-mailbox", layout.owner_words(shape_of_lanes.senders))?;
        let lanes = lanes_file(&layout, shape_of_lanes.senders)?;
        let memory = Arc::new(Sealed::open(lanes.try_clone()?, lane_at(&layout, shape_of_lanes.senders))?);
        let (answer, _) =
            self.link.ask(Ask::Create(name, shape), &[&own.as_fd().try_clone_to_owned()?, &lanes])?;
        let Answer::Created { place, generation } = answer else { return Err(odd(&answer).into()) };
        Ok(Mailbox {
            link: self.link.clone(),
            name,
            place,
            generation,
            inbox: Inbox::new(own, &shape_of_lanes),
            lanes: memory,
            attached: vec![0; shape_of_lanes.senders].into_boxed_slice(),
            changes: 0,
            leaving: 0,
            waits: Waits::with_room(MOST_SENDERS + 1),
            patience: Patience::default(),
        })
    }
}

impl Mailbox {
    /// What it is called.
    pub fn name(&self) -> MailboxName {
        self.name
    }

    /// A way from here to another mailbox of the station: what is sent by it is from this one.
    pub fn sender(&self, to: MailboxName) -> Result<Sender, Error> {
        Sender::bind(&self.link, self.name, to)
    }

    /// Waits for the most urgent package, at most so long; `None`: for ever. It stays where it is while it is lent.
    pub fn receive(&mut self, timeout: Option<Duration>) -> Result<Package<'_>, ReceiveError> {
        let until = timeout.map(|timeout| later(monotonic(), timeout));
        let found = loop {
            self.follow()?;
            let now = monotonic();
            if let Some(found) = self.inbox.find(now) {
                break found;
            }
            if until.is_some_and(|until| until <= now) {
                return Err(ReceiveError::TimedOut);
            }
            if !self.spin(until) {
                self.sleep(until)?;
            }
        };
        Ok(self.inbox.lend(found))
    }

    /// The most urgent package, if there is one. For who spins: it asks the kernel for nothing but the time.
    #[inline]
    pub fn try_receive(&mut self) -> Result<Option<Package<'_>>, ReceiveError> {
        self.follow()?;
        Ok(self.inbox.receive(monotonic()))
    }

    /// Waits, and copies the body: the head, and how long the body is. One that is too long stays.
    pub fn receive_into(
        &mut self,
        into: &mut [u8],
        timeout: Option<Duration>,
    ) -> Result<(Head, usize), ReceiveError> {
        let package = self.receive(timeout)?;
        let (head, needed) = (*package.head(), package.body().len());
        if needed > into.len() {
            package.put_back();
            return Err(TooSmall { got: into.len(), needed }.into());
        }
        package.body().copy_to(0, into);
        Ok((head, needed))
    }

    /// Throws away what waits: how many.
    pub fn clean(&mut self) -> Result<usize, ReceiveError> {
        self.follow()?;
        Ok(self.inbox.clean(monotonic()))
    }

    /// How many wait.
    pub fn depth(&mut self) -> Result<usize, ReceiveError> {
        self.follow()?;
        Ok(self.inbox.depth(monotonic()))
    }

    /// Its own memory, where it counts: see [`of_owner`].
    pub fn counted(&self, what: usize) -> u64 {
        Word::get(self.inbox.segment().at(what))
    }

    /// Follows who comes and goes.
    #[inline]
    fn follow(&mut self) -> Result<(), ReceiveError> {
        if self.link.board.changes(self.place).get_acquire() != self.changes {
            self.follow_changes()?;
        }
        if self.leaving > 0 {
            self.let_leave();
        }
        Ok(())
    }

    #[cold]
    fn follow_changes(&mut self) -> Result<(), ReceiveError> {
        let changes = self.link.board.changes(self.place).get_acquire();
        if !self.link.board.has(self.place, self.generation) {
            return Err(ReceiveError::Gone);
        }
        self.changes = changes;
        for lane in 0..self.attached.len() {
            match self.link.board.lane(self.place, lane) {
                LaneShown::Bound { generation, from } => self.let_in(lane, generation, from),
                LaneShown::Left { generation, from } => {
                    // It may have come and gone unseen; nobody else has the lane before it is said that it is read.
                    self.let_in(lane, generation, from);
                    self.leaving += usize::from(self.inbox.leave(lane));
                }
                LaneShown::Free => {}
            }
        }
        Ok(())
    }

    /// Lets in who has a lane now, if that is not known yet.
    fn let_in(&mut self, lane: usize, generation: u32, from: MailboxName) {
        // Who is from nobody is the router, whose lane is not in this file.
        if self.attached[lane] == generation || from == MailboxName::NOBODY {
            return;
        }
        self.attached[lane] = generation;
        let layout = self.inbox.layout();
        let view = View::of(self.lanes.clone(), lane_at(layout, lane), layout.sender_words());
        // It is free: the broker has seen that all was read of who had it before.
        let is_in = view.is_some_and(|view| self.inbox.attach(lane, from, view).is_ok());
        debug_assert!(is_in);
    }

    /// Lanes that are read to their end are others'.
    fn let_leave(&mut self) {
        while let Some((lane, _)) = self.inbox.next_left(monotonic()) {
            self.leaving = self.leaving.saturating_sub(1);
            let drained = self.inbox.layout().drained(lane);
            self.inbox.segment().at(drained).set_release(self.attached[lane].into());
        }
    }

    /// Looks for itself for a while; `false`: that was in vain, or is not worth it.
    fn spin(&mut self, until: Option<u64>) -> bool {
        if !self.patience.has_some() {
            return false;
        }
        let end = until.unwrap_or(u64::MAX).min(monotonic() + SPIN);
        let mut found = false;
        while !found && monotonic() < end {
            core::hint::spin_loop();
            found = self.inbox.has_news();
        }
        self.patience.note(found);
        found
    }

    fn sleep(&mut self, until: Option<u64>) -> Result<(), ReceiveError> {
        let now = monotonic();
        if self.inbox.falls_asleep(now) {
            let board = (self.link.board.changes(self.place), self.changes);
            let no_later = until.unwrap_or(u64::MAX).min(now + STATION_EVERY);
            let over = self.waits.wait([board].into_iter().chain(self.inbox.awaited()), Some(no_later));
            self.inbox.wakes_up();
            if over && self.link.has_hung_up() {
                return Err(ReceiveError::Gone);
            }
        }
        Ok(())
    }
}

impl Drop for Mailbox {
    fn drop(&mut self) {
        // A station that has ended has deleted it.
        let _ = self.link.ask(Ask::Delete(self.name), &[]);
    }
}

impl Sender {
    fn bind(link: &Arc<Link>, from: MailboxName, to: MailboxName) -> Result<Self, Error> {
        let (answer, files) = link.ask(Ask::Bind { from, to }, &[])?;
        let Answer::Reserved { lane: which, generation, shape } = answer else {
            return Err(odd(&answer).into());
        };
        let bound = files.try_into().map_err(|_| odd(&answer)).and_then(|[owner, lanes]: [OwnedFd; 2]| {
            let layout = Layout::of(&shape);
            let theirs = Sealed::open(owner, layout.owner_words(shape.senders + 1))?;
            Ok(LaneSender::new(Room::open(&lanes, &layout, which.lane)?, theirs, layout, which.lane))
        });
        let lane = match bound {
            Ok(lane) => lane,
            Err(error) => {
                let _ = link.ask(Ask::Unbind(which), &[]);
                return Err(error.into());
            }
        };
        let priority = priority::of_class(from.class());
        // From now on it is given back when this is dropped.
        let sender =
            Self { link: link.clone(), lane: Some(lane), which, generation, from, to, priority, id: 0 };
        link.ask(Ask::Ready(which), &[])?;
        Ok(sender)
    }

    /// To which mailbox.
    pub fn to(&self) -> MailboxName {
        self.to
    }

    /// How urgent its packages are, unless they say it: larger is more urgent.
    pub fn set_priority(&mut self, priority: u8) {
        self.priority = priority;
    }

    /// Sends a package. It does not wait, whatever its receiver does. Tells the package's number, which a reply has, too.
    #[inline]
    pub fn send(&mut self, kind: i8, body: &[u8]) -> Result<u8, SendError> {
        self.id = self.id.wrapping_add(1);
        let head = Head { kind, priority: self.priority, id: self.id, ..Head::default() };
        self.send_with(&head, body)?;
        Ok(self.id)
    }

    /// Sends a package with this head, but for whose it is, whom it is for and how long it is.
    #[inline]
    pub fn send_with(&mut self, head: &Head, body: &[u8]) -> Result<(), SendError> {
        if !self.link.board.has(self.which.place, self.generation) {
            return Err(SendError::NoMailbox(self.to));
        }
        let Some(lane) = &mut self.lane else { return Err(SendError::NoMailbox(self.to)) };
        let head = Head { from: self.from, to: self.to, ..*head };
        let stamps = Stamps { sent: monotonic(), left: None, came: None };
        if lane.send(&head, body, &stamps)? {
            wait::wake(lane.published());
        }
        Ok(())
    }

    /// Its own memory, where it counts: see [`mailbox::of_sender`].
    pub fn counted(&self, what: usize) -> u64 {
        self.lane.as_ref().map_or(0, |lane| Word::get(lane.segment().at(what)))
    }
}

impl Drop for Sender {
    fn drop(&mut self) {
        // It is not written any more before another may have it.
        self.lane = None;
        let _ = self.link.ask(Ask::Unbind(self.which), &[]);
    }
}

impl Link {
    fn ask(&self, ask: Ask, files: &[&OwnedFd]) -> Result<(Answer, Vec<OwnedFd>), Error> {
        let socket = self.socket.lock().unwrap_or_else(PoisonError::into_inner);
        let (answer, files) = exchange(&socket, ask, files)?;
        match answer {
            Answer::Refused(refused) => Err(refused.into()),
            Answer::Failed(errno) => Err(io::Error::from_raw_os_error(errno).into()),
            answer => Ok((answer, files)),
        }
    }

    fn has_hung_up(&self) -> bool {
        let socket = self.socket.lock().unwrap_or_else(PoisonError::into_inner);
        let mut fds = [PollFd::new(socket.as_fd(), PollFlags::POLLHUP)];
        poll(&mut fds, PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
    }
}

fn exchange(socket: &Socket, ask: Ask, files: &[&OwnedFd]) -> io::Result<(Answer, Vec<OwnedFd>)> {
    let files: Vec<_> = files.iter().map(AsFd::as_fd).collect();
    letters::send(socket.as_fd(), &ask.to_bytes(), &files)?;
    let mut packet = [0; ANSWER_LEN + 1];
    loop {
        match letters::receive(socket.as_fd(), &mut packet) {
            Err(Errno::EINTR) => {}
            Ok((0, _)) => return Err(io::ErrorKind::ConnectionReset.into()),
            Ok((length, files)) => {
                let answer = Answer::parse(&packet[..length]).ok_or(io::ErrorKind::InvalidData)?;
                return Ok((answer, files));
            }
            Err(errno) => {
                // An answer that came later would be taken for that to the next ask.
                let _ = socket.shutdown(std::net::Shutdown::Both);
                return Err(if errno == Errno::EAGAIN { Errno::ETIMEDOUT } else { errno }.into());
            }
        }
    }
}

fn odd(answer: &Answer) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("it answers what it was not asked: {answer:?}"))
}

/// Whether it is worth looking for oneself: where the sender has another core, and answers soon.
#[derive(Default)]
struct Patience {
    /// Times to sleep at once.
    sleeps: u32,
}

impl Patience {
    fn has_some(&mut self) -> bool {
        self.sleeps = self.sleeps.saturating_sub(1);
        self.sleeps == 0
    }

    fn note(&mut self, found: bool) {
        self.sleeps = if found { 0 } else { SPINS_EVERY };
    }
}
