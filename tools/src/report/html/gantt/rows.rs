//! Which stations have a row of their own in a picture.

use std::collections::BTreeSet;

use crate::judge::closely::Shown;

/// Rows of stations at the most.
const STATIONS_MAX: usize = 16;

/// What a row shows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Row {
    /// Synchronisations, and their window.
    Syncs,
    /// A station's slots.
    Station(usize),
    /// Those of so many stations together.
    Stations(usize),
    /// Frames that are no Synchronisation and of no slot.
    Others,
}

/// The rows of a picture, from its top.
#[derive(Debug, PartialEq)]
pub struct Rows {
    /// The first is of Synchronisations.
    pub all: Vec<Row>,
}

impl Rows {
    /// A row for every station that has a turn; of many stations, for those with which something is wrong, and then the
    /// first, all others together.
    pub fn of(shown: &Shown) -> Self {
        let captured = &shown.captured;
        let seen = captured.frames.iter().filter_map(|frame| frame.author).filter(|of| of.slot.is_some());
        let stations: BTreeSet<usize> =
            shown.slots.iter().map(|&(station, _)| station).chain(seen.map(|of| of.station)).collect();
        let mut rows = vec![Row::Syncs];
        if stations.len() <= STATIONS_MAX {
            rows.extend(stations.iter().map(|&station| Row::Station(station)));
        } else {
            let wrong = captured.faults.iter().flat_map(|fault| fault.authors).flatten();
            let wrong: BTreeSet<usize> = wrong
                .filter(|of| of.slot.is_some())
                .map(|of| of.station)
                .filter(|of| stations.contains(of))
                .collect();
            let right = stations.iter().filter(|of| !wrong.contains(of));
            let own: BTreeSet<usize> = wrong.iter().chain(right).copied().take(STATIONS_MAX).collect();
            rows.extend(own.iter().map(|&station| Row::Station(station)));
            rows.push(Row::Stations(stations.len() - own.len()));
        }
        if captured.frames.iter().any(|frame| frame.author.is_none()) {
            rows.push(Row::Others);
        }
        Self { all: rows }
    }

    /// The row in which a station's slots are.
    pub fn of_station(&self, station: usize) -> usize {
        let is_own = |row: &Row| *row == Row::Station(station);
        let own = self.all.iter().position(is_own);
        own.or_else(|| self.all.iter().position(|row| matches!(row, Row::Stations(_)))).unwrap_or(0)
    }

    /// The row of frames that are of no slot.
    pub fn others(&self) -> usize {
        self.all.len() - 1
    }
}

#[cfg(test)]
mod tests {
    use rtnet::time::Span;

    use super::*;
    use crate::judge::closely::captures::{Captured, Fault, FaultKind};
    use crate::judge::findings::{Author, FindingKind};
    use crate::scenario::SlotPlan;

    fn shown(stations: usize, wrong: &[usize]) -> Shown {
        let plan = SlotPlan { id: 0, offset: Span::ZERO, phase: 0, period: 1, size: 46, joint: None };
        let fault = |&station: &usize| Fault {
            kind: FaultKind::Found(FindingKind::SlotMissed),
            authors: [Some(Author { station, cycle: 0, slot: Some(0) }), None],
            span: Span::ZERO,
            cause: None,
        };
        let captured = Captured { faults: wrong.iter().map(fault).collect(), ..Captured::default() };
        Shown { captured, slots: (0..stations).map(|station| (station, plan)).collect() }
    }

    #[test]
    fn few_stations_have_a_row_each() {
        let rows = Rows::of(&shown(3, &[1]));
        assert_eq!(rows.all, [Row::Syncs, Row::Station(0), Row::Station(1), Row::Station(2)]);
        assert_eq!(rows.of_station(2), 3);
    }

    #[test]
    fn of_many_stations_those_with_which_something_is_wrong_have_one() {
        let rows = Rows::of(&shown(100, &[70, 99]));
        assert_eq!(rows.all.len(), 1 + STATIONS_MAX + 1);
        assert_eq!(
            rows.all[STATIONS_MAX - 1..],
            [Row::Station(70), Row::Station(99), Row::Stations(100 - STATIONS_MAX)]
        );
        assert_eq!((rows.of_station(0), rows.of_station(50)), (1, STATIONS_MAX + 1));
    }
}
