//! What a station shows is of its last look at the clock, however long it is held up before it shows it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rtnet::buf::Buf;
use rtnet::counters::Refusal;
use rtnet::discipline::{Opportunity, Outlet, Service};
use rtnet::live::clock::monotonic;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::EtherType;
use tests::host::alone;

use crate::live::{Extras, Medium, clock, our_master};

/// Longer than a snapshot waits for the next one, which is due then.
const HELD_UP: Duration = Duration::from_millis(150);

/// Holds its station up once, behind a slot, as a hypervisor does; from when to when, CLOCK_MONOTONIC.
struct HoldsUp {
    rests: u32,
    from: Arc<AtomicU64>,
    until: Arc<AtomicU64>,
}

impl Service for HoldsUp {
    fn claims(&self, _: EtherType) -> bool {
        false
    }
    fn on_frame(&mut self, _: Option<Instant>, _: Buf) -> Result<(), Refusal> {
        unreachable!("it claims none")
    }
    fn poll(&mut self, _: &Opportunity, _: &mut Outlet<'_>) {}
    fn rest(&mut self) {
        self.rests += 1;
        if self.rests == 50 {
            self.from.store(monotonic(), Ordering::Relaxed);
            std::thread::sleep(HELD_UP);
            self.until.store(monotonic(), Ordering::Release);
        }
    }
}

#[test]
fn what_is_shown_behind_a_hold_up_is_dated_before_it() {
    alone("what_is_shown_behind_a_hold_up_is_dated_before_it", || {
        let ideal = clock(Span::ZERO, 0);
        let (from, until) = (Arc::<AtomicU64>::default(), Arc::<AtomicU64>::default());
        let holds_up = HoldsUp { rests: 0, from: from.clone(), until: until.clone() };
        let extras = Extras { service: Some(Box::new(holds_up)), ..Extras::default() };
        let mut medium = Medium::new();
        let master =
            medium.start_with(ideal, 0, extras, |address| our_master(address, &ideal, Span::from_millis(2)));
        let mut dates = Vec::new();
        while until.load(Ordering::Acquire) == 0
            || dates.last().is_none_or(|&at| at <= until.load(Ordering::Acquire))
        {
            dates.extend(master.dates());
            std::thread::sleep(Duration::from_millis(10));
        }
        let (from, until) = (from.load(Ordering::Relaxed), until.load(Ordering::Relaxed));
        // What it missed meanwhile it tells of only when it looks at the clock again; the next snapshot is due 100 ms later.
        let soon = until + 20_000_000;
        assert_eq!(
            dates.iter().filter(|&at| (from..soon).contains(at)).count(),
            0,
            "{from} to {until}: {dates:?}"
        );
        assert!(
            dates.iter().any(|&at| (from - 50_000_000..from).contains(&at)),
            "{from} to {until}: {dates:?}"
        );
    });
}
