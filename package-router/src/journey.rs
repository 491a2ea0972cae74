//! Where a package's time went: from who sent it to who received it.
//!
//! ```text
//!   sent ──slot wait──► left ──wire──► came ──router──► delivered ──mailbox──► received      from another station
//!                                                       sent     ──mailbox──► received      here
//!   └──────────────────────────────────── age ─────────────────────────────────┘
//! ```
//!
//! The slot's wait is that for the sender's station to take it, and for those that were to leave before, too. Of a package in
//! several frames the last one counts: it was not there before. Two stations' clocks are as far apart as they are synchronised:
//! what is shorter than that may be less than nothing.

use rtnet::time::{GlobalTime, Span};

use crate::mailbox::{Origin, Stamps};

/// When a package was where, in global time; `None` where nobody knows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Journey {
    /// Whether it came from another station.
    pub is_from_elsewhere: bool,
    /// Its sender sent it.
    pub sent: Option<GlobalTime>,
    /// The last of it left its sender's station.
    pub left: Option<GlobalTime>,
    /// The last of it came to this station.
    pub came: Option<GlobalTime>,
    /// It was in the mailbox.
    pub delivered: Option<GlobalTime>,
    /// It was received.
    pub received: Option<GlobalTime>,
    /// How long it was in the mailbox, by this host's clock.
    pub mailbox: Span,
}

impl Journey {
    /// That of a package with these stamps, which has waited for so many nanoseconds in its mailbox, where it was delivered and
    /// received at these moments.
    pub fn of(stamps: &Stamps, waited: u64, moments: Option<[GlobalTime; 2]>) -> Self {
        let [delivered, received] = moments.map_or([None; 2], |moments| moments.map(Some));
        let (is_from_elsewhere, sent) = match stamps.origin {
            Origin::Here => (false, delivered),
            Origin::Elsewhere(sent) => (true, sent),
        };
        let mailbox = Span::from_nanos(waited.min(i64::MAX as u64) as i64);
        let Stamps { left, came, .. } = *stamps;
        Self { is_from_elsewhere, sent, left, came, delivered, received, mailbox }
    }

    /// How old it was when it was received.
    pub fn age(&self) -> Option<Span> {
        if self.is_from_elsewhere { between(self.sent, self.received) } else { Some(self.mailbox) }
    }

    /// How long it was until the last of it left: it waited for its station, for others and for its slot.
    pub fn slot_wait(&self) -> Option<Span> {
        between(self.sent, self.left)
    }

    /// How long the last of it was on its way.
    pub fn wire(&self) -> Option<Span> {
        between(self.left, self.came)
    }

    /// How long it took from there into the mailbox.
    pub fn router(&self) -> Option<Span> {
        between(self.came, self.delivered).filter(|_| self.is_from_elsewhere)
    }
}

fn between(begin: Option<GlobalTime>, end: Option<GlobalTime>) -> Option<Span> {
    Some(end? - begin?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(nanos: u64) -> Option<GlobalTime> {
        Some(GlobalTime::from_nanos(nanos))
    }

    fn ns(nanos: i64) -> Option<Span> {
        Some(Span::from_nanos(nanos))
    }

    const MOMENTS: Option<[GlobalTime; 2]> =
        Some([GlobalTime::from_nanos(700), GlobalTime::from_nanos(1_100)]);

    #[test]
    fn the_parts_of_a_journey_are_its_age() {
        let origin = Origin::Elsewhere(at(100));
        let stamps = Stamps { sent: 9_000_000, origin, left: at(500), came: at(530) };
        let journey = Journey::of(&stamps, 400, MOMENTS);
        let parts = [journey.slot_wait(), journey.wire(), journey.router(), Some(journey.mailbox)];
        assert_eq!(parts, [ns(400), ns(30), ns(170), ns(400)]);
        assert_eq!((journey.age(), parts.into_iter().flatten().map(Span::nanos).sum()), (ns(1_000), 1_000));
    }

    #[test]
    fn what_was_sent_here_was_only_in_its_mailbox_also_where_there_is_no_global_time() {
        let stamps = Stamps { sent: 9_000_000, ..Stamps::default() };
        for (moments, sent) in [(MOMENTS, at(700)), (None, None)] {
            let journey = Journey::of(&stamps, 400, moments);
            assert_eq!(
                (journey.age(), journey.mailbox, journey.sent),
                (ns(400), Span::from_nanos(400), sent)
            );
            assert_eq!([journey.slot_wait(), journey.wire(), journey.router()], [None; 3]);
        }
    }

    #[test]
    fn what_nobody_says_is_unknown_and_the_rest_is_not() {
        let stamps = Stamps { origin: Origin::Elsewhere(None), came: at(530), ..Stamps::default() };
        let journey = Journey::of(&stamps, 400, MOMENTS);
        assert_eq!((journey.age(), journey.slot_wait(), journey.wire()), (None, None, None));
        assert_eq!((journey.router(), journey.mailbox), (ns(170), Span::from_nanos(400)));
        let stamps = Stamps { origin: Origin::Elsewhere(at(100)), came: at(530), ..stamps };
        let journey = Journey::of(&stamps, 400, MOMENTS);
        assert_eq!((journey.age(), journey.slot_wait(), journey.wire()), (ns(1_000), None, None));
        let journey = Journey::of(&stamps, u64::MAX, None);
        assert_eq!(
            (journey.age(), journey.router(), journey.mailbox),
            (None, None, Span::from_nanos(i64::MAX))
        );
    }

    #[test]
    fn of_clocks_that_are_apart_a_part_may_be_less_than_nothing() {
        let stamps = Stamps { origin: Origin::Elsewhere(at(100)), left: at(540), came: at(530), sent: 0 };
        assert_eq!(Journey::of(&stamps, 400, MOMENTS).wire(), ns(-10));
    }
}
