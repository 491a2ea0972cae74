//! The device that Linux sees, and the thread behind it, which is no real-time one.
//!
//! ```text
//!          poll: device, socket, orders, changes of links
//!  Linux ──► read ──► Mouth::send ── outward ──► the station's slot 1
//!  Linux ◄── write ◄── Inner::of ◄── a socket that hears what is tunnelled to this station
//! ```
//!
//! Instead of a tunnel it is the end of a [`proxy`](crate::proxy) as well: what comes is found at its mouth then, and Linux,
//! which has the station's own address, is kept from hearing the interface itself.
//!
//! The real-time thread has no part in what comes by a tunnel, and none in the kernel's stack, which does its work in the calls to the
//! device. The thread keeps one capability, CAP_NET_ADMIN: it lets the device's MTU follow the slots, and makes it anew.
//!
//! The driver's queue drops what finds it full, and whoever sends does not feel it before. So a token bucket filter stands
//! in front of it, a little slower than the slots: there a connection's own bound holds, and Linux is told of what is dropped.
//! What waits there is bounded in packets, however short they are: each takes a turn.

#![allow(clippy::disallowed_methods)]

mod aside;
mod device;
mod worker;

use std::io;
use std::path::PathBuf;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use nix::sys::eventfd::EventFd;
use rtnet::live::interface::Interface;
use rtnet::live::rights;
use rtnet::wire::ethernet::Address;

use crate::netlink::{Refused, ShapingStatistics};
use crate::peers::{NotAHosts, Peer, PeerError, Prefix};
use crate::proxy::MTU as PROXY_MTU;
use crate::tunnel::{Counts, MTU};

pub use aside::put_back;
pub use device::{Device, Mode, OpenError};
pub use worker::{Vnic, fed};

/// An answer takes as long as a few requests to the kernel; on a busy host a little longer.
const ANSWERED_WITHIN: Duration = Duration::from_secs(2);

/// What a VNIC is to be.
#[derive(Clone, Debug)]
pub struct Options {
    /// The name of its device; not given: `vnic` with the first number that is free.
    pub name: Option<String>,
    /// What goes through it.
    pub mode: Mode,
    /// Its addresses.
    pub addresses: Vec<Prefix>,
    /// Its MTU at the most, 68 to 1496, or 1500 of a proxy's; it is what the slot takes if that is less.
    pub mtu: usize,
    /// Which station has which address, where nobody can be asked.
    pub peers: Vec<Peer>,
    /// What it is tunnelled through.
    pub interface: Interface,
    /// A directory in which a proxy notes what it changes of Linux's, for [`put_back`] if it is killed.
    pub notes: Option<PathBuf>,
}

/// Why there is no VNIC. The station runs on without.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// No device.
    #[error(transparent)]
    Device(#[from] OpenError),
    /// It cannot be what it is to be.
    #[error("no VNIC: {0}")]
    Link(#[from] Refused),
    /// Nothing can be heard.
    #[error("no VNIC: packet sockets on '{0}' ({remedy}): {1}", remedy = rights::remedy(&["CAP_NET_RAW"]))]
    Socket(String, #[source] io::Error),
    /// Linux would hear the station's packets without it, and answer beside its slots.
    #[error(
        "no VNIC: Linux cannot be kept from the packets of '{0}': {1} (as root: `sysctl -w net.ipv4.conf.{0}.rp_filter=1 \
         net.ipv4.conf.{0}.arp_ignore=1`)"
    )]
    Aside(String, #[source] io::Error),
    /// Two would have the address, one of which answers beside the station's slots.
    #[error(
        "no VNIC: Linux has an address on '{0}' itself, {1}: take it away (`ip address del {1} dev {0}`), a proxy gives it the \
         station's"
    )]
    HasAddress(String, Prefix),
    /// What a proxy has from its station.
    #[error("a proxy has the address of its station, and goes by its routes (`rtnet route`)")]
    OfStation,
    /// A station that cannot be one.
    #[error("no VNIC: {0}")]
    Peer(#[from] PeerError),
    /// An address that cannot be a device's.
    #[error("no VNIC: {0}")]
    Address(#[from] NotAHosts),
    /// The host is out of something.
    #[error("no VNIC: {0}")]
    Host(#[from] io::Error),
}

/// Why a running VNIC does not do as it is told.
#[derive(Debug, thiserror::Error)]
pub enum OrderError {
    /// It has no device to be changed.
    #[error("the VNIC's device '{0}' is gone: `rtnet vnic up` makes it anew")]
    Gone(String),
    /// It cannot be made anew.
    #[error(transparent)]
    Start(#[from] StartError),
    /// Linux refuses.
    #[error(transparent)]
    Link(#[from] Refused),
    /// A station that cannot be one.
    #[error(transparent)]
    Peer(#[from] PeerError),
    /// Nobody looks them up there.
    #[error(
        "peers are for mode tun; this VNIC is a tap, by which Linux asks who has an address: leave --peer out"
    )]
    NoPeers,
    /// An address that cannot be a device's.
    #[error(transparent)]
    Address(#[from] NotAHosts),
    /// Neither has the device it, nor is it to.
    #[error("cannot take {0} away: it has no such address")]
    NoSuchAddress(Prefix),
    /// RTmac's header has its place in a slot, too.
    #[error("an MTU of {0} is too much: say {1} or less (a tunnel takes {MTU}, a proxy {PROXY_MTU})")]
    Mtu(usize, usize),
    /// Linux has an address of IPv6 only once, and the device is to have it with another prefix already.
    #[error("it is to have {0} already: take that away (`--no-address {0}`), or leave {1} out")]
    OtherPrefix(Prefix, Prefix),
}

/// What a running VNIC may be told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Order {
    /// Nothing: only tell how it is.
    Status,
    /// Set the device up, or make it anew if it is gone.
    Up,
    /// Set the device down.
    Down,
    /// Change it.
    Set(Change),
}

/// What is to be changed of a VNIC.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Change {
    /// Its MTU at the most.
    pub mtu: Option<usize>,
    /// Addresses that it is to have besides.
    pub add: Vec<Prefix>,
    /// Addresses that it is to have no more.
    pub remove: Vec<Prefix>,
    /// Stations, and what they are reached for.
    pub peers: Vec<Peer>,
}

/// How a VNIC is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Status {
    /// The device's name.
    pub name: String,
    /// What goes through it.
    pub mode: Mode,
    /// Whether Linux has the station's own address by it.
    pub is_proxy: bool,
    /// What Linux says of the device; none if it is gone.
    pub device: Option<DeviceStatus>,
    /// The MTU that was asked for, at the most.
    pub most: usize,
    /// What the slots take, bytes of inner payload.
    pub slot: usize,
    /// Which station has which address.
    pub peers: Vec<Peer>,
    /// What keeps the device from what it is to be, a line each.
    pub remarks: Vec<String>,
    /// What holds back what Linux sends, or why nothing does.
    pub shaping: Result<Shaped, String>,
    /// What became of what Linux sends, in all filters that this VNIC has had.
    pub filter: ShapingStatistics,
    /// Frames from Linux that the driver's queue had no room for, of all devices that this VNIC has had.
    pub queue_full: u64,
    /// The last thing that happened to the device that nobody here has asked for.
    pub news: Option<String>,
    /// What went through, and what did not.
    pub counts: Counts,
}

/// What Linux says of the device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceStatus {
    /// Whether it is up.
    pub is_up: bool,
    /// Its MTU now.
    pub mtu: usize,
    /// Its Ethernet address, if it has one.
    pub address: Option<Address>,
    /// Its addresses.
    pub addresses: Vec<Prefix>,
}

/// What holds back what Linux sends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shaped {
    /// So fast it lets frames through, the largest.
    pub bytes_per_second: u64,
    /// Why that is what slots allowed before, if it is not what they allow now.
    pub as_before: Option<String>,
}

/// How often a frame may leave.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Turns {
    /// No cycle is known, yet or any more.
    #[default]
    NoCycle,
    /// The station has slots, but none from which the tunnel may take.
    NoSlot,
    /// At once: there are no slots.
    AtOnce,
    /// So many times in 1000 seconds.
    In1000Seconds(u64),
}

/// Whoever has it may ask a VNIC, and tell it how often its slot comes.
#[derive(Clone)]
pub struct Handle {
    orders: Sender<(Order, Sender<Result<Status, String>>)>,
    bell: Arc<EventFd>,
    turns: Arc<Mutex<Turns>>,
}

impl Handle {
    /// Gives an order, and waits for what came of it. For the control thread.
    pub fn ask(&self, order: Order) -> Result<Status, String> {
        let ended = || "the VNIC's thread has ended: start the station anew".to_owned();
        let (answer, answered) = channel();
        self.orders.send((order, answer)).map_err(|_| ended())?;
        self.ring();
        answered.recv_timeout(ANSWERED_WITHIN).map_err(|error| match error {
            RecvTimeoutError::Disconnected => ended(),
            RecvTimeoutError::Timeout => {
                format!(
                    "the VNIC's thread has not answered within {ANSWERED_WITHIN:?}: ask how it is, and again"
                )
            }
        })?
    }

    /// Says how often a frame may leave.
    pub fn set_turns(&self, turns: Turns) {
        // Neither thread that has it is real-time, and neither fails with it in hand.
        let before =
            std::mem::replace(&mut *self.turns.lock().unwrap_or_else(PoisonError::into_inner), turns);
        if before != turns {
            self.ring();
        }
    }

    fn ring(&self) {
        // It does not block: one that was not read is readable already.
        let _ = self.bell.write(1);
    }
}
