//! The master: listens, then tells the time.
//!
//! ```text
//!              another master heard
//!  Listening ───────────────────────► Yielded (for good)
//!      │ 3 cycles of silence
//!      ▼
//!   Active: a Synchronisation at every point of the grid, replies where they were asked for
//! ```
//!
//! The grid is fixed when the master becomes active, and never moves: a Synchronisation that comes too
//! late for its window is not sent, and the next carries the number that the grid says.

use arrayvec::ArrayVec;
use rtnet::counters::Refusal;
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use rtnet::wire::ethernet::Address;

use super::line::{Drift, TimeLine};

/// Cycles of silence before a master speaks.
const LISTEN_CYCLES: i64 = 3;
/// And at least this long.
const LISTEN_AT_LEAST: Span = Span::from_millis(3);
/// Calibration requests that wait for their reply's instant, as in RTnet.
pub const MAX_PENDING_REPLIES: usize = 64;
/// Furthest cycle a reply may be asked for: stations ask for one period of their first slot ahead.
pub const MAX_REPLY_AHEAD: u32 = 1024;

/// Times that a late reply is put off. Real stations never ask again: they wait for ever.
const PUT_OFF_AT_MOST: u8 = 8;

/// What is configured of a master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MasterConfig {
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// How long after a cycle's start its Synchronisation may still be sent.
    pub sync_latest: Span,
    /// How long after the instant asked for a calibration reply may still be sent.
    pub reply_latest: Span,
    /// From this station's clock to global time, taken once.
    pub epoch: Offset,
    /// A cycle and its scheduled start, of a master before this one whose grid is gone on with. `None`: a new
    /// grid begins.
    pub resume: Option<(u32, GlobalTime)>,
}

/// A station that gives the time.
pub struct Master {
    config: MasterConfig,
    phase: Phase,
    replies: ArrayVec<Reply, MAX_PENDING_REPLIES>,
    /// The reply that is being sent.
    taken: Option<Reply>,
}

enum Phase {
    Attached,
    Listening { until: Instant },
    Active { line: TimeLine },
    Yielded { to: Address },
}

/// A reply that was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply {
    pub at: Instant,
    pub to: Address,
    pub cycle: u32,
    pub request_xmit: u64,
    pub reception: Instant,
    /// From one use of the slave's slot to the next, in cycles.
    period: u32,
    put_off: u8,
}

impl Master {
    pub fn new(config: MasterConfig) -> Self {
        Self { config, phase: Phase::Attached, replies: ArrayVec::new(), taken: None }
    }

    pub fn config(&self) -> &MasterConfig {
        &self.config
    }

    /// Time has passed; `true` when the master has just become active.
    pub fn on_timeout(&mut self, now: Instant) -> bool {
        match self.phase {
            Phase::Attached => {
                let listen = (self.config.cycle * LISTEN_CYCLES).max(LISTEN_AT_LEAST);
                self.phase = Phase::Listening { until: now + listen };
                false
            }
            Phase::Listening { until } if now >= until => {
                self.phase = Phase::Active { line: self.grid(now) };
                true
            }
            _ => false,
        }
    }

    /// Of a new grid cycle 0 begins now, without a Synchronisation; the first carries cycle 1, as RTnet's does. Of
    /// one that is gone on with, the next cycle is the first to be told of.
    fn grid(&self, now: Instant) -> TimeLine {
        let MasterConfig { cycle: period, epoch: offset, resume, .. } = self.config;
        let (cycle, sched) = resume.unwrap_or((0, offset.global(now)));
        let known = TimeLine { cycle, start: offset.local(sched), sched, period, offset, drift: Drift::NONE };
        let gone = (now - known.start).nanos().div_euclid(period.nanos());
        let cycle = cycle.wrapping_add(gone as u32);
        TimeLine { cycle, start: known.start_of(cycle), sched: known.sched_of(cycle), ..known }
    }

    /// Another master's Synchronisation. Before this one speaks, it yields; `true` when it just did.
    pub fn on_foreign_sync(&mut self, from: Address) -> bool {
        let yields = matches!(self.phase, Phase::Attached | Phase::Listening { .. });
        if yields {
            self.phase = Phase::Yielded { to: from };
        }
        yields
    }

    /// A calibration request, received at `rx`.
    pub fn on_request(
        &mut self,
        rx: Instant,
        from: Address,
        request_xmit: u64,
        cycle: u32,
        offset: u64,
    ) -> Result<(), Refusal> {
        let Phase::Active { line } = &self.phase else { return Err(Refusal::NotMaster) };
        if offset >= line.period.nanos() as u64 || line.ahead(cycle) > MAX_REPLY_AHEAD as i32 {
            return Err(Refusal::ReplyImplausible);
        }
        let at = line.start_of(cycle) + Span::from_nanos(offset as i64);
        if at < rx {
            return Err(Refusal::ReplyOverdue);
        }
        // The reply is asked for in the slot's next use.
        let asked_in = line.ahead(cycle) - ((rx - line.start).nanos().div_euclid(line.period.nanos())) as i32;
        let period = asked_in.max(1) as u32;
        let reply = Reply { at, to: from, cycle, request_xmit, reception: rx, period, put_off: 0 };
        self.replies.try_push(reply).map_err(|_| Refusal::ReplyBacklog)
    }

    /// The line of the grid, anchored at the last cycle that was begun.
    pub fn line(&self) -> Option<&TimeLine> {
        match &self.phase {
            Phase::Active { line } => Some(line),
            _ => None,
        }
    }

    /// The master this one made way for.
    pub fn yielded_to(&self) -> Option<Address> {
        match self.phase {
            Phase::Yielded { to } => Some(to),
            _ => None,
        }
    }

    /// When to wake while nothing can be sent yet.
    pub fn deadline(&self) -> Option<Instant> {
        match self.phase {
            Phase::Attached => Some(Instant::default()),
            Phase::Listening { until } => Some(until),
            _ => None,
        }
    }

    /// The next Synchronisation: its cycle, instant and global time.
    pub fn next_sync(&self) -> Option<(u32, Instant, GlobalTime)> {
        let line = self.line()?;
        let cycle = line.cycle.wrapping_add(1);
        Some((cycle, line.start_of(cycle), line.sched_of(cycle)))
    }

    /// The next cycle has begun, with or without its Synchronisation.
    pub fn advance(&mut self) {
        if let Phase::Active { line } = &mut self.phase {
            let cycle = line.cycle.wrapping_add(1);
            *line = TimeLine { cycle, start: line.start_of(cycle), sched: line.sched_of(cycle), ..*line };
        }
    }

    /// The reply whose instant is first.
    pub fn next_reply(&self) -> Option<&Reply> {
        self.replies.iter().min_by_key(|reply| reply.at)
    }

    /// Takes the reply whose instant is first.
    pub fn take_reply(&mut self) -> Option<Reply> {
        let first = self.next_reply().copied()?;
        self.replies.retain(|reply| *reply != first);
        self.taken = Some(first);
        Some(first)
    }

    /// The reply that was taken came too late: it goes into the slave's slot two uses later. In the next,
    /// a slave that repeats its request sends; two later it is silent again. `false` when it is given up.
    pub fn put_off(&mut self) -> bool {
        let (Some(late), Phase::Active { line }) = (self.taken.take(), &self.phase) else { return false };
        let cycles = late.period * 2;
        let later = Reply {
            at: late.at + line.period * i64::from(cycles),
            cycle: late.cycle.wrapping_add(cycles),
            put_off: late.put_off + 1,
            ..late
        };
        late.put_off < PUT_OFF_AT_MOST && self.replies.try_push(later).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: Address = Address([2, 0, 0, 0, 0, 9]);

    fn at(micros: u64) -> Instant {
        Instant::from_nanos(micros * 1_000)
    }

    fn master() -> Master {
        let (sync_latest, reply_latest) = (Span::from_micros(40), Span::from_micros(40));
        let epoch = Offset::between(at(0), GlobalTime::from_nanos(u64::MAX - 4_999_999));
        let cycle = Span::from_millis(1);
        Master::new(MasterConfig { cycle, sync_latest, reply_latest, epoch, resume: None })
    }

    fn active() -> Master {
        let mut master = master();
        assert!(!master.on_timeout(at(0)));
        assert!(!master.on_timeout(at(2_999)));
        assert!(master.on_timeout(at(3_000)));
        master
    }

    #[test]
    fn the_first_synchronisation_carries_cycle_1_one_period_after_the_silence() {
        let (cycle, start, sched) = active().next_sync().unwrap();
        assert_eq!((cycle, start), (1, at(4_000)));
        assert_eq!(sched.nanos(), u64::MAX - 999_999, "global time is the epoch's, modulo 2^64");
    }

    #[test]
    fn a_grid_that_is_gone_on_with_keeps_its_numbers_and_its_instants() {
        let mut master = master();
        let MasterConfig { epoch, .. } = master.config;
        // Its predecessor's cycle u32::MAX was to begin at 1.2 ms on this clock.
        master.config.resume = Some((u32::MAX, epoch.global(at(1_200))));
        master.on_timeout(at(0));
        assert!(master.on_timeout(at(3_300)));
        let (cycle, start, sched) = master.next_sync().unwrap();
        assert_eq!((cycle, start), (2, at(4_200)));
        assert_eq!(sched, epoch.global(at(4_200)));
    }

    #[test]
    fn global_time_wraps_without_a_jump() {
        let mut master = active();
        master.advance();
        assert_eq!(master.next_sync().unwrap().2.nanos(), 0);
    }

    #[test]
    fn every_phase_answers_every_event() {
        let foreign_while = |mut master: Master| (master.on_foreign_sync(A), master.yielded_to());
        assert_eq!(foreign_while(master()), (true, Some(A)), "attached");
        let mut listening = master();
        listening.on_timeout(at(0));
        assert_eq!(foreign_while(listening), (true, Some(A)), "listening");
        assert_eq!(foreign_while(active()), (false, None), "active: its line is not re-timed");
        let mut yielded = master();
        yielded.on_foreign_sync(A);
        assert!(!yielded.on_timeout(at(99_000)), "yielded for good");
        assert_eq!(yielded.on_request(at(0), A, 0, 1, 0), Err(Refusal::NotMaster));
        assert_eq!((yielded.deadline(), yielded.next_sync()), (None, None));
    }

    #[test]
    fn requests_are_answered_in_the_order_of_their_instants() {
        let mut master = active();
        master.on_request(at(3_500), A, 1, 3, 200_000).unwrap();
        master.on_request(at(3_600), A, 2, 2, 700_000).unwrap();
        assert_eq!(master.next_reply().unwrap().at, at(5_700));
        assert_eq!(master.take_reply().unwrap().request_xmit, 2);
        assert_eq!(master.take_reply().unwrap().at, at(6_200));
        assert_eq!(master.take_reply(), None);
    }

    #[test]
    fn a_late_reply_is_put_off_by_two_uses_of_the_slot_and_given_up_at_last() {
        let mut master = active();
        master.advance();
        // Asked in cycle 1 for cycle 4: a slot that is used in every third.
        master.on_request(at(4_400), A, 7, 4, 400_000).unwrap();
        assert_eq!(master.take_reply().unwrap().at, at(7_400));
        assert!(master.put_off());
        let later = *master.next_reply().unwrap();
        assert_eq!((later.at, later.cycle, later.request_xmit), (at(13_400), 10, 7));
        assert!(!master.put_off(), "only what was taken");
        let times = (0..).take_while(|_| master.take_reply().is_some() && master.put_off()).count();
        assert_eq!(times, usize::from(PUT_OFF_AT_MOST) - 1);
    }

    #[test]
    fn impossible_requests_are_refused_by_reason() {
        let mut master = active();
        let mut ask = |cycle, offset| master.on_request(at(3_500), A, 0, cycle, offset);
        assert_eq!(ask(0, 400_000), Err(Refusal::ReplyOverdue));
        assert_eq!(ask(u32::MAX, 0), Err(Refusal::ReplyOverdue));
        assert_eq!(ask(2_000, 0), Err(Refusal::ReplyImplausible));
        assert_eq!(ask(2, 1_000_000), Err(Refusal::ReplyImplausible));
        assert_eq!(ask(2, u64::MAX), Err(Refusal::ReplyImplausible));
        for _ in 0..MAX_PENDING_REPLIES {
            assert_eq!(ask(2, 0), Ok(()));
        }
        assert_eq!(ask(2, 0), Err(Refusal::ReplyBacklog));
    }
}
