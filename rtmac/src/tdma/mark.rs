//! One Synchronisation compared with the line that is followed: whether it agrees, was delayed, or is of another line.

use rtnet::time::{GlobalTime, Instant, Offset, Span};

use super::envelope::syncs_of_window;
use super::line::{self, DRIFT_PARTS, Drift, LINE_GOOD_FOR, PERIODS, TimeLine};

/// Smallest disagreement that is a time step, and as a part of the cycle; see [`SlaveConfig`](super::SlaveConfig).
const STEP_AT_LEAST: Span = Span::from_micros(20);
const STEP_PARTS: i64 = 100;
/// Number of consecutive early Synchronisations that make a new line.
pub const MOVED: u32 = 2;
/// Number of consecutive late Synchronisations that make a new line, unless a slow host explains them ([`Mark::takes`]). A
/// network that delays one in ten delays eight in a row once in 10^8 cycles. Until then the slave sends in bridged cycles only.
pub const MOVED_LATE: u32 = 8;
/// Two early Synchronisations make a new line only if they agree within this, or within this part of the cycle: delays in a
/// row seldom have one length. For [`MOVED_LATE`] of them the step limit applies.
const CONFIRMED_WITHIN: Span = Span::from_micros(2);
const CONFIRMED_PARTS: i64 = 2_000;
/// A Synchronisation that is late by less than this part of the cycle, and by less than [`BRIDGED_BELOW`], is bridged like a
/// missing one. A later one silences its cycle.
const BRIDGED_PARTS: i64 = 4;
const BRIDGED_BELOW: Span = Span::from_millis(4);
/// So many cycles after a Synchronisation those that it has overtaken may come.
const OVERTAKEN_WITHIN: i64 = 2;
/// Largest part of a cycle by which one Synchronisation moves the line, while it does.
const SLEW_PARTS: i64 = 300;
/// The part of a lateness beyond drift that moves the line: frames are delayed on their way, but never early.
const LATE_PARTS: i64 = 8;

/// One Synchronisation.
#[derive(Clone, Copy)]
pub struct Mark {
    pub cycle: u32,
    pub sched: GlobalTime,
    pub offset: Offset,
    /// By how much later than scheduled it was sent, by its author's clock.
    pub sent: Span,
}

/// What disagrees with the line: the last of so many Synchronisations in a row that agree with each other, of as many as
/// another line takes.
#[derive(Clone, Copy)]
pub struct Step {
    pub mark: Mark,
    pub seen: u32,
    pub takes: u32,
}

impl TimeLine {
    /// The line after a Synchronisation that agrees with it.
    pub fn moved_to(&self, mark: &Mark) -> TimeLine {
        let drift = drifted(self, mark.cycle);
        let slew = self.period / SLEW_PARTS + drift;
        let deviation = mark.deviation_from(self).clamp(-slew, slew);
        let late = (deviation - drift).max(Span::ZERO);
        let by = deviation - late + late / LATE_PARTS;
        self.carried_on(mark, self.start_of(mark.cycle) + by, Drift::NONE)
    }

    /// The line on from a Synchronisation whose cycle starts then, on this clock.
    pub fn carried_on(&self, mark: &Mark, start: Instant, drift: Drift) -> TimeLine {
        let Mark { cycle, sched, .. } = *mark;
        TimeLine { cycle, start, sched, period: self.period, offset: Offset::between(start, sched), drift }
    }
}

impl Step {
    /// The same with one more, which alone would take so many, and their line, if it agrees. If one of them cannot have been
    /// late, none was.
    pub fn with(
        &self,
        mark: Mark,
        takes: u32,
        limit: Option<Span>,
        period: Span,
    ) -> Option<(Step, TimeLine)> {
        let step = Step { mark, seen: self.seen + 1, takes: self.takes.min(takes) };
        let closely = (period / CONFIRMED_PARTS).max(CONFIRMED_WITHIN);
        let limit = if step.takes > MOVED { limit } else { Some(closely) };
        self.mark.line_to(&mark, limit).map(|line| (step, line))
    }
}

impl Mark {
    pub fn start(&self) -> Instant {
        line::cycle_start(self.sched, self.offset)
    }

    /// This cycle's start less what the line says of it; of a cycle that came twice: of the same.
    pub fn deviation_from(&self, line: &TimeLine) -> Span {
        self.start() - line.start_of(self.cycle)
    }

    /// Whether it is of the line, if what is on a line that is known may be late by `slower`.
    pub fn agrees_with(&self, line: &TimeLine, limit: Option<Span>, slower: Span) -> bool {
        let limit = step_limit(limit, line.period) + drifted(line, self.cycle);
        let around = -limit..=limit.max(slower);
        (1..=LINE_GOOD_FOR).contains(&line.ahead(self.cycle)) && around.contains(&self.deviation_from(line))
    }

    /// Whether it says of the line's last cycle what the line says.
    pub fn repeats(&self, line: &TimeLine, limit: Option<Span>) -> bool {
        let limit = step_limit(limit, line.period);
        self.cycle == line.cycle && self.sched == line.sched && self.deviation_from(line).abs() <= limit
    }

    /// Whether it says of its cycle what the line says, and came later. Nothing in it tells a frame that was long on its way
    /// from a clock that was set. But one that was sent before its cycle had begun is of a master that has set its clock
    /// since it chose the moment.
    pub fn is_late(&self, line: &TimeLine, limit: Option<Span>) -> bool {
        let limit = step_limit(limit, line.period);
        let is_near = (1 - LINE_GOOD_FOR..=LINE_GOOD_FOR).contains(&line.ahead(self.cycle));
        let says_the_same = (self.sched - line.sched_of(self.cycle)).abs() <= limit && self.sent >= -limit;
        is_near && says_the_same && self.deviation_from(line) > limit
    }

    /// Number of consecutive Synchronisations, this one included, that make a new line. A slow host explains a late one if
    /// its sender is that of `line` (`same_clock`) and it is late by less than [`bridged_below`].
    pub fn takes(&self, line: &TimeLine, limit: Option<Span>, same_clock: bool) -> u32 {
        match self.is_late(line, limit) {
            false => MOVED,
            true if same_clock && self.is_bridged(line) => slow_at_most(line.period),
            true => MOVED_LATE,
        }
    }

    /// Whether it is late, and came at `rx` after a later one. Where those do not come any more, it may be of a master whose
    /// clock was set back.
    pub fn is_overtaken(&self, line: &TimeLine, rx: Instant, limit: Option<Span>) -> bool {
        line.ahead(self.cycle) <= 0
            && self.is_late(line, limit)
            && rx - line.start < line.period * OVERTAKEN_WITHIN
    }

    /// The cycle of the line that is silent, if any is, as it was received at `rx` and disagrees with the line: its own, if it is a
    /// little early, but its number may be what is wrong with it.
    pub fn silences(&self, line: &TimeLine, rx: Instant) -> u32 {
        let here = line.cycle_at(rx);
        let is_early =
            self.cycle == here.wrapping_add(1) && self.deviation_from(line).abs() <= line.period / 2;
        if is_early { self.cycle } else { here }
    }

    /// Whether its cycle is bridged, as if it were missing; see [`BRIDGED_PARTS`].
    pub fn is_bridged(&self, line: &TimeLine) -> bool {
        let late = self.deviation_from(line);
        let on_the_line = (1..=LINE_GOOD_FOR).contains(&line.ahead(self.cycle));
        on_the_line && Span::ZERO < late && late < bridged_below(line.period)
    }

    /// The line through this Synchronisation and a later one, if they can be of one line.
    pub fn line_to(&self, later: &Mark, limit: Option<Span>) -> Option<TimeLine> {
        let cycles = later.cycle.wrapping_sub(self.cycle) as i32;
        if !(1..=LINE_GOOD_FOR).contains(&cycles) {
            return None;
        }
        let period = (later.sched - self.sched) / i64::from(cycles);
        let Mark { cycle, sched, offset, .. } = *self;
        let line = TimeLine { cycle, start: self.start(), sched, period, offset, drift: Drift::NONE };
        let fits = PERIODS.contains(&period) && later.agrees_with(&line, limit, Span::ZERO);
        fits.then(|| line.carried_on(later, later.start(), Drift::NONE))
    }
}

/// A Synchronisation that is late by this or more silences its cycle.
pub fn bridged_below(period: Span) -> Span {
    (period / BRIDGED_PARTS).min(BRIDGED_BELOW)
}

/// Number of consecutive late Synchronisations that make a new line if a slow host explains them: a window of the envelope,
/// which needs one in time per window. The longest row on a disturbed host was 52, late by 26 to 42 us.
pub fn slow_at_most(period: Span) -> u32 {
    MOVED_LATE.max(syncs_of_window(period) as u32)
}

/// How far two clocks may have drifted apart since the line's last Synchronisation.
fn drifted(line: &TimeLine, cycle: u32) -> Span {
    line.period * i64::from(line.ahead(cycle)) / DRIFT_PARTS
}

/// What disagrees by more is a time step.
pub fn step_limit(configured: Option<Span>, period: Span) -> Span {
    configured.unwrap_or((period / STEP_PARTS).max(STEP_AT_LEAST))
}
