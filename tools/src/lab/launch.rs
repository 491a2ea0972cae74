//! How a lab starts its stations: the command lines of their processes.

use rtmac::tdma::{LatePolicy, schedule};
use rtnet::clock::{EmulatedClock, True};
use rtnet::time::{GlobalTime, Offset, Span};

use super::run::INTERFACE;
use crate::cli::VnicMode;
use crate::control::{ChangesTold, Home};
use crate::judge::givers::{TrueMaster, same_time};
use crate::report::figures::Role;
use crate::scenario::{Happening, RouterPlan, Scenario, ServoName, VnicPlan};
use crate::station::link::LabOptions;
use crate::station::stack::OwnIp;

/// A station's only VNIC, in a namespace of its own.
const VNIC: &str = "vnic0";

/// What all stations of a lab are started with.
#[derive(Clone, Debug)]
pub struct Launch {
    /// CLOCK_MONOTONIC at which only their clocks' offsets apply.
    pub anchor: True,
    /// From the master's clock to global time.
    pub epoch: Offset,
    /// The core of their real-time threads.
    pub cpu: usize,
    /// How long before their slots they wake.
    pub lead: Span,
    /// Whether those ask for SCHED_FIFO.
    pub fifo: bool,
    /// Where they are to be asked, if they are to be.
    pub home: Option<Home>,
}

/// Where a station goes on that comes after another process of its.
#[derive(Clone, Copy, Debug, Default)]
pub struct Resume {
    /// A cycle of the master's grid, and its scheduled start.
    pub grid: Option<(u32, GlobalTime)>,
    /// The number of its first frame of test traffic.
    pub first: u64,
    /// Its clock, if that is not as it was at first.
    pub clock: Option<EmulatedClock>,
}

/// The command line of a station's process, behind the verb.
pub fn arguments(
    scenario: &Scenario,
    station: usize,
    launch: &Launch,
    resume: &Resume,
) -> anyhow::Result<Vec<String>> {
    let Launch { anchor, cpu, lead, fifo, .. } = *launch;
    let master = TrueMaster { clock: clock(scenario, 0, anchor), epoch: launch.epoch };
    let own = resume.clock.unwrap_or_else(|| clock(scenario, station, anchor));
    let epoch = same_time(&master, &own);
    let plan = &scenario.stations[station];
    let mut line: Vec<String> = Vec::new();
    let mut add = |option: &str, value: String| line.extend([option.to_owned(), value]);
    add("--interface", INTERFACE.into());
    add("--cpu", cpu.to_string());
    add("--latest", scenario.latest().to_string());
    add("--lead", lead.to_string());
    if !fifo {
        add("--scheduling", "other".into());
    }
    if scenario.late == LatePolicy::Send {
        add("--late", "send".into());
    }
    add("--slot-guard", scenario.slot_guard.name().into());
    if scenario.servo == ServoName::None {
        add("--servo", "none".into());
    }
    if let Some(delay) = scenario.delay {
        add("--delay", delay.delay_of().name().into());
    }
    // Without a value.
    line.push("--exclusive".into());
    let mut add = |option: &str, value: String| line.extend([option.to_owned(), value]);
    for slot in &plan.slots {
        let (id, offset, size) = (slot.id, slot.offset, slot.size);
        let phase = format!("phase={}/{}", slot.phase + 1, slot.period);
        let joint = slot.joint.map_or(String::new(), |joint| format!(",joint={joint}"));
        add("--slot", format!("{id}={offset},{phase},size={size}{joint}"));
    }
    if let Some(OwnIp { ip, prefix }) = plan.ip {
        add("--ip", format!("{ip}/{prefix}"));
        // All know each other: nobody asks the medium.
        for (other, of) in scenario.stations.iter().enumerate().filter(|(other, _)| *other != station) {
            of.ip.iter().for_each(|of| add("--route", format!("{}={}", of.ip, scenario.address(other))));
        }
    }
    if let Some(VnicPlan { addresses, mode, proxy }) = &plan.vnic {
        add("--vnic-mode", mode.name().into());
        add("--vnic-name", VNIC.into());
        // Linux asks for the others' with Ethernet frames, but not with packets.
        let is_needed = |other: &usize| *other != station && *mode == VnicMode::Tun;
        for (other, of) in scenario.stations.iter().enumerate().filter(|(other, _)| is_needed(other)) {
            for prefix in of.vnic.iter().flat_map(|vnic| &vnic.addresses) {
                add("--vnic-peer", format!("{}={}", prefix.ip, scenario.address(other)));
            }
        }
        if *proxy {
            line.push("--vnic-proxy".into());
        }
        line.push("--vnic".into());
        line.extend(addresses.iter().map(ToString::to_string));
    }
    if let Some(packages) = &scenario.packages {
        line.push("--packages".into());
        let mut add = |option: &str, value: String| line.extend([option.to_owned(), value]);
        if plan.ip.is_some() {
            packages
                .routes
                .iter()
                .for_each(|route| add("--package-route", format!("{}={}", route.to, route.station)));
        }
        add("--package-system", packages.system.to_string());
        packages.priorities.iter().for_each(|file| add("--package-priorities", file.display().to_string()));
        if let Some(RouterPlan { address, keys, largest_body }) = &packages.router {
            add("--router", address.to_string());
            keys.iter().for_each(|keys| add("--router-keys", keys.display().to_string()));
            largest_body.iter().for_each(|bytes| add("--router-body", bytes.to_string()));
        }
        if packages.times && plan.ip.is_some() {
            line.push("--package-times".into());
        }
    }
    let mut add = |option: &str, value: String| line.extend([option.to_owned(), value]);
    let lab = LabOptions {
        station: station as u16,
        name: plan.name.clone(),
        control: launch.home.as_ref().map(|home| home.station(&plan.name)),
        anchor: own.anchor,
        offset_ns: own.offset.nanos(),
        drift_ppb: own.drift_ppb,
        epoch: epoch.nanos(),
        destination: scenario.address(scenario.receiver(station)).0,
        from: scenario.sender(station) as u16,
        payload: plan.payload,
        from_payload: scenario.stations[scenario.sender(station)].payload,
        step_limit_ns: schedule::step_limit(scenario.guard).nanos(),
        resume: resume.grid.map(|(cycle, sched)| (cycle, sched.nanos())),
        first: resume.first,
        flows: scenario.flow_plan(station),
        changes: ChangesTold::of(scenario, plan.role != Role::Slave),
        may_stall: scenario.conditions.events.iter().any(|event| matches!(event.what, Happening::Stall(..))),
    };
    add("--lab", serde_json::to_string(&lab)?);
    add("--rounds", plan.rounds.to_string());
    if plan.role == Role::Slave {
        line.push("--slave".into());
        return Ok(line);
    }
    add("--cycle", scenario.cycle.to_string());
    add("--sync-window", scenario.sync_window.to_string());
    match (plan.backup, scenario.stations.iter().filter_map(|station| station.backup).min()) {
        (Some(backup), _) => add("--backup", backup.to_string()),
        (None, Some(first)) => add("--backups-from", first.to_string()),
        (None, None) => {}
    }
    line.push("--master".into());
    Ok(line)
}

/// The clock of a station, as its scenario begins.
pub fn clock(scenario: &Scenario, station: usize, anchor: True) -> EmulatedClock {
    let plan = &scenario.stations[station];
    EmulatedClock { anchor, offset: plan.clock_offset, drift_ppb: plan.clock_drift_ppb }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Source;

    const NETWORK: &str = "cycle = \"1ms\"\n[[station]]\nname = \"arm\"\nrole = \"slave\"\n[[station]]\nname = \"m\"\n\
                           role = \"master\"\n[[station]]\nname = \"leg\"\nrole = \"slave\"\n";

    fn launch() -> Launch {
        let lead = Span::from_micros(50);
        Launch { anchor: 0, epoch: Offset::default(), cpu: 0, lead, fifo: false, home: None }
    }

    /// What a station is told of its stack, in pairs of an option and its value.
    fn told(text: &str, station: usize) -> Vec<String> {
        let scenario = Source::new("net.toml", text).parse().unwrap();
        let launch = launch();
        let line = arguments(&scenario, station, &launch, &Resume::default()).unwrap();
        let pairs = line.windows(2).filter(|pair| ["--ip", "--route"].contains(&pair[0].as_str()));
        pairs.map(|pair| pair.join(" ")).collect()
    }

    #[test]
    fn only_packets_need_to_be_told_which_station_has_an_address_of_a_vnic() {
        for (mode, expected) in [("tap", 0), ("tun", 2)] {
            let ips = ["10.1.0.1/24", "10.1.0.2/24", "10.1.0.3/24"].into_iter();
            let mut text = format!("vnic_mode = \"{mode}\"\n");
            for (lines, ip) in NETWORK.split_inclusive("\"\nrole").zip(ips.chain([""])) {
                text += &lines.replace("\"\nrole", &format!("\"\nvnic = \"{ip}\"\nrole"));
            }
            let scenario = Source::new("net.toml", &text).parse().unwrap();
            let launch = launch();
            let line = arguments(&scenario, 1, &launch, &Resume::default()).unwrap();
            assert_eq!(line.iter().filter(|word| *word == "--vnic-peer").count(), expected, "{line:?}");
        }
    }

    #[test]
    fn stations_join_the_router_of_their_file() {
        let text = format!(
            "network = \"10.0.0.0/24\"\npackages = true\nrouter = \"10.1.0.4\"\nrouter_body = 20000\n{NETWORK}"
        );
        let scenario = Source::new("net.toml", &text).parse().unwrap();
        let line = arguments(&scenario, 2, &launch(), &Resume::default()).unwrap();
        let joins = ["--router", "10.1.0.4:2000", "--router-body", "20000"];
        assert!(line.windows(joins.len()).any(|words| words == joins), "{line:?}");
    }

    #[test]
    fn stations_with_addresses_know_all_others_of_their_lab_and_others_have_no_sockets() {
        let with = format!("network = \"10.0.0.0/24\"\n{NETWORK}");
        assert_eq!(
            told(&with, 1),
            ["--ip 10.0.0.2/24", "--route 10.0.0.1=02:00:00:00:00:01", "--route 10.0.0.3=02:00:00:00:00:03"]
        );
        assert!((0..3).all(|station| told(NETWORK, station).is_empty()));
        let one = NETWORK.replace("\"leg\"", "\"leg\"\nip = \"10.0.0.9/24\"");
        assert_eq!((told(&one, 2), told(&one, 0)), (vec!["--ip 10.0.0.9/24".to_owned()], vec![]));
    }
}
