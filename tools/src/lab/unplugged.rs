//! When a station's wire was cut: what was sent to it meanwhile was lost for that, and no more.

use rtnet::clock::True;
use rtnet::time::Span;

/// So long after its wire is back at the latest a station hears again.
const HEARS_WITHIN: Span = Span::from_millis(100);

/// A wire, as its station tells of it.
#[derive(Debug, Default)]
pub struct Unplugged {
    count: u32,
    gone: Span,
    since: Option<True>,
}

impl Unplugged {
    /// How often it was cut.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// It is gone since `at`, or seen to be back.
    pub fn note(&mut self, carrier: bool, at: True, now: True) {
        if !carrier {
            self.count += 1;
            self.since.get_or_insert(at);
        } else if let Some(since) = self.since.take() {
            self.gone = self.gone + lasted(since, now);
        }
    }

    /// Another process is at the wire: it should hear what is sent once it has heard something, not what was before.
    pub fn begin_anew(&mut self) {
        *self = Self { count: self.count, ..Self::default() };
    }

    /// How many were lost for that, at most, of frames that are sent every so often.
    pub fn lost(&self, every: Span, now: True) -> u64 {
        let gone = self.gone + self.since.map_or(Span::ZERO, |since| lasted(since, now));
        (gone.nanos() / every.nanos().max(1)) as u64
    }
}

/// How long it heard nothing.
fn lasted(since: True, now: True) -> Span {
    Span::from_nanos(now.saturating_sub(since) as i64) + HEARS_WITHIN
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;
    const EVERY: Span = Span::from_millis(2);

    #[test]
    fn as_many_frames_are_excused_as_were_sent_while_the_wire_was_cut() {
        let mut wire = Unplugged::default();
        assert_eq!(wire.lost(EVERY, 1_000 * MS), 0);
        wire.note(false, 1_000 * MS, 1_001 * MS);
        assert_eq!(wire.lost(EVERY, 1_100 * MS), 100, "and is still");
        wire.note(true, 1_150 * MS, 1_200 * MS);
        for now in [1_200, 9_000] {
            assert_eq!(wire.lost(EVERY, now * MS), 150);
        }
        wire.note(true, 9_000 * MS, 9_000 * MS);
        wire.note(false, 9_000 * MS, 9_000 * MS);
        wire.note(true, 9_000 * MS, 9_000 * MS);
        assert_eq!((wire.lost(EVERY, 9_500 * MS), wire.count()), (200, 2));
        wire.begin_anew();
        assert_eq!((wire.lost(EVERY, 9_500 * MS), wire.count()), (0, 2));
    }
}
