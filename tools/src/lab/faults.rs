//! The events of a scenario, as far as a host can play them: it ends, stops and starts processes, and cuts wires.

use std::collections::VecDeque;

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use rtnet::clock::True;
use rtnet::live::clock::monotonic;

use super::run::{Lab, port_name};
use crate::scenario::{Act, Conditions, Happening, Part, Scenario, acts};

/// What is still to be played.
#[derive(Default)]
pub struct Play {
    acts: VecDeque<Act>,
    /// Stations that are started anew as soon as their processes have ended.
    restarting: Vec<usize>,
}

/// Whether a host can do this to its stations.
fn can_play(what: &Happening) -> bool {
    matches!(what, Happening::Kill(_) | Happening::Restart(_) | Happening::Stop(..) | Happening::Unplug(..))
}

/// What of a scenario only a simulation has; each in a line for the reader.
pub fn only_simulated(conditions: &Conditions) -> Vec<String> {
    let Conditions { joint, propagation, host, hosts, wanders, wires, events, expectations } = conditions;
    let default = Conditions::default();
    let sections = [
        ("[medium]", *joint != default.joint || propagation.is_some()),
        ("[host]", *host != default.host || !hosts.is_empty()),
        ("[[wire]]", !wires.is_empty()),
        ("wander", !wanders.is_empty()),
    ];
    let sections = sections.iter().filter(|(_, is_said)| *is_said).map(|(name, _)| (*name).to_owned());
    let events = events.iter().filter(|event| !can_play(&event.what));
    let mut names: Vec<String> = sections.collect();
    names.extend(events.map(|event| format!("the event of line {}", event.line)));
    let unmeasured = expectations.iter().filter(|expected| !expected.measure.is_of_labs());
    names.extend(unmeasured.map(|expected| format!("{} of line {}", expected.measure.name(), expected.line)));
    let line = |name| format!("only in a simulation (rtnet sim run), and not here: {name}");
    names.into_iter().map(line).collect()
}

impl Lab {
    /// Everything that is to be played, if the measurement begins then.
    pub(super) fn prepare(&mut self, scenario: &Scenario, begin: True) {
        let events = &scenario.conditions.events;
        let acts = acts(events, begin).into_iter().filter(|act| can_play(&events[act.event].what));
        self.play = Play { acts: acts.collect(), restarting: Vec::new() };
    }

    /// Plays what is due.
    pub(super) fn play(&mut self, scenario: &Scenario) -> Result<()> {
        let now = monotonic();
        while let Some(act) = self.play.acts.pop_front_if(|act| act.at <= now) {
            let event = &scenario.conditions.events[act.event];
            self.act(&event.what, act.part).with_context(|| format!("the event of line {}", event.line))?;
        }
        let ended = |&mut station: &mut usize| self.members[station].silent;
        let ready: Vec<usize> = self.play.restarting.extract_if(.., ended).collect();
        ready.into_iter().try_for_each(|station| self.restart(scenario, station))?;
        if !scenario.conditions.events.is_empty() {
            self.note_stopped();
        }
        Ok(())
    }

    fn act(&mut self, what: &Happening, part: Part) -> Result<()> {
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
                let to = if part == Part::End { Signal::SIGCONT } else { Signal::SIGSTOP };
                for &station in stations {
                    let member = &self.members[station];
                    // Who has ended meanwhile is neither stopped nor let go on.
                    if !member.silent {
                        kill(Pid::from_raw(member.pid() as i32), to)?;
                    }
                }
            }
            Happening::Unplug(stations, _) => {
                let mut netlink = self.segment.namespace().netlink()?;
                for &station in stations {
                    let port = netlink.link_index(&port_name(station))?;
                    if part == Part::End { netlink.set_up(port)? } else { netlink.set_down(port)? }
                }
            }
            _ => {}
        }
        Ok(())
    }
}
