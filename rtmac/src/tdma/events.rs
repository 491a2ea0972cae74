//! What happened, until somebody asks.

use std::collections::VecDeque;

use rtnet::discipline::{Event, EventKind};
use rtnet::time::Span;

/// Events that are kept: half a second of one a cycle at 1 ms, and the shell takes them every turn.
const CAPACITY: usize = 512;

/// A bounded log; what does not fit is counted.
pub struct Events {
    log: VecDeque<Event>,
    lost: u64,
}

impl Events {
    pub fn new() -> Self {
        Self { log: VecDeque::with_capacity(CAPACITY), lost: 0 }
    }

    pub fn note(&mut self, cycle: u32, kind: EventKind, span: Span) {
        if self.log.len() == CAPACITY {
            self.lost += 1;
        } else {
            self.log.push_back(Event { cycle, kind, span });
        }
    }

    pub fn take(&mut self) -> Option<Event> {
        self.log.pop_front()
    }

    pub fn lost(&self) -> u64 {
        self.lost
    }
}
