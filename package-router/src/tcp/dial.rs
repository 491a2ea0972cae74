//! A connection to a router that is opened again whenever it is lost.

use std::io;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs};
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::thread::Builder;
use std::time::Duration;

use mio::net::TcpStream;
use mio::{Interest, Registry, Token};
use socket2::{SockRef, TcpKeepalive};

use super::address::Address;
use super::control::Proof;
use super::keys::ClientKeys;
use super::stream::Stream;

/// Milliseconds that a connection may take to open.
const OPEN_WITHIN: u64 = 2_000;
/// Milliseconds from a lost connection to the first attempt to open another, and the most between two attempts.
const BACK_OFF: core::ops::RangeInclusive<u64> = 50..=1_000;
/// Milliseconds until a router that has refused this one is tried again: its configuration may be another by then.
const REFUSED: u64 = 5_000;
/// Milliseconds between two looks whether a name was found.
const LOOK_AGAIN: u64 = 20;
/// A peer that has vanished from the network without a word is noticed after 25 s, if nothing is sent to it.
const KEEPALIVE: TcpKeepalive = TcpKeepalive::new()
    .with_time(Duration::from_secs(10))
    .with_interval(Duration::from_secs(5))
    .with_retries(3);
/// Unsent bytes in the kernel: a more urgent package overtakes those that wait here, and none that wait there.
const UNSENT: u32 = 16 << 10;

/// A router, and the attempts to connect to it. Times are milliseconds of any clock that does not go back.
pub struct Dial {
    router: Address,
    keys: Option<ClientKeys>,
    state: State,
    back_off: u64,
    attempts: usize,
}

enum State {
    /// There is no connection; the next attempt is due then.
    Down(u64),
    /// The host's name is looked up by a thread of its own: a name server may be silent. It is looked then whether it has been found.
    Looking(Receiver<io::Result<Vec<SocketAddr>>>, u64),
    /// One is being opened; it fails then.
    Opening(Stream, u64),
    /// The one that was opened is in use.
    Open,
}

/// A connection that is open.
pub struct Opened {
    /// The connection.
    pub stream: Stream,
    /// The proof that it begins with, if it needs one.
    pub proof: Option<Proof>,
}

impl Dial {
    /// To this router, with these keys by TLS. The first attempt is due at once.
    pub fn new(router: Address, keys: Option<ClientKeys>) -> Self {
        Self { router, keys, state: State::Down(0), back_off: *BACK_OFF.start(), attempts: 0 }
    }

    /// Goes on as far as that goes without waiting. Its events have this token. An error is the end of an attempt: another follows.
    pub fn go_on(&mut self, registry: &Registry, token: Token, now: u64) -> io::Result<Option<Opened>> {
        let gone_on = match core::mem::replace(&mut self.state, State::Open) {
            State::Down(at) if at <= now => match self.router.host.parse::<IpAddr>() {
                Ok(address) => self.begin(&[(address, self.router.port).into()], registry, token, now),
                Err(_) => self.look_up(now),
            },
            State::Looking(found, _) => match found.try_recv() {
                Ok(found) => found.and_then(|addresses| self.begin(&addresses, registry, token, now)),
                Err(TryRecvError::Empty) => {
                    self.state = State::Looking(found, now + LOOK_AGAIN);
                    Ok(None)
                }
                Err(TryRecvError::Disconnected) => Err(io::Error::other("the host's name was not looked up")),
            },
            State::Opening(mut stream, until) => match self.is_open(&mut stream) {
                Ok(Some(proof)) => return Ok(Some(Opened { stream, proof })),
                Ok(None) if until <= now => Err(io::ErrorKind::TimedOut.into()),
                Ok(None) => {
                    self.state = State::Opening(stream, until);
                    Ok(None)
                }
                Err(error) => Err(error),
            },
            state => {
                self.state = state;
                Ok(None)
            }
        };
        if gone_on.is_err() {
            self.lost(now);
        }
        gone_on
    }

    /// Something has come by the connection that was opened: the next one follows soon if it is lost.
    pub fn works(&mut self) {
        self.back_off = *BACK_OFF.start();
    }

    /// The router there refuses this one.
    pub fn refused(&mut self, now: u64) {
        self.state = State::Down(now + REFUSED);
    }

    /// The connection that was opened is lost.
    pub fn lost(&mut self, now: u64) {
        self.state = State::Down(now + self.back_off);
        self.back_off = (2 * self.back_off).min(*BACK_OFF.end());
    }

    /// When [`Self::go_on`] is due without an event; `None`: a connection is open.
    pub fn due(&self) -> Option<u64> {
        match &self.state {
            State::Down(at) | State::Looking(_, at) | State::Opening(_, at) => Some(*at),
            State::Open => None,
        }
    }

    /// Whether no connection is open, nor being opened for the first time. An attempt that follows one that failed may fail, too, after
    /// seconds.
    pub fn is_down(&self) -> bool {
        match self.state {
            State::Down(_) | State::Looking(..) => true,
            State::Opening(..) => self.back_off > *BACK_OFF.start(),
            State::Open => false,
        }
    }

    fn look_up(&mut self, now: u64) -> io::Result<Option<Opened>> {
        let Address { host, port } = self.router.clone();
        let (answer, found) = channel();
        Builder::new().name("packages-names".into()).spawn(move || {
            // Nobody waits any more if this end of the connection has ended.
            let _ = answer.send((host.as_str(), port).to_socket_addrs().map(Iterator::collect));
        })?;
        self.state = State::Looking(found, now + LOOK_AGAIN);
        Ok(None)
    }

    fn begin(
        &mut self,
        addresses: &[SocketAddr],
        registry: &Registry,
        token: Token,
        now: u64,
    ) -> io::Result<Option<Opened>> {
        // Each attempt takes the next address.
        let place = self.attempts % addresses.len().max(1);
        self.attempts += 1;
        let address = addresses.get(place).ok_or(io::ErrorKind::AddrNotAvailable)?;
        let mut stream = TcpStream::connect(*address)?;
        registry.register(&mut stream, token, Interest::READABLE | Interest::WRITABLE)?;
        prepare(&stream);
        let session = self
            .keys
            .as_ref()
            .map(|keys| keys.session(&self.router.host))
            .transpose()
            .map_err(io::Error::other)?;
        self.state = State::Opening(Stream::new(stream, session.map(Into::into)), now + OPEN_WITHIN);
        Ok(None)
    }

    /// Whether a connection that was begun is open, with the proof that it begins with, if any; an error if it never will be.
    fn is_open(&self, stream: &mut Stream) -> io::Result<Option<Option<Proof>>> {
        if !is_connected(&stream.tcp)? || !stream.begin()? {
            return Ok(None);
        }
        let proof = self.keys.as_ref().zip(stream.tls()).map(|(keys, session)| keys.proof(session));
        proof.transpose().map(|proof| Some(proof.flatten())).map_err(io::Error::other)
    }
}

/// Options of a connection for packages. Without them it is slower, not wrong.
pub fn prepare(stream: &TcpStream) {
    let _ = stream.set_nodelay(true);
    let socket = SockRef::from(stream);
    let _ = socket.set_tcp_notsent_lowat(UNSENT);
    let _ = socket.set_tcp_keepalive(&KEEPALIVE);
}

/// Whether a socket that connects is connected; an error if it never will be.
fn is_connected(stream: &TcpStream) -> io::Result<bool> {
    if let Some(error) = stream.take_error()? {
        return Err(error);
    }
    let peer = match stream.peer_addr() {
        Ok(peer) => peer,
        Err(error) if error.kind() == io::ErrorKind::NotConnected => return Ok(false),
        Err(error) => return Err(error),
    };
    // The kernel may connect a socket to itself, if nobody listens at a port of the range for clients.
    match stream.local_addr()? == peer {
        true => Err(io::ErrorKind::ConnectionRefused.into()),
        false => Ok(true),
    }
}

// Lookups take their time.
#[cfg(test)]
#[allow(clippy::disallowed_methods)]
mod tests {
    use std::net::TcpListener;

    use mio::{Events, Poll};

    use super::*;

    #[test]
    fn rests_double_up_to_a_second_until_the_router_sends() {
        let mut dial = Dial::new(Address { host: "127.0.0.1".into(), port: 1 }, None);
        let rest = |dial: &mut Dial| {
            dial.lost(70);
            dial.due().unwrap() - 70
        };
        let rests: Vec<u64> = (0..7).map(|_| rest(&mut dial)).collect();
        assert_eq!(rests, [50, 100, 200, 400, 800, 1_000, 1_000]);
        dial.works();
        assert_eq!([rest(&mut dial), rest(&mut dial)], [50, 100]);
        dial.refused(70);
        assert_eq!(dial.due(), Some(70 + REFUSED));
    }

    /// Packages wait for the first attempt, and for no other.
    #[test]
    fn a_router_is_down_while_it_is_tried_again() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let (poll, port) = (Poll::new().unwrap(), listener.local_addr().unwrap().port());
        let mut dial = Dial::new(Address { host: "127.0.0.1".into(), port }, None);
        assert!(dial.is_down());
        let begins =
            |dial: &mut Dial, now| assert!(dial.go_on(poll.registry(), Token(1), now).unwrap().is_none());
        begins(&mut dial, 0);
        assert!(!dial.is_down());
        dial.lost(0);
        begins(&mut dial, 50);
        assert!(matches!(dial.state, State::Opening(..)) && dial.is_down());
    }

    #[test]
    fn a_hosts_name_is_looked_up_while_others_go_on() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let mut poll = Poll::new().unwrap();
        for host in ["localhost", "127.0.0.1"] {
            let mut dial = Dial::new(Address { host: host.into(), port }, None);
            let (mut now, mut looked) = (0, 0);
            while dial.go_on(poll.registry(), Token(1), now).ok().flatten().is_none() {
                looked += usize::from(matches!(dial.state, State::Looking(..)));
                assert!(now < 30_000, "{host} is not found");
                let wait = Duration::from_millis(dial.due().unwrap().saturating_sub(now).clamp(1, 20));
                poll.poll(&mut Events::with_capacity(4), Some(wait)).unwrap();
                now += wait.as_millis() as u64;
            }
            assert_eq!((looked > 0, dial.is_down()), (host == "localhost", false));
        }
    }
}
