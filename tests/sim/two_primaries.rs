//! Two primaries begin in halves of a medium that do not hear each other; then it is whole.

use std::cell::RefCell;
use std::rc::Rc;

use rtmac::tdma::Mastery;
use rtmac::wire::{self, Message, Rtmac};
use rtnet::discipline::{EventKind, SyncState};
use rtnet::sim::Host;
use rtnet::time::{GlobalTime, Span};
use tests::networks::{Lab, Plan};

/// Of two primaries: the address of the first is the lower one.
const LOWER: usize = 0;
const HIGHER: usize = 1;
const OTHERS: [usize; 4] = [2, 3, 4, 5];
/// In so many cycles in a row the lower address is heard before the higher one makes way.
const HEARD: usize = 3;

/// What was on the medium: every frame's sender and whether it met another, and what it says if it is a Synchronisation.
#[derive(Clone, Default)]
struct Log(Rc<RefCell<Vec<Seen>>>);

#[derive(Clone, Copy)]
struct Seen {
    from: usize,
    met: bool,
    sync: Option<(u32, GlobalTime)>,
}

impl Log {
    fn of(lab: &mut Lab) -> Self {
        let log = Self::default();
        let seen = log.0.clone();
        lab.network.observe(move |aired| {
            let sync = match wire::parse(aired.bytes) {
                Ok(Rtmac::Tdma(Message::Sync { cycle, sched, .. })) => Some((cycle, sched)),
                _ => None,
            };
            seen.borrow_mut().push(Seen { from: aired.from, met: aired.overlaps, sync });
        });
        log
    }

    /// Synchronisations in the order in which they were sent, each with its sender.
    fn syncs(&self) -> Vec<(usize, u32, GlobalTime)> {
        let seen = self.0.borrow();
        seen.iter().filter_map(|seen| seen.sync.map(|(cycle, sched)| (seen.from, cycle, sched))).collect()
    }

    fn take(&self) -> Vec<Seen> {
        self.0.take()
    }
}

/// Both give the time, each to two slaves; the second began so long after the first.
fn two_halves(apart: Span) -> (Lab, Log) {
    let mut options = Plan::lab_options(6);
    options.cycle = Span::from_millis(2);
    let plan = Plan::of(&options).on(Host::IDEAL);
    let mut lab = plan.build_without_slaves();
    let log = Log::of(&mut lab);
    lab.network.cut_off(&[HIGHER, 3, 5]);
    lab.add(HIGHER, Some(plan.cycle()), lab.network.now() + apart.nanos() as u64);
    OTHERS.iter().for_each(|_| _ = lab.add_next(lab.network.now()));
    lab.run_until_locked();
    assert_eq!([LOWER, HIGHER].map(|id| lab.status(id).mastery), [Some(Mastery::Active); 2]);
    // Of the second half's, 3 and 5 follow another grid.
    assert!(OTHERS.iter().all(|&id| (lab.line_error(id).abs() > Span::from_micros(10)) == (id % 2 == 1)));
    lab.events.clear();
    (lab, log)
}

/// A primary's Synchronisations are of one grid, one for each cycle, whatever others send.
fn check_grid(syncs: &[(usize, u32, GlobalTime)], cycle: Span) {
    let of_lower: Vec<_> = syncs.iter().filter(|(from, ..)| *from == LOWER).collect();
    for pair in of_lower.windows(2) {
        let (&(_, number, sched), &(_, next, then)) = (pair[0], pair[1]);
        assert_eq!((next, then), (number + 1, sched + cycle));
    }
}

#[test]
fn of_two_primaries_that_begin_cut_off_from_each_other_the_lower_address_stays_and_all_follow_it() {
    for part in 0..8 {
        let cycle = Span::from_millis(2);
        // Somewhere in the first one's cycle, and with other numbers.
        let (mut lab, log) = two_halves(cycle * 7 + cycle * part / 8);
        let before = log.syncs().len();
        lab.network.cut_off(&[]);
        lab.run_cycles(1_000);
        let syncs = log.syncs();
        let after: Vec<_> = syncs[before..].iter().map(|(from, ..)| *from).collect();
        let heard: Vec<_> = (0..after.len()).filter(|&n| after[n] == LOWER).collect();
        let last = after.iter().rposition(|from| *from == HIGHER).expect("at first it does not know");
        // Where both begin their cycles at once, its own has left when it hears the last that it waits for.
        let end = heard[HEARD - usize::from(part > 0)];
        assert!((heard[HEARD - 2]..end).contains(&last), "{part}: {:?}", &after[..10]);
        check_grid(&syncs, cycle);

        assert_eq!(lab.status(LOWER).mastery, Some(Mastery::Active));
        assert_eq!(lab.status(HIGHER).mastery, Some(Mastery::Following));
        assert_eq!(lab.cycles_with(HIGHER, EventKind::Yielded).len(), 1, "told of by name");
        assert!(lab.cycles_with(LOWER, EventKind::Yielded).is_empty());
        assert!(!lab.cycles_with(LOWER, EventKind::OtherMaster).is_empty(), "so is that there were two");
        for id in 1..6 {
            assert_eq!(lab.state(id), SyncState::Locked);
            assert!(lab.line_error(id).abs() < Span::from_micros(10), "station {id}: {}", lab.line_error(id));
        }
        log.take();
        lab.run_cycles(100);
        let seen = log.take();
        let frames = |id| seen.iter().filter(|seen| seen.from == id && seen.sync.is_none()).count();
        let sent = [0, 1, 2, 3, 4, 5].map(frames);
        // The clocks drift from true time, so a slot may cross either end of the interval.
        assert!(sent.iter().all(|n| (99..=101).contains(n)), "each in its slot of every cycle: {sent:?}");
        assert!(seen.iter().all(|seen| !seen.met && seen.sync.is_none_or(|_| seen.from == LOWER)));
    }
}
