//! The events of a scenario, as far as a host can play them: it ends, stops and starts processes, has them held up before
//! they send, cuts wires, and has its kernel lose, change and double frames.

use std::collections::VecDeque;

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use rtnet::clock::{EmulatedClock, True};
use rtnet::live::clock::monotonic;
use rtnet::time::Span;

use super::launch::clock;
use super::run::{Lab, port_name};
use crate::judge::clocks::set_clock;
use crate::scenario::{Act, Conditions, Happening, Part, Scenario, acts};
use crate::station::link::Order;

/// An act is told of that is later than this: it waits for the next look, and a moment for the kernel.
const LATE: Span = Span::from_millis(20);
/// A station is told of its clock so much later at the most, on a host that is busy with others.
const CLOCK_LATE: Span = Span::from_millis(100);
/// Whoever is to be held up sends within so many cycles.
const HELD_UP_WITHIN: i64 = 8;

/// What is still to be played.
#[derive(Default)]
pub struct Play {
    acts: VecDeque<Act>,
    /// Stations that are started anew as soon as their processes have ended.
    restarting: Vec<usize>,
    /// Stations whose wire is out now.
    unplugged: Vec<usize>,
    /// By how much an act was late at the worst, and the line of its event.
    latest: (Span, usize),
    /// Stations that are held up before they send, from when until when at the latest.
    held_up: Vec<(usize, True, True)>,
}

impl Play {
    /// Since when a station that ends now may have been held up, and could tell nothing.
    pub(super) fn held_up_since(&self, station: usize, now: True) -> Option<True> {
        let of_it =
            |&&(of, from, until): &&(usize, True, True)| of == station && (from..=until).contains(&now);
        self.held_up.iter().find(of_it).map(|&(_, from, _)| from)
    }
}

/// Whether a host can do this to its stations.
fn can_play(what: &Happening) -> bool {
    use Happening::*;
    matches!(what, Kill(_) | Restart(_) | Stop(..) | Stall(..) | Unplug(..) | Wires(..) | Cut(..) | Clock(..))
}

/// What of a scenario only a simulation has; each in a line for the reader.
pub fn only_simulated(conditions: &Conditions) -> Vec<String> {
    let Conditions { joint, propagation, host, hosts, wanders, wires, events, expectations } = conditions;
    let default = Conditions::default();
    let sections = [
        ("[medium]", *joint != default.joint || propagation.is_some()),
        ("[host]", *host != default.host || !hosts.is_empty()),
        ("delay and reorder of a [[wire]]", wires.iter().any(|wire| wire.effects.hold_back())),
        ("wander", !wanders.is_empty()),
    ];
    let sections = sections.iter().filter(|(_, is_said)| *is_said).map(|(name, _)| (*name).to_owned());
    let mut names: Vec<String> = sections.collect();
    names.extend(events.iter().filter_map(|event| match &event.what {
        Happening::Wires(wire, _) if wire.effects.hold_back() => {
            Some(format!("delay and reorder of the event of line {}", event.place.line))
        }
        Happening::Clock(.., Some(_)) => Some(format!("wander of the event of line {}", event.place.line)),
        what => (!can_play(what)).then(|| format!("the event of line {}", event.place.line)),
    }));
    let unmeasured = expectations.iter().filter(|expected| !expected.measure.is_of_labs());
    names.extend(
        unmeasured.map(|expected| format!("{} of line {}", expected.measure.name(), expected.place.line)),
    );
    let line = |name| format!("only in a simulation (rtnet sim run), and not here: {name}");
    names.into_iter().map(line).collect()
}

impl Lab {
    /// Everything that is to be played, if the measurement begins then.
    pub(super) fn prepare(&mut self, scenario: &Scenario, begin: True) {
        let events = &scenario.conditions.events;
        let acts = acts(events, begin).into_iter().filter(|act| can_play(&events[act.event].what));
        self.play = Play { acts: acts.collect(), ..Play::default() };
    }

    /// Plays what is due.
    pub(super) fn play(&mut self, scenario: &Scenario) -> Result<()> {
        let now = monotonic();
        while let Some(act) = self.play.acts.pop_front_if(|act| act.at <= now) {
            let event = &scenario.conditions.events[act.event];
            self.act(scenario, &event.what, act.part)
                .with_context(|| format!("the event of line {}", event.place.line))?;
            let late = Span::from_nanos(monotonic().saturating_sub(act.at) as i64);
            self.play.latest = self.play.latest.max((late, event.place.line));
        }
        let ended = |&mut station: &mut usize| self.members[station].silent;
        let ready: Vec<usize> = self.play.restarting.extract_if(.., ended).collect();
        ready.into_iter().try_for_each(|station| self.restart(scenario, station))?;
        if !scenario.conditions.events.is_empty() {
            self.note_stopped();
        }
        Ok(())
    }

    /// Whoever reads how long something took is to know that it was not as long as the scenario says.
    pub(super) fn note_late_events(&mut self) {
        let (late, line) = self.play.latest;
        if late > LATE {
            self.notes
                .push(format!("this host was busy: events began or ended up to {late} late (line {line})"));
        }
    }

    fn act(&mut self, scenario: &Scenario, what: &Happening, part: Part) -> Result<()> {
        let begins = part == Part::Begin;
        match what {
            Happening::Kill(stations) => stations.iter().for_each(|&station| self.members[station].kill()),
            Happening::Restart(stations) => {
                for &station in stations {
                    self.members[station].kill();
                    if !self.play.restarting.contains(&station) {
                        self.play.restarting.push(station);
                    }
                }
            }
            Happening::Stop(stations, _) => {
                let to = if begins { Signal::SIGSTOP } else { Signal::SIGCONT };
                for &station in stations {
                    let member = &self.members[station];
                    // Who has ended meanwhile is neither stopped nor let go on.
                    if !member.silent {
                        kill(Pid::from_raw(member.pid() as i32), to)?;
                    }
                }
            }
            Happening::Stall(stations, span) if begins => {
                let order = Order::Stall(span.nanos().max(0) as u64);
                // It begins with a frame of the station, and may still be told of.
                let over =
                    monotonic() + (*span + self.analysis.cycle() * HELD_UP_WITHIN + LATE).nanos() as u64;
                for &station in stations {
                    self.members[station].order(order);
                    self.play.held_up.push((station, monotonic(), over));
                }
            }
            Happening::Clock(stations, step, drift_ppb, _) => {
                for &station in stations {
                    let (now, member) = (monotonic(), &mut self.members[station]);
                    let before = member.clock.unwrap_or_else(|| clock(scenario, station, self.launch.anchor));
                    let set = before.at_rate(now, drift_ppb.unwrap_or(before.drift_ppb)).stepped(*step);
                    member.clock = Some(set);
                    let of = (&mut self.analysis, &mut self.records);
                    let late = CLOCK_LATE.nanos() / scenario.cycle.nanos() + 1;
                    set_clock(of, (station, set, *step), now, late as u32);
                    let EmulatedClock { anchor, offset, drift_ppb } = set;
                    member.order(Order::Clock { anchor, offset_ns: offset.nanos(), drift_ppb });
                }
            }
            Happening::Unplug(stations, _) => {
                self.play.unplugged.retain(|station| !stations.contains(station));
                if begins {
                    self.play.unplugged.extend(stations);
                }
                stations.iter().try_for_each(|&station| self.plug(station))?;
            }
            Happening::Wires(wire, _) => {
                self.wires.set(&scenario.conditions, &wire.stations, begins.then_some(wire));
            }
            Happening::Cut(stations, _) => {
                // What was lost by now was lost as it was until now.
                self.take_lost();
                let cut_off: &[usize] = if begins { stations } else { &[] };
                self.wires.cut_off(cut_off);
                if self.wires.are_there() {
                    self.analysis.cut_off(cut_off);
                    if let Some(now) = self.analysis.cycle_at(monotonic()) {
                        self.records.cuts.note(begins, now);
                    }
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Has a station's wire in or out, as it is to be now.
    pub(super) fn plug(&self, station: usize) -> Result<()> {
        let mut netlink = self.segment.namespace().netlink()?;
        // Without a port there is none: the next is as it is to be by then.
        let Ok(port) = netlink.link_index(&port_name(station)) else { return Ok(()) };
        if self.play.unplugged.contains(&station) { netlink.set_down(port) } else { netlink.set_up(port) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_ends_while_it_may_be_held_up_has_been_so_since_that_began() {
        let play = Play { held_up: vec![(1, 100, 200), (1, 500, 600), (2, 150, 900)], ..Play::default() };
        let since = |station, now| play.held_up_since(station, now);
        assert_eq!(
            [99, 100, 200, 201, 550].map(|now| since(1, now)),
            [None, Some(100), Some(100), None, Some(500)]
        );
        assert_eq!((since(2, 550), since(3, 550)), (Some(150), None));
    }
}
