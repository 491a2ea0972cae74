//! From a frame to a datagram, and to whom it is for.

use core::net::SocketAddrV4;

use super::collect::{Complete, Key};
use super::{Exit, Refused, Stack};
use crate::buf::{Buf, Chain, hand_over};
use crate::counters::Refusal;
use crate::socket::{Datagram, Sender, SocketId};
use crate::time::Instant;
use crate::wire::ethernet::{EtherType, HEADER_LEN as LINK_HEADER, Header as LinkHeader};
use crate::wire::ipv4::{self, Header, Protocol};
use crate::wire::udp;
use crate::wire::udp_options::{self, Times};

/// Of a datagram in fragments, more than this behind its end is not looked at.
const SURPLUS_AT_MOST: usize = 128;

impl Stack {
    /// A frame that neither the discipline nor a service claims. What it refuses the station counts, or has somebody else for.
    pub fn on_frame(&mut self, rx: Option<Instant>, frame: Buf, exit: &mut dyn Exit) -> Result<(), Refused> {
        self.now = rx.unwrap_or(self.now);
        let (&header, _) = LinkHeader::parse(&frame).ok_or(Refusal::Runt)?;
        let is_ours = matches!(header.ether_type(), EtherType::IPV4 | EtherType::ARP);
        if is_ours {
            // Whatever becomes of it: packet sockets that hear all are for seeing just that.
            self.overhear(rx, &frame);
        }
        let result = match header.ether_type() {
            _ if is_ours && header.source.is_group() => Err(Refusal::ForgedSource.into()),
            EtherType::IPV4 => self.medium_input(rx, frame, exit),
            EtherType::ARP => Ok(self.arp_input(&header, &frame[LINK_HEADER..], exit)?),
            _ => Ok(self.packet_input(rx, frame)?),
        };
        self.run_programs(exit);
        result
    }

    /// Nobody on the medium has this station's address, or one of a group.
    fn medium_input(&mut self, rx: Option<Instant>, frame: Buf, exit: &mut dyn Exit) -> Result<(), Refused> {
        let (header, _) = ipv4::parse(&frame[LINK_HEADER..])?;
        let source = header.source();
        let own = self.routes.own();
        let forged =
            own.takes(source) || source.is_multicast() || source.is_loopback() || source.is_unspecified();
        if forged {
            return Err(Refusal::ForgedSource.into());
        }
        if !own.takes(header.destination()) {
            return Err(Refusal::ForeignAddress.into());
        }
        self.ip_input(rx, frame, exit)
    }

    /// An IP packet for this station, behind its Ethernet header.
    pub(crate) fn ip_input(
        &mut self,
        rx: Option<Instant>,
        mut frame: Buf,
        exit: &mut dyn Exit,
    ) -> Result<(), Refused> {
        let (&header, payload) = ipv4::parse(&frame[LINK_HEADER..])?;
        let content = LINK_HEADER + header.header_len();
        let len = payload.len();
        frame.trim_front(content);
        frame.truncate(len);
        match header.protocol() {
            Protocol::UDP if header.is_fragment() => self.fragment_input(rx, &header, frame),
            Protocol::UDP => self.udp_input(rx, &header, frame),
            Protocol::ICMP if header.is_fragment() => Err(Refused::unwanted(frame, Refusal::IcmpFragmented)),
            Protocol::ICMP => self.icmp_input(rx, &header, &frame, exit).map_err(|why| match why {
                Refusal::IcmpType | Refusal::IcmpUnexpected => Refused::unwanted(frame, why),
                why => why.into(),
            }),
            _ => Err(Refused::unwanted(frame, Refusal::NoProtocol)),
        }
    }

    /// A whole datagram in one packet.
    fn udp_input(&mut self, rx: Option<Instant>, header: &Header, frame: Buf) -> Result<(), Refused> {
        let (head, _) = udp::parse(&frame)?;
        let len = usize::from(head.len());
        if len > frame.len() {
            return Err(Refusal::UdpLength.into());
        }
        let (from, to) = ends(header, head);
        let Some(id) = self.udp_socket(from, to) else {
            return Err(Refused::unwanted(frame, Refusal::NoSocket));
        };
        if head.checksum() != 0 {
            let mut sum = udp::pseudo_header(header.source(), header.destination(), head.len());
            sum.add(&frame[..len]);
            if sum.finish() != 0 {
                return Err(Refusal::UdpChecksum.into());
            }
        }
        let times = self.times_behind(head, &frame[len..]);
        let socket = self.sockets.get_mut(id).map_err(|_| Refusal::NoSocket)?;
        match hand_over(frame, &socket.pool) {
            Ok(kept) => self.deliver(id, Chain::of(kept), len, from, rx, times),
            Err(_) => {
                socket.counters.dropped += 1;
                return Err(Refusal::PoolEmpty.into());
            }
        }
        Ok(())
    }

    /// A part of a datagram: its first fragment says for which socket.
    fn fragment_input(&mut self, rx: Option<Instant>, header: &Header, frame: Buf) -> Result<(), Refused> {
        let (key, now) = (Key::of(header), self.now);
        if header.offset() == 0 {
            let (head, _) = udp::parse(&frame)?;
            let (from, to) = ends(header, head);
            let Some(id) = self.udp_socket(from, to) else {
                return Err(Refused::unwanted(frame, Refusal::NoSocket));
            };
            let socket = self.sockets.get_mut(id).map_err(|_| Refusal::NoSocket)?;
            let begun = self.collectors.begin(key, id, frame, &socket.pool, now);
            return Ok(begun.inspect_err(|&why| self.count_dropped(id, why))?);
        }
        let (offset, is_last) = (usize::from(header.offset()), !header.more_fragments());
        let (sockets, mut of) = (&self.sockets, SocketId::NOBODY);
        let pool = |id: SocketId| {
            of = id;
            sockets.get(id).ok().map(|socket| &*socket.pool)
        };
        let gone_on = self.collectors.go_on(key, offset, is_last, frame, now, pool);
        match gone_on.inspect_err(|refused| self.count_dropped(of, refused.why))? {
            Some(complete) => Ok(self.complete(rx, header, complete)?),
            None => Ok(()),
        }
    }

    /// A datagram that found none of its socket's buffers free is told of there, too.
    fn count_dropped(&mut self, id: SocketId, why: Refusal) {
        if let (Refusal::PoolEmpty, Ok(socket)) = (why, self.sockets.get_mut(id)) {
            socket.counters.dropped += 1;
        }
    }

    fn complete(&mut self, rx: Option<Instant>, header: &Header, complete: Complete) -> Result<(), Refusal> {
        let Complete { socket, chain } = complete;
        let first = chain.parts().next().ok_or(Refusal::Truncated)?;
        let (head, _) = udp::parse(first)?;
        let (len, whole) = (usize::from(head.len()), chain.len());
        if len > whole {
            return Err(Refusal::UdpLength);
        }
        if head.checksum() != 0 {
            let mut sum = udp::pseudo_header(header.source(), header.destination(), head.len());
            let mut left = len;
            for part in chain.parts() {
                let part = &part[..left.min(part.len())];
                sum.add(part);
                left -= part.len();
            }
            let is_wrong = sum.finish() != 0;
            // Whose checksums are wrong knows of no options: what is behind the end then is there since the length is wrong.
            if is_wrong && (self.config.fragment_checksums || len < whole) {
                return Err(Refusal::UdpChecksum);
            }
            self.counters.checksums_tolerated += u64::from(is_wrong);
        }
        let (from, _) = ends(header, head);
        let mut room = [0; SURPLUS_AT_MOST];
        let times = match room.get_mut(..whole - len) {
            Some(surplus) => {
                chain.copy_to(len, surplus);
                self.times_behind(head, surplus)
            }
            None => None,
        };
        self.deliver(socket, chain, len, from, rx, times);
        Ok(())
    }

    fn udp_socket(&self, from: SocketAddrV4, to: SocketAddrV4) -> Option<SocketId> {
        self.sockets.udp_for(self.routes.own(), from, to)
    }

    /// What is behind a datagram's end may say when it was where.
    fn times_behind(&mut self, head: &udp::Header, surplus: &[u8]) -> Option<Times> {
        if surplus.is_empty() {
            return None;
        }
        let times = udp_options::parse(head.len().into(), head.checksum() != 0, surplus);
        times.unwrap_or_else(|_| {
            self.counters.options_ignored += 1;
            None
        })
    }

    /// Leaves a datagram of `len` bytes, its header among them, where its program finds it.
    fn deliver(
        &mut self,
        id: SocketId,
        chain: Chain,
        len: usize,
        from: SocketAddrV4,
        rx: Option<Instant>,
        times: Option<Times>,
    ) {
        let Ok(socket) = self.sockets.get_mut(id) else { return };
        let (begin, from) = (udp::HEADER_LEN, Sender::Udp(from));
        socket.keep(Datagram { chain, begin, len: len - begin, from, rx, times });
        self.delivered = true;
    }
}

fn ends(header: &Header, head: &udp::Header) -> (SocketAddrV4, SocketAddrV4) {
    let from = SocketAddrV4::new(header.source(), head.source_port());
    (from, SocketAddrV4::new(header.destination(), head.destination_port()))
}
