//! A component's side: its mailboxes, and its ways to others'.
//!
//! ```no_run
//! use package_router::component::Component;
//! use package_router::mailbox::Shape;
//!
//! // As behind `rtnet -S`; the station was started with `--packages`.
//! let component = Component::named("cell/arm")?;
//! let mut mailbox = component.mailbox("0.0x80.1".parse()?, Shape::new(16, 240))?;
//! let mut camera = mailbox.sender("0.Camera.0".parse()?)?;
//! camera.send(21, b"look")?;
//! let reply = mailbox.receive(None)?;
//! println!("{} says {}", reply.head().from, reply.head().kind);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod away;
mod look;
mod mailbox;
mod sender;
mod times;

use core::time::Duration;
use std::io;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use rtnet::api::{letters, place};
use socket2::{Domain, SockAddr, Socket, Type};

use crate::board::Board;
use crate::handshake::{ANSWER_LEN, Answer, Ask};
use crate::mailbox::Shape;
use crate::name::MailboxName;
use crate::node::Node;
use crate::registry::Refused;
use crate::route::RouteError;
use crate::tcp::client::{TcpOptions, TcpWatch};

pub use look::{MailboxSeen, SenderSeen, Way};
pub use mailbox::{Mailbox, Package, ReceiveError};
pub use sender::{SendError, Sender};
pub use times::Times;

/// How long a broker may take to answer.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);
/// Behind a station's name, instead of its control socket's [`place::SOCKET`].
const SOCKET: &str = "packages";

/// Where the broker of the station with this control socket listens.
pub fn socket_of(control: &Path) -> PathBuf {
    control.with_extension(SOCKET)
}

/// A program that has come to a station's broker.
pub struct Component {
    link: Arc<Link>,
}

struct Link {
    socket: Mutex<Socket>,
    board: Board,
    /// The station's control socket, if it has one.
    station: PathBuf,
    /// Once somebody has asked: the station has a descriptor for each who does.
    times: OnceLock<Times>,
    /// The broker, if it is this process's own. It ends with the last that refers to it.
    node: Option<Node>,
}

/// What goes wrong between a component and its station.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The broker does not do it.
    #[error(transparent)]
    Refused(#[from] Refused),
    /// A route that cannot be, or is not there.
    #[error(transparent)]
    Route(#[from] RouteError),
    /// There is no broker, or no memory.
    #[error("the station's broker: {0}")]
    Io(#[from] io::Error),
}

impl Component {
    /// Comes to the broker that listens there.
    pub fn attach(path: &Path) -> Result<Self, Error> {
        Self::attach_to(path, None)
    }

    /// Comes to a TCP router, on a host without a station: packages for mailboxes that are not this process's go there.
    ///
    /// ```no_run
    /// use package_router::component::Component;
    /// use package_router::tcp::client::TcpOptions;
    ///
    /// let component = Component::of_router(&TcpOptions::new("robot.local:2000".parse()?))?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// It does not wait for the router. Its threads end with it and its last mailbox; packages that were sent before are written, for up to a
    /// second, if there is a connection.
    ///
    /// # Errors
    /// No memory, no room for a file in the directory for temporary ones, or no thread.
    pub fn of_router(options: &TcpOptions) -> Result<Self, Error> {
        let (node, path) = Node::of_process(options)?;
        Self::attach_to(&path, Some(node))
    }

    fn attach_to(path: &Path, node: Option<Node>) -> Result<Self, Error> {
        let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
        socket.connect(&SockAddr::unix(path)?)?;
        socket.set_read_timeout(Some(ANSWER_WITHIN))?;
        let (answer, files) = exchange(&socket, Ask::Attach, &[])?;
        let [board] = files.try_into().map_err(|_| odd(&answer))?;
        let station = path.with_extension(&place::SOCKET[1..]);
        let (board, times) = (Board::open(board)?, OnceLock::new());
        Ok(Self { link: Arc::new(Link { socket: Mutex::new(socket), board, station, times, node }) })
    }

    /// Comes to the broker of a station of this user, by its name as behind `rtnet -S`.
    pub fn named(station: &str) -> Result<Self, Error> {
        Self::attach(&socket_of(&place::socket_of(station)?))
    }

    /// What is known of the station's time: how old packages are. It asks the station the first time, which takes until that has
    /// sent what it is about to, and again as long as there is no answer.
    ///
    /// ```no_run
    /// # let component = package_router::component::Component::named("cell/arm")?;
    /// # let mut mailbox = component.mailbox("0.0x80.1".parse()?, package_router::mailbox::Shape::new(16, 240))?;
    /// let times = component.times();
    /// let package = mailbox.receive(None)?;
    /// if let Some(age) = times.journey(&package).age() {
    ///     println!("what {} says is {age} old", package.head().from);
    /// }
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn times(&self) -> Times {
        let known = &self.link.times;
        if known.get().is_none()
            && let Ok(times) = Times::of(&self.link.station)
        {
            // Another thread's are the same.
            let _ = known.set(times);
        }
        known.get().cloned().unwrap_or_default()
    }

    /// A look at this process's connection to a router, if it was made by [`Self::of_router`].
    pub fn tcp(&self) -> Option<TcpWatch> {
        self.link.node.as_ref().and_then(Node::tcp)
    }

    /// A mailbox of this name. All memory that it will ever take is taken now.
    pub fn mailbox(&self, name: MailboxName, shape: Shape) -> Result<Mailbox, Error> {
        Mailbox::create(&self.link, name, shape)
    }

    /// The mailbox of the TCP client: packages that have no other way wait there. None but the broker's own process has it.
    pub(crate) fn tcp_mailbox(&self, shape: Shape) -> Result<Mailbox, Error> {
        Mailbox::create(&self.link, MailboxName::NOBODY, shape)
    }
}

impl Link {
    fn ask(&self, ask: Ask, files: &[BorrowedFd<'_>]) -> Result<(Answer, Vec<OwnedFd>), Error> {
        let (answer, files) = exchange(&self.socket(), ask, files)?;
        match answer {
            Answer::Refused(refused) => Err(refused.into()),
            Answer::Failed(errno) => Err(io::Error::from_raw_os_error(errno).into()),
            answer => Ok((answer, files)),
        }
    }

    fn socket(&self) -> MutexGuard<'_, Socket> {
        self.socket.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn exchange(socket: &Socket, ask: Ask, files: &[BorrowedFd<'_>]) -> io::Result<(Answer, Vec<OwnedFd>)> {
    letters::send(socket, &ask.to_bytes(), files)?;
    let mut packet = [0; ANSWER_LEN + 1];
    match letters::answer(socket, &mut packet)? {
        (0, _) => Err(io::ErrorKind::ConnectionReset.into()),
        (length, files) => Ok((Answer::parse(&packet[..length]).ok_or(io::ErrorKind::InvalidData)?, files)),
    }
}

/// What came with an answer is not what was to come.
fn short() -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, "what a mailbox lies in is not all there")
}

fn odd(answer: &Answer) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("it answers what it was not asked: {answer:?}"))
}
