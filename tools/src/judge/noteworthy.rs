//! What stations told of that a reader of the report should know: in which cycles, the first ones by number.

use std::collections::BTreeMap;

use rtnet::discipline::EventKind;

/// Cycles that are told one by one.
const CYCLES_AT_MOST: usize = 5;

/// What is worth knowing even if nothing was missed by it.
const KINDS: [EventKind; 9] = [
    EventKind::SyncLost,
    EventKind::SendFailed,
    EventKind::ReplyFailed,
    EventKind::CalibrationTimeout,
    EventKind::OtherMaster,
    EventKind::JointDetached,
    EventKind::TookOver,
    EventKind::SteppedDown,
    EventKind::Yielded,
];

/// Of one station.
#[derive(Clone, Debug, Default)]
pub struct Noteworthy {
    by_kind: BTreeMap<EventKind, (u64, Vec<u32>)>,
}

impl Noteworthy {
    /// It told of something.
    pub fn note(&mut self, kind: EventKind, cycle: u32) {
        if !KINDS.contains(&kind) {
            return;
        }
        let (n, cycles) = self.by_kind.entry(kind).or_default();
        *n += 1;
        if cycles.len() < CYCLES_AT_MOST {
            cycles.push(cycle);
        }
    }

    /// A line for each kind.
    pub fn lines(&self) -> impl Iterator<Item = String> {
        self.by_kind.iter().map(|(kind, (n, cycles))| {
            let list = cycles.iter().map(u32::to_string).collect::<Vec<_>>().join(", ");
            let more = if *n > cycles.len() as u64 { format!(", ... ({n} times)") } else { String::new() };
            format!("{} in cycle {list}{more}", kind.name())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_cycles_are_told_one_by_one_and_the_others_counted() {
        let mut noteworthy = Noteworthy::default();
        noteworthy.note(EventKind::Overrun, 1);
        noteworthy.note(EventKind::SyncLost, 9);
        (10..17).for_each(|cycle| noteworthy.note(EventKind::TookOver, cycle));
        let lines: Vec<String> = noteworthy.lines().collect();
        assert_eq!(lines, ["sync_lost in cycle 9", "took_over in cycle 10, 11, 12, 13, 14, ... (7 times)"]);
    }
}
