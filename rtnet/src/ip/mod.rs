//! UDP/IP for a medium in slots: everything that is decided, nothing that waits.
//!
//! ```text
//!            on_frame                                  Exit::send
//!  medium ──────────► input ─► collect ─► sockets ─► output ─────► the discipline's queue
//!                       │ ▲                  │  ▲      ▲
//!                       ▼ └──── loopback ────┼──┼──────┤
//!                  arp, icmp ────────────────┼──┼──────┘
//!                                            ▼  │
//!                                          programs
//! ```
//!
//! It asks the medium nothing by itself: routes are said by hand, or asked for by hand (`arp`, `route`).

mod arp;
pub mod collect;
mod icmp;
mod input;
pub mod output;
pub mod route;

use core::any::Any;
use core::ops::RangeInclusive;

use crate::buf::{Buf, Pool, PoolStatistics};
use crate::counters::{Refusal, Refusals};
use crate::discipline::{Channel, SendError, TimeView};
use crate::queue::Priority;
use crate::socket::{Access, Program, SocketId, Table};
use crate::time::{Instant, Span};

use arp::Arp;
use collect::{CollectorCounters, Collectors};
use icmp::Icmp;
use output::Output;
use route::{Interface, Routes};

pub use icmp::Pong;

/// Sockets that a station may have: RTnet's.
pub const DEFAULT_SOCKETS: u16 = 64;
/// Ports that are given to sockets which do not ask for one: RTnet's.
pub const DEFAULT_PORTS: RangeInclusive<u16> = 1024..=1087;
/// How often programs run because of what they sent to their own station: a slot is about to come.
const MOST_ROUNDS: usize = 4;

/// What a station's stack is made with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StackConfig {
    /// Its place in the Internet Protocol.
    pub interface: Interface,
    /// Host routes at the most.
    pub hosts: usize,
    /// Network routes at the most.
    pub networks: usize,
    /// Sockets at the most.
    pub sockets: u16,
    /// Ports that are given out.
    pub ports: RangeInclusive<u16>,
    /// Buffers for echoes.
    pub icmp_buffers: usize,
    /// Buffers for requests and replies of address resolution.
    pub arp_buffers: usize,
    /// How long the next fragment of a datagram is waited for.
    pub fragment_timeout: Span,
    /// Whether a datagram in fragments must have the right checksum: RTnet's of 2019 and later send wrong ones.
    pub fragment_checksums: bool,
}

impl StackConfig {
    /// The defaults of a station with this address.
    pub fn new(interface: Interface) -> Self {
        Self {
            interface,
            hosts: route::DEFAULT_HOSTS,
            networks: route::DEFAULT_NETWORKS,
            sockets: DEFAULT_SOCKETS,
            ports: DEFAULT_PORTS,
            icmp_buffers: icmp::DEFAULT_BUFFERS,
            arp_buffers: arp::DEFAULT_BUFFERS,
            fragment_timeout: collect::DEFAULT_TIMEOUT,
            fragment_checksums: false,
        }
    }
}

/// What a stack does not take.
#[derive(Debug)]
pub struct Refused {
    /// Why.
    pub why: Refusal,
    /// A sound packet for this station that its sockets and echoes have no part in, for whoever else has its address: behind
    /// its Ethernet header, without what it was padded by.
    pub unwanted: Option<Buf>,
}

impl Refused {
    /// A packet, trimmed up to its content, that others may want.
    fn unwanted(mut packet: Buf, why: Refusal) -> Self {
        packet.untrim_front();
        Self { why, unwanted: Some(packet) }
    }
}

impl From<Refusal> for Refused {
    fn from(why: Refusal) -> Self {
        Self { why, unwanted: None }
    }
}

/// Where frames leave a stack: a discipline's queue.
pub trait Exit {
    /// Queues a frame for the slot `channel`.
    fn send(&mut self, frame: Buf, priority: Priority, channel: Channel) -> Result<(), (SendError, Buf)>;
    /// Largest payload behind the Ethernet header that fits the slot.
    fn limit(&self, channel: Channel) -> Result<usize, SendError>;
    /// What is known of the master's time.
    fn time(&self) -> TimeView;
}

/// What a stack has counted besides what the station refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct StackCounters {
    /// Echoes that were answered.
    pub echoes_answered: u64,
    /// Datagrams in fragments with a wrong checksum, which were let in.
    pub checksums_tolerated: u64,
    /// Datagrams behind whose end there was what is no list of options, or a changed one: they were let in without it.
    pub options_ignored: u64,
    /// Somebody claimed an address that is this station's, or another's by the table.
    pub arp_conflicts: u64,
    /// Entries of the host table that their station, or the answer to a question, has changed.
    pub arp_changed: u64,
    /// Datagrams that were never complete.
    pub collectors: CollectorCounters,
    /// What this station sent to itself and did not take, by reason.
    pub loopback: Refusals,
}

/// A pool of a stack's own, as it is now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolStatus {
    /// Whose it is.
    pub name: &'static str,
    /// Its counts.
    pub statistics: PoolStatistics,
}

/// UDP/IP of one station. All of its memory is reserved when it is made.
pub struct Stack {
    pub(crate) routes: Routes,
    pub(crate) sockets: Table,
    pub(crate) collectors: Collectors,
    pub(crate) output: Output,
    pub(crate) counters: StackCounters,
    pub(crate) config: StackConfig,
    /// The newest moment that it was told of.
    pub(crate) now: Instant,
    /// Something has come for a socket since programs ran.
    pub(crate) delivered: bool,
    icmp: Icmp,
    arp: Arp,
    programs: Vec<Box<dyn Program>>,
}

impl Stack {
    /// A stack without sockets and routes, with these programs in its station's thread.
    pub fn new(config: StackConfig, programs: Vec<Box<dyn Program>>) -> Self {
        Self {
            routes: Routes::new(config.interface, config.hosts, config.networks),
            sockets: Table::new(config.sockets, config.ports.clone()),
            collectors: Collectors::new(usize::from(config.sockets), config.fragment_timeout),
            output: Output::default(),
            counters: StackCounters::default(),
            now: Instant::default(),
            delivered: false,
            icmp: Icmp::new(Pool::new(config.icmp_buffers)),
            arp: Arp::new(Pool::new(config.arp_buffers)),
            programs,
            config,
        }
    }

    /// A slot is about to come at `now`: the last moment for programs to send in it. Or it is `now`, and none comes soon.
    pub fn poll(&mut self, now: Instant, exit: &mut dyn Exit) {
        self.now = now;
        self.collectors.expire(now);
        self.delivered = true;
        self.run_programs(exit);
    }

    /// The slot's frame has left: programs may do what takes longer.
    pub fn rest(&mut self) {
        self.programs.iter_mut().for_each(|program| program.rest());
    }

    /// The station is about to wait until it is rung for, or is awake again. Tells whether it should not wait.
    pub fn sleeps(&mut self, is_asleep: bool) -> bool {
        let stays = self.programs.iter_mut().filter_map(|program| program.sleeps(is_asleep).then_some(()));
        stays.count() > 0
    }

    /// The program of this kind, if there is one in the station's thread.
    pub fn program_mut<P: Program>(&mut self) -> Option<&mut P> {
        self.programs.iter_mut().find_map(|program| {
            let program: &mut dyn Any = program.as_mut();
            program.downcast_mut()
        })
    }

    /// Where packets go.
    pub fn routes(&self) -> &Routes {
        &self.routes
    }
    /// Where packets go, to change it.
    pub fn routes_mut(&mut self) -> &mut Routes {
        &mut self.routes
    }

    /// What was counted.
    pub fn counters(&self) -> StackCounters {
        StackCounters { collectors: self.collectors.counters(), ..self.counters }
    }

    /// Buffers of a socket's in which parts of datagrams have come whose rest is waited for.
    pub fn collecting(&self, socket: SocketId) -> usize {
        self.collectors.held_of(socket)
    }

    /// The stack's own pools; each socket has one besides.
    pub fn pools(&self) -> [PoolStatus; 2] {
        [
            PoolStatus { name: "icmp", statistics: self.icmp.pool.statistics() },
            PoolStatus { name: "arp", statistics: self.arp.pool.statistics() },
        ]
    }

    /// Lets programs see what has come. What they send to this station itself they see, too, unless they never end to.
    pub(crate) fn run_programs(&mut self, exit: &mut dyn Exit) {
        let mut programs = core::mem::take(&mut self.programs);
        for _ in 0..MOST_ROUNDS {
            if !core::mem::take(&mut self.delivered) {
                break;
            }
            for program in &mut programs {
                let now = self.now;
                program.run(&mut Access::new(self, exit, now));
            }
        }
        self.programs = programs;
    }
}

#[cfg(test)]
pub(crate) mod tests;
