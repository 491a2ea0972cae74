//! Who gives the time, and what that time truly is: a backup goes on with the grid by its own clock.

use rtnet::clock::{EmulatedClock, True};
use rtnet::time::{GlobalTime, Offset, Span};
use rtnet::wire::ethernet::Address;

use crate::report::figures::Role;
use crate::scenario::Scenario;

/// The clock of a master, which the emulation knows.
#[derive(Clone, Copy, Debug)]
pub struct TrueMaster {
    /// Its clock.
    pub clock: EmulatedClock,
    /// From its clock to global time.
    pub epoch: Offset,
}

impl TrueMaster {
    /// The true moment at which global time is `at`.
    pub fn truth(&self, at: GlobalTime) -> True {
        self.clock.truth(self.epoch.local(at))
    }
    /// Global time at a true moment.
    pub fn global(&self, at: True) -> GlobalTime {
        self.epoch.global(self.clock.local(at))
    }
}

/// The master and its backups.
#[derive(Debug)]
pub struct Givers {
    all: Vec<Giver>,
    /// Which of them gives the time, and whether any has done so yet.
    now: usize,
    has_begun: bool,
    /// When that one took over.
    since: True,
}

#[derive(Debug)]
struct Giver {
    station: usize,
    address: Address,
    /// When it sends, after a cycle's start.
    after: Span,
    truth: TrueMaster,
    /// The furthest that its clock was ahead of what it shows now, before it was set back: others still go by that.
    before: Option<EmulatedClock>,
    has_given: bool,
}

impl Giver {
    /// The latest that global time is at a true moment, by its clock, and by what that was.
    fn latest_at(&self, at: True) -> GlobalTime {
        let TrueMaster { epoch, .. } = self.truth;
        let before = self.before.map(|clock| TrueMaster { clock, epoch }.global(at));
        before.map_or(self.truth.global(at), |before| later(before, self.truth.global(at)))
    }

    fn goes_on_by_its_own(&self) -> bool {
        self.has_given && self.after == Span::ZERO
    }
}

impl Givers {
    /// Those of a scenario whose master has this clock. Whoever begins does so with the same global time.
    pub fn of(scenario: &Scenario, master: TrueMaster) -> Self {
        let giver = |(station, plan): (usize, &crate::scenario::StationPlan)| {
            let (offset, drift_ppb) = (plan.clock_offset, plan.clock_drift_ppb);
            let clock = EmulatedClock { offset, drift_ppb, ..master.clock };
            let epoch = same_time(&master, &clock);
            (plan.role != Role::Slave).then(|| Giver {
                station,
                address: scenario.address(station),
                after: plan.backup.unwrap_or(Span::ZERO),
                truth: TrueMaster { clock, epoch },
                before: None,
                has_given: false,
            })
        };
        Self {
            all: scenario.stations.iter().enumerate().filter_map(giver).collect(),
            now: 0,
            has_begun: false,
            since: 0,
        }
    }

    /// The clock by which all is judged.
    pub fn truth(&self) -> &TrueMaster {
        &self.all[self.now].truth
    }

    /// Which station gives the time.
    pub fn now(&self) -> usize {
        self.all[self.now].station
    }

    /// Whether it is that one's clock by which all goes, or will be as soon as it is heard again: a primary that was only
    /// held up goes on by its own time.
    pub fn has_the_time(&self, station: usize) -> bool {
        let mut its = self.all.iter().filter(|giver| giver.station == station);
        station == self.now() || its.any(Giver::goes_on_by_its_own)
    }

    /// Which station has this address; who has an unknown one is taken for who gives the time.
    pub fn station(&self, address: Address) -> usize {
        self.giver(address).station
    }

    /// Whether that is one who may give the time.
    pub fn has(&self, address: Address) -> bool {
        self.all.iter().any(|giver| giver.address == address)
    }

    /// When after a cycle's start it sends.
    pub fn after(&self, address: Address) -> Span {
        self.giver(address).after
    }

    /// Global time at a true moment, by the clock of who has given it and goes on by its own; else by that of who gives it.
    pub fn global_of(&self, address: Address, at: True) -> GlobalTime {
        let its = self.giver(address);
        if its.goes_on_by_its_own() { its.truth.global(at) } else { self.truth().global(at) }
    }

    fn giver(&self, address: Address) -> &Giver {
        self.all.iter().find(|giver| giver.address == address).unwrap_or(&self.all[self.now])
    }

    /// A Synchronisation, seen at `at`: whether that one has taken over.
    pub fn heard(&mut self, from: Address, at: True) -> bool {
        let Some(next) = self.all.iter().position(|giver| giver.address == from) else { return false };
        let begins = !std::mem::replace(&mut self.has_begun, true);
        if begins {
            self.now = next;
            self.all[next].has_given = true;
        }
        if next == self.now {
            return false;
        }
        let (global, giver) = (self.truth().global(at), &mut self.all[next]);
        // All others go on by what they heard of it.
        if !giver.goes_on_by_its_own() {
            giver.truth.epoch = Offset::between(giver.truth.clock.local(at), global);
        }
        giver.has_given = true;
        (self.now, self.since) = (next, at);
        true
    }

    /// A station begins anew, and follows first.
    pub fn begins_anew(&mut self, station: usize) {
        let its = self.all.iter_mut().filter(|giver| giver.station == station);
        its.for_each(|giver| giver.has_given = false);
    }

    /// A station has another clock from now on: a master's global time goes on by it, or jumps with it.
    pub fn set_clock(&mut self, station: usize, clock: EmulatedClock) {
        for giver in self.all.iter_mut().filter(|giver| giver.station == station) {
            let ahead = |of: &EmulatedClock| of.local(clock.anchor) - clock.local(clock.anchor);
            let was = giver.before.into_iter().chain([giver.truth.clock]).max_by_key(ahead);
            giver.before = was.filter(|was| ahead(was) > Span::ZERO);
            giver.truth.clock = clock;
        }
    }

    /// The latest that global time can be at a true moment: by the clock of who gives it, and by those of all who gave it and
    /// may not have heard of another since.
    pub fn latest_at(&self, at: True) -> GlobalTime {
        let others = self.all.iter().filter(|giver| giver.has_given).map(|giver| giver.latest_at(at));
        others.fold(self.all[self.now].latest_at(at), later)
    }

    /// What a station took global time for at a true moment: that of who gives it is right.
    pub fn told(&mut self, station: usize, at: True, global: GlobalTime) {
        let giver = &mut self.all[self.now];
        if giver.station == station && at > self.since {
            giver.truth.epoch = Offset::between(giver.truth.clock.local(at), global);
        }
    }
}

/// The later of two, modulo 2^64 as they are.
fn later(a: GlobalTime, b: GlobalTime) -> GlobalTime {
    if b - a > Span::ZERO { b } else { a }
}

/// From another clock to the global time that a master's clock showed when all clocks were anchored.
pub fn same_time(master: &TrueMaster, clock: &EmulatedClock) -> Offset {
    Offset::between(clock.local(clock.anchor), master.global(clock.anchor))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Source;

    const CELL: &str = "cycle = \"2ms\"\n\
        [[station]]\nname = \"m\"\nrole = \"master\"\nclock = { drift_ppm = 0.0 }\n\
        [[station]]\nname = \"b\"\nrole = \"backup\"\nbackup = \"100us\"\nclock = { offset = \"1s\", drift_ppm = 100.0 }\n\
        [[station]]\nname = \"s\"\nrole = \"slave\"\n";
    const SECOND: True = 1_000_000_000;

    fn givers() -> (Givers, Address, Address) {
        let scenario = Source::new("cell.toml", CELL).parse().unwrap();
        let master = TrueMaster { clock: EmulatedClock::default(), epoch: Offset::default() };
        (Givers::of(&scenario, master), scenario.address(0), scenario.address(1))
    }

    fn global(at: True) -> GlobalTime {
        GlobalTime::from_nanos(at)
    }

    #[test]
    fn who_takes_over_goes_on_with_the_time_by_its_own_clock() {
        let (mut givers, master, backup) = givers();
        assert!(!givers.heard(master, SECOND));
        assert!(givers.heard(backup, SECOND));
        assert_eq!((givers.station(backup), givers.after(backup)), (1, Span::from_micros(100)));
        assert_eq!(givers.truth().global(SECOND), global(SECOND), "without a jump");
        assert_eq!(givers.truth().global(2 * SECOND), global(2 * SECOND + 100_000), "but faster");
    }

    #[test]
    fn the_time_goes_on_by_the_clock_that_a_master_is_given() {
        let (mut givers, master, _) = givers();
        givers.heard(master, 0);
        let faster = givers.truth().clock.at_rate(SECOND, 100_000);
        givers.set_clock(0, faster);
        assert_eq!(givers.truth().global(SECOND), global(SECOND), "without a jump");
        assert_eq!(givers.truth().global(2 * SECOND), global(2 * SECOND + 100_000), "but faster");
        givers.set_clock(0, faster.stepped(Span::from_millis(5)));
        assert_eq!(givers.truth().global(SECOND), global(SECOND + 5_000_000));
    }

    #[test]
    fn a_master_that_was_only_held_up_goes_on_by_its_own_time_and_one_that_is_new_by_the_others() {
        for (is_new, off) in [(false, 0), (true, 100_000)] {
            let (mut givers, master, backup) = givers();
            givers.heard(master, 0);
            givers.heard(backup, SECOND);
            if is_new {
                givers.begins_anew(0);
            }
            assert!(givers.heard(master, 2 * SECOND));
            assert_eq!(givers.truth().global(2 * SECOND), global(2 * SECOND + off));
        }
    }

    #[test]
    fn what_who_gives_the_time_tells_of_it_is_right() {
        let (mut givers, master, backup) = givers();
        givers.heard(master, 0);
        givers.heard(backup, SECOND);
        for (station, at) in [(0, 2 * SECOND), (1, SECOND / 2), (2, 2 * SECOND)] {
            givers.told(station, at, global(at + 900));
            assert_eq!(givers.truth().global(SECOND), global(SECOND), "not {station}'s");
        }
        givers.told(1, SECOND + 5, global(SECOND + 905));
        assert_eq!(givers.truth().global(SECOND + 5), global(SECOND + 905));
    }

    #[test]
    fn who_begins_does_so_with_the_same_time() {
        let (mut givers, master, backup) = givers();
        assert!(!givers.heard(backup, 0), "it takes no place");
        assert_eq!(givers.truth().global(0), global(0));
        assert_eq!(givers.truth().global(SECOND), global(SECOND + 100_000), "by its own clock");
        assert!(givers.heard(master, SECOND));
        assert_eq!(givers.truth().global(SECOND), global(SECOND + 100_000));
    }

    #[test]
    fn somebody_unknown_is_no_giver() {
        let (mut givers, ..) = givers();
        let other = Address([2, 0, 0, 0, 0, 77]);
        assert!(!givers.heard(other, SECOND));
        assert_eq!((givers.station(other), givers.after(other)), (0, Span::ZERO));
    }
}
