//! These need root, and say SKIP without.

use std::thread::sleep;
use std::time::Duration;

use pnet_datalink::{Channel, Config, DataLinkSender};

use super::*;
use crate::lab::namespace::Namespace;
use crate::lab::run::INTERFACE;
use crate::scenario::Source;

const LOSSY: &str = r#"
cycle = "4ms"
duration = "2s"
[[station]]
name = "master"
role = "master"
[[station]]
name = "slave"
role = "slave"
[[event]]
at = "500ms"
wire = { stations = "slave", direction = "in", lose_data = "100%" }
for = "1s"
"#;
/// The station that loses.
const SLAVE: usize = 1;

/// Two stations on a medium, as a lab has them.
struct Network {
    scenario: Scenario,
    segment: Segment,
    stations: Vec<Namespace>,
    wires: Wires,
}

impl Network {
    /// None, aloud, where the host has none.
    fn up() -> Option<Self> {
        let skip = |why: &str| {
            let _ = std::io::Write::write_all(&mut std::io::stderr(), format!("SKIP: {why}\n").as_bytes());
        };
        if !nix::unistd::geteuid().is_root() {
            skip("needs root");
            return None;
        }
        let scenario = Source::new("lossy.toml", LOSSY).parse().unwrap();
        let mut segment = Segment::new().unwrap();
        let attach = |station: usize| {
            let namespace = Namespace::new().unwrap();
            let address = scenario.address(station).0;
            segment.attach(&namespace, &port_name(station), INTERFACE, address).unwrap();
            namespace
        };
        let stations = (0..scenario.stations.len()).map(attach).collect();
        let (wires, refused) = Wires::of(&scenario, &segment).unwrap();
        if let Some(line) = refused {
            skip(&line);
            return None;
        }
        Some(Self { scenario, segment, stations, wires })
    }

    /// The slave's interface goes, and it gets another.
    fn rewire_slave(&mut self) {
        self.segment.detach(&port_name(SLAVE)).unwrap();
        let (station, address) = (&self.stations[SLAVE], self.scenario.address(SLAVE).0);
        self.segment.attach(station, &port_name(SLAVE), INTERFACE, address).unwrap();
        self.wires.mend(&self.segment, SLAVE).unwrap();
    }

    /// The master sends so many frames to the slave, which is to lose all of them or none: how many were lost by now, of all
    /// that ever were sent.
    fn lost_after(&self, frames: u64, are_lost: bool) -> u64 {
        let mut sender = self.sender();
        let before = self.wires.counts(SLAVE).lost_data;
        let frame =
            [&self.scenario.address(SLAVE).0[..], &self.scenario.address(0).0, &[0x88, 0xb5], &[0; 46]];
        (0..frames).for_each(|_| sender.send_to(&frame.concat(), None).unwrap().unwrap());
        // The kernel takes them on from a queue: what is expected is waited for, and what is not, for a moment.
        let lost = || self.wires.counts(SLAVE).lost_data;
        for _ in 0..if are_lost { 20_000 } else { 100 } {
            if lost() == before + frames {
                break;
            }
            sleep(Duration::from_millis(1));
        }
        lost()
    }

    fn sender(&self) -> Box<dyn DataLinkSender> {
        let open = || {
            let interface = pnet_datalink::interfaces().into_iter().find(|of| of.name == INTERFACE).unwrap();
            let channel = pnet_datalink::channel(&interface, Config::default()).unwrap();
            let Channel::Ethernet(sender, _) = channel else { panic!("not an Ethernet channel") };
            sender
        };
        self.stations[0].run(open).unwrap()
    }
}

#[test]
fn a_station_with_another_port_loses_what_it_is_to_lose_by_then_and_its_counts_add_up() {
    let Some(mut network) = Network::up() else { return };
    assert_eq!(network.lost_after(2, false), 0, "nothing has happened yet");
    let Happening::Wires(wire, _) = &network.scenario.conditions.events[0].what else { panic!("no wire") };
    network.wires.set(&network.scenario.conditions, &[SLAVE], Some(wire));
    assert_eq!(network.lost_after(3, true), 3);
    network.rewire_slave();
    assert_eq!(network.lost_after(2, true), 5, "the event is under way");
    network.wires.set(&network.scenario.conditions, &[SLAVE], None);
    network.rewire_slave();
    assert_eq!(network.lost_after(2, false), 5, "it is over");
}

#[test]
fn a_station_that_is_cut_off_stays_so_with_another_port() {
    let Some(mut network) = Network::up() else { return };
    network.wires.cut_off(&[SLAVE]);
    network.rewire_slave();
    assert_eq!(network.lost_after(2, true), 2);
    network.wires.cut_off(&[]);
    assert_eq!(network.lost_after(1, false), 2);
}
