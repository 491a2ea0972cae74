//! The TCP client: a thread between a broker and a TCP router.
//!
//! ```text
//! components ─► the mailbox of nobody's name ─► session ─► the router      packages that have no other way
//! components' mailboxes ◄─ the lane of each ◄── session ◄─ the router
//! ```
//!
//! It is a component of its broker. Its mailbox is its queue: bounded, the most urgent package first. A sender that finds it full is
//! refused at once, as by any mailbox; its commands are answered NOT_AVAILABLE. It connects again by itself.

mod local;
pub mod session;

use std::io::{self, Read, Write};
use std::os::fd::{AsFd, AsRawFd};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use mio::unix::SourceFd;
use mio::{Events, Interest, Poll, Token, Waker};
use rtnet::live::clock::monotonic;

use super::address::Address;
use super::dial::{Dial, Opened};
use super::keys::ClientKeys;
use super::stream::Stream;
use crate::component::{Component, Error};
use crate::mailbox::{LARGEST_BODY, Layout, MOST_BYTES, MOST_SENDERS, Shape};

use local::Local;
pub use local::LocalCounters;
use session::{Session, SessionCounters, Written};

/// Stack of the thread.
const STACK: usize = 256 << 10;
/// Packages of each sender that may wait for the router.
const SLOTS: usize = 8;
/// Bytes of the largest body that goes to the router, by default.
pub const BODY: usize = 4_096;
/// Bytes of one read.
const READ: usize = 64 << 10;
/// Milliseconds that it goes on at its end while packages wait to be written; and how often it looks.
const END_WITHIN: u64 = 1_000;
const END_EVERY: Duration = Duration::from_millis(10);
/// Milliseconds after which it looks again how many packages wait and were refused, while some wait.
const SHOWN_EVERY: u64 = 100;
const WAKER: Token = Token(0);
const MAILBOX: Token = Token(1);
const STREAM: Token = Token(2);

/// The router of a TCP client, and the way there.
#[derive(Clone, Debug)]
pub struct TcpOptions {
    /// The router.
    pub router: Address,
    /// Bytes of the largest body that goes there, up to 262128: memory is reserved for it.
    pub largest_body: usize,
    /// Keys, for a router that is reached by TLS.
    pub keys: Option<ClientKeys>,
}

impl TcpOptions {
    /// In the clear, for bodies of up to 4096 bytes.
    pub fn new(router: Address) -> Self {
        Self { router, largest_body: BODY, keys: None }
    }

    /// The mailbox in which packages wait: of as many senders as there may be, and as its memory takes.
    fn shape(&self) -> Shape {
        let largest_body = self.largest_body.min(LARGEST_BODY);
        let shape = Shape::new(SLOTS, largest_body).senders(1).answering();
        let each = Layout::of(&shape).sender_words() * size_of::<u64>();
        shape.senders((MOST_BYTES / each).clamp(1, MOST_SENDERS))
    }
}

/// A running client. Its thread ends with it.
pub struct TcpClient {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// A look at a client, from any thread.
#[derive(Clone)]
pub struct TcpWatch(Arc<Shared>);

/// The state of a client.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TcpStatus {
    /// Whether it has a connection.
    pub is_connected: bool,
    /// Connections that it has opened.
    pub connections: u64,
    /// The end of the last connection, or the failure of the last attempt.
    pub last_error: Option<String>,
    /// Mailboxes that are registered.
    pub names: usize,
    /// Mailboxes that are not, or not yet.
    pub names_waiting: usize,
    /// Counters of the connections.
    pub session: SessionCounters,
    /// Counters of the mailboxes here.
    pub local: LocalCounters,
}

struct Shared {
    router: Address,
    stop: AtomicBool,
    waker: Waker,
    status: Mutex<TcpStatus>,
}

impl TcpClient {
    /// Starts the client of the broker that listens there.
    pub fn start(broker: &Path, options: &TcpOptions) -> Result<Self, Error> {
        let component = Component::attach(broker)?;
        let mailbox = component.tcp_mailbox(options.shape())?;
        let poll = Poll::new()?;
        let waker = Waker::new(poll.registry(), WAKER)?;
        let bells = mailbox.as_fd().as_raw_fd();
        poll.registry().register(&mut SourceFd(&bells), MAILBOX, Interest::READABLE)?;
        let (router, stop) = (options.router.clone(), AtomicBool::new(false));
        let shared = Arc::new(Shared { router, stop, waker, status: Mutex::default() });
        let worker = Worker {
            poll,
            shared: shared.clone(),
            dial: Dial::new(options.router.clone(), options.keys.clone()),
            session: Session::default(),
            local: Local::new(component, mailbox),
            up: None,
            connections: 0,
            last_error: None,
            look_at: 0,
        };
        let thread =
            Builder::new().name("packages-tcp".into()).stack_size(STACK).spawn(move || worker.run())?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// A look at it, for as long as that is wanted.
    pub fn watch(&self) -> TcpWatch {
        TcpWatch(self.shared.clone())
    }
}

impl TcpWatch {
    /// The router that it connects to.
    pub fn router(&self) -> &Address {
        &self.0.router
    }

    /// Its state now.
    pub fn status(&self) -> TcpStatus {
        self.0.status().clone()
    }
}

impl Drop for TcpClient {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        // Without it the thread ends at its next event: the router asks for a sign of life.
        let _ = self.shared.waker.wake();
        self.thread.take().into_iter().for_each(|thread| drop(thread.join()));
    }
}

impl Shared {
    fn status(&self) -> MutexGuard<'_, TcpStatus> {
        self.status.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The thread.
struct Worker {
    poll: Poll,
    shared: Arc<Shared>,
    dial: Dial,
    up: Option<Up>,
    session: Session,
    local: Local,
    connections: u64,
    last_error: Option<String>,
    /// When it looks again at its mailbox.
    look_at: u64,
}

/// The connection to the router.
struct Up {
    stream: Stream,
    /// More may be there to be read, and room to write.
    is_readable: bool,
    is_writable: bool,
    /// A call has written as much as it may, and more is there.
    has_more: bool,
}

impl Worker {
    fn run(mut self) {
        let mut events = Events::with_capacity(8);
        let mut room = vec![0; READ];
        let mut stop_at = None;
        // An error says that the broker has ended, and with it this.
        while let Ok(is_empty) = self.local.prepare_wait() {
            if self.is_over(is_empty, &mut stop_at) {
                break;
            }
            if is_empty || now() >= self.look_at {
                self.local.look();
                self.look_at = now() + SHOWN_EVERY;
            }
            self.publish();
            let patience = self.patience(is_empty).min(stop_at.map_or(Duration::MAX, |_| END_EVERY));
            // Interrupted, or too late: there is nothing new.
            let _ = self.poll.poll(&mut events, Some(patience));
            if self.local.end_wait().is_err() {
                break;
            }
            self.note(&events);
            if let Some(names) = self.local.follow() {
                self.session.set_names(&names);
            }
            self.open();
            if let Err(error) = self.exchange(&mut room) {
                self.down(&error);
            }
            if self.dial.is_down() {
                self.local.refuse_all();
            }
        }
        self.down(&io::Error::other("the TCP client has ended"));
        self.publish();
    }

    /// Whether it is stopped, and the router has read all packages that were taken before, as far as that goes within a while. With unread
    /// bytes the kernel would reset the connection, and drop those that it has not sent.
    fn is_over(&self, is_empty: bool, stop_at: &mut Option<u64>) -> bool {
        if !self.shared.stop.load(Ordering::Relaxed) {
            return false;
        }
        let is_done = self.up.is_none() || is_empty && self.session.is_idle() && self.session.is_read();
        is_done || now() > *stop_at.get_or_insert(now() + END_WITHIN)
    }

    fn note(&mut self, events: &Events) {
        for event in events {
            if let (STREAM, Some(up)) = (event.token(), &mut self.up) {
                up.is_readable |= event.is_readable() || event.is_read_closed() || event.is_error();
                up.is_writable |= event.is_writable();
            }
        }
    }

    /// How long it may wait for events.
    fn patience(&self, is_empty: bool) -> Duration {
        let until = match &self.up {
            Some(up) if up.is_readable => 0,
            Some(up) if up.is_writable && (up.has_more || !is_empty && self.session.takes_packages()) => 0,
            // The next question goes with the next batch.
            Some(up) => self.session.next_due(up.is_writable),
            None if self.dial.is_down() && !is_empty => 0,
            None => self.dial.due().unwrap_or(0),
        };
        // A package that is refused does not wake this thread, unless it is a command.
        let until = if is_empty { until } else { until.min(self.look_at) };
        Duration::from_millis(until.saturating_sub(now()))
    }

    /// Opens a connection if there is none, as far as that goes.
    fn open(&mut self) {
        if self.up.is_some() {
            return;
        }
        match self.dial.go_on(self.poll.registry(), STREAM, now()) {
            Ok(None) => {}
            Ok(Some(Opened { stream, proof })) => {
                self.connections += 1;
                self.session.connected(now(), proof.as_ref());
                self.up = Some(Up { stream, is_readable: true, is_writable: true, has_more: true });
            }
            Err(error) => self.last_error = Some(error.to_string()),
        }
    }

    /// Reads and writes as far as that goes. An error ends the connection.
    fn exchange(&mut self, room: &mut [u8]) -> io::Result<()> {
        let Some(up) = &mut self.up else { return Ok(()) };
        let (session, local, now) = (&mut self.session, &mut self.local, now());
        if up.is_readable {
            match up.stream.read(room) {
                Ok(0) => return Err(io::Error::other("the router has closed the connection")),
                Ok(length) => {
                    self.dial.works();
                    let mut answers = Vec::new();
                    let read = session.received(&room[..length], now, |head, body| {
                        answers.extend(local.deliver(head, body));
                    });
                    read.map_err(io::Error::other)?;
                    answers.iter().for_each(|answer| session.answer(answer));
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => up.is_readable = false,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        if session.is_silent(now) {
            return Err(io::Error::other("no byte of the router for 15 s, or it reads none"));
        }
        session.retry(now);
        if up.is_writable {
            let written = match up.stream.flush_tls()? {
                true => session.write(|batch| local.next(batch), |part| up.stream.write(part))?,
                false => Written::Blocked,
            };
            (up.is_writable, up.has_more) = (written != Written::Blocked, written == Written::More);
        }
        Ok(())
    }

    fn down(&mut self, why: &io::Error) {
        self.last_error = Some(why.to_string());
        self.session.disconnected();
        self.up = None;
        self.dial.lost(now());
    }

    fn publish(&self) {
        let (names, names_waiting) = self.session.names();
        let is_connected = self.up.is_some();
        *self.shared.status() = TcpStatus {
            is_connected,
            connections: self.connections,
            last_error: self.last_error.clone(),
            names: if is_connected { names } else { 0 },
            names_waiting: if is_connected { names_waiting } else { names + names_waiting },
            session: self.session.counters(),
            local: self.local.counters(),
        };
    }
}

/// Milliseconds of this host's clock.
fn now() -> u64 {
    monotonic() / 1_000_000
}
