//! Parts of schedules and answers: none comes to a station that does not know what it is about.

use rtnet::counters::Refusal;
use rtnet::sim::{Latency, Random};
use tests::seeds;

use super::*;

const CHANGES: u32 = 60;

/// Changes the schedule and the cycle's length again and again, proposed anywhere in a cycle, on hosts that are so late. How
/// often each station has refused what is about schedules.
fn refused_in_changes(late: Latency, seed: u64) -> Vec<u64> {
    let host = Host { late, ..Host::IDEAL };
    let first = plan(0).on(host);
    let second = turned(&first, Span::from_micros(2_400));
    let mut changing = Changing::running(first, second);
    let mut random = Random::new(seed);
    for number in 1..=CHANGES {
        let anywhere = random.below(2_000_000);
        changing.lab.network.run_until(changing.lab.network.now() + anywhere);
        changing.propose(Some(Activation::Soon)).unwrap();
        changing.run_cycles(250);
        for id in 0..STATIONS {
            assert_eq!(u32::from(changing.in_use(id)), number, "station {id}");
        }
        changing.schedules.swap(0, 1);
    }
    let refused = |id| changing.lab.network.member(id).station.refusals().get(Refusal::ScheduleUnknown);
    (0..STATIONS).map(refused).collect()
}

#[test]
fn changes_that_succeed_leave_no_schedule_unknown() {
    // Of the window of 250us a part may begin in the first 167us: a third is too late behind its sync, and takes a turn.
    for late in [Latency::NONE, Latency::Uniform(Span::ZERO, Span::from_micros(240))] {
        seeds::each(4, move |seed| {
            assert_eq!(refused_in_changes(late.clone(), seed), [0; STATIONS], "{late:?}")
        });
    }
}
