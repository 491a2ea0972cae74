//! When a station was not there: its process had ended, or its wire was cut. Of what it missed then it could tell
//! nothing itself.

use rtmac::tdma::line::LINE_GOOD_FOR;

use super::timetable::before;

/// So many cycles after somebody is back a station may still be silent: a line that comes back must be confirmed.
const LOCKED_AFTER: u32 = 4;
/// Who was stopped for no longer has all to tell when it goes on: slaves keep their line for so long, and the log of a
/// station with all slots there are holds as much.
const TOLD_OF: u32 = LINE_GOOD_FOR as u32;

/// Why a station was not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Absence {
    /// It had no process.
    Down,
    /// Its interface had no carrier.
    NoCarrier,
    /// Its process was stopped.
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
        self.entries(station).find(|entry| entry.covers(cycle)).map(|entry| entry.why)
    }

    /// The same, if it cannot tell of it either: its words went with its process, or it was away for too long.
    pub fn untold(&self, station: usize, cycle: u32) -> Option<Absence> {
        self.entries(station).find(|entry| entry.covers(cycle) && entry.is_untold()).map(|entry| entry.why)
    }

    /// Whether a station was not there in a cycle, or shortly before.
    pub fn just_now(&self, station: usize, cycle: u32) -> bool {
        (0..=LOCKED_AFTER).any(|ago| self.of(station, cycle.wrapping_sub(ago)).is_some())
    }

    /// Since when, before a cycle, nobody who follows a station had a line any more: it had not been there for longer than
    /// lines are kept. For each time that it was so.
    pub fn without_line(&self, station: usize, cycle: u32) -> impl Iterator<Item = u32> {
        let since = |entry: &Entry| entry.from.wrapping_add(TOLD_OF);
        let all = self.entries(station).filter(move |entry| entry.covers(since(entry)));
        all.map(since).filter(move |&since| before(since, cycle))
    }

    fn entries(&self, station: usize) -> impl Iterator<Item = &Entry> {
        self.list.iter().filter(move |entry| entry.station == station)
    }

    /// Why a station is not there now, if it is not, and since when.
    pub fn now(&self, station: usize) -> Option<(Absence, u32)> {
        let its = self.open().filter(|&(of, ..)| of == station).map(|(_, why, from)| (why, from));
        its.reduce(|a, b| if before(b.1, a.1) { b } else { a })
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

    fn is_untold(&self) -> bool {
        let is_long = |until: u32| until.wrapping_sub(self.from) > TOLD_OF;
        // Where the wire is cut at its far end, the kernel takes every frame and tells nobody.
        self.why != Absence::Stopped || self.until.is_none_or(is_long)
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

    #[test]
    fn who_was_stopped_tells_of_it_when_it_goes_on_unless_it_was_too_long() {
        let mut absences = Absences::default();
        absences.begin(2, Absence::Stopped, 100);
        assert_eq!(absences.untold(2, 150), Some(Absence::Stopped), "it cannot yet");
        absences.end(2, Absence::Stopped, 100 + TOLD_OF);
        assert_eq!((absences.of(2, 150), absences.untold(2, 150)), (Some(Absence::Stopped), None));
        assert_eq!(absences.without_line(2, 9_999).count(), 0, "who follows it has told of all");

        absences.begin(2, Absence::Stopped, 5_000);
        absences.end(2, Absence::Stopped, 5_000 + TOLD_OF + 10);
        assert_eq!(absences.untold(2, 5_001), Some(Absence::Stopped));
        let since = 5_000 + TOLD_OF;
        assert_eq!(absences.without_line(2, since).count(), 0, "not yet");
        assert_eq!(absences.without_line(2, since + 5_000).collect::<Vec<_>>(), [since]);
    }
}
