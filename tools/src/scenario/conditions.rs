//! What a network goes through: its medium, its hosts, its wires, and what happens when. Without any of it, a
//! simulation is of ideal hosts on a bridge.

use rtnet::sim::{Host, Joint, Medium};
use rtnet::time::Span;

use super::{Expectation, Place, Wire};

/// The conditions of a network, and what is expected of it under them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Conditions {
    /// What joins the stations.
    pub joint: Joint,
    /// From any station to any other; of a switch, to it.
    pub propagation: Option<Span>,
    /// What every station's host is like, unless its own is given.
    pub host: Host,
    /// Hosts of single stations.
    pub hosts: Vec<(usize, Host)>,
    /// Clocks that wander: the station, how often by how much, and how far, in parts per billion.
    pub wanders: Vec<(usize, Wandering)>,
    /// What is said of wires throughout, in the order of the file.
    pub wires: Vec<Wire>,
    /// What happens, in the order of the file.
    pub events: Vec<Event>,
    /// What the run must show.
    pub expectations: Vec<Expectation>,
}

impl Conditions {
    /// How long a frame is on its way at the least, from its begin at the sender to that at a receiver.
    pub fn way(&self) -> Span {
        let propagation = self.propagation.unwrap_or(Medium::default().propagation);
        match self.joint {
            Joint::Switch { latency, .. } => propagation * 2 + latency,
            Joint::Bridge | Joint::Hub => propagation,
        }
    }
}

/// How a clock's rate changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wandering {
    /// How often.
    pub every: Span,
    /// By how much at most, parts per billion.
    pub step_ppb: i64,
    /// How far from its drift, parts per billion.
    pub within_ppb: i64,
}

/// Something that happens to a network, once or repeatedly.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// How long after the begin of the measurement.
    pub at: Span,
    /// How often altogether, and how long after each other.
    pub times: u32,
    /// See `times`.
    pub every: Span,
    /// What.
    pub what: Happening,
    /// Where it stands in its file.
    pub place: Place,
}

/// What can happen.
#[derive(Clone, Debug, PartialEq)]
pub enum Happening {
    /// Stations end at once, and say nothing more.
    Kill(Vec<usize>),
    /// New processes take the place of stations, dead or not.
    Restart(Vec<usize>),
    /// Stations that were not there before begin.
    Start(Vec<usize>),
    /// Stations are stopped for so long, as by SIGSTOP.
    Stop(Vec<usize>, Span),
    /// The next frame of each is held up for so long behind its last look at the clock.
    Stall(Vec<usize>, Span),
    /// Clocks show so much more from now on, run at another rate, parts per billion, and wander.
    Clock(Vec<usize>, Span, Option<i64>, Option<Wandering>),
    /// The medium falls apart for so long: these on one side, the others on the other.
    Cut(Vec<usize>, Span),
    /// Wires are out for so long.
    Unplug(Vec<usize>, Span),
    /// Wires do this besides for so long.
    Wires(Wire, Span),
    /// A station sends a frame again and again at any time, for so long.
    Babble(usize, Span, Span),
    /// A foreign frame is on the medium.
    Inject(Vec<u8>),
}

impl Happening {
    /// How long it lasts.
    pub fn lasts(&self) -> Span {
        match *self {
            Happening::Stop(_, span)
            | Happening::Stall(_, span)
            | Happening::Cut(_, span)
            | Happening::Unplug(_, span)
            | Happening::Wires(_, span)
            | Happening::Babble(_, span, _) => span,
            Happening::Kill(_)
            | Happening::Restart(_)
            | Happening::Start(_)
            | Happening::Clock(..)
            | Happening::Inject(_) => Span::ZERO,
        }
    }

    /// The stations that are not there until they are started by this.
    pub fn starts(&self) -> &[usize] {
        if let Happening::Start(stations) = self { stations } else { &[] }
    }
}

impl Happening {
    /// Of those that last, which undo each other where they are at once, and whose they are; all stations': none.
    pub(super) fn undoes(&self) -> Option<(&'static str, &[usize])> {
        match self {
            Happening::Stop(stations, _) => Some(("stop", stations)),
            Happening::Unplug(stations, _) => Some(("unplug", stations)),
            Happening::Wires(wire, _) => Some(("wire", &wire.stations)),
            Happening::Cut(..) => Some(("cut", &[])),
            _ => None,
        }
    }
}

impl Event {
    /// Each time that it happens, after the begin of the measurement.
    pub fn instants(&self) -> impl Iterator<Item = Span> {
        (0..self.times).map(|i| self.at + self.every * i64::from(i))
    }

    /// When it happens for the last time and is over.
    pub fn is_over(&self) -> Span {
        self.at + self.every * i64::from(self.times.saturating_sub(1)) + self.what.lasts()
    }
}

impl Conditions {
    /// A station's host.
    pub fn host(&self, station: usize) -> &Host {
        self.hosts.iter().find(|(of, _)| *of == station).map_or(&self.host, |(_, host)| host)
    }

    /// Whether anything is asked for that only a simulation does.
    pub fn is_default(&self) -> bool {
        *self == Conditions::default()
    }

    /// Whether its events hold a station up, or set the clock by which it is late.
    pub fn holds_up(&self, station: usize) -> bool {
        self.events.iter().any(|event| match &event.what {
            Happening::Stop(stations, _) | Happening::Stall(stations, _) | Happening::Clock(stations, ..) => {
                stations.contains(&station)
            }
            _ => false,
        })
    }

    /// Stations in the order that `place` gives each: the numbers in here are of the order before.
    pub fn renumber(&mut self, place: impl Fn(usize) -> usize) {
        let all =
            |stations: &mut Vec<usize>| stations.iter_mut().for_each(|station| *station = place(*station));
        self.hosts.iter_mut().for_each(|(station, _)| *station = place(*station));
        self.wanders.iter_mut().for_each(|(station, _)| *station = place(*station));
        self.wires.iter_mut().for_each(|wire| all(&mut wire.stations));
        self.expectations.iter_mut().for_each(|expected| {
            expected.station = expected.station.map(&place);
        });
        for event in &mut self.events {
            match &mut event.what {
                Happening::Kill(stations)
                | Happening::Restart(stations)
                | Happening::Start(stations)
                | Happening::Stop(stations, _)
                | Happening::Stall(stations, _)
                | Happening::Clock(stations, ..)
                | Happening::Cut(stations, _)
                | Happening::Unplug(stations, _)
                | Happening::Wires(Wire { stations, .. }, _) => all(stations),
                Happening::Babble(station, ..) => *station = place(*station),
                Happening::Inject(_) => {}
            }
        }
    }
}
