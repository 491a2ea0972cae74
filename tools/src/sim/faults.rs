//! The events of a scenario, played in virtual time.

use rtnet::discipline::Discipline;
use rtnet::sim::Network;
use rtnet::wire::ethernet::{Address, EtherType, Header, MIN_FRAME};
use zerocopy::IntoBytes;

use crate::scenario::{Happening, Part, Scenario};

/// Does what concerns only the network; what stations there are is somebody else's.
pub fn act<D: Discipline>(network: &mut Network<D>, scenario: &Scenario, what: &Happening, part: Part) {
    let begins = part == Part::Begin;
    match what {
        Happening::Stop(stations, span) if begins => {
            stations.iter().for_each(|&id| network.freeze(id, *span))
        }
        Happening::Stall(stations, span) if begins => {
            stations.iter().for_each(|&id| network.stall_next(id, *span));
        }
        Happening::Clock(stations, step, drift_ppb, wandering) => {
            for &id in stations {
                let (now, clock) = (network.now(), network.member(id).clock);
                let changed = clock.at_rate(now, drift_ppb.unwrap_or(clock.drift_ppb)).stepped(*step);
                network.set_clock(id, changed);
                let around_ppb = drift_ppb.unwrap_or(network.rate_around(id));
                network.wander_around(id, around_ppb);
                if let Some(wandering) = wandering {
                    network.wander(id, super::world::wander(wandering, around_ppb));
                }
            }
        }
        Happening::Cut(stations, _) => network.cut_off(if begins { stations } else { &[] }),
        Happening::Unplug(stations, _) => {
            for &id in stations {
                let (sends_by, hears_by) = network.wire_mut(id);
                (sends_by.down, hears_by.down) = (begins, begins);
            }
        }
        Happening::Wires(wire, _) => {
            let event = begins.then_some(wire);
            super::world::set_wires(network, &scenario.conditions, &wire.stations, event);
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

#[cfg(test)]
mod tests {
    use rtmac::tdma::Tdma;

    use super::*;
    use crate::scenario::Source;
    use crate::sim::World;

    const NETWORK: &str = r#"
cycle = "1ms"
duration = "2s"
[[station]]
name = "master"
role = "master"
[[station]]
name = "wanders"
role = "slave"
clock = { drift_ppm = 10.0, wander = { step_ppm = 0.05, within_ppm = 0.1, every = "1ms" } }
[[event]]
at = "1s"
clock = { stations = "wanders", drift_ppm = 50.0 }
[[event]]
at = "1s"
clock = { stations = "wanders", wander = { step_ppm = 1.0, within_ppm = 5.0, every = "1ms" } }
[[event]]
at = "1s"
clock = { stations = "master", drift_ppm = -20.0, wander = { step_ppm = 1.0, within_ppm = 5.0, every = "1ms" } }
"#;

    #[test]
    fn a_clock_that_wanders_keeps_the_rate_that_an_event_gives_it_and_an_event_lets_it_wander_otherwise() {
        let scenario = Source::new("net.toml", NETWORK).parse().unwrap();
        let mut network = World::new(&scenario, |_| true).unwrap().network;
        let farthest = |network: &mut Network<Tdma>, id, around_ppb: i64| {
            let mut farthest = 0;
            for _ in 0..200 {
                network.run_until(network.now() + 1_000_000);
                farthest = farthest.max((network.member(id).clock.drift_ppb - around_ppb).abs());
            }
            farthest
        };
        let play = |network: &mut Network<Tdma>, event: usize| {
            act(network, &scenario, &scenario.conditions.events[event].what, Part::Begin);
        };
        assert!((51..=100).contains(&farthest(&mut network, 1, 10_000)));
        play(&mut network, 0);
        assert!((51..=100).contains(&farthest(&mut network, 1, 50_000)));
        play(&mut network, 1);
        assert!(
            (1_000..=5_000).contains(&farthest(&mut network, 1, 50_000)),
            "around the rate that it was given"
        );
        let masters = network.rate_around(0);
        assert_eq!(farthest(&mut network, 0, masters), 0, "the master's does not wander yet");
        play(&mut network, 2);
        assert!((1_000..=5_000).contains(&farthest(&mut network, 0, -20_000)));
    }
}
