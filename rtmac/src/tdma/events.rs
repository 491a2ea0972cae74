//! What happened, until somebody asks.

use std::collections::VecDeque;

use rtnet::discipline::{Channel, Event, EventKind};
use rtnet::time::Span;

use super::job::Job;

/// Events that are kept: what a master with all eight slots has missed in the thousand cycles for which slaves keep its line,
/// since one that was stopped notices all of it at once. Otherwise the shell takes them every turn.
const CAPACITY: usize = 10_240;

/// A bounded log; what does not fit is counted.
pub struct Events {
    log: VecDeque<Event>,
    lost: u64,
}

impl Events {
    pub fn new() -> Self {
        Self { log: VecDeque::with_capacity(CAPACITY), lost: 0 }
    }

    /// Something of the cycle as a whole.
    pub fn note(&mut self, cycle: u32, kind: EventKind, span: Span) {
        self.push(Event { cycle, kind, slot: None, span });
    }

    /// Something of a slot.
    pub fn note_slot(&mut self, cycle: u32, slot: Channel, kind: EventKind) {
        self.push(Event { cycle, kind, slot: Some(slot), span: Span::ZERO });
    }

    /// Something that became of a job.
    pub fn note_job(&mut self, job: &Job, kind: EventKind, span: Span) {
        self.push(Event { cycle: job.cycle(), kind, slot: job.slot(), span });
    }

    fn push(&mut self, event: Event) {
        if self.log.len() == CAPACITY {
            self.lost += 1;
        } else {
            self.log.push_back(event);
        }
    }

    /// An empty log begins at its place of old: nobody goes through memory that others have no use for.
    pub fn take(&mut self) -> Option<Event> {
        let taken = self.log.pop_front();
        if self.log.is_empty() {
            self.log.clear();
        }
        taken
    }

    pub fn lost(&self) -> u64 {
        self.lost
    }
}
