//! Who has which address: said by hand, or asked for by hand. Nothing is asked by itself, and nobody is believed who was
//! not asked.
//!
//! ```text
//! request for our address ─► answered; its sender is learned, unless somebody said otherwise by hand
//! reply to what was asked ─► learned
//! any other               ─► refused; one that contradicts the table, or claims our own address, counts as a conflict
//! ```

use core::net::Ipv4Addr;

use arrayvec::ArrayVec;

use super::icmp::OPTIONS;
use super::route::{HostRoute, Origin, RouteError};
use super::{Exit, Stack};
use crate::buf::Pool;
use crate::counters::Refusal;
use crate::socket::SocketError;
use crate::time::{Instant, Span};
use crate::wire::arp::{self, Operation, Packet};
use crate::wire::ethernet::{Address, EtherType, HEADER_LEN, Header, MIN_FRAME};
use zerocopy::IntoBytes;

use super::output::no_buffers;

/// Buffers for requests and replies: RTnet's share of its global pool for one interface.
pub const DEFAULT_BUFFERS: usize = 16;
/// Addresses that are asked for at a time; the oldest question is forgotten for one more.
const MOST_QUESTIONS: usize = 32;
/// How long an answer is waited for.
const ANSWER_WITHIN: Span = Span::from_millis(10_000);

/// What a station has for address resolution.
pub(super) struct Arp {
    pub pool: Pool,
    questions: ArrayVec<Question, MOST_QUESTIONS>,
}

struct Question {
    ip: Ipv4Addr,
    asked: Instant,
}

impl Arp {
    pub fn new(pool: Pool) -> Self {
        Self { pool, questions: ArrayVec::new() }
    }

    /// Whether `ip` was asked for: a question is answered once.
    fn was_asked(&mut self, ip: Ipv4Addr, now: Instant) -> bool {
        self.questions.retain(|question| now - question.asked <= ANSWER_WITHIN);
        let place = self.questions.iter().position(|question| question.ip == ip);
        place.map(|place| self.questions.remove(place)).is_some()
    }
}

impl Stack {
    /// Asks who has an address. The answer becomes a host route.
    pub fn solicit(&mut self, ip: Ipv4Addr, exit: &mut dyn Exit) -> Result<(), SocketError> {
        let own = self.routes.own();
        let packet = Packet::request(own.address, own.ip, ip);
        self.send_arp(Address::BROADCAST, packet, exit)?;
        let questions = &mut self.arp.questions;
        questions.retain(|question| question.ip != ip);
        if questions.is_full() {
            questions.remove(0);
        }
        questions.push(Question { ip, asked: self.now });
        Ok(())
    }

    /// Whether this address was asked for, and no answer has come yet.
    pub fn is_asked_for(&self, ip: Ipv4Addr) -> bool {
        self.arp.questions.iter().any(|question| question.ip == ip)
    }

    pub(super) fn arp_input(
        &mut self,
        header: &Header,
        payload: &[u8],
        exit: &mut dyn Exit,
    ) -> Result<(), Refusal> {
        let packet = arp::parse(payload)?;
        let own = *self.routes.own();
        let (sender, ip) = (packet.sender(), packet.sender_ip());
        if sender != header.source || sender.is_group() {
            return Err(Refusal::ForgedSource);
        }
        if ip == own.ip {
            self.counters.arp_conflicts += 1;
            return Err(Refusal::ArpConflict);
        }
        let is_question = packet.operation() == Operation::Request;
        if packet.target_ip() != own.ip || ip == packet.target_ip() {
            return Err(self.unasked(ip, sender, Refusal::ArpNotForUs));
        }
        if !is_question && !self.arp.was_asked(ip, self.now) {
            return Err(self.unasked(ip, sender, Refusal::ArpUnsolicited));
        }
        // Who only looks whether an address is free has none yet.
        let learned = if is_question && ip.is_unspecified() {
            Ok(())
        } else {
            let origin = if is_question { Origin::Learned } else { Origin::Solicited };
            self.learn(HostRoute { ip, address: sender, origin })
        };
        if is_question {
            let reply = Packet::reply_to(packet, own.address);
            self.send_arp(sender, reply, exit).map_err(|error| match error {
                SocketError::NoBuffers { .. } => Refusal::PoolEmpty,
                _ => Refusal::NotQueued,
            })?;
        }
        learned
    }

    fn learn(&mut self, route: HostRoute) -> Result<(), Refusal> {
        let there = self.routes.host(route.ip).map(|there| there.address);
        match self.routes.add_host(route) {
            Ok(()) => {
                self.counters.arp_changed += u64::from(there.is_some_and(|there| there != route.address));
                Ok(())
            }
            Err(RouteError::IsStatic(_)) if there == Some(route.address) => Ok(()),
            Err(RouteError::IsStatic(_)) => {
                self.counters.arp_conflicts += 1;
                Err(Refusal::ArpConflict)
            }
            Err(RouteError::TableFull { .. }) => Err(Refusal::RoutesFull),
            Err(_) => Err(Refusal::ForgedSource),
        }
    }

    /// Nothing is learned from it; but if it says something else than the table, somebody should know.
    fn unasked(&mut self, ip: Ipv4Addr, sender: Address, reason: Refusal) -> Refusal {
        let contradicts = self.routes.host(ip).is_some_and(|there| there.address != sender);
        self.counters.arp_conflicts += u64::from(contradicts);
        if contradicts { Refusal::ArpConflict } else { reason }
    }

    fn send_arp(&mut self, to: Address, packet: Packet, exit: &mut dyn Exit) -> Result<(), SocketError> {
        let header = Header::new(to, self.routes.own().address, EtherType::ARP);
        let Some(mut frame) = self.arp.pool.take() else { return Err(no_buffers(1, &self.arp.pool)) };
        let end = HEADER_LEN + packet.as_bytes().len();
        frame.room_mut()[..HEADER_LEN].copy_from_slice(header.as_bytes());
        frame.room_mut()[HEADER_LEN..end].copy_from_slice(packet.as_bytes());
        frame.set_len(end);
        frame.pad_to(MIN_FRAME);
        exit.send(frame, OPTIONS.priority, OPTIONS.channel).map_err(|(error, _)| error.into())
    }
}
