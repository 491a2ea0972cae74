//! What happens when: events, each with its begin and its end, in order.

use rtnet::clock::True;
use rtnet::time::Span;

use super::{Event, Happening};

/// One thing to do.
#[derive(Clone, Debug, PartialEq)]
pub struct Act {
    /// When, in true time.
    pub at: True,
    /// The event's place in the scenario.
    pub event: usize,
    /// What of it.
    pub part: Part,
}

/// A part of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// It begins.
    Begin,
    /// Once more of what it does again and again.
    Again,
    /// It is over.
    End,
}

/// Everything that is to be done, in order, if the measurement begins then.
pub fn acts(events: &[Event], begin: True) -> Vec<Act> {
    let mut acts = Vec::new();
    for (event, plan) in events.iter().enumerate() {
        for instant in plan.instants() {
            let at = |span: Span| begin + (instant + span).nanos().max(0) as u64;
            let mut act = |span, part| acts.push(Act { at: at(span), event, part });
            act(Span::ZERO, Part::Begin);
            if let Happening::Babble(_, lasts, every) = plan.what {
                let mut span = every;
                while span < lasts {
                    act(span, Part::Again);
                    span = span + every;
                }
            }
            if plan.what.lasts() > Span::ZERO {
                act(plan.what.lasts(), Part::End);
            }
        }
    }
    // Of one instant in the order of the file; what ends, ends before what begins.
    acts.sort_by_key(|act| (act.at, act.part != Part::End));
    acts
}

/// When the last of all events is over, after the begin.
pub fn over(events: &[Event]) -> Span {
    events.iter().map(Event::is_over).max().unwrap_or(Span::ZERO)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(at: i64, times: u32, what: Happening) -> Event {
        Event {
            at: Span::from_millis(at),
            times,
            every: Span::from_millis(10),
            what,
            place: Default::default(),
        }
    }

    #[test]
    fn what_ends_ends_before_what_begins_at_the_same_instant() {
        let stop = |station| Happening::Stop(vec![station], Span::from_millis(10));
        let events = [event(5, 2, stop(1)), event(15, 1, stop(2))];
        let acts: Vec<_> = acts(&events, 1_000).iter().map(|act| (act.at, act.event, act.part)).collect();
        let (first, second, third) = (5_001_000, 15_001_000, 25_001_000);
        let expected = [
            (first, 0, Part::Begin),
            (second, 0, Part::End),
            (second, 0, Part::Begin),
            (second, 1, Part::Begin),
            (third, 0, Part::End),
            (third, 1, Part::End),
        ];
        assert_eq!(acts, expected);
        assert_eq!(over(&events), Span::from_millis(25));
    }

    #[test]
    fn who_babbles_does_so_again_and_again_until_it_is_over() {
        let babble = Happening::Babble(1, Span::from_millis(3), Span::from_millis(1));
        let parts: Vec<_> = acts(&[event(0, 1, babble)], 0).iter().map(|act| act.part).collect();
        assert_eq!(parts, [Part::Begin, Part::Again, Part::Again, Part::End]);
    }
}
