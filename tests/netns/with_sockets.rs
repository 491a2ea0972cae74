//! A station with sockets on a real port, with a program in its thread, and a host beside it.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;

use crossbeam::queue::ArrayQueue;
use rtmac::tdma::DEFAULT_LEAD;
use rtnet::buf::Pool;
use rtnet::clock::EmulatedClock;
use rtnet::discipline::Discipline;
use rtnet::ip::route::{HostRoute, Interface as Place, Origin};
use rtnet::ip::{Stack, StackConfig};
use rtnet::live::clock::monotonic;
use rtnet::live::interface::Interface;
use rtnet::live::{Data, Driver, DriverConfig, GuardMode, Port, Snapshot};
use rtnet::socket::{Access, Flags, Program, Sender, Socket, SocketId};
use rtnet::station::Station;
use rtnet::wire::ethernet::Address;
use tools::lab::namespace::{Namespace, Segment};
use vnic::netlink::Links;

use crate::live::as_a_station;

pub const STATION: [u8; 6] = [2, 0, 0, 0, 0, 1];
pub const HOST: [u8; 6] = [2, 0, 0, 0, 0, 2];
pub const STATION_IP: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
pub const HOST_IP: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 2);
pub const PORT: u16 = 7;
/// Two datagrams of the longest on their way, one in each direction, and some more.
const BUFFERS: usize = 128;

/// Sends everything back to where it came from.
pub struct Echo {
    unopened: Option<Box<Socket>>,
    socket: Option<SocketId>,
    room: Vec<u8>,
    heard: Arc<Heard>,
}

/// What the program has heard.
#[derive(Default)]
pub struct Heard {
    pub datagrams: AtomicU64,
    /// When the last one was there for it, CLOCK_MONOTONIC.
    pub last: AtomicU64,
}

impl Echo {
    fn new(heard: Arc<Heard>) -> Self {
        let unopened = Some(Socket::udp(Arc::new(Pool::new(BUFFERS))));
        Self { unopened, socket: None, room: vec![0; 65_536], heard }
    }
}

impl Program for Echo {
    fn run(&mut self, sockets: &mut Access<'_>) {
        if let Some(unopened) = self.unopened.take() {
            let id = sockets.open(unopened).map_err(|(error, _)| error).unwrap();
            sockets.bind(id, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT)).unwrap();
            self.socket = Some(id);
        }
        let Some(id) = self.socket else { return };
        while let Ok(received) = sockets.receive(id, &mut self.room, Flags::NONE) {
            self.heard.last.store(monotonic(), Ordering::Relaxed);
            self.heard.datagrams.fetch_add(1, Ordering::Release);
            let Sender::Udp(from) = received.from else { continue };
            // Whoever knows nothing of times hears the same.
            let now = sockets.time().to_global(sockets.now());
            // Who asks for more at once than fits asks again.
            let _ = sockets.send_sent_at(id, &self.room[..received.len], Some(from), Flags::NONE, now);
        }
    }
}

/// A station with an [`Echo`], and the namespace of a host on the same medium. Dropping it ends the station.
pub struct Pair<D: Discipline> {
    pub host: Namespace,
    pub heard: Arc<Heard>,
    pub snapshots: Arc<ArrayQueue<Snapshot<D::Status>>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    medium: (Namespace, Segment),
}

impl<D: Discipline + 'static> Pair<D> {
    pub fn start(discipline: impl FnOnce(Address) -> D) -> Self
    where
        D::Status: Send,
    {
        let (here, host) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&here, "port0", "rt0", STATION).unwrap();
        segment.attach(&host, "port1", "rt0", HOST).unwrap();
        let clock = EmulatedClock::default();
        let spin = DEFAULT_LEAD.nanos() as u64;
        let open = || Port::open(&Interface::find("rt0").unwrap(), Data::All, clock, spin, GuardMode::Auto);
        let port = here.run(open).unwrap().unwrap();
        let heard = Arc::<Heard>::default();
        let place = Place { address: Address(STATION), ip: STATION_IP, prefix: 24 };
        let mut stack = Stack::new(StackConfig::new(place), vec![Box::new(Echo::new(heard.clone()))]);
        let route = HostRoute { ip: HOST_IP, address: Address(HOST), origin: Origin::Static };
        stack.routes_mut().add_host(route).unwrap();
        let station = Station::new(discipline(Address(STATION)), Vec::new()).with_stack(stack);
        let stop = Arc::new(AtomicBool::new(false));
        let config = DriverConfig { stop: stop.clone(), sample_time: false, changed: None };
        let mut driver = Driver::new(station, port, config);
        let snapshots = driver.snapshots();
        let thread = Some(as_a_station(move || driver.run()));
        Self { host, heard, snapshots, stop, thread, medium: (here, segment) }
    }

    /// Lets all interfaces of the medium take frames with so many bytes behind their headers.
    pub fn set_mtu(&self, mtu: usize) {
        let (here, segment) = &self.medium;
        let places = [
            (here, "rt0"),
            (&self.host, "rt0"),
            (segment.namespace(), "port0"),
            (segment.namespace(), "port1"),
        ];
        for (namespace, name) in places {
            let set = move || {
                let mut links = Links::open()?;
                let index = links.find(name)?.map_or(0, |link| link.index);
                links.set_mtu(index, mtu)
            };
            namespace.run(set).unwrap().unwrap();
        }
    }
}

impl<D: Discipline> Drop for Pair<D> {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let ended = thread.join();
            assert!(ended.is_ok() || std::thread::panicking(), "the station panicked");
        }
    }
}
