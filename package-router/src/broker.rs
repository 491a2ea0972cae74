//! Where components of a station meet: the broker knows names, and hands out files. No package goes through it, and nobody who
//! sends or receives ever waits for it.
//!
//! ```text
//!   component ─ ask, files ─► Broker ─► Registry: may it?
//!             ◄ answer, files ─┘  └───► board: everybody sees what has changed
//! ```

use core::time::Duration;
use std::fs;
use std::io::{self, ErrorKind};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::stat::fstat;
use rtnet::live::sealed::Sealed;
use socket2::{Domain, SockAddr, Socket, Type};

use crate::board::Shown;
use crate::handshake::{ASK_LEN, Answer, Ask, FILES, Lane};
use crate::letters;
use crate::mailbox::{Layout, Segment, Shape, Word, of_owner};
use crate::name::MailboxName;
use crate::registry::{ComponentId, Refused, Registry};
use crate::shared::lane_at;

/// Components at a time.
pub const MOST_COMPONENTS: usize = 256;
/// New ones that are let in before those that are there get their turn.
const ACCEPT_AT_ONCE: usize = 16;
const BACKLOG: i32 = 64;

/// A station's broker; its socket's file goes with it.
pub struct Broker {
    listener: Socket,
    path: PathBuf,
    board: Shown,
    registry: Registry,
    /// Of each place: what comes with its mailbox.
    memories: Vec<Option<Memory>>,
    seats: Vec<Seat>,
    /// Those that have hung up, and whose processes may still write to their lanes.
    lingering: Vec<(ComponentId, OwnedFd)>,
    components: u64,
}

/// A component that is there.
struct Seat {
    id: ComponentId,
    socket: Socket,
    /// Becomes readable when its process has ended; `None`: that cannot be seen from here.
    process: Option<OwnedFd>,
}

/// What a mailbox lies in.
struct Memory {
    owner: Sealed,
    lanes: OwnedFd,
}

impl Broker {
    /// Listens there. A file that is there is taken for that of a broker that is dead: names of stations are locked elsewhere.
    pub fn bind(path: &Path) -> io::Result<Self> {
        match fs::remove_file(path) {
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        let listener = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
        listener.set_nonblocking(true)?;
        listener.bind(&SockAddr::unix(path)?)?;
        listener.listen(BACKLOG)?;
        let registry = Registry::new();
        Ok(Self {
            listener,
            path: path.to_owned(),
            board: Shown::new()?,
            memories: (0..crate::registry::MOST_MAILBOXES).map(|_| None).collect(),
            registry,
            seats: Vec::new(),
            lingering: Vec::new(),
            components: 0,
        })
    }

    /// Waits for asks, at most so long, and answers one of each component.
    pub fn serve(&mut self, at_most: Duration) {
        let ready = self.wait(at_most);
        let mut ready = ready.into_iter();
        let is_ready = |ready: &mut std::vec::IntoIter<bool>| ready.next().unwrap_or(false);
        for seat in std::mem::take(&mut self.seats) {
            if !is_ready(&mut ready) || self.answer(&seat) {
                self.seats.push(seat);
            } else {
                self.left(seat);
            }
        }
        for (id, process) in std::mem::take(&mut self.lingering) {
            if is_ready(&mut ready) {
                self.ended(id);
            } else {
                self.lingering.push((id, process));
            }
        }
        self.admit();
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
        let seats = self.seats.iter().map(|seat| seat.socket.as_fd());
        let fds = seats.chain(self.lingering.iter().map(|(_, process)| process.as_fd()));
        let mut fds: Vec<_> =
            fds.chain([self.listener.as_fd()]).map(|fd| PollFd::new(fd, PollFlags::POLLIN)).collect();
        // Interrupted, or nothing came: nobody is ready.
        let _ = poll(&mut fds, PollTimeout::try_from(at_most).unwrap_or(PollTimeout::MAX));
        fds.iter().map(|fd| fd.revents().is_some_and(|events| !events.is_empty())).collect()
    }

    fn admit(&mut self) {
        for _ in 0..ACCEPT_AT_ONCE {
            let Ok((socket, _)) = self.listener.accept() else { return };
            // One more than there may be is hung up on: that is an answer.
            if self.seats.len() + self.lingering.len() >= MOST_COMPONENTS
                || socket.set_nonblocking(true).is_err()
            {
                continue;
            }
            self.components += 1;
            let process = process_of(&socket);
            self.seats.push(Seat { id: ComponentId(self.components), socket, process });
        }
    }

    /// `false`: it has gone, or has to.
    fn answer(&mut self, seat: &Seat) -> bool {
        let mut packet = [0; ASK_LEN + 1];
        let (length, files) = match letters::receive(seat.socket.as_fd(), &mut packet) {
            Ok((0, _)) => return false,
            Ok(letter) => letter,
            Err(Errno::EAGAIN | Errno::EINTR) => return true,
            Err(_) => return false,
        };
        let (answer, files) = match Ask::parse(&packet[..length]) {
            Some(ask) => self.carry_out(seat.id, ask, files),
            None => (Answer::Failed(libc::EPROTO), Vec::new()),
        };
        let files: Vec<_> = files.iter().map(AsFd::as_fd).collect();
        // Who does not take its answer has to go.
        letters::send(seat.socket.as_fd(), &answer.to_bytes(), &files).is_ok()
    }

    fn carry_out(&mut self, by: ComponentId, ask: Ask, files: Vec<OwnedFd>) -> (Answer, Vec<OwnedFd>) {
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
            Ask::Create(name, shape) => self.create(by, name, shape, files),
            Ask::Delete(name) => match self.registry.delete(by, name) {
                Ok(place) => {
                    self.show(place);
                    Answer::Done
                }
                Err(refused) => Answer::Refused(refused),
            },
            Ask::Ready(Lane { place, lane }) => {
                self.changed(place, |registry| registry.ready(by, place, lane))
            }
            Ask::Unbind(Lane { place, lane }) => {
                self.changed(place, |registry| registry.unbind(by, place, lane))
            }
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

    fn create(&mut self, by: ComponentId, name: MailboxName, shape: Shape, files: Vec<OwnedFd>) -> Answer {
        let place = match self.registry.create(by, name, shape) {
            Ok(place) => place,
            Err(refused) => return Answer::Refused(refused),
        };
        match memory(&shape, files) {
            Ok(memory) => {
                self.memories[place] = Some(memory);
                self.show(place);
                let generation = self.registry.get(place).map_or(0, |mailbox| mailbox.generation);
                Answer::Created { place, generation }
            }
            Err(error) => {
                // It was never shown.
                let _ = self.registry.delete(by, name);
                failed(&error)
            }
        }
    }

    fn bind_lane(
        &mut self,
        by: ComponentId,
        from: MailboxName,
        to: MailboxName,
    ) -> Result<(Answer, Vec<OwnedFd>), Answer> {
        let memory = self.registry.find(to).and_then(|place| self.memories[place].as_ref());
        let layout =
            self.registry.find(to).and_then(|place| self.registry.get(place)).map(|m| Layout::of(&m.shape));
        let (Some(memory), Some(layout)) = (memory, layout) else {
            return Err(Answer::Refused(Refused::NoMailbox(to)));
        };
        let drained =
            |lane, generation| memory.owner.at(layout.drained(lane)).get_acquire() == u64::from(generation);
        let (place, lane) = self.registry.bind(by, from, to, drained).map_err(Answer::Refused)?;
        let clones = || Ok(vec![memory.owner.as_fd().try_clone_to_owned()?, memory.lanes.try_clone()?]);
        let files = clones().map_err(|error: io::Error| failed(&error));
        if files.is_err() {
            self.registry.unbind(by, place, lane);
        }
        let Some(mailbox) = self.registry.get(place) else { return Err(Answer::Failed(libc::EINVAL)) };
        let reserved = Answer::Reserved {
            lane: Lane { place, lane },
            generation: mailbox.generation,
            shape: mailbox.shape,
        };
        Ok((reserved, files?))
    }

    /// A component has hung up.
    fn left(&mut self, seat: Seat) {
        self.registry.left(seat.id).into_iter().for_each(|place| self.show(place));
        match seat.process {
            Some(process) if self.registry.has_lanes(seat.id) && !has_ended(process.as_fd()) => {
                self.lingering.push((seat.id, process));
            }
            _ => self.ended(seat.id),
        }
    }

    fn ended(&mut self, id: ComponentId) {
        self.registry.ended(id).into_iter().for_each(|place| self.show(place));
    }

    fn show(&mut self, place: usize) {
        let mailbox = self.registry.get(place);
        if mailbox.is_none() {
            self.memories[place] = None;
        }
        self.board.show(place, mailbox);
    }

    /// What a mailbox has counted, as its owner shows it.
    pub fn counted(&self, place: usize) -> Option<Vec<u64>> {
        let memory = self.memories.get(place)?.as_ref()?;
        Some(
            (of_owner::RECEIVED..of_owner::LATENCIES)
                .map(|place| Word::get(memory.owner.at(place)))
                .collect(),
        )
    }
}

impl Drop for Broker {
    /// Nobody waits for what will not come.
    fn drop(&mut self) {
        let places: Vec<_> = self.registry.all().map(|(place, _)| place).collect();
        places.into_iter().for_each(|place| self.board.show(place, None));
        let _ = fs::remove_file(&self.path);
    }
}

/// What an owner has brought for its mailbox.
fn memory(shape: &Shape, files: Vec<OwnedFd>) -> io::Result<Memory> {
    let odd = |why| io::Error::new(ErrorKind::InvalidInput, why);
    let [owner, lanes]: [OwnedFd; FILES] =
        files.try_into().map_err(|_| odd("two files come with a mailbox"))?;
    let layout = Layout::of(shape);
    let owner = Sealed::open(owner, layout.owner_words(shape.senders + 1))?;
    let bytes = (lane_at(&layout, shape.senders + 1) * size_of::<u64>()) as i64;
    if fstat(&lanes)?.st_size < bytes {
        return Err(odd("the lanes of a mailbox are all there"));
    }
    Ok(Memory { owner, lanes })
}

fn failed(error: &io::Error) -> Answer {
    Answer::Failed(error.raw_os_error().unwrap_or(libc::EINVAL))
}

/// The process at the other end, as something that becomes readable when it ends.
#[allow(unsafe_code)]
fn process_of(socket: &Socket) -> Option<OwnedFd> {
    use std::os::fd::FromRawFd;
    let credentials =
        nix::sys::socket::getsockopt(socket, nix::sys::socket::sockopt::PeerCredentials).ok()?;
    // SAFETY: it takes numbers, and gives a descriptor of its own or -1.
    let process = Errno::result(unsafe { libc::syscall(libc::SYS_pidfd_open, credentials.pid(), 0) }).ok()?;
    // SAFETY: it was just made, and is nobody else's.
    Some(unsafe { OwnedFd::from_raw_fd(process as i32) })
}

fn has_ended(process: BorrowedFd<'_>) -> bool {
    poll(&mut [PollFd::new(process, PollFlags::POLLIN)], PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
}
