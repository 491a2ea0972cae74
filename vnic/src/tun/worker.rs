//! The thread behind a VNIC's device: moves frames, and keeps the device as it is to be.

mod hold_back;
mod keep;

use std::io;
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::eventfd::EventFd;
use rtnet::buf::{Buf, Pool};
use rtnet::live::Tunnelled;
use rtnet::live::clock::monotonic;
use rtnet::wire::ethernet::EtherType;

use self::hold_back::HeldBack;
pub use self::hold_back::fed;
use super::aside::Aside;
use super::device::kind_of_packet;
use super::{Device, Handle, Mode, Options, Order, StartError, Status, Turns};
use crate::netlink::{Links, Watch};
use crate::peers::{Peers, Prefix};
use crate::proxy::PACKET;
use crate::resolve::{self, Asked};
use crate::tunnel::{FRAME, HEAD, Inner, Loss, Mouth};

/// Frames moved one way before the other one is looked at.
const AT_ONCE: usize = 32;
/// How often it is looked whether slots have changed, milliseconds.
const LOOK_EVERY: u16 = 100;
type Answer = Sender<Result<Status, String>>;

/// What is behind a device: to be run by a thread of its own.
pub struct Vnic {
    options: Options,
    mouth: Mouth,
    device: Option<Device>,
    /// Its name now, which others may change.
    name: String,
    index: u32,
    peers: Peers,
    /// Neighbours that were asked for lately.
    asked: Asked,
    links: Links,
    watch: Watch,
    /// Where what is tunnelled to the station comes; what is for a proxy comes by its mouth.
    socket: Option<Tunnelled>,
    _aside: Option<Aside>,
    /// Where one frame lies that has come.
    came: Buf,
    _room: Pool,
    /// What ends its waits.
    bell: Arc<EventFd>,
    /// What ends the station's.
    station: Arc<EventFd>,
    turns: Arc<Mutex<Turns>>,
    orders: Receiver<(Order, Answer)>,
    handle: Handle,
    stop: Arc<AtomicBool>,
    /// All buffers wait for their turns: the device is not read.
    is_full: bool,
    /// What Linux is held back by.
    held_back: HeldBack,
    mtu: usize,
    /// It may lack addresses of its own.
    owes_addresses: bool,
    /// It was down, or its MTU too small for IPv6.
    lost_ipv6: bool,
    /// Something was heard of it.
    is_changed: bool,
    /// What was said of a slot that is too small.
    small: Option<String>,
    looked: Instant,
    news: Option<String>,
    tell: Box<dyn Fn(&str) + Send>,
}

impl Vnic {
    /// Makes the device as it is to be, in the network namespace of the calling thread. `bell` is what wakes this,
    /// `station` what wakes the station; `tell` is told, a line each, what becomes of the device later.
    pub fn open(
        options: Options,
        mouth: Mouth,
        bells: [Arc<EventFd>; 2],
        stop: Arc<AtomicBool>,
        tell: Box<dyn Fn(&str) + Send>,
    ) -> Result<Self, StartError> {
        options.addresses.iter().try_for_each(|address| address.of_a_host().map(drop))?;
        let mut peers = Peers::new(options.interface.address, options.addresses.clone());
        options.peers.iter().try_for_each(|&peer| peers.add(peer))?;
        let refused = |error| StartError::Socket(options.interface.name.clone(), error);
        let mut links = Links::open()?;
        let (socket, aside) = match mouth.is_proxy() {
            true => (None, Some(stand_aside(&options, &mut links)?)),
            false => {
                let socket = Tunnelled::open(&options.interface, mouth.config().keeps_source);
                (Some(socket.map_err(refused)?), None)
            }
        };
        let (orders, told) = channel();
        let [bell, station] = bells;
        let turns = Arc::<Mutex<Turns>>::default();
        let room = Pool::new(1);
        let came = room.take().ok_or(io::ErrorKind::OutOfMemory).map_err(io::Error::from)?;
        let mut vnic = Self {
            mouth,
            device: None,
            name: options.name.clone().unwrap_or_default(),
            index: 0,
            peers,
            asked: Asked::default(),
            links,
            watch: Watch::open()?,
            socket,
            _aside: aside,
            came,
            _room: room,
            handle: Handle { orders, bell: bell.clone(), turns: turns.clone() },
            bell,
            station,
            turns,
            orders: told,
            stop,
            is_full: false,
            held_back: HeldBack::default(),
            mtu: 0,
            owes_addresses: false,
            lost_ipv6: false,
            is_changed: false,
            small: None,
            looked: Instant::now(),
            news: None,
            tell,
            options,
        };
        vnic.make()?;
        Ok(vnic)
    }

    /// How others reach it.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// The device's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Moves frames until it is to stop.
    pub fn run(mut self) {
        while !self.stop.load(Ordering::Relaxed) {
            self.wait();
            let _ = self.bell.read();
            while let Some(heard) = self.watch.next() {
                self.hear(&heard);
            }
            self.look();
            while let Ok((order, answer)) = self.orders.try_recv() {
                let done = self.obey(&order).and_then(|()| Ok(self.status()?));
                // Who has asked may have given up.
                let _ = answer.send(done.map_err(|refused| refused.to_string()));
            }
            self.take_in();
            self.send_out();
            self.follow();
        }
    }

    fn wait(&self) {
        // One that is not read need not be waited for.
        let device = self.device.as_ref().filter(|_| !self.is_full).map_or(self.bell.as_fd(), AsFd::as_fd);
        let socket = self.socket.as_ref().map_or(self.bell.as_fd(), AsFd::as_fd);
        let waited_for = [self.bell.as_fd(), self.watch.as_fd(), socket, device];
        let mut entries = waited_for.map(|fd| PollFd::new(fd, PollFlags::POLLIN));
        let most = if self.mouth.sleeps(true) { 0 } else { LOOK_EVERY };
        // Whatever it says, everything is looked at.
        let _ = poll(&mut entries, PollTimeout::from(most));
        self.mouth.sleeps(false);
    }

    /// Gives Linux what has come.
    fn take_in(&mut self) {
        for _ in 0..AT_ONCE {
            let given = match &self.socket {
                Some(socket) => {
                    let Some(is_whole) = socket.receive(&mut self.came) else { break };
                    self.mouth.count_received();
                    self.give_inner(is_whole)
                }
                None => {
                    let Some(frame) = self.mouth.received() else { break };
                    self.give(|device| device.write_packet(&frame[PACKET..]))
                }
            };
            if let Err(why) = given {
                self.mouth.lose(why);
            }
        }
    }

    fn give_inner(&mut self, is_whole: bool) -> Result<(), Loss> {
        let inner = Inner::of(&self.came).filter(|_| is_whole).ok_or(Loss::Truncated)?;
        if self.options.mode == Mode::Tun {
            if inner.kind() == EtherType::ARP {
                // An answer would draw packets here that nobody takes.
                self.device.as_ref().ok_or(Loss::DeviceDown)?;
                return resolve::hear(&self.mouth, &mut self.peers, &inner);
            }
            if inner.payload().first().and_then(|&first| kind_of_packet(first)) != Some(inner.kind()) {
                return Err(Loss::NotIp);
            }
        }
        self.give(|device| device.write(&inner))
    }

    fn give(&self, write: impl FnOnce(&Device) -> io::Result<()>) -> Result<(), Loss> {
        let device = self.device.as_ref().ok_or(Loss::DeviceDown)?;
        write(device).map_err(|error| match error.raw_os_error() {
            Some(libc::EIO | libc::EBADFD | libc::ENETDOWN) => Loss::DeviceDown,
            _ => Loss::DeviceRefused,
        })
    }

    /// Leaves what Linux sends where the station finds it.
    fn send_out(&mut self) {
        let Self { device, mouth, peers, asked, .. } = self;
        let Some(device) = device else { return };
        self.is_full = false;
        let mut is_gone = false;
        let is_proxy = mouth.is_proxy();
        let at = match device.mode() {
            Mode::Tap => FRAME,
            Mode::Tun if is_proxy => PACKET,
            Mode::Tun => HEAD,
        };
        for _ in 0..AT_ONCE {
            let taken = if is_proxy { mouth.take_for_packet() } else { mouth.take() };
            let Some(mut frame) = taken else {
                self.is_full = !mouth.wait_for_buffers();
                break;
            };
            match device.read(&mut frame, at) {
                Ok(Some(len)) => {
                    // What is lost is counted there.
                    let _ = match device.mode() {
                        Mode::Tap => mouth.send_frame(frame, len),
                        Mode::Tun if is_proxy => mouth.send_plain(frame, len),
                        Mode::Tun => Self::send_packet(mouth, peers, asked, frame, len),
                    };
                }
                Ok(None) => break,
                Err(error) => {
                    is_gone = error.raw_os_error() == Some(libc::EBADFD);
                    break;
                }
            }
        }
        if mouth.should_ring() {
            let _ = self.station.write(1);
        }
        if is_gone {
            self.lose_device();
        }
    }

    fn send_packet(
        mouth: &Mouth,
        peers: &Peers,
        asked: &mut Asked,
        mut packet: Buf,
        len: usize,
    ) -> Result<(), Loss> {
        let bytes = packet.room_mut().get(HEAD..HEAD + len);
        let Some(bytes) = bytes else { return Err(mouth.lose(Loss::TooLong)) };
        let Some(kind) = bytes.first().and_then(|&first| kind_of_packet(first)) else {
            return Err(mouth.lose(Loss::NotIp));
        };
        if let Some(station) = peers.station_of(bytes) {
            return mouth.send_packet(packet, len, station, kind);
        }
        if let Some(question) = peers.question(bytes)
            && asked.may_ask(question.target_ip(), rtnet::time::Instant::from_nanos(monotonic()))
        {
            // What is lost of it is counted there.
            let _ = resolve::ask(mouth, packet, &question);
        }
        Err(mouth.lose(Loss::NoStation))
    }
}

/// Linux has the station's address by the device alone.
fn stand_aside(options: &Options, links: &mut Links) -> Result<Aside, StartError> {
    let Options { interface, notes, .. } = options;
    let addresses = links.addresses(interface.index)?;
    if let Some(&(ip, length)) = addresses.iter().find(|(ip, _)| ip.is_ipv4()) {
        return Err(StartError::HasAddress(interface.name.clone(), Prefix { ip, length }));
    }
    Aside::at(interface, notes.as_deref()).map_err(|error| StartError::Aside(interface.name.clone(), error))
}
