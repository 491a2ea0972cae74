//! When a station was not there: its process had ended, or its wire was cut. Of what it missed then it could tell
//! nothing itself.

use std::collections::BTreeMap;

use rtmac::tdma::line::LINE_GOOD_FOR;

use super::timetable::before;

/// So many cycles after somebody is back a station may still be silent: a line that comes back must be confirmed.
const LOCKED_AFTER: u32 = 4;
/// Who was stopped for no longer has all to tell when it goes on: slaves keep their line for so long, and the log of a
/// station with all slots there are holds as much.
const TOLD_OF: u32 = LINE_GOOD_FOR as u32;

/// Why a station was not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
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
}

/// All stations' absences, by cycles: searched by cycle, as thousands of them may be told of.
#[derive(Debug, Default)]
pub struct Absences {
    list: BTreeMap<(usize, Absence), Times>,
    begun: u64,
}

/// When one station was not there for one reason.
#[derive(Debug, Default)]
struct Times {
    /// It is not there now.
    open: Option<Entry>,
    /// It was there again, in order.
    over: Vec<Entry>,
    /// Those of them that were longer than lines are kept.
    long: Vec<Entry>,
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    why: Absence,
    from: u32,
    /// The cycle in which it was there again.
    until: Option<u32>,
    /// Its place among all that have begun.
    place: u64,
    /// It ended meanwhile, and with it what it had to tell.
    is_broken_off: bool,
}

impl Absences {
    /// A station is not there from a cycle on.
    pub fn begin(&mut self, station: usize, why: Absence, from: u32) {
        let times = self.list.entry((station, why)).or_default();
        let begun = Entry { why, from, until: None, is_broken_off: false, place: self.begun };
        times.open.get_or_insert(begun);
        self.begun += 1;
    }

    /// It is there again.
    pub fn end(&mut self, station: usize, why: Absence, until: u32) {
        self.close(station, why, |open| Entry { until: Some(until), ..open });
    }

    /// Its process ends meanwhile: it is another that goes on, and can tell nothing of this one.
    pub fn break_off(&mut self, station: usize, why: Absence, until: u32) {
        self.close(station, why, |open| Entry { until: Some(until), is_broken_off: true, ..open });
    }

    fn close(&mut self, station: usize, why: Absence, closed: impl Fn(Entry) -> Entry) {
        let Some(times) = self.list.get_mut(&(station, why)) else { return };
        let Some(entry) = times.open.take().map(closed) else { return };
        let insert = |into: &mut Vec<Entry>| {
            let place = into.partition_point(|other| !before(entry.from, other.from));
            into.insert(place, entry);
        };
        if entry.is_long() {
            insert(&mut times.long);
        }
        insert(&mut times.over);
    }

    /// Whether its process was ever stopped.
    pub fn was_stopped(&self, station: usize) -> bool {
        self.list.contains_key(&(station, Absence::Stopped))
    }

    /// Whether it is still not there.
    pub fn is_open(&self, station: usize, why: Absence) -> bool {
        self.list.get(&(station, why)).is_some_and(|times| times.open.is_some())
    }

    /// Why a station was not there in a cycle, if it was not.
    pub fn of(&self, station: usize, cycle: u32) -> Option<Absence> {
        self.that(station, cycle, |_| true)
    }

    /// The same, if it cannot tell of it either: its words went with its process, or it was away for too long.
    pub fn untold(&self, station: usize, cycle: u32) -> Option<Absence> {
        self.that(station, cycle, Entry::is_untold)
    }

    /// Whether a station was not there in a cycle, or shortly before.
    pub fn just_now(&self, station: usize, cycle: u32) -> bool {
        (0..=LOCKED_AFTER).any(|ago| self.of(station, cycle.wrapping_sub(ago)).is_some())
    }

    /// Since when, before a cycle, nobody who follows a station had a line any more: it had not been there for longer than
    /// lines are kept. For each reason the last time that it was so.
    pub fn without_line(&self, station: usize, cycle: u32) -> impl Iterator<Item = u32> {
        let is_before = move |entry: &&Entry| before(entry.without_line(), cycle);
        let last = move |times: &Times| {
            let over = times.long.partition_point(|entry| is_before(&entry));
            let entry = times.open.as_ref().filter(is_before).or(times.long[..over].last())?;
            Some(entry.without_line())
        };
        self.times(station).filter_map(last)
    }

    /// Why a station is not there now, if it is not, and since when.
    pub fn now(&self, station: usize) -> Option<(Absence, u32)> {
        let its = self.open().filter(|&(of, ..)| of == station).map(|(_, why, from)| (why, from));
        its.reduce(|a, b| if before(b.1, a.1) { b } else { a })
    }

    /// Those that are not there now, and since when.
    pub fn open(&self) -> impl Iterator<Item = (usize, Absence, u32)> {
        let open = self.list.iter().filter_map(|(&(station, _), times)| Some((station, times.open?)));
        open.map(|(station, entry)| (station, entry.why, entry.from))
    }

    /// Forgets what had ended before this cycle.
    pub fn forget_before(&mut self, cycle: u32) {
        for times in self.list.values_mut() {
            let is_newer = |entry: &Entry| entry.until.is_none_or(|until| !before(until, cycle));
            times.over.retain(is_newer);
            // Who has had no line since has none still.
            let older = times.long.partition_point(|entry| !is_newer(entry));
            times.long.drain(..older.saturating_sub(1));
        }
    }

    /// When the first of those absences began that were not over before a cycle; that cycle, if it is earlier.
    pub fn begin_of(&self, why: Absence, cycle: u32) -> u32 {
        let such = self.list.iter().filter(|((_, of), _)| *of == why).map(|(_, times)| times);
        let since = such.flat_map(|times| {
            let over =
                times.over.iter().rev().take_while(|of| of.until.is_none_or(|until| !before(until, cycle)));
            over.chain(&times.open).map(|entry| entry.from)
        });
        since.fold(cycle, |first, from| if before(from, first) { from } else { first })
    }

    fn times(&self, station: usize) -> impl Iterator<Item = &Times> {
        let whys = [Absence::Down, Absence::NoCarrier, Absence::Stopped];
        whys.into_iter().filter_map(move |why| self.list.get(&(station, why)))
    }

    /// Of those of a cycle that are such, the one that began first.
    fn that(&self, station: usize, cycle: u32, is_such: impl Fn(&Entry) -> bool) -> Option<Absence> {
        let found = self.times(station).flat_map(|times| times.around(cycle)).filter(|entry| is_such(entry));
        found.min_by_key(|entry| entry.place).map(|entry| entry.why)
    }
}

impl Times {
    /// Those that cover a cycle: where one begins another may end, and no others meet.
    fn around(&self, cycle: u32) -> impl Iterator<Item = &Entry> {
        let over = self.over.partition_point(|entry| !before(cycle, entry.from));
        let newest = self.over[over.saturating_sub(2)..over].iter();
        newest.chain(&self.open).filter(move |entry| entry.covers(cycle))
    }
}

impl Entry {
    /// Since when who follows it has no line, if it is so long.
    fn without_line(&self) -> u32 {
        self.from.wrapping_add(TOLD_OF)
    }

    fn is_long(&self) -> bool {
        self.until.is_none_or(|until| until.wrapping_sub(self.from) > TOLD_OF)
    }

    fn is_untold(&self) -> bool {
        // Where the wire is cut at its far end, the kernel takes every frame and tells nobody.
        self.why != Absence::Stopped || self.is_broken_off || self.is_long()
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

    #[test]
    fn of_a_thousand_short_absences_the_one_of_the_cycle_is_found() {
        let mut absences = Absences::default();
        for n in 0..1_000 {
            absences.begin(2, Absence::Stopped, n * 10);
            absences.end(2, Absence::Stopped, n * 10 + 3);
        }
        // One that begins where another ends, and is over at once.
        absences.begin(2, Absence::Stopped, 9_992);
        absences.end(2, Absence::Stopped, 9_992);
        absences.begin(2, Absence::Down, 5_002);
        let of = [4_999, 5_000, 5_002, 5_003, 9_992, 9_993].map(|cycle| absences.of(2, cycle));
        let [stopped, down] = [Absence::Stopped, Absence::Down].map(Some);
        assert_eq!(of, [None, stopped, stopped, down, stopped, down], "the first that began of two");
        assert_eq!(absences.untold(2, 5_002), down);
        absences.forget_before(9_000);
        assert_eq!((absences.of(2, 4_000), absences.of(2, 9_001)), (None, stopped));
    }

    #[test]
    fn who_was_stopped_and_then_killed_tells_nothing_of_it_however_short_that_was() {
        let mut absences = Absences::default();
        absences.begin(2, Absence::Stopped, 100);
        absences.break_off(2, Absence::Stopped, 150);
        absences.end(2, Absence::Stopped, 200);
        assert_eq!([120, 150].map(|cycle| absences.untold(2, cycle)), [Some(Absence::Stopped), None]);
    }
}
