//! `rtnet jitter`.

use std::time::{Duration, Instant};

use anyhow::Result;

use super::delivery::Delivery;
use super::dump::learn;
use super::{Failure, writable};
use crate::cli::JitterArgs;
use crate::observe::ear::Ear;
use crate::observe::figures::JitterFigures;
use crate::observe::screen;
use crate::observe::tally::Tally;
use crate::observe::watch::Watch;
use crate::report::host::HostFacts;
use crate::report::text::grouped;

/// Syncs are listened to before: 64 of a cycle of 50 ms, and some that are missing.
const LEARN_AT_MOST: Duration = Duration::from_secs(5);
const PROGRESS_EVERY: Duration = Duration::from_secs(1);

/// Observes for a while, and tells how the frames are spread. The exit status is 1 if no sync was heard.
pub fn jitter(args: &JitterArgs) -> Result<u8, Failure> {
    let mut ear = Ear::open(&args.at.spot()).map_err(Failure::Usage)?;
    args.json.iter().try_for_each(|path| writable(path)).map_err(Failure::Usage)?;
    eprintln!("rtnet: listening on {}; Ctrl-C ends it", ear.place());
    let (mut watch, mut tally) = (Watch::default(), Tally::new(args.rate));
    let goes_on = learn(&mut ear, &mut watch, LEARN_AT_MOST).map_err(Failure::Run)?;
    let (host, since) = (HostFacts::begin(), Instant::now());
    let duration = Duration::from_nanos(args.duration.nanos() as u64);
    let heard = if goes_on { observe(&mut ear, &mut watch, &mut tally, since + duration) } else { Ok(()) };
    let observed = since.elapsed().as_nanos() as u64;
    let rate = args.rate.bits_per_second();
    let figures = JitterFigures::of(&mut ear, &tally, &watch.line, observed, rate, host.finish());
    let json = args.json.as_ref();
    let mut delivery = Delivery::begin(&screen::render(&figures, super::screen_width()), &[json]);
    delivery.json(json, &figures);
    delivery.unwritten(heard.err());
    if !figures.kinds.contains_key("sync") {
        eprintln!(
            "rtnet: no sync was heard on {}: without an active master there are no cycles",
            ear.place()
        );
        return delivery.end_with(1);
    }
    delivery.end_with(0)
}

fn observe(ear: &mut Ear, watch: &mut Watch, tally: &mut Tally, until: Instant) -> Result<()> {
    let mut next_progress = Instant::now() + PROGRESS_EVERY;
    let mut goes_on = true;
    while goes_on && Instant::now() < until {
        goes_on = ear.listen(|at, frame| {
            let sight = watch.frame(at, frame.bytes, frame.wire_len);
            tally.frame(at, frame.wire_len, &sight);
        })?;
        if (next_progress..until).contains(&Instant::now()) {
            next_progress += PROGRESS_EVERY;
            let left = until.saturating_duration_since(Instant::now()).as_secs_f64().round();
            eprintln!("rtnet: {} frames, {left}s to go", grouped(tally.frames));
        }
    }
    Ok(())
}
