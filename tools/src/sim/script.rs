//! What happens when: the events of a scenario, each with its begin and its end.

use rtmac::tdma::Tdma;
use rtnet::clock::True;
use rtnet::sim::{Link, Network};
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, EtherType, Header, MIN_FRAME};
use zerocopy::IntoBytes;

use crate::scenario::{Happening, Scenario, Wire};

/// One thing to do.
#[derive(Clone, Debug, PartialEq)]
pub struct Act {
    /// When, in true time.
    pub at: True,
    /// The event's place in the scenario.
    pub event: usize,
    /// What of it.
    pub part: Part,
}

/// A part of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// It begins.
    Begin,
    /// Once more of what it does again and again.
    Again,
    /// It is over.
    End,
}

/// Everything that is to be done, in order.
pub fn acts(scenario: &Scenario, begin: True) -> Vec<Act> {
    let mut acts = Vec::new();
    for (event, plan) in scenario.conditions.events.iter().enumerate() {
        for instant in plan.instants() {
            let at = |span: Span| begin + (instant + span).nanos().max(0) as u64;
            let mut act = |span, part| acts.push(Act { at: at(span), event, part });
            act(Span::ZERO, Part::Begin);
            if let Happening::Babble(_, lasts, every) = plan.what {
                let mut span = every;
                while span < lasts {
                    act(span, Part::Again);
                    span = span + every;
                }
            }
            if plan.what.lasts() > Span::ZERO {
                act(plan.what.lasts(), Part::End);
            }
        }
    }
    // Of one instant in the order of the file; what ends, ends before what begins.
    acts.sort_by_key(|act| (act.at, act.part != Part::End));
    acts
}

/// When the last of all events is over, after the begin.
pub fn over(scenario: &Scenario) -> Span {
    scenario.conditions.events.iter().map(crate::scenario::Event::is_over).max().unwrap_or(Span::ZERO)
}

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
            let always = scenario.conditions.wires.iter();
            always.for_each(|wire| super::world::set_wire(network, wire));
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
