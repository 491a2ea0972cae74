//! The events of a scenario, played in virtual time.

use rtmac::tdma::Tdma;
use rtnet::sim::{Link, Network};
use rtnet::wire::ethernet::{Address, EtherType, Header, MIN_FRAME};
use zerocopy::IntoBytes;

use crate::scenario::{Happening, Part, Scenario, Wire};

/// Does what concerns only the network; what stations there are is somebody else's.
pub fn act(network: &mut Network<Tdma>, scenario: &Scenario, what: &Happening, part: Part) {
    let begins = part == Part::Begin;
    match what {
        Happening::Stop(stations, span) if begins => {
            stations.iter().for_each(|&id| network.freeze(id, *span))
        }
        Happening::Stall(stations, span) if begins => {
            stations.iter().for_each(|&id| network.stall_next(id, *span));
        }
        Happening::Clock(stations, step, drift_ppb) => {
            for &id in stations {
                let (now, clock) = (network.now(), network.member(id).clock);
                let changed = clock.at_rate(now, drift_ppb.unwrap_or(clock.drift_ppb)).stepped(*step);
                network.set_clock(id, changed);
            }
        }
        Happening::Cut(stations, _) => network.cut_off(if begins { stations } else { &[] }),
        Happening::Unplug(stations, _) => {
            for &id in stations {
                let (sends_by, hears_by) = network.wire_mut(id);
                (sends_by.down, hears_by.down) = (begins, begins);
            }
        }
        Happening::Wires(wire, _) if begins => super::world::set_wire(network, wire),
        Happening::Wires(wire, _) => {
            super::world::set_wire(network, &Wire { link: Link::default(), ..wire.clone() });
            for always in &scenario.conditions.wires {
                let mut always = always.clone();
                always.stations.retain(|station| wire.stations.contains(station));
                super::world::set_wire(network, &always);
            }
        }
        Happening::Babble(id, ..) if part != Part::End => network.babble(*id, &noise(scenario.address(*id))),
        Happening::Inject(frame) => network.inject(frame),
        _ => {}
    }
}

/// What a station sends that has lost its mind: nobody's frame, to nobody.
fn noise(source: Address) -> [u8; MIN_FRAME] {
    let header = Header::new(Address([0x02, 0xff, 0xff, 0xff, 0xff, 0xff]), source, EtherType::EXPERIMENTAL);
    let mut frame = [0; MIN_FRAME];
    frame[..header.as_bytes().len()].copy_from_slice(header.as_bytes());
    // It says that it is of a station that is none.
    frame[14..16].fill(0xff);
    frame
}
