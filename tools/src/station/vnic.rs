//! A station's VNIC: what it is to be, its thread, and what the control thread says of it.

use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::thread::JoinHandle;

use anyhow::Result;
use caps::{CapSet, Capability, CapsHashSet};
use nix::sys::eventfd::{EfdFlags, EventFd};
use rtnet::buf::Pool;
use rtnet::discipline::Service;
use rtnet::live::Port;
use rtnet::live::interface::Interface;
use rtnet::live::realtime::avoid;
use vnic::peers::{Peer, Prefix};
use vnic::proxy;
use vnic::tun::{self, Change, Handle, Mode, Order, Shaped, Status, Vnic};
use vnic::tunnel::{self, AT_ONCE, Config};

use super::access::AccessStatus;
use super::stack::OwnIp;
use crate::control::{Directory, PoolShown, VnicChange, VnicRequest, VnicShown};

/// Stack of its thread.
const STACK: usize = 256 * 1024;

/// What a VNIC is to be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VnicOptions {
    /// Its device's addresses.
    pub addresses: Vec<Prefix>,
    /// What goes through it.
    pub mode: Mode,
    /// Its device's name.
    pub name: Option<String>,
    /// Its MTU at the most.
    pub mtu: usize,
    /// Its buffers.
    pub buffers: usize,
    /// Which station has which address.
    pub peers: Vec<Peer>,
    /// Whether hosts are behind the device.
    pub forwards: bool,
    /// Whether it has the station's own address, of IP and routes, instead of a tunnel's end.
    pub proxy: bool,
}

impl VnicOptions {
    /// As usual, with these addresses.
    pub fn usual(addresses: Vec<Prefix>) -> Self {
        let (mode, mtu, buffers) = (Mode::default(), tunnel::MTU, tunnel::DEFAULT_BUFFERS);
        Self { addresses, mode, name: None, mtu, buffers, peers: Vec::new(), forwards: false, proxy: false }
    }

    /// A proxy for a station with this address.
    pub fn proxy(ip: OwnIp) -> Self {
        let address = Prefix { ip: ip.ip.into(), length: ip.prefix };
        Self { mode: Mode::Tun, mtu: proxy::MTU, proxy: true, ..Self::usual(vec![address]) }
    }
}

/// A VNIC whose thread has not started.
pub struct Opened {
    vnic: Vnic,
    /// What the control thread keeps.
    pub told: Told,
}

/// What the control thread has of a VNIC.
#[derive(Clone)]
pub struct Told {
    handle: Handle,
    pool: Arc<Pool>,
}

/// Where this user's stations note what they change of Linux's: beside their sockets, if there are to be any.
pub fn notes() -> Option<PathBuf> {
    let directory = Directory::of_user();
    (directory.path().exists() && directory.check().is_ok()).then(|| directory.path().to_owned())
}

/// Makes the device, and what the station has of the tunnel. Where that cannot be, a line says why, and the station goes
/// without.
pub fn open(
    options: &VnicOptions,
    (interface, notes): (&Interface, Option<PathBuf>),
    port: &mut Port,
    has_slots: bool,
    stop: &Arc<AtomicBool>,
) -> Result<(Opened, Box<dyn Service>), String> {
    let said = |error: &dyn std::fmt::Display| error.to_string();
    let config = Config {
        buffers: options.buffers,
        per_turn: if has_slots { 1 } else { AT_ONCE },
        keeps_source: options.forwards,
        ..Config::of(interface.address)
    };
    let bell = EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC);
    let bell = Arc::new(bell.map_err(|error| said(&error))?);
    let rung = bell.clone();
    let ring = Box::new(move || {
        // It does not block: one that was not read is readable already.
        let _ = rung.write(1);
    });
    let (service, mouth): (Box<dyn Service>, _) = if options.proxy {
        let (proxy, mouth) = proxy::new(config);
        (Box::new(proxy.ringing(ring)), mouth)
    } else {
        let (tunnel, mouth) = tunnel::new(config);
        (Box::new(tunnel.ringing(ring)), mouth)
    };
    let pool = mouth.pool().clone();
    let wished = tun::Options {
        name: options.name.clone(),
        mode: options.mode,
        addresses: options.addresses.clone(),
        mtu: options.mtu,
        peers: options.peers.clone(),
        interface: interface.clone(),
        notes,
    };
    let tell = Box::new(|line: &str| {
        // Nobody may read it any more; `rtnet vnic status` tells it, too.
        let _ = writeln!(std::io::stderr(), "rtnet: {line}");
    });
    let vnic = Vnic::open(wished, mouth, [bell, port.bell()], stop.clone(), tell);
    let vnic = vnic.map_err(|error| said(&error))?;
    if !options.proxy {
        port.leave_tunnelled().map_err(|error| said(&error))?;
    }
    let told = Told { handle: vnic.handle(), pool };
    Ok((Opened { vnic, told }, service))
}

impl Opened {
    /// Starts its thread, on any core but that of the real-time thread.
    pub fn start(self, not_on: Option<usize>) -> Result<JoinHandle<()>> {
        let builder = std::thread::Builder::new().name("vnic".into()).stack_size(STACK);
        Ok(builder.spawn(move || {
            if let Some(cpu) = not_on {
                // It runs wherever it may, then.
                let _ = avoid(cpu);
            }
            keep_only_what_devices_need();
            self.vnic.run();
        })?)
    }
}

/// Its thread sets the device's MTU, and makes it anew.
fn keep_only_what_devices_need() {
    let need = CapsHashSet::from([Capability::CAP_NET_ADMIN]);
    let has = caps::read(None, CapSet::Permitted).unwrap_or_default();
    let kept: CapsHashSet = has.intersection(&need).copied().collect();
    for set in [CapSet::Ambient, CapSet::Inheritable] {
        let _ = caps::clear(None, set);
    }
    // What the kernel does not let go of, it keeps: the device is the same.
    let _ = caps::set(None, CapSet::Effective, &kept);
    let _ = caps::set(None, CapSet::Permitted, &kept);
}

impl Told {
    /// Its buffers, as a pool of the station's.
    pub fn pool(&self) -> PoolShown {
        let statistics = self.pool.statistics();
        PoolShown::new("vnic".into(), statistics, 0)
    }

    /// Tells it how often its slot comes.
    pub fn follow(&self, status: &AccessStatus) {
        self.handle.set_turns(turns_in_1000_seconds(status));
    }

    /// Does what is asked, and tells how it is then.
    pub fn answer(&self, request: VnicRequest) -> Result<VnicShown, String> {
        let order = match request {
            VnicRequest::Status => Order::Status,
            VnicRequest::Up => Order::Up,
            VnicRequest::Down => Order::Down,
            VnicRequest::Set(change) => Order::Set(read(&change)?),
        };
        Ok(shown(self.handle.ask(order)?, self.pool()))
    }
}

fn read(change: &VnicChange) -> Result<Change, String> {
    fn all<T: std::str::FromStr<Err: std::fmt::Display>>(texts: &[String]) -> Result<Vec<T>, String> {
        texts.iter().map(|text| text.parse().map_err(|error: T::Err| error.to_string())).collect()
    }
    let VnicChange { mtu, add, remove, peers } = change;
    Ok(Change { mtu: *mtu, add: all(add)?, remove: all(remove)?, peers: all(peers)? })
}

fn shown(status: Status, pool: PoolShown) -> VnicShown {
    let Status { name, mode, is_proxy, device, most, slot, peers, remarks, shaping, news, counts } = status;
    let state = device.as_ref().map_or("gone", |device| if device.is_up { "up" } else { "down" });
    let mut lost: std::collections::BTreeMap<String, u64> =
        counts.losses().map(|(why, n)| (why.name().to_owned(), n)).collect();
    if let Some(full) = device.as_ref().map(|device| device.queue_full).filter(|&n| n > 0) {
        lost.insert("device_queue_full".into(), full);
    }
    let (bytes_per_second, not_held_back, filter) = match shaping {
        Ok(Shaped { bytes_per_second, statistics }) => {
            let all = [
                ("packets", statistics.packets),
                ("bytes", statistics.bytes),
                ("dropped", statistics.drops),
                ("waiting", statistics.waiting),
                ("waiting_bytes", statistics.backlog),
            ];
            let all = all.into_iter().map(|(name, n)| (name.to_owned(), n)).collect();
            (Some(bytes_per_second), None, all)
        }
        Err(why) => (None, Some(why), Default::default()),
    };
    let [sent, received] = if is_proxy { ["proxied_out", "proxied_in"] } else { ["sent", "received"] };
    let counters = [(sent, counts.sent), ("put_off", counts.put_off), (received, counts.received)];
    let addresses = device.as_ref().map(|device| device.addresses.clone()).unwrap_or_default();
    VnicShown {
        device: name,
        mode: match mode {
            Mode::Tap => "tap".into(),
            Mode::Tun => "tun".into(),
        },
        proxy: is_proxy,
        state: state.into(),
        mac: device.as_ref().and_then(|device| device.address).map(|address| address.to_string()),
        mtu: device.map_or(0, |device| device.mtu),
        mtu_at_most: most,
        slot_takes: slot,
        addresses: addresses.iter().map(Prefix::to_string).collect(),
        peers: peers.iter().map(Peer::to_string).collect(),
        remarks,
        bytes_per_second,
        not_held_back,
        filter,
        counters: counters.into_iter().map(|(name, n)| (name.to_owned(), n)).collect(),
        lost,
        pool,
        news,
    }
}

/// How often what is not real-time may leave: turns of every slot that takes from the queue of slot 1, or of slot 0 while
/// that has no other name. 0 without slots.
fn turns_in_1000_seconds(status: &AccessStatus) -> u64 {
    let Some((tdma, period)) = status.tdma().and_then(|tdma| Some((tdma, tdma.period?))) else { return 0 };
    let slots = || tdma.slots.iter().flatten().map(|slot| slot.config);
    let queue = |id| slots().find(|slot| slot.id == id).map(|slot| slot.joint.unwrap_or(slot.id));
    let Some(non_rt) = queue(1).or_else(|| queue(0)) else { return 0 };
    let takes = slots().filter(|slot| slot.joint.unwrap_or(slot.id) == non_rt);
    let turns = takes.map(|slot| 1e12 / (period.nanos() as f64 * f64::from(slot.period)));
    turns.sum::<f64>() as u64
}
