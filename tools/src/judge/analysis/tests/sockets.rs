//! Frames of programs in the slots of a station with sockets, which say nothing of their turn.

use super::*;
use crate::judge::explain::Records;
use rtnet::discipline::{Cause, EventKind};
use zerocopy::IntoBytes;

/// The second station has sockets.
fn bench() -> Bench {
    Bench::of(|scenario| scenario.stations[1].ip = Some("10.0.0.2/24".parse().unwrap()))
}

impl Bench {
    /// Something of the second station is on the medium instead of a cycle's test traffic.
    fn programs(&mut self, cycle: u32, late: i64) {
        let offset = self.scenario.stations[1].slots[0].offset;
        let at = (u64::from(cycle) * CYCLE + offset.nanos() as u64).wrapping_add_signed(late);
        let header = Header::new(Address::BROADCAST, self.scenario.address(1), EtherType::IPV4);
        let mut frame = header.as_bytes().to_vec();
        frame.resize(60, 0);
        self.analysis.frame(at, &frame);
    }

    /// What is found where that is so late in cycle 12.
    fn with_programs_frame(self, late: i64) -> Analysis {
        self.run(|bench| {
            bench.sync(12, 0);
            bench.data(0, 12, 0);
            bench.programs(12, late);
        })
    }
}

#[test]
fn a_slot_that_a_programs_frame_takes_is_not_missed() {
    let share = bench().analysis.clock_share.nanos();
    for late in [-share, 0, 700, 20_000] {
        let analysis = bench().with_programs_frame(late);
        assert_eq!(found(&analysis), [], "{late}");
        let seen = &analysis.stations[1];
        assert_eq!((analysis.expected(1), seen.frames, seen.stray), (5, 5, 0), "{late}");
        assert_eq!(seen.slot_error.max().max(-seen.slot_error.min()), late.abs(), "it is one of its frames");
    }
}

#[test]
fn of_a_station_without_sockets_it_is_no_frame_of_its_slot() {
    let analysis = Bench::new().with_programs_frame(0);
    assert_eq!(found(&analysis), [(12, FindingKind::SlotMissed, Some(1))]);
}

#[test]
fn a_programs_frame_that_is_out_of_its_slot_is_found_with_whose_it_is() {
    let late = 425_000;
    let analysis = bench().with_programs_frame(late);
    assert_eq!(found(&analysis), [(12, FindingKind::OutOfSlot, Some(1))]);
    assert_eq!((analysis.findings[0].span.nanos(), analysis.stations[1].stray), (late, 1));
    let twice = bench().run(|bench| {
        bench.sync(12, 0);
        bench.data(0, 12, 0);
        bench.data(1, 12, 0);
        bench.programs(12, 20_000);
    });
    assert_eq!(found(&twice), [(12, FindingKind::Repeated, Some(1))]);
}

#[test]
fn a_programs_frame_that_was_held_up_into_the_next_turn_is_explained_by_who_told_of_it() {
    // That of cycle 12 comes where 13's was to be, which was missed for that.
    let analysis = bench().run(|bench| {
        bench.sync(12, 0);
        bench.data(0, 12, 0);
        bench.programs(12, CYCLE as i64 + 1_000);
    });
    let findings = found(&analysis);
    assert!(findings.contains(&(12, FindingKind::SlotMissed, Some(1))), "{findings:?}");
    let author = Author { station: 1, cycle: 12, slot: Some(0) };
    let missed = Finding::of(author, FindingKind::SlotMissed, Span::ZERO);
    for (of, why) in [(bench(), Some("stalled_in_send")), (Bench::new(), None)] {
        let mut records = Records::new(&of.scenario);
        assert_eq!(records.explain(&missed), None);
        records.note(
            author,
            EventKind::StalledInSend,
            Span::from_nanos(CYCLE as i64),
            Some(Cause::StalledInSend),
        );
        assert_eq!(records.explain(&missed), why);
    }
}
