//! The events of a ring's scenario, as far as a host can play them.

use std::collections::VecDeque;

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use rtnet::clock::{EmulatedClock, True};
use rtnet::live::clock::monotonic;
use rtnet::time::Span;

use super::Lab;
use crate::lab::run::port_name;
use crate::scenario::{Act, Event, Happening, Part, acts};
use crate::station::link::Order;

/// An act is told of that is later than this: it waits for the next look, and a moment for the kernel.
const LATE: Span = Span::from_millis(20);
/// A station is told of what happens to it so much later at the most, on a host that is busy with others.
const TOLD_WITHIN: Span = Span::from_millis(100);

/// What is still to be played.
#[derive(Default)]
pub struct Play {
    acts: VecDeque<Act>,
    /// Stations that are started anew as soon as their processes have ended.
    restarting: Vec<usize>,
    latest: Span,
}

impl Play {
    /// Everything, if the measurement begins then.
    pub fn of(events: &[Event], begin: True) -> Self {
        Self { acts: acts(events, begin).into(), ..Self::default() }
    }

    /// Whoever reads how long something took is to know that it was not as long as the scenario says.
    pub fn note_late(&self, notes: &mut Vec<String>) {
        if self.latest > LATE {
            notes.push(format!("this host was busy: events began or ended up to {} late", self.latest));
        }
    }
}

impl Lab<'_> {
    /// Plays what is due.
    pub(super) fn act(&mut self) -> Result<()> {
        let now = monotonic();
        let scenario = self.scenario;
        while let Some(act) = self.play.acts.pop_front_if(|act| act.at <= now) {
            let event = &scenario.network.conditions.events[act.event];
            if act.part == Part::Begin {
                let until = act.at + event.what.lasts().nanos() as u64 + TOLD_WITHIN.nanos() as u64;
                self.judge.happens(act.at, until);
            }
            self.happens(&event.what, act.part)
                .with_context(|| format!("the event of line {}", event.place.line))?;
            let late = Span::from_nanos(monotonic().saturating_sub(act.at) as i64);
            self.play.latest = self.play.latest.max(late);
        }
        let ready: Vec<usize> =
            self.play.restarting.extract_if(.., |station| self.members[*station].silent).collect();
        for station in ready {
            self.judge.begins_anew(station);
            let now = monotonic();
            // Until it runs.
            self.judge.happens(now, now + 10 * TOLD_WITHIN.nanos() as u64);
            self.members[station].begins_anew();
            let first = self.judge.beyond(station);
            self.start(station, first)?;
        }
        Ok(())
    }

    fn happens(&mut self, what: &Happening, part: Part) -> Result<()> {
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
                for member in stations.iter().map(|&station| &self.members[station]) {
                    // Who has ended meanwhile is neither stopped nor let go on.
                    if !member.silent {
                        kill(Pid::from_raw(member.pid() as i32), to)?;
                    }
                }
            }
            Happening::Stall(stations, span) if begins => {
                let order = Order::Stall(span.nanos().max(0) as u64);
                stations.iter().for_each(|&station| self.members[station].order(order));
            }
            Happening::Clock(stations, step, drift_ppb, _) => {
                for &station in stations {
                    let member = &mut self.members[station];
                    let drift = drift_ppb.unwrap_or(member.clock.drift_ppb);
                    let set = member.clock.at_rate(monotonic(), drift).stepped(*step);
                    member.clock = set;
                    self.judge.set_clock(station, set);
                    let EmulatedClock { anchor, offset, drift_ppb } = set;
                    member.order(Order::Clock { anchor, offset_ns: offset.nanos(), drift_ppb });
                }
            }
            Happening::Unplug(stations, _) => {
                for &station in stations {
                    if begins {
                        // It is out a moment before the kernel says so, and longer than asked for.
                        let (now, lasts) = (monotonic(), what.lasts() + TOLD_WITHIN);
                        let sender = self.scenario.network.sender(station);
                        let before = LATE.nanos() as u64;
                        self.judge.is_unheard(sender, now - before, now + lasts.nanos() as u64);
                    }
                    let mut netlink = self.segment.namespace().netlink()?;
                    let port = netlink.link_index(&port_name(station))?;
                    if begins { netlink.set_down(port) } else { netlink.set_up(port) }?;
                }
            }
            Happening::Wires(wire, _) => {
                let conditions = &self.scenario.network.conditions;
                self.wires.set(conditions, &wire.stations, begins.then_some(wire));
            }
            // Only a simulation has these, which was told.
            _ => {}
        }
        Ok(())
    }
}
