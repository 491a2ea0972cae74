//! A station's VNIC: what it is to be, its thread, and what the control thread says of it.

mod running;

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::thread::Builder;

use caps::{CapSet, Capability, CapsHashSet};
use nix::sys::eventfd::{EfdFlags, EventFd};
use rtmac::tdma::{NON_RT_SLOT, joint};
use rtnet::buf::Pool;
use rtnet::discipline::Service;
use rtnet::live::Port;
use rtnet::live::interface::Interface;
use rtnet::live::realtime::avoid;
use vnic::peers::{Peer, Prefix};
use vnic::proxy;
use vnic::tun::{self, Change, Handle, Mode, Order, Status, Turns, Vnic};
use vnic::tunnel::{self, AT_ONCE, Config, Loss};

use super::access::AccessStatus;
use super::stack::OwnIp;
use crate::control::{Directory, PoolShown, VnicChange, VnicCounted, VnicRequest, VnicShown};
pub use running::Running;

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
    stop: Arc<AtomicBool>,
    bell: Arc<EventFd>,
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
    let directory = Directory::of_user().ok()?;
    directory.path().exists().then(|| directory.path().to_owned())
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
    let vnic = Vnic::open(wished, mouth, [bell.clone(), port.bell()], stop.clone(), tell);
    let vnic = vnic.map_err(|error| said(&error))?;
    if !options.proxy {
        port.leave_tunnelled().map_err(|error| said(&error))?;
    }
    let told = Told { handle: vnic.handle(), pool };
    Ok((Opened { vnic, stop: stop.clone(), bell, told }, service))
}

impl Opened {
    /// Starts its thread, on any core but that of the real-time thread; a line says why it does not.
    pub fn start(self, not_on: Option<usize>) -> Result<Running, String> {
        let Self { vnic, stop, bell, .. } = self;
        Running::start(Builder::new().stack_size(STACK), stop, bell, move || {
            if let Some(cpu) = not_on {
                // It runs wherever it may, then.
                let _ = avoid(cpu);
            }
            keep_only_what_devices_need();
            vnic.run();
        })
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

    /// What it counts, as far as its thread says so.
    pub fn counted(&self) -> VnicCounted {
        match self.answer(VnicRequest::Status) {
            Ok(VnicShown { counters, lost, filter, .. }) => {
                VnicCounted { counters, lost, filter, unknown: None }
            }
            Err(why) => VnicCounted { unknown: Some(why), ..VnicCounted::default() },
        }
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
    let Status {
        name,
        mode,
        is_proxy,
        device,
        most,
        slot,
        peers,
        remarks,
        shaping,
        filter,
        queue_full,
        news,
        counts,
    } = status;
    let state = device.as_ref().map_or("gone", |device| if device.is_up { "up" } else { "down" });
    let by_linux = [("filter_dropped", filter.drops), ("device_queue_full", queue_full)];
    let lost = Loss::ALL.iter().map(|&why| (why.name(), counts.lost(why))).chain(by_linux);
    let filtered = [
        ("packets", filter.packets),
        ("bytes", filter.bytes),
        ("dropped", filter.drops),
        ("waiting", filter.waiting),
        ("waiting_bytes", filter.backlog),
    ];
    let (shaped, not_held_back) = shaping.map_or_else(|why| (None, Some(why)), |shaped| (Some(shaped), None));
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
        bytes_per_second: shaped.as_ref().map(|shaped| shaped.bytes_per_second),
        held_back_as_before: shaped.and_then(|shaped| shaped.as_before),
        not_held_back,
        filter: named(filtered),
        counters: named(counters),
        lost: named(lost),
        pool,
        news,
    }
}

fn named(counts: impl IntoIterator<Item = (&'static str, u64)>) -> BTreeMap<String, u64> {
    counts.into_iter().map(|(name, n)| (name.to_owned(), n)).collect()
}

/// How often what is not real-time may leave: turns of every slot that takes from the queue of slot 1, or of slot 0 while
/// that has no other name.
fn turns_in_1000_seconds(status: &AccessStatus) -> Turns {
    let Some(tdma) = status.tdma() else { return Turns::AtOnce };
    let slots: Vec<_> = tdma.slots.iter().flatten().map(|slot| slot.config).collect();
    let takes = joint::serving(&slots, |slot| (slot.id, slot.joint), NON_RT_SLOT);
    if takes.is_empty() {
        return Turns::NoSlot;
    }
    let Some(period) = tdma.period else { return Turns::NoCycle };
    let turns = takes.iter().map(|slot| 1e12 / (period.nanos() as f64 * f64::from(slot.period)));
    Turns::In1000Seconds(turns.sum::<f64>() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::station::access::{Access, AccessConfig};
    use rtmac::tdma::{DEFAULT_LEAD, LatePolicy, RoleConfig, SlaveConfig, SlotConfig, TdmaConfig};
    use rtnet::discipline::Discipline;
    use rtnet::time::Span;
    use rtnet::wire::ethernet::{Address, MTU};
    use vnic::netlink::ShapingStatistics;
    use vnic::tun::Shaped;

    fn turns(access: &AccessConfig) -> Turns {
        turns_in_1000_seconds(&Access::new(access, Address::default()).unwrap().status())
    }

    /// With these slots, in each of so many cycles.
    fn tdma(role: RoleConfig, slots: &[(u8, u32)]) -> AccessConfig {
        let slot = |&(id, period)| SlotConfig {
            id,
            offset: Span::from_micros(100 + 100 * i64::from(id)),
            phase: 0,
            period,
            size: MTU,
            joint: None,
            latest: Span::from_micros(50),
        };
        AccessConfig::Tdma(TdmaConfig {
            address: Address::default(),
            role,
            slots: slots.iter().map(slot).collect(),
            max_slot_id: 7,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        })
    }

    #[test]
    fn what_is_known_of_turns_is_told_apart_from_why_none_is() {
        let slave = || RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() });
        assert_eq!(turns(&AccessConfig::NoMac), Turns::AtOnce);
        // Before its master.
        assert_eq!(turns(&tdma(slave(), &[(0, 1), (1, 1)])), Turns::NoCycle);
        assert_eq!(turns(&tdma(slave(), &[(2, 1)])), Turns::NoSlot);
        assert_eq!(turns(&tdma(slave(), &[])), Turns::NoSlot);
    }

    #[test]
    fn all_reasons_of_losses_are_shown_what_filter_and_driver_dropped_among_them() {
        let filter = ShapingStatistics { drops: 49_117, packets: 3, ..ShapingStatistics::default() };
        let shaped = Shaped { bytes_per_second: 985, as_before: Some("why".into()) };
        let status = Status {
            name: "vnic0".into(),
            mode: Mode::Tap,
            is_proxy: false,
            device: None,
            most: 1_496,
            slot: 1_496,
            peers: Vec::new(),
            remarks: Vec::new(),
            shaping: Ok(shaped),
            filter,
            queue_full: 7,
            news: None,
            counts: Default::default(),
        };
        let pool = || PoolShown::new("vnic".into(), Pool::new(1).statistics(), 0);
        let it = shown(status.clone(), pool());
        assert_eq!((it.lost["filter_dropped"], it.lost["device_queue_full"]), (49_117, 7));
        assert_eq!((it.lost.len(), it.lost["too_long"]), (Loss::ALL.len() + 2, 0));
        assert_eq!((it.bytes_per_second, it.held_back_as_before.as_deref()), (Some(985), Some("why")));
        // What was counted outlasts the filter.
        let without = shown(Status { shaping: Err("it is gone".into()), ..status }, pool());
        assert_eq!((without.bytes_per_second, without.not_held_back.as_deref()), (None, Some("it is gone")));
        assert_eq!((&without.filter, without.filter["dropped"]), (&it.filter, 49_117));
    }
}
