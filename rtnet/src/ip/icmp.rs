//! Echo: answered for others, and asked for by `rtnet ping`.

use core::net::Ipv4Addr;

use arrayvec::ArrayVec;
use zerocopy::IntoBytes;

use super::output::Route;
use super::{Exit, Stack};
use crate::buf::Pool;
use crate::counters::Refusal;
use crate::discipline::Channel;
use crate::queue::Priority;
use crate::socket::{Options, SocketError};
use crate::time::Instant;
use crate::wire::ethernet::{self, EtherType};
use crate::wire::icmpv4::{self, Echo, Kind};
use crate::wire::ipv4::{self, Header, Protocol};

use super::output::{Content, Output};

/// Buffers for echoes: RTnet's.
pub const DEFAULT_BUFFERS: usize = 8;
/// Answers that wait to be looked at; one more is lost, and counted.
const MOST_PONGS: usize = 32;
/// Rounds of questions at a time, of people who each wait for their own answers; the oldest makes room.
const MOST_ROUNDS: usize = 8;
/// The slot of whatever is not urgent, and the last real-time priority: RTnet's for ICMP and ARP.
pub(super) const OPTIONS: Options =
    Options { priority: Priority::LAST_REAL_TIME, channel: NON_RT_CHANNEL, tos: 0 };
const NON_RT_CHANNEL: Channel = 1;

/// An answer to an echo that was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pong {
    /// Who answered.
    pub from: Ipv4Addr,
    /// Which round of questions.
    pub identifier: u16,
    /// Which question.
    pub sequence: u16,
    /// Bytes that came back.
    pub len: usize,
    /// When, on this station's clock; `None` where the stamp could not be trusted.
    pub rx: Option<Instant>,
    /// When the question was to leave, by the slot that it was chosen for; `None` if it was not seen to leave.
    pub left: Option<Instant>,
}

/// What a station has for echoes.
pub(super) struct Icmp {
    pub pool: Pool,
    /// Its own count, as real stations have.
    output: Output,
    /// The rounds of questions whose answers are waited for, oldest first.
    asking: ArrayVec<Round, MOST_ROUNDS>,
    pongs: ArrayVec<Pong, MOST_PONGS>,
    /// The newest questions that have left, by round and number, and when.
    left: ArrayVec<((u16, u16), Instant), MOST_PONGS>,
}

/// Questions whose answers are waited for together.
struct Round {
    identifier: u16,
    /// Of which so many were chosen for a slot.
    left: u64,
}

impl Icmp {
    pub fn new(pool: Pool) -> Self {
        let (asking, pongs, left) = (ArrayVec::new(), ArrayVec::new(), ArrayVec::new());
        Self { pool, output: Output::default(), asking, pongs, left }
    }

    fn round(&mut self, identifier: u16) -> Option<&mut Round> {
        self.asking.iter_mut().find(|round| round.identifier == identifier)
    }
}

impl Stack {
    pub(super) fn icmp_input(
        &mut self,
        rx: Option<Instant>,
        header: &Header,
        message: &[u8],
        exit: &mut dyn Exit,
    ) -> Result<(), Refusal> {
        let (echo, data) = icmpv4::parse(message)?;
        match echo.kind() {
            // One question to all of a network would be answered by all at once.
            Kind::Request if self.routes.own().is_broadcast(header.destination()) => {
                Err(Refusal::IcmpBroadcast)
            }
            Kind::Request => {
                let options = Options { tos: header.tos(), ..OPTIONS };
                let reply = Echo::new(Kind::Reply, echo.identifier(), echo.sequence(), data);
                let ends = (header.destination(), header.source());
                let answered = self.send_echo(ends, reply, data, options, exit);
                match answered {
                    Ok(()) => self.counters.echoes_answered += 1,
                    Err(SocketError::NoRoute(_)) => return Err(Refusal::NoRoute),
                    Err(SocketError::NoBuffers { .. }) => return Err(Refusal::PoolEmpty),
                    Err(_) => return Err(Refusal::NotQueued),
                }
                Ok(())
            }
            Kind::Reply => {
                let from = header.source();
                let (identifier, sequence) = (echo.identifier(), echo.sequence());
                let waited = self.icmp.round(identifier).is_some();
                let which = (identifier, sequence);
                let left = self.icmp.left.iter().rev().find(|(of, _)| *of == which).map(|(_, at)| *at);
                let pong = Pong { from, identifier, sequence, len: data.len(), rx, left };
                if !waited {
                    return Err(Refusal::IcmpUnexpected);
                }
                self.icmp.pongs.try_push(pong).map_err(|_| Refusal::IcmpBacklog)
            }
        }
    }

    /// Asks for an echo. Its answer is waited for until eight rounds with other identifiers have begun.
    pub fn ask_echo(
        &mut self,
        to: Ipv4Addr,
        (identifier, sequence): (u16, u16),
        data: &[u8],
        options: Options,
        exit: &mut dyn Exit,
    ) -> Result<(), SocketError> {
        if self.icmp.round(identifier).is_none() {
            let asking = &mut self.icmp.asking;
            if asking.is_full() {
                asking.remove(0);
            }
            asking.push(Round { identifier, left: 0 });
        }
        let echo = Echo::new(Kind::Request, identifier, sequence, data);
        self.send_echo((Ipv4Addr::UNSPECIFIED, to), echo, data, options, exit)
    }

    /// The oldest answer that nobody has looked at.
    pub fn next_pong(&mut self) -> Option<Pong> {
        self.icmp.pongs.pop_at(0)
    }

    /// How many questions of a round were chosen for a slot: none of one that is not waited for any more.
    pub fn echoes_left(&self, identifier: u16) -> u64 {
        let mut rounds = self.icmp.asking.iter();
        rounds.find(|round| round.identifier == identifier).map_or(0, |round| round.left)
    }

    /// A frame was chosen for a slot that begins then: one that asks for an echo has waited until now.
    pub fn leaves(&mut self, begin: Instant, frame: &[u8]) {
        if self.icmp.asking.is_empty() {
            return;
        }
        let Some((link, packet)) = ethernet::Header::parse(frame) else { return };
        if link.ether_type() != EtherType::IPV4 {
            return;
        }
        let Ok((header, message)) = ipv4::parse(packet) else { return };
        if header.protocol() != Protocol::ICMP || header.is_fragment() {
            return;
        }
        let Ok((echo, _)) = icmpv4::parse(message) else { return };
        if echo.kind() != Kind::Request {
            return;
        }
        let which = (echo.identifier(), echo.sequence());
        // One that missed its slot leaves again.
        let is_first = !self.icmp.left.iter().any(|(of, _)| *of == which);
        let Some(round) = self.icmp.round(echo.identifier()) else { return };
        round.left += u64::from(is_first);
        let left = &mut self.icmp.left;
        left.retain(|(of, _)| *of != which);
        if left.is_full() {
            left.remove(0);
        }
        left.push((which, begin));
    }

    fn send_echo(
        &mut self,
        (from, to): (Ipv4Addr, Ipv4Addr),
        echo: Echo,
        data: &[u8],
        options: Options,
        exit: &mut dyn Exit,
    ) -> Result<(), SocketError> {
        let route = Route::find(&self.routes, to, false)?.for_who_hears_at(from);
        let Self { icmp, .. } = self;
        let parts = &[echo.as_bytes(), data];
        let content = Content { protocol: Protocol::ICMP, parts, ends_in_times: false };
        let frames = icmp.output.datagram(&route, options, &content, &icmp.pool, exit)?;
        self.dispatch(&route, options, frames, exit)
    }
}
