//! When a station was not there: its process had ended, or its wire was cut. Of what it missed then it could tell
//! nothing itself.

use super::timetable::before;

/// Why a station was not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Absence {
    /// It had no process.
    Down,
    /// Its interface had no carrier.
    NoCarrier,
    /// Its process was stopped, and what it missed is more than it could remember.
    Stopped,
}

impl Absence {
    /// The name of this cause in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Absence::Down => "station_down",
            Absence::NoCarrier => "no_carrier",
            Absence::Stopped => "station_stopped",
        }
    }

    /// Whether a cause is an absence.
    pub fn is_name(cause: &str) -> bool {
        [Absence::Down, Absence::NoCarrier, Absence::Stopped].iter().any(|of| of.name() == cause)
    }
}

/// All stations' absences, by cycles.
#[derive(Debug, Default)]
pub struct Absences {
    list: Vec<Entry>,
}

#[derive(Debug)]
struct Entry {
    station: usize,
    why: Absence,
    from: u32,
    /// The cycle in which it was there again.
    until: Option<u32>,
}

impl Absences {
    /// A station is not there from a cycle on.
    pub fn begin(&mut self, station: usize, why: Absence, from: u32) {
        if !self.is_open(station, why) {
            self.list.push(Entry { station, why, from, until: None });
        }
    }

    /// It is there again.
    pub fn end(&mut self, station: usize, why: Absence, until: u32) {
        for entry in self.list.iter_mut().filter(|entry| entry.is_open(station, why)) {
            entry.until = Some(until);
        }
    }

    /// Whether it is still not there.
    pub fn is_open(&self, station: usize, why: Absence) -> bool {
        self.list.iter().any(|entry| entry.is_open(station, why))
    }

    /// Why a station was not there in a cycle, if it was not.
    pub fn of(&self, station: usize, cycle: u32) -> Option<Absence> {
        self.list.iter().find(|entry| entry.station == station && entry.covers(cycle)).map(|entry| entry.why)
    }

    /// Those that are not there now, and since when.
    pub fn open(&self) -> impl Iterator<Item = (usize, Absence, u32)> {
        let open = self.list.iter().filter(|entry| entry.until.is_none());
        open.map(|entry| (entry.station, entry.why, entry.from))
    }

    /// Forgets what had ended before this cycle.
    pub fn forget_before(&mut self, cycle: u32) {
        self.list.retain(|entry| entry.until.is_none_or(|until| !before(until, cycle)));
    }
}

impl Entry {
    fn is_open(&self, station: usize, why: Absence) -> bool {
        self.station == station && self.why == why && self.until.is_none()
    }

    fn covers(&self, cycle: u32) -> bool {
        !before(cycle, self.from) && self.until.is_none_or(|until| before(cycle, until))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_station_is_absent_from_its_end_until_it_is_heard_again() {
        let mut absences = Absences::default();
        absences.begin(2, Absence::Down, u32::MAX - 1);
        absences.begin(2, Absence::Down, 3);
        assert!(absences.is_open(2, Absence::Down));
        assert_eq!(absences.of(2, 1_000_000), Some(Absence::Down));
        absences.end(2, Absence::Down, 5);
        let absent = |cycle| absences.of(2, cycle);
        assert_eq!(
            [u32::MAX - 2, u32::MAX - 1, 4, 5].map(absent),
            [None, Some(Absence::Down), Some(Absence::Down), None]
        );
        assert_eq!(absences.of(1, 3), None, "somebody else was there");
        absences.forget_before(6);
        assert_eq!(absences.of(2, 4), None);
    }
}
