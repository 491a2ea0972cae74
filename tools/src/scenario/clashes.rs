//! Events that would end each other: of one kind, at once, and of the same station.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use rtnet::time::Span;

use super::Event;

/// Two events of which the end of one is the end of both.
#[derive(Debug, PartialEq, Eq)]
pub struct Clash {
    /// The places of the two, the lower one first.
    pub events: [usize; 2],
    /// What both are.
    pub kind: &'static str,
}

/// The first that there is, if any; of each kind the first in time. No event overlaps itself.
pub fn first(events: &[Event]) -> Option<Clash> {
    let mut kinds: BTreeMap<&'static str, Vec<usize>> = BTreeMap::new();
    for (place, event) in events.iter().enumerate() {
        if let Some((kind, _)) = event.what.undoes() {
            kinds.entry(kind).or_default().push(place);
        }
    }
    let several = kinds.iter().filter(|(_, places)| places.len() > 1);
    let clashes =
        several.filter_map(|(kind, places)| Some(Clash { events: first_of(events, places)?, kind }));
    clashes.min_by_key(|clash| (clash.events[1], clash.events[0]))
}

/// Of these, which are of one kind. All their times are gone through in order: a station is busy with one at most.
fn first_of(events: &[Event], places: &[usize]) -> Option<[usize; 2]> {
    let mut times: BinaryHeap<_> =
        places.iter().map(|&place| Reverse((events[place].at, place, 1))).collect();
    let mut busy: Vec<Option<(Span, usize)>> = Vec::new();
    while let Some(Reverse((at, place, time))) = times.pop() {
        let event = &events[place];
        let stations = event.what.undoes().map_or(&[][..], |(_, stations)| stations);
        // All stations are as one.
        for &station in if stations.is_empty() { &[0][..] } else { stations } {
            if busy.len() <= station {
                busy.resize(station + 1, None);
            }
            if let Some((until, other)) = busy[station]
                && at < until
                && other != place
            {
                return Some([place.min(other), place.max(other)]);
            }
            busy[station] = Some((at + event.what.lasts(), place));
        }
        if time < event.times {
            times.push(Reverse((at + event.every, place, time + 1)));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::{Happening, Place};

    fn stop(at: i64, times: u32, stations: &[usize]) -> Event {
        let what = Happening::Stop(stations.to_vec(), Span::from_millis(4));
        Event {
            at: Span::from_millis(at),
            times,
            every: Span::from_millis(10),
            what,
            place: Place::default(),
        }
    }

    fn first_places(events: &[Event]) -> Option<[usize; 2]> {
        first(events).map(|clash| clash.events)
    }

    #[test]
    fn only_events_of_one_kind_at_once_of_the_same_station_clash() {
        let unplug =
            |at, of| Event { what: Happening::Unplug(vec![of], Span::from_millis(4)), ..stop(at, 1, &[]) };
        let cut = |at, of| Event { what: Happening::Cut(vec![of], Span::from_millis(4)), ..stop(at, 1, &[]) };
        assert_eq!(first_places(&[stop(0, 9, &[1]), stop(4, 9, &[1, 2]), stop(0, 9, &[2])]), None);
        assert_eq!(first_places(&[stop(0, 9, &[1]), stop(53, 1, &[1])]), Some([0, 1]));
        assert_eq!(first_places(&[stop(0, 9, &[1]), stop(0, 9, &[3, 2]), stop(35, 1, &[2])]), None);
        assert_eq!(first_places(&[stop(57, 1, &[2]), stop(0, 9, &[1]), stop(0, 9, &[3, 2])]), Some([0, 2]));
        assert_eq!(first_places(&[stop(0, 1, &[1]), unplug(1, 1), unplug(5, 1), unplug(5, 2)]), None);
        let clash = first(&[stop(0, 1, &[1]), cut(0, 1), cut(3, 2)]);
        assert_eq!(clash, Some(Clash { events: [1, 2], kind: "cut" }), "any two, whosever");
    }

    #[test]
    fn a_long_event_clashes_with_each_that_is_within_it() {
        let long = Event { what: Happening::Stop(vec![1], Span::from_millis(1_000)), ..stop(0, 1, &[]) };
        assert_eq!(first_places(&[stop(999, 1, &[1]), long.clone()]), Some([0, 1]));
        assert_eq!(first_places(&[stop(1_000, 1, &[1]), long]), None);
    }

    #[test]
    fn many_thousand_events_are_gone_through_once() {
        let events: Vec<Event> = (0..200_000).map(|n| stop(n * 4, 1, &[n as usize % 3])).collect();
        assert_eq!(first(&events), None);
    }
}
