//! `rtnet station`.

use std::net::Ipv4Addr;
use std::path::Path;
use std::str::FromStr;

use anyhow::{Context, anyhow, bail};
use package_router::priority::Priorities;
use package_router::route::{Own, Routes};
use package_router::tcp::client::{BODY, TcpOptions};
use package_router::tcp::keys::ClientKeys;
use rtmac::tdma::change::ChangeConfig;
use rtmac::tdma::{
    DEFAULT_ROUNDS, HOLDOVER_CYCLES, LatePolicy, MasterConfig, RoleConfig, SlaveConfig, Tdma, TdmaConfig,
};
use rtmac::token::RingConfig;
use rtnet::clock::EmulatedClock;
use rtnet::live::GuardMode;
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;
use vnic::peers::Prefix;
use vnic::tunnel::MTU;

use super::Failure;
use super::route::read_routes;
use crate::cli::{DisciplineName, Late, Scheduling, StationArgs, VnicMode};
use crate::control::SlotChange;
use crate::daemon;
use crate::scenario::read_text;
use crate::scenario::{
    DelayName, RingTimes, SlotGuard, default_sync_window, parse_phase, room_for_parts, room_for_replies,
};
use crate::station::access::AccessConfig;
use crate::station::link::{self, LabOptions, Report};
use crate::station::packages::PackagesOptions;
use crate::station::sockets::parse;
use crate::station::stack::StackOptions;
use crate::station::vnic::VnicOptions;
use crate::station::{self, Options, OwnSlots};
use crate::units::parse_nonnegative_span;

/// A station by itself has room for schedules with so many slots.
const SLOTS_OF_OTHERS: usize = 256;

/// Reads a slot from the command line: `ID=OFFSET[,phase=P/N][,size=B][,joint=ID]`; `joint=none` is a queue of its own.
pub fn parse_slot(text: &str) -> Result<SlotChange, String> {
    let mut parts = text.split(',');
    let first = parts.next().unwrap_or_default();
    let (id, offset) = first.split_once('=').ok_or("write ID=OFFSET, as in 0=100us")?;
    let id = u8::from_str(id).map_err(|_| format!("'{id}' is no slot id: write a number from 0 on"))?;
    let offset = parse_nonnegative_span(offset).map_err(|error| error.to_string())?;
    let offset_ns = offset.nanos();
    let mut slot = SlotChange { id, offset_ns, phase: None, period: None, size: None, joint: None };
    for part in parts {
        match part.split_once('=') {
            Some(("phase", phase)) => {
                let (phase, period) = parse_phase(phase)?;
                (slot.phase, slot.period) = (Some(phase), Some(period));
            }
            Some(("size", size)) => {
                slot.size = Some(size.parse().map_err(|_| format!("'{size}' is no size in bytes"))?);
            }
            Some(("joint", "none")) => slot.joint = Some(None),
            Some(("joint", to)) => {
                let to =
                    to.parse().map_err(|_| format!("'{to}' is no slot id: write joint=ID, or joint=none"))?;
                slot.joint = Some(Some(to));
            }
            _ => return Err(format!("'{part}' means nothing here: only phase=P/N, size=B and joint=ID do")),
        }
    }
    Ok(slot)
}

/// Runs a station until it is told to stop.
pub fn station(args: &StationArgs) -> Result<u8, Failure> {
    if args.lab.is_some() {
        daemon::belong_to_lab().map_err(Failure::Usage)?;
    }
    daemon::private_umask();
    let options = options(args).map_err(Failure::Usage)?;
    let in_lab = options.lab.is_some();
    // A lab that ended while it was set up, by an error of its own, has reported that.
    match run(options, in_lab) {
        Err(failure) if in_lab && is_left_alone(failure.error()) => Ok(failure.status()),
        done => done,
    }
}

/// Whether there is nobody any more who reads what it tells.
fn is_left_alone(error: &anyhow::Error) -> bool {
    let kinds = error.chain().filter_map(|cause| cause.downcast_ref::<std::io::Error>());
    kinds.map(std::io::Error::kind).any(|kind| kind == std::io::ErrorKind::BrokenPipe)
}

fn run(options: Options, in_lab: bool) -> Result<u8, Failure> {
    let station = station::set_up(options)
        .inspect_err(|error| {
            if in_lab {
                // Nobody may read our standard error any more.
                let _ = Report::Failed(format!("{error:#}")).say();
            }
        })
        .map_err(Failure::Usage)?;
    station.run().map(|()| 0).map_err(Failure::Run)
}

fn options(args: &StationArgs) -> anyhow::Result<Options> {
    let lab: Option<LabOptions> =
        args.lab.as_deref().map(serde_json::from_str).transpose().context("--lab is set by a lab only")?;
    let access = match args.discipline {
        DisciplineName::Tdma => AccessConfig::Tdma(tdma(args, lab.as_ref())?),
        DisciplineName::Nomac => AccessConfig::NoMac,
        DisciplineName::Direct => AccessConfig::Direct,
        DisciplineName::Token => AccessConfig::Token(ring(args)?),
    };
    let given = args.cycle.filter(|_| args.master).map(|cycle| (cycle, sync_window(args, cycle)));
    // A lab has judged the slots of all its stations together.
    let single = access.tdma().filter(|_| lab.is_none());
    let own_slots = single.map(|tdma| OwnSlots::of(tdma, given, args.rate));
    if let Some(own) = &own_slots {
        own.check().map_err(|why| anyhow!(why))?;
    }
    if let (None, Some(option)) = (access.ring(), args.ring.said()) {
        bail!("{option} is about a ring: leave it out, or run the station with --discipline token");
    }
    // Where there is neither slot nor token nothing is late.
    let guard = match &access {
        AccessConfig::Tdma(_) if args.scheduling == Scheduling::Busy => bail!(
            "--scheduling busy goes without time slots, for which a station sleeps: leave it out, or run the station with \
             --discipline nomac"
        ),
        AccessConfig::Tdma(_) => args.slot_guard.mode(),
        AccessConfig::NoMac | AccessConfig::Direct => {
            without_slots(args, false)?;
            GuardMode::User
        }
        AccessConfig::Token(_) => {
            without_slots(args, true)?;
            args.slot_guard.mode()
        }
    };
    let changes = changes(args, lab.as_ref())?;
    Ok(Options {
        changes,
        interface: args.interface.clone(),
        name: args.name.clone(),
        access,
        latest: args.latest,
        own_slots,
        fifo: args.scheduling == Scheduling::Fifo,
        busy: args.scheduling == Scheduling::Busy,
        cpu: args.cpu,
        spin: args.lead,
        guard,
        exclusive: args.exclusive,
        stack: stack(args)?,
        vnic: vnic(args)?,
        packages: packages(args)?,
        metrics: args.metrics,
        lab,
    })
}

/// What it is told so that it takes part in changes of the schedule.
fn changes(args: &StationArgs, lab: Option<&LabOptions>) -> anyhow::Result<Option<ChangeConfig>> {
    if let Some(told) = lab.and_then(|lab| lab.changes.as_ref()) {
        return told.config().map(Some).map_err(|why| anyhow!(why));
    }
    if !args.extensions {
        return Ok(None);
    }
    let room = match args.cycle.filter(|_| args.master) {
        Some(cycle) => {
            let window = sync_window(args, cycle);
            room_for_parts(window, args.rate).with_context(|| {
                format!("--extensions: a sync window of {window} has no room for parts of schedules: lengthen it (--sync-window)")
            })?
        }
        None => (Span::ZERO, Span::ZERO),
    };
    let (capacity, first, masters) = (SLOTS_OF_OTHERS, None, Vec::new());
    let (behind, latest) = room;
    Ok(Some(ChangeConfig { capacity, is_reserved: true, first, masters, behind, latest }))
}

/// Its address and sockets, with routes that can be.
fn stack(args: &StationArgs) -> anyhow::Result<Option<StackOptions>> {
    let (package_times, args) = (args.packages.package_times, &args.stack);
    let Some(ip) = args.ip else { return Ok(None) };
    let mut said: Vec<_> = args.route.iter().map(|said| ("--route".to_owned(), said.clone())).collect();
    if let Some(file) = &args.routes {
        said.extend(read_routes(file)?);
    }
    let parsed = |(whence, said)| Ok((whence, parse(&said).map_err(|why| anyhow!(why))?));
    let routes = said.into_iter().map(parsed).collect::<anyhow::Result<_>>()?;
    let usual = StackOptions::usual(ip);
    let or = |said: Option<u16>, usual: usize| said.map_or(usual, usize::from);
    let options = StackOptions {
        ip,
        routes,
        sockets: args.sockets.unwrap_or(usual.sockets),
        ports: args.ports.clone().unwrap_or(usual.ports),
        strict_checksums: args.strict_checksums,
        fragment_timeout: args.fragment_timeout.unwrap_or(usual.fragment_timeout),
        hosts: or(args.hosts, usual.hosts),
        networks: or(args.networks, usual.networks),
        socket_buffers: args.socket_buffers.unwrap_or(usual.socket_buffers),
        receive_buffers: or(args.receive_buffers, usual.receive_buffers),
        icmp_buffers: or(args.icmp_buffers, usual.icmp_buffers),
        arp_buffers: or(args.arp_buffers, usual.arp_buffers),
        package_times,
    };
    options.check()?;
    Ok(Some(options))
}

/// Where its packages go, and how urgent they are.
fn packages(args: &StationArgs) -> anyhow::Result<Option<PackagesOptions>> {
    let said = &args.packages;
    if !said.packages {
        return Ok(None);
    }
    let read = |file: &Path| read_text(file).with_context(|| file.display().to_string());
    let own = Own {
        station: args.stack.ip.map_or(Ipv4Addr::UNSPECIFIED, |own| own.ip),
        system: said.package_system.unwrap_or_default(),
    };
    let mut routes = match &said.package_routes {
        // A station by itself knows others by their addresses only.
        Some(file) => Routes::parse(&read(file)?, &file.display().to_string(), own, |_| None)?,
        None => Routes::new(own),
    };
    for &(to, station) in &said.package_route {
        routes.add(to, station).with_context(|| format!("--package-route {to}={station}"))?;
    }
    let priorities = match &said.package_priorities {
        Some(file) => Priorities::parse(&read(file)?, &file.display().to_string())?,
        None => Priorities::default(),
    };
    let keys = said.router_keys.as_deref().map(ClientKeys::read).transpose()?;
    let tcp = said.router.clone().map(|router| TcpOptions {
        largest_body: said.router_body.map_or(BODY, |bytes| bytes as usize),
        router,
        keys,
    });
    Ok(Some(PackagesOptions { routes, priorities, tcp }))
}

/// Its VNIC, if it is to have one.
fn vnic(args: &StationArgs) -> anyhow::Result<Option<VnicOptions>> {
    let said = &args.vnic;
    let Some(addresses) = &said.vnic else { return Ok(None) };
    if args.discipline == DisciplineName::Direct && !said.vnic_proxy {
        bail!(
            "--vnic goes with RTmac, which --discipline direct has not: leave it out, or run the station with \
             --discipline nomac"
        );
    }
    if let Some(mtu) = said.vnic_mtu.map(usize::from).filter(|&mtu| mtu > MTU && !said.vnic_proxy) {
        bail!(
            "--vnic-mtu {mtu} is too much for a tunnel, which takes {MTU}: say {MTU} or less, or add --vnic-proxy"
        );
    }
    let mode = said.vnic_mode.unwrap_or_default();
    if mode == VnicMode::Tun && said.vnic_forward {
        bail!(
            "--vnic-forward is about frames of hosts behind a bridge, of which --vnic-mode tun has only the packets: leave \
             one of the two out; Linux routes packets to hosts behind it without"
        );
    }
    if mode == VnicMode::Tap && !said.vnic_peer.is_empty() {
        bail!(
            "--vnic-peer is for --vnic-mode tun; with --vnic-mode tap Linux asks who has an address: leave it out"
        );
    }
    let usual = if said.vnic_proxy { proxy(args, addresses)? } else { VnicOptions::usual(addresses.clone()) };
    Ok(Some(VnicOptions {
        mode: if said.vnic_proxy { usual.mode } else { mode.into() },
        name: said.vnic_name.clone(),
        mtu: said.vnic_mtu.map_or(usual.mtu, usize::from),
        buffers: said.vnic_buffers.map_or(usual.buffers, usize::from),
        peers: said.vnic_peer.clone(),
        forwards: said.vnic_forward,
        ..usual
    }))
}

/// Shares the address that it has already, and packets only.
fn proxy(args: &StationArgs, addresses: &[Prefix]) -> anyhow::Result<VnicOptions> {
    let Some(ip) = args.stack.ip else {
        bail!("--vnic-proxy shares the station's own address: give it one by --ip");
    };
    let usual = VnicOptions::proxy(ip);
    if args.vnic.vnic_mode != Some(VnicMode::Tun) {
        bail!("--vnic-proxy is about packets of IP, without an Ethernet of their own: add --vnic-mode tun");
    }
    if let Some(other) = addresses.iter().find(|address| !usual.addresses.contains(address)) {
        bail!(
            "--vnic-proxy shares the station's own address, {}: leave {other} out, or run the station with a VNIC that has \
             addresses of its own, without --vnic-proxy",
            usual.addresses[0]
        );
    }
    Ok(usual)
}

/// The ring that it is in.
fn ring(args: &StationArgs) -> anyhow::Result<RingConfig> {
    let said = &args.ring;
    if said.ring.is_empty() {
        bail!("--discipline token needs --ring ADDRESS,ADDRESS,...: all stations, in the order of the token");
    }
    let times = RingTimes {
        hold: said.token_hold,
        rest: said.token_rest,
        late: said.token_late,
        delay: said.token_delay,
        invite: said.token_invite,
    };
    let ring = times.ring(said.ring.clone(), args.rate);
    ring.check()?;
    Ok(ring)
}

/// Refuses what only a discipline with time slots could do; where late frames are, there may be a guard.
fn without_slots(args: &StationArgs, may_be_late: bool) -> anyhow::Result<()> {
    let said = [
        ("--master", args.master),
        ("--slave", args.slave),
        ("--cycle", args.cycle.is_some()),
        ("--sync-window", args.sync_window.is_some()),
        ("--slot", !args.slots.is_empty()),
        ("--slot-guard kernel", args.slot_guard == SlotGuard::Kernel && !may_be_late),
        ("--exclusive", args.exclusive && !may_be_late),
        ("--rounds", args.rounds.is_some()),
        ("--servo", args.servo.is_some()),
        ("--delay", args.delay.is_some()),
        ("--holdover", args.holdover.is_some()),
        ("--on-master-change", args.on_master_change.is_some()),
        ("--late", args.late.is_some()),
        ("--extensions", args.extensions),
    ];
    match said.iter().find(|(_, is_said)| *is_said) {
        Some((option, _)) => bail!(
            "{option} goes with time slots, which this discipline has not: leave it out, or run the station with \
             --discipline tdma"
        ),
        None => Ok(()),
    }
}

fn tdma(args: &StationArgs, lab: Option<&LabOptions>) -> anyhow::Result<TdmaConfig> {
    if !args.master && !args.slave {
        bail!("a station is --master, with --cycle, or --slave: say which");
    }
    let step_limit = lab.map(|lab| Span::from_nanos(lab.step_limit_ns));
    let follow = SlaveConfig {
        rounds: args.rounds.unwrap_or(DEFAULT_ROUNDS),
        step_limit,
        servo: args.servo.unwrap_or_default().servo(),
        delay_of: args.delay.map(DelayName::delay_of),
        holdover: args.holdover.unwrap_or(HOLDOVER_CYCLES.unsigned_abs()),
        on_master_change: args.on_master_change.unwrap_or_default().on_master_change(),
    };
    let role = match args.cycle.filter(|_| args.master) {
        Some(cycle) => {
            let window = sync_window(args, cycle);
            RoleConfig::Master(MasterConfig {
                cycle,
                sync_latest: station::sync_latest(window),
                reply_latest: args.latest,
                epoch: match lab {
                    Some(lab) => link::offset(lab.epoch),
                    None => station::epoch(&EmulatedClock::default()),
                },
                resume: lab.and_then(LabOptions::resume),
                backup: args.backup,
                backups_from: args.backups_from,
                max_requests: args.max_requests,
                behind_sync: room_for_replies(window, args.rate),
                follow,
            })
        }
        None => RoleConfig::Slave(follow),
    };
    let slots = args.slots.iter().map(|slot| slot.over(None).config(args.latest));
    let tdma = TdmaConfig {
        address: Address::default(),
        role,
        slots: slots.collect(),
        max_slot_id: args.max_slot_id,
        lead: args.lead,
        late: if args.late == Some(Late::Send) { LatePolicy::Send } else { LatePolicy::Skip },
    };
    // What cannot be is refused before anything is opened.
    Tdma::new(&tdma).map_err(|refused| anyhow!(refused))?;
    Ok(tdma)
}

fn sync_window(args: &StationArgs, cycle: Span) -> Span {
    args.sync_window.unwrap_or(default_sync_window(cycle, args.rate))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slots_are_read_as_the_help_says() {
        let slot = parse_slot("2=250us,phase=2/4,size=128,joint=0").unwrap();
        let (phase, period, size, joint) = (Some(1), Some(4), Some(128), Some(Some(0)));
        assert_eq!(slot, SlotChange { id: 2, offset_ns: 250_000, phase, period, size, joint });
        let moved = SlotChange { id: 2, offset_ns: 0, phase: None, period: None, size: None, joint: None };
        assert_eq!(parse_slot("2=0us").unwrap(), moved);
        assert_eq!(parse_slot("2=0us,joint=none").unwrap(), SlotChange { joint: Some(None), ..moved });
    }

    #[test]
    fn what_is_no_slot_says_what_to_write() {
        for (text, expected) in [
            ("100us", "write ID=OFFSET"),
            ("x=100us", "'x' is no slot id"),
            ("0=100", "no unit"),
            ("0=100us,phase=0/2", "'0/2' is no phase"),
            ("0=100us,size=big", "'big' is no size"),
            ("0=100us,joint=-1", "'-1' is no slot id: write joint=ID, or joint=none"),
            ("0=100us,join=1", "'join=1' means nothing here: only phase=P/N, size=B and joint=ID do"),
        ] {
            let error = parse_slot(text).unwrap_err();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
