//! Changes of the schedule of all stations, as one of them is asked for them.

use rtmac::tdma::TdmaCommand;
use rtmac::tdma::change::Book;
use rtmac::tdma::schedule::{Schedule, Slot};
use rtnet::time::Span;

use super::Desk;
use crate::control::{ActivationSaid, Reply, ScheduleRequest, ScheduleShown};

/// Why nothing can be told of changes.
const NO_CHANGES: &str =
    "it takes no part in changes of the schedule: start it, and all others of its network, with --extensions";

impl Desk {
    pub(super) fn schedule(&mut self, request: ScheduleRequest) -> Reply {
        self.look();
        let tdma = self.newest.as_ref().and_then(|newest| newest.status.tdma());
        let Some((tdma, change)) = tdma.and_then(|tdma| Some((tdma, tdma.change?))) else {
            return Reply::Refused(NO_CHANGES.into());
        };
        let (cycle, period) = (tdma.cycle, tdma.period);
        let when = |said: ActivationSaid| said.activation(cycle, period);
        match request {
            ScheduleRequest::Show => Reply::Schedule(Box::new(ScheduleShown::of(&self.name, tdma, &change))),
            ScheduleRequest::Propose { schedule, activate } => match schedule.book() {
                Err(why) => Reply::Refused(why),
                Ok(book) => match self.conflict(&book) {
                    Some(why) => Reply::Refused(why),
                    None => self.as_they_are(TdmaCommand::Propose(book, activate.map(when))),
                },
            },
            ScheduleRequest::Activate(said) => self.as_they_are(TdmaCommand::Activate(when(said))),
            ScheduleRequest::Cancel => self.as_they_are(TdmaCommand::CancelChange),
        }
    }

    /// Another schedule is in use: changes of single slots are judged by its slots.
    pub(super) fn note_schedule(&mut self) {
        let Some(tdma) = self.newest.as_ref().and_then(|newest| newest.status.tdma()) else { return };
        let in_use = tdma.change.map_or(0, |change| change.in_use.number);
        if in_use != self.schedule {
            let slots = tdma.slots.iter().flatten().map(|slot| slot.config).collect();
            self.own_slots = self.own_slots.as_ref().map(|own| own.switched(slots, tdma.period));
            self.schedule = in_use;
        }
    }

    /// What its own slots are judged by is so until it has switched.
    fn as_they_are(&mut self, command: TdmaCommand) -> Reply {
        self.change(command, |own, _| Ok(own.clone()))
    }

    /// What a single station sees of a schedule that cannot work: frames of full size over one another. A lab has looked with
    /// its guard bands.
    fn conflict(&self, book: &Book) -> Option<String> {
        let own = self.own_slots.as_ref()?;
        let slots = book.planned().iter().map(|planned| Slot {
            owner: planned.station.to_string(),
            id: planned.slot.id,
            offset: planned.slot.offset,
            phase: planned.slot.phase,
            period: planned.slot.period,
            size: planned.slot.size,
        });
        let schedule = Schedule {
            cycle: book.cycle(),
            sync_window: own.sync_window().unwrap_or(Span::ZERO),
            rate: own.rate(),
            guard: Span::ZERO,
            backups: Vec::new(),
            slots: slots.collect(),
        };
        schedule.conflicts().first().map(|conflict| conflict.to_string())
    }
}
