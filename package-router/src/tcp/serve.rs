//! The router's loop over sockets: one thread.

mod arrivals;
mod awake;
mod links;
mod remote;
mod socket;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::net::SocketAddr;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Duration;

use mio::event::Event;
use mio::net::{TcpListener, TcpStream};
use mio::{Events, Interest, Poll, Token, Waker};
use rtnet::clock::True;
use rtnet::live::clock::monotonic;

use super::dial::prepare;
use super::keys::RouterKeys;
use super::router::{Connection, Ending, Limits, Router, Status, UNTRUSTED};
use super::stream::Stream;
use awake::{AWAKE_AT_MOST, Awake};
pub use links::LinkTo;
use links::OwnLink;
use remote::Order;
pub use remote::Remote;
use socket::{Begun, Socket};

/// Connections of one listener that are accepted before the others have their turn.
const ACCEPTS: usize = 64;
/// Bytes of one read. A connection that has more waits until all others had their turn.
const READ: usize = 64 << 10;
/// Milliseconds from an accept that failed for want of descriptors or memory to the next.
const REST: u64 = 100;
const WAKER: Token = Token(usize::MAX);
/// Tokens of connections count up from 0, those of listeners and of links that are being opened from here.
const LISTENERS: usize = usize::MAX / 2;
const LINKS: usize = usize::MAX / 4;

/// A router on sockets. [`Server::run`] is its thread.
pub struct Server {
    poll: Poll,
    router: Router,
    /// When it began: its times are milliseconds since then.
    begun: True,
    listeners: Vec<(TcpListener, Option<RouterKeys>)>,
    /// Connections to the routers of other systems.
    links: Vec<OwnLink>,
    sockets: Vec<Option<Socket>>,
    /// Connections whose TLS sessions have a step to take, the oldest first.
    handshakes: VecDeque<Connection>,
    /// Connections that may have more to be read.
    readable: Vec<Connection>,
    /// Events of one wait: of each connection at most one. So each that has bytes has been read from after it.
    events: usize,
    /// Connections to which packages may be in flight, and when it looks for those that have arrived.
    in_flight: Vec<Connection>,
    looks_again: u64,
    /// Listeners that may have more connections.
    accepting: Vec<usize>,
    /// When listeners are tried again.
    accepts_again: Option<u64>,
    awake: Awake,
    orders: Receiver<Order>,
    remote: Remote,
}

impl Server {
    /// Listens at these addresses, with keys by TLS.
    pub fn listen(addresses: &[(SocketAddr, Option<RouterKeys>)], limits: Limits) -> io::Result<Self> {
        let poll = Poll::new()?;
        let (remote, orders) = Remote::new(Waker::new(poll.registry(), WAKER)?);
        let mut listeners = Vec::new();
        for (place, (address, keys)) in addresses.iter().enumerate() {
            let mut listener = TcpListener::bind(*address)?;
            poll.registry().register(&mut listener, Token(LISTENERS + place), Interest::READABLE)?;
            listeners.push((listener, keys.clone()));
        }
        Ok(Self {
            poll,
            router: Router::new(limits, 0),
            begun: monotonic(),
            listeners,
            links: Vec::new(),
            sockets: Vec::new(),
            handshakes: VecDeque::new(),
            readable: Vec::new(),
            in_flight: Vec::new(),
            looks_again: 0,
            events: limits.connections + UNTRUSTED + 2 * addresses.len() + 1,
            accepting: Vec::new(),
            accepts_again: None,
            awake: Awake::new(),
            orders,
            remote,
        })
    }

    /// The same with links from this system to the routers of others.
    pub fn with_links(mut self, system: u8, links: Vec<LinkTo>) -> Self {
        self.router.set_links(system, links.iter().map(|link| link.systems.clone()).collect());
        self.links = links.into_iter().map(OwnLink::new).collect();
        self
    }

    /// Where it listens: the ports that it was given for 0.
    pub fn addresses(&self) -> io::Result<Vec<SocketAddr>> {
        self.listeners.iter().map(|(listener, _)| listener.local_addr()).collect()
    }

    /// The handle for other threads.
    pub fn remote(&self) -> Remote {
        self.remote.clone()
    }

    /// Runs until it is stopped.
    pub fn run(&mut self) -> io::Result<()> {
        let mut events = Events::with_capacity(self.events + self.links.len());
        let mut room = vec![0; READ];
        while !self.remote.is_stopped() {
            match self.wait(&mut events) {
                Err(error) if error.kind() != io::ErrorKind::Interrupted => return Err(error),
                _ => {}
            }
            for event in &events {
                self.event(event);
            }
            self.look_for_arrivals();
            self.read(&mut room);
            // Each connection that has bytes has been read from by now: they are signs of life.
            if self.now() >= self.router.next_round() {
                self.router.round(self.now());
            }
            self.accept_all();
            self.link();
            self.write();
            self.close();
            self.obey();
        }
        self.finish(&mut events)
    }

    /// Waits for events: awake as long as they follow each other closely, else asleep.
    fn wait(&mut self, events: &mut Events) -> io::Result<()> {
        let (patience, begun) = (self.patience(), monotonic());
        if patience == Some(Duration::ZERO) {
            return self.poll.poll(events, patience);
        }
        if !self.awake.is_due() {
            self.poll.poll(events, patience)?;
            self.awake.slept(monotonic() - begun);
            return Ok(());
        }
        while monotonic() - begun < AWAKE_AT_MOST {
            self.poll.poll(events, Some(Duration::ZERO))?;
            if !events.is_empty() {
                self.awake.succeeded();
                return Ok(());
            }
        }
        self.awake.failed();
        // Time has passed.
        self.poll.poll(events, self.patience())
    }

    fn now(&self) -> u64 {
        (monotonic() - self.begun) / 1_000_000
    }

    /// How long it waits for events.
    fn patience(&self) -> Option<Duration> {
        let has_work = !self.readable.is_empty() || !self.handshakes.is_empty() || !self.accepting.is_empty();
        if has_work || self.router.has_awake() {
            return Some(Duration::ZERO);
        }
        let links = self.links.iter().filter_map(OwnLink::due);
        let next = links.chain(self.accepts_again).fold(self.router.next_round(), u64::min);
        Some(Duration::from_millis(next.saturating_sub(self.now())))
    }

    fn event(&mut self, event: &Event) {
        match event.token() {
            WAKER => {}
            Token(place) if place >= LISTENERS => self.accepting.push(place - LISTENERS),
            // It is looked at after all events.
            Token(place) if place >= LINKS => {}
            Token(place) => {
                let Some(socket) = self.sockets.get_mut(place).and_then(Option::as_mut) else { return };
                socket.is_ended |= event.is_read_closed() || event.is_error();
                if (event.is_readable() || socket.is_ended) && !socket.is_readable {
                    socket.is_readable = true;
                    self.readable.push(Connection(place as u32));
                }
                if event.is_writable() {
                    self.write_to(Connection(place as u32));
                }
            }
        }
    }

    fn accept(&mut self, place: usize) {
        for _ in 0..ACCEPTS {
            match self.listeners[place].0.accept() {
                Ok((stream, peer)) => self.connected(stream, peer, place),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                // The client has gone meanwhile.
                Err(error)
                    if error
                        .raw_os_error()
                        .is_some_and(|of| [libc::ECONNABORTED, libc::EINTR].contains(&of)) => {}
                Err(_) => {
                    self.router.accept_failed();
                    self.accepts_again = Some(self.now() + REST);
                    return;
                }
            }
        }
        self.accepting.push(place);
    }

    fn accept_all(&mut self) {
        if self.accepts_again.is_some_and(|at| self.now() >= at) {
            self.accepts_again = None;
            self.accepting = (0..self.listeners.len()).collect();
        }
        core::mem::take(&mut self.accepting).into_iter().for_each(|place| self.accept(place));
    }

    fn connected(&mut self, mut stream: TcpStream, peer: SocketAddr, listener: usize) {
        prepare(&stream);
        let (keys, now) = (self.listeners[listener].1.clone(), self.now());
        let connection = match keys {
            None => self.router.connect(peer, now),
            Some(_) => Ok(self.router.connect_by_tls(peer, now)),
        };
        // One connection too many is closed at once, and counted.
        let Ok(connection) = connection else { return };
        let place = connection.0 as usize;
        let both = Interest::READABLE | Interest::WRITABLE;
        if let Err(error) = self.poll.registry().register(&mut stream, Token(place), both) {
            return self.router.disconnect(connection, broken(&error), self.now());
        }
        let stream = match keys.as_ref().map(RouterKeys::session).transpose() {
            Ok(session) => Stream::new(stream, session.map(Into::into)),
            Err(error) => return self.router.disconnect(connection, Ending::Tls(error.to_string()), now),
        };
        self.keep(connection, Socket::new(stream, keys));
    }

    fn keep(&mut self, connection: Connection, socket: Socket) {
        let place = connection.0 as usize;
        if self.sockets.len() <= place {
            self.sockets.resize_with(place + 1, || None);
        }
        self.sockets[place] = Some(socket);
    }

    /// Reads once from each connection that has something. One TLS session takes a step: that is as long as a thousand packages take, so
    /// that strangers who begin sessions delay clients by one such step a turn.
    fn read(&mut self, room: &mut [u8]) {
        if let Some(connection) = self.handshakes.pop_front() {
            self.begin(connection);
        }
        let now = self.now();
        for connection in core::mem::take(&mut self.readable) {
            let Some(socket) = self.sockets.get_mut(connection.0 as usize).and_then(Option::as_mut) else {
                continue;
            };
            if socket.keys.is_some() {
                self.handshakes.push_back(connection);
                continue;
            }
            let read = socket.stream.read(room);
            let ending = match read {
                Ok(0) => Some(Ending::Left),
                Ok(length) => {
                    if let Some(place) = self.router.place_of_link(connection) {
                        self.links[place].works();
                    }
                    self.router.received(connection, &room[..length], now);
                    // A read that was not filled has found the end of what there is, but for TLS.
                    if length == room.len() || socket.is_ended || socket.stream.is_in_parts() {
                        self.readable.push(connection);
                    } else {
                        socket.is_readable = false;
                    }
                    None
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    socket.is_readable = false;
                    None
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {
                    self.readable.push(connection);
                    None
                }
                Err(error) => Some(broken(&error)),
            };
            if let Some(why) = ending {
                self.disconnect(connection, why);
            }
        }
    }

    /// Takes a step of a handshake.
    fn begin(&mut self, connection: Connection) {
        let Some(socket) = self.sockets.get_mut(connection.0 as usize).and_then(Option::as_mut) else {
            return;
        };
        match socket.begin() {
            Ok(Some(Begun(proof))) => {
                self.router.secured(connection, proof);
                self.readable.push(connection);
            }
            Ok(None) => socket.is_readable = false,
            Err(error) => self.disconnect(connection, broken(&error)),
        }
    }

    fn write(&mut self) {
        while let Some(connection) = self.router.next_awake() {
            self.write_to(connection);
        }
    }

    /// Bytes that the kernel does not take wait until there is room.
    fn write_to(&mut self, connection: Connection) {
        let Some(socket) = self.sockets.get_mut(connection.0 as usize).and_then(Option::as_mut) else {
            return;
        };
        let mut write = || -> io::Result<()> {
            while socket.stream.flush_tls()? {
                self.router.written(connection, socket.stream.taken());
                let is_all = self.router.write(connection, |slices| socket.stream.write_vectored(slices))?;
                // TLS takes a part at a time, and more once that has left.
                if is_all || !socket.stream.is_in_parts() {
                    break;
                }
            }
            Ok(())
        };
        let written = write();
        self.flies_to(connection);
        if let Err(error) = written {
            self.disconnect(connection, broken(&error));
        }
    }

    fn close(&mut self) {
        while let Some((connection, why)) = self.router.next_ending() {
            self.disconnect(connection, why);
        }
    }

    fn disconnect(&mut self, connection: Connection, why: Ending) {
        self.looks_at(connection);
        // Closed before its number is another's.
        if let Some(socket) = self.sockets.get_mut(connection.0 as usize).and_then(Option::take) {
            if socket.is_in_flight {
                self.in_flight.retain(|in_flight| *in_flight != connection);
            }
            drop(socket);
            let now = self.now();
            if let Some(place) = self.router.place_of_link(connection) {
                self.links[place].ended(&why, now);
            }
            self.readable.retain(|readable| *readable != connection);
            self.handshakes.retain(|waiting| *waiting != connection);
            self.router.disconnect(connection, why, self.now());
        }
    }

    fn obey(&mut self) {
        loop {
            match self.orders.try_recv() {
                Ok(Order::Status(asked)) => {
                    // A question that was given up meanwhile has no answer.
                    let links = self.links.iter().enumerate();
                    let links =
                        links.map(|(place, link)| link.status(self.router.unnamed_system(place))).collect();
                    let _ = asked.send(Status { links, ..self.router.status(self.now()) });
                }
                Ok(Order::Rules(Ok(rules))) => self.router.set_rules(rules),
                Ok(Order::Rules(Err(why))) => self.router.refuse_rules(why),
                Err(TryRecvError::Empty | TryRecvError::Disconnected) => return,
            }
        }
    }
}

fn broken(error: &io::Error) -> Ending {
    match error.kind() {
        io::ErrorKind::InvalidData => of_tls(error),
        io::ErrorKind::UnexpectedEof => Ending::Left,
        _ => Ending::Broken(error.raw_os_error().unwrap_or(libc::EIO)),
    }
}

/// An error of a TLS session.
fn of_tls(error: &io::Error) -> Ending {
    use rustls::Error::{InvalidCertificate, InvalidMessage, NoCertificatesPresented};
    match error.get_ref().and_then(|of| of.downcast_ref()) {
        Some(InvalidMessage(_)) => {
            Ending::Tls(format!("it does not speak TLS, which this address asks for: {error}"))
        }
        Some(InvalidCertificate(_) | NoCertificatesPresented) => Ending::Certificate(error.to_string()),
        _ => Ending::Tls(error.to_string()),
    }
}
