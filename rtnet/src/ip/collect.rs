//! Datagrams that come in fragments.
//!
//! ```text
//!            ┌────────────────────── the socket is closed, or nothing came for `timeout`: given up
//!  first ──► collecting ── offset = bytes so far ──► collecting ── last ──► complete
//!            ├────────────────────── bytes that are there already: refused, and nothing changes
//!            └────────────────────── anything else: given up, and the fragment refused
//! ```
//!
//! Fragments are taken in exactly ascending order, as RTnet sends them: so each is kept where it came, and nothing is
//! ever sorted or overlapped. A medium may double any of them. Unlike RTnet's, collectors do not wait for ever, and belong to a socket: a
//! storm of beginnings takes them, and their buffers, from the socket that it is sent to and from nobody else, and from
//! the sender that it comes from before all.

use core::net::Ipv4Addr;

use crate::buf::{Buf, Chain, Pool, hand_over};
use crate::counters::Refusal;
use crate::ip::Refused;
use crate::socket::SocketId;
use crate::time::{Instant, Span};
use crate::wire::ipv4::{Header, Protocol};

/// Datagrams in fragments that a socket waits for at a time. RTnet has 10 for a whole station.
pub const PER_SOCKET: usize = 8;
/// Of these, from one sender: who begins one more gives up its oldest.
pub const PER_SOURCE: usize = 4;
/// How long a datagram's next fragment is waited for: ten turns of a slot in a cycle of 100 ms.
pub const DEFAULT_TIMEOUT: Span = Span::from_millis(1_000);

/// Whose fragments belong together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Key {
    source: Ipv4Addr,
    destination: Ipv4Addr,
    identification: u16,
    protocol: Protocol,
}

/// What became of datagrams that were never complete.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct CollectorCounters {
    /// The next fragment did not come in time.
    pub timed_out: u64,
    /// Another fragment came than the next.
    pub out_of_order: u64,
    /// Its sender began too many others.
    pub given_up: u64,
    /// The socket had no buffer for a fragment.
    pub pool_empty: u64,
}

/// All datagrams of a station of which a part has come.
pub struct Collectors {
    active: Vec<Collector>,
    timeout: Span,
    counters: CollectorCounters,
}

/// A datagram of which a part has come.
struct Collector {
    key: Key,
    socket: SocketId,
    chain: Chain,
    /// Bytes in it.
    len: usize,
    newest: Instant,
}

/// A datagram that is complete.
pub struct Complete {
    /// Whose it is.
    pub socket: SocketId,
    /// Its fragments, in order, in buffers of the socket's.
    pub chain: Chain,
}

impl Key {
    /// What the fragments of one datagram have in common.
    pub fn of(header: &Header) -> Self {
        Self {
            source: header.source(),
            destination: header.destination(),
            identification: header.identification(),
            protocol: header.protocol(),
        }
    }
}

impl Collector {
    /// Whether these very bytes have come at `offset`. Others there are of another datagram with the same number.
    fn has(&self, offset: usize, fragment: &[u8]) -> bool {
        offset < self.len && self.chain.is_at(offset, fragment)
    }
}

impl Collectors {
    /// None yet; at most [`PER_SOCKET`] for each of so many sockets.
    pub fn new(sockets: usize, timeout: Span) -> Self {
        let active = Vec::with_capacity(sockets * PER_SOCKET);
        Self { active, timeout, counters: CollectorCounters::default() }
    }

    /// The first fragment of a datagram for a socket, whose pool pays for it.
    pub fn begin(
        &mut self,
        key: Key,
        socket: SocketId,
        first: Buf,
        pool: &Pool,
        now: Instant,
    ) -> Result<(), Refusal> {
        if self.active.iter().any(|active| active.key == key && active.has(0, &first)) {
            return Err(Refusal::FragmentRepeated);
        }
        // A sender that has begun to count again, since it was restarted: what follows is of this datagram.
        self.counters.given_up += self.give_up(|other| other.key == key);
        self.make_room(key, socket, now)?;
        let kept = hand_over(first, pool).map_err(|_| self.no_buffer())?;
        let len = kept.len();
        self.active.push(Collector { key, socket, chain: Chain::of(kept), len, newest: now });
        Ok(())
    }

    /// A further fragment, `offset` bytes from the datagram's begin. `pool` finds the pool of the datagram's socket. One of a
    /// datagram that is not collected here comes back.
    pub fn go_on<'p>(
        &mut self,
        key: Key,
        offset: usize,
        is_last: bool,
        fragment: Buf,
        now: Instant,
        pool: impl FnOnce(SocketId) -> Option<&'p Pool>,
    ) -> Result<Option<Complete>, Refused> {
        let Some(place) = self.active.iter().position(|active| active.key == key) else {
            return Err(Refused::unwanted(fragment, Refusal::FragmentOrphan));
        };
        if self.active[place].has(offset, &fragment) {
            return Err(Refusal::FragmentRepeated.into());
        }
        if self.active[place].len != offset {
            self.active.swap_remove(place);
            self.counters.out_of_order += 1;
            return Err(Refusal::FragmentOrder.into());
        }
        let kept = pool(self.active[place].socket).and_then(|pool| hand_over(fragment, pool).ok());
        let Some(kept) = kept else {
            self.active.swap_remove(place);
            return Err(self.no_buffer().into());
        };
        let collector = &mut self.active[place];
        collector.len += kept.len();
        collector.chain.push(kept);
        collector.newest = now;
        Ok(is_last.then(|| {
            let Collector { socket, chain, .. } = self.active.swap_remove(place);
            Complete { socket, chain }
        }))
    }

    /// Gives up what nothing came for in time.
    pub fn expire(&mut self, now: Instant) {
        let timeout = self.timeout;
        self.counters.timed_out += self.give_up(|active| now - active.newest > timeout);
    }

    /// A socket was closed.
    pub fn forget(&mut self, socket: SocketId) {
        self.give_up(|active| active.socket == socket);
    }

    /// Datagrams of which a part has come.
    pub fn active(&self) -> usize {
        self.active.len()
    }
    /// Buffers of a socket's in which parts of datagrams have come.
    pub fn held_of(&self, socket: SocketId) -> usize {
        self.active.iter().filter(|active| active.socket == socket).map(|active| active.chain.count()).sum()
    }
    /// What became of those that were never complete.
    pub fn counters(&self) -> CollectorCounters {
        self.counters
    }

    /// Whoever asks for more than its share gives up its own oldest.
    fn make_room(&mut self, key: Key, socket: SocketId, now: Instant) -> Result<(), Refusal> {
        let of_source = |active: &&Collector| active.socket == socket && active.key.source == key.source;
        if self.active.iter().filter(of_source).count() >= PER_SOURCE {
            let oldest = self.active.iter().filter(of_source).min_by_key(|active| active.newest);
            if let Some(oldest) = oldest.map(|oldest| oldest.key) {
                self.counters.given_up += self.give_up(|active| active.key == oldest);
            }
        }
        let of_socket = |active: &&Collector| active.socket == socket;
        if self.active.iter().filter(of_socket).count() >= PER_SOCKET {
            self.expire(now);
        }
        match self.active.iter().filter(of_socket).count() {
            full if full >= PER_SOCKET => Err(Refusal::FragmentLimit),
            _ => Ok(()),
        }
    }

    fn give_up(&mut self, which: impl Fn(&Collector) -> bool) -> u64 {
        let before = self.active.len();
        self.active.retain(|active| !which(active));
        (before - self.active.len()) as u64
    }

    fn no_buffer(&mut self) -> Refusal {
        self.counters.pool_empty += 1;
        Refusal::PoolEmpty
    }
}
