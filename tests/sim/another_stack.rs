//! An independent stack (smoltcp) and ours understand each other: datagrams, fragments, echoes, addresses.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use rtnet::at_once::DEFAULT_ASK_EVERY;
use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{Discipline, Opportunity, Outlet, Service, TimeView};
use rtnet::ip::Stack;
use rtnet::queue::Priority;
use rtnet::sim::{Host, Latency, Network};
use rtnet::socket::{Flags, Options, SocketId};
use rtnet::station::Station;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::{EtherType, HEADER_LEN, MIN_FRAME, MTU};
use rtnet::{Direct, ip::Exit};
use smoltcp::iface::{Config, Interface, SocketHandle, SocketSet};
use smoltcp::phy::{self, Device, DeviceCapabilities, Medium};
use smoltcp::socket::{icmp, udp};
use smoltcp::time::Instant as SmolInstant;
use smoltcp::wire::{
    EthernetAddress, Icmpv4Packet, Icmpv4Repr, IpAddress, IpCidr, IpEndpoint, IpListenEndpoint,
};
use tests::rings::in_a_ring;
use tests::stacks::{
    address, assert_pools_full, at, bytes, in_slots, ip, network, slot, stack, strange_stack, udp as open,
};

/// Who is smoltcp.
const OTHER: usize = 1;
const PORT: u16 = 2_000;
/// The longest datagram: its buffers for fragments hold 65 536 bytes, the most that it can be compiled for.
const LONGEST: usize = 65_507;
/// Buffers for the longest datagram, and some more.
const BUFFERS: usize = 64;

/// What its interface has heard and is to send.
#[derive(Default)]
struct Card {
    heard: VecDeque<Vec<u8>>,
    to_send: VecDeque<Vec<u8>>,
    mtu: usize,
}

struct Heard(Vec<u8>);

struct Sends<'a>(&'a mut VecDeque<Vec<u8>>);

impl phy::RxToken for Heard {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, read: F) -> R {
        read(&self.0)
    }
}

impl phy::TxToken for Sends<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, len: usize, write: F) -> R {
        let mut frame = vec![0; len];
        let result = write(&mut frame);
        self.0.push_back(frame);
        result
    }
}

impl Device for Card {
    type RxToken<'a> = Heard;
    type TxToken<'a> = Sends<'a>;

    fn receive(&mut self, _: SmolInstant) -> Option<(Heard, Sends<'_>)> {
        self.heard.pop_front().map(|frame| (Heard(frame), Sends(&mut self.to_send)))
    }
    fn transmit(&mut self, _: SmolInstant) -> Option<Sends<'_>> {
        Some(Sends(&mut self.to_send))
    }
    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = HEADER_LEN + self.mtu;
        capabilities
    }
}

/// All of it, with one socket of each kind.
struct Other {
    interface: Interface,
    card: Card,
    sockets: SocketSet<'static>,
    udp: SocketHandle,
    icmp: SocketHandle,
}

impl Other {
    fn new(mtu: usize) -> Self {
        let mut card = Card { mtu, ..Card::default() };
        let hardware = EthernetAddress(address(OTHER).0);
        let mut interface = Interface::new(Config::new(hardware.into()), &mut card, SmolInstant::ZERO);
        interface.update_ip_addrs(|own| own.push(IpCidr::new(ip(OTHER).into(), 24)).unwrap());
        let mut sockets = SocketSet::new(Vec::new());
        let room = || udp::PacketBuffer::new(vec![udp::PacketMetadata::EMPTY; 8], vec![0; 2 * LONGEST]);
        let mut udp = udp::Socket::new(room(), room());
        udp.bind(IpListenEndpoint::from(PORT)).unwrap();
        let room = || icmp::PacketBuffer::new(vec![icmp::PacketMetadata::EMPTY; 8], vec![0; 4_096]);
        let mut icmp = icmp::Socket::new(room(), room());
        icmp.bind(icmp::Endpoint::Ident(7)).unwrap();
        let (udp, icmp) = (sockets.add(udp), sockets.add(icmp));
        Self { interface, card, sockets, udp, icmp }
    }

    fn poll(&mut self, now: Instant) {
        let now = SmolInstant::from_micros(now.nanos() as i64 / 1_000);
        self.interface.poll(now, &mut self.card, &mut self.sockets);
    }

    fn udp(&mut self) -> &mut udp::Socket<'static> {
        self.sockets.get_mut(self.udp)
    }

    fn icmp(&mut self) -> &mut icmp::Socket<'static> {
        self.sockets.get_mut(self.icmp)
    }

    fn send(&mut self, data: &[u8]) {
        self.udp().send_slice(data, IpEndpoint::new(ip(0).into(), PORT)).unwrap();
    }

    fn receive(&mut self) -> Option<Vec<u8>> {
        self.udp().recv().ok().map(|(data, from)| {
            assert_eq!(from.endpoint, IpEndpoint::new(ip(0).into(), PORT));
            data.to_vec()
        })
    }
}

/// In the place of a station's own stack.
struct Instead(Arc<Mutex<Other>>, Pool);

impl Service for Instead {
    fn claims(&self, ether_type: EtherType) -> bool {
        [EtherType::IPV4, EtherType::ARP].contains(&ether_type)
    }
    fn on_frame(&mut self, _: Option<Instant>, frame: Buf) -> Result<(), Refusal> {
        self.0.lock().unwrap().card.heard.push_back(frame.to_vec());
        Ok(())
    }
    fn poll(&mut self, slot: &Opportunity, out: &mut Outlet<'_>) {
        let mut other = self.0.lock().unwrap();
        other.poll(slot.begin);
        while let Some(bytes) = other.card.to_send.pop_front() {
            let mut frame = self.1.take().expect("there are as many as frames of the longest datagram");
            frame.fill(&bytes);
            frame.pad_to(MIN_FRAME);
            out(frame, Priority::DEFAULT, slot.channel).expect("it fits");
        }
    }
}

/// Ours as station 0, the other as station 1.
struct Pair<D: Discipline> {
    network: Network<D>,
    other: Arc<Mutex<Other>>,
    socket: SocketId,
}

impl<D: Discipline> Pair<D> {
    fn new(mut stack: Stack, mtu: usize, host: Host, disciplines: [D; 2]) -> Self {
        let socket = open(&mut stack, PORT, BUFFERS);
        let other = Arc::new(Mutex::new(Other::new(mtu)));
        let [ours, others] = disciplines;
        let instead = Instead(other.clone(), Pool::new(BUFFERS));
        let others = Station::new(others, vec![Box::new(instead)]);
        let network = network(vec![Station::new(ours, Vec::new()).with_stack(stack), others], host);
        let mut pair = Self { network, other, socket };
        pair.runs(600);
        pair
    }

    fn runs(&mut self, millis: i64) {
        self.network.run_until(self.network.now() + Span::from_millis(millis).nanos() as u64);
    }

    fn other(&self) -> std::sync::MutexGuard<'_, Other> {
        self.other.lock().unwrap()
    }

    fn ours(&mut self) -> (&mut Stack, &mut dyn Exit) {
        self.network.member_mut(0).station.stack_mut().unwrap()
    }

    fn send(&mut self, data: &[u8]) {
        let socket = self.socket;
        let (stack, exit) = self.ours();
        stack.send_to(socket, data, Some(at(OTHER, PORT)), Flags::NONE, exit).unwrap();
    }

    fn receive(&mut self) -> Option<Vec<u8>> {
        let (socket, mut room) = (self.socket, vec![0; LONGEST + 1]);
        let (stack, _) = self.ours();
        let received = stack.receive(socket, &mut room, Flags::NONE, &TimeView::default()).ok()?;
        room.truncate(received.len);
        Some(room)
    }

    fn check_both_ways(&mut self, len: usize, millis: i64) {
        self.send(&bytes(len));
        self.runs(millis);
        assert!(self.other().receive() == Some(bytes(len)), "{len} bytes to the other");
        self.other().send(&bytes(len));
        self.runs(millis);
        assert!(self.receive() == Some(bytes(len)), "{len} bytes from the other");
    }

    fn check_clean(&self) {
        let station = &self.network.member(0).station;
        assert_eq!(station.refusals().total(), 0);
        let stack = station.stack().unwrap();
        assert_eq!(stack.counters().checksums_tolerated, 0);
        assert_pools_full(stack, "ours");
    }
}

/// Frames leave one behind the other: no receiver has room for the 45 of the longest datagram at once.
fn without_slots(stack: Stack) -> Pair<Direct> {
    let send = Latency::Constant(Span::from_micros(12));
    Pair::new(stack, MTU, Host { send, ..Host::IDEAL }, [0, 1].map(|_| Direct::new(DEFAULT_ASK_EVERY)))
}

#[test]
fn datagrams_of_any_length_go_both_ways_in_as_many_fragments_as_they_take() {
    let mut pair = without_slots(stack(0, Vec::new()));
    for len in [0, 1, 18, 19, 1_472, 1_473, 1_480, 2_952, 2_953, 10_000, 60_000, LONGEST - 1, LONGEST] {
        // It sends a fragment each time it is asked.
        pair.check_both_ways(len, 60);
    }
    pair.check_clean();
}

#[test]
fn datagrams_of_any_length_go_both_ways_in_a_ring() {
    let disciplines = [0, OTHER].map(|id| in_a_ring(id, &[0, OTHER]));
    let mut pair = Pair::new(stack(0, Vec::new()), MTU, Host::IDEAL, disciplines);
    for len in [0, 18, 1_472, 1_473, 10_000, LONGEST] {
        pair.check_both_ways(len, 60);
    }
    pair.check_clean();
}

#[test]
fn datagrams_in_fragments_go_both_ways_in_slots_of_any_size() {
    for size in [1_500, 576, 128] {
        let slots = [200, 500].map(|micros| rtmac::tdma::SlotConfig { size, ..slot(0, micros) });
        let disciplines = [0, 1].map(|id| in_slots(id, &slots[id..=id]));
        // It fills its frames also where the parts are then no multiples of eight, as fragments are.
        let mtu = 20 + ((size - 20) & !7);
        let mut pair = Pair::new(stack(0, Vec::new()), mtu, Host::IDEAL, disciplines);
        for len in [1, size - 28, size - 27, 5_000] {
            pair.check_both_ways(len, 100);
        }
        pair.check_clean();
    }
}

#[test]
fn each_answers_the_others_echoes() {
    let mut pair = without_slots(stack(0, Vec::new()));
    // It does not answer whose address it does not know, but asks for that.
    let (stack, exit) = pair.ours();
    stack.solicit(ip(OTHER), exit).unwrap();
    pair.runs(3);
    for (sequence, len) in [(1, 0), (2, 8), (3, 56), (4, 1_472)] {
        let (stack, exit) = pair.ours();
        stack.ask_echo(ip(OTHER), (9, sequence), &bytes(len), Options::default(), exit).unwrap();
        pair.runs(3);
        let pong = pair.ours().0.next_pong().expect("it is answered");
        assert_eq!((pong.from, pong.sequence, pong.len), (ip(OTHER), sequence, len));

        let data = bytes(len);
        let asked = Icmpv4Repr::EchoRequest { ident: 7, seq_no: sequence, data: &data };
        {
            let mut other = pair.other();
            let buffer = other.icmp().send(asked.buffer_len(), IpAddress::from(ip(0))).unwrap();
            asked.emit(&mut Icmpv4Packet::new_unchecked(buffer), &Default::default());
        }
        pair.runs(3);
        let mut other = pair.other();
        let (answer, from) = other.icmp().recv().expect("it is answered");
        assert_eq!(from, IpAddress::from(ip(0)));
        let answer = Icmpv4Packet::new_checked(answer).unwrap();
        let answer = Icmpv4Repr::parse(&answer, &Default::default()).unwrap();
        assert_eq!(answer, Icmpv4Repr::EchoReply { ident: 7, seq_no: sequence, data: &data });
    }
    assert_eq!(pair.ours().0.counters().echoes_answered, 4);
    pair.check_clean();
}

#[test]
fn each_learns_the_others_address_when_it_asks() {
    // Ours knows nobody, and asks.
    let mut pair = without_slots(strange_stack(0, Vec::new()));
    let (stack, exit) = pair.ours();
    assert!(stack.routes().host(ip(OTHER)).is_none());
    stack.solicit(ip(OTHER), exit).unwrap();
    pair.runs(3);
    assert_eq!(pair.ours().0.routes().host(ip(OTHER)).unwrap().address, address(OTHER));
    pair.check_both_ways(100, 3);

    // The other knows nobody, and asks: what it was told to send leaves when it is answered, and who was asked has learned, too.
    let mut pair = without_slots(strange_stack(0, Vec::new()));
    pair.other().send(b"who are you?");
    pair.runs(2_000);
    assert_eq!(pair.receive().as_deref(), Some(&b"who are you?"[..]));
    pair.send(b"a stack");
    pair.runs(3);
    assert_eq!(pair.other().receive().as_deref(), Some(&b"a stack"[..]));
    pair.check_clean();
}
