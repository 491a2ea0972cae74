//! The calibration replies that a master has promised, each at the instant that was asked for.

use rtnet::counters::Refusal;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::Address;

use super::line::TimeLine;

/// Calibration requests that wait for their reply's instant unless configured otherwise, as in RTnet.
pub const DEFAULT_MAX_REQUESTS: usize = 64;
/// Most that can be: a station asks once at a time, a network has hardly more, and all are looked at for which is next.
pub const MAX_REQUESTS: usize = 256;
/// Furthest cycle a reply may be asked for: stations ask for one period of their first slot ahead.
pub const MAX_REPLY_AHEAD: u32 = 1024;
/// Times that a late reply is put off. Real stations never ask again: they wait for ever.
const PUT_OFF_AT_MOST: u8 = 8;
/// In this use of the slave's slot after the one that asked the last of them is due.
pub const LAST_USE: i64 = 1 + 2 * PUT_OFF_AT_MOST as i64;

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

/// All of them.
pub struct Replies {
    pending: Vec<Reply>,
    at_most: usize,
    /// The one that is being sent.
    taken: Option<Reply>,
    /// Promised, and not sent: this station gave the time no more, or who asked gives it.
    broken: u64,
}

impl Replies {
    /// None yet, and so many at a time.
    pub fn of(at_most: usize) -> Self {
        Self { pending: Vec::with_capacity(at_most), at_most, taken: None, broken: 0 }
    }

    /// A calibration request, received at `rx` by the master of `line`.
    pub fn ask(
        &mut self,
        line: &TimeLine,
        rx: Instant,
        from: Address,
        request_xmit: u64,
        cycle: u32,
        offset: u64,
    ) -> Result<(), Refusal> {
        let ahead = i64::from(line.ahead(cycle));
        if offset >= line.period.nanos() as u64 || ahead > i64::from(MAX_REPLY_AHEAD) {
            return Err(Refusal::ReplyImplausible);
        }
        let at = line.start_of(cycle) + Span::from_nanos(offset as i64);
        // Cycles that are long over may have begun before the clock did: their instants mean nothing.
        if ahead < 0 || at < rx {
            return Err(Refusal::ReplyOverdue);
        }
        // Who asks again waits for nothing that was promised before, and takes nobody's place.
        self.forget(from);
        // The reply is asked for in the slot's next use.
        let asked_in = ahead - (rx - line.start).nanos().div_euclid(line.period.nanos());
        let period = asked_in.max(1) as u32;
        let reply = Reply { at, to: from, cycle, request_xmit, reception: rx, period, put_off: 0 };
        if self.promise(reply) { Ok(()) } else { Err(Refusal::ReplyBacklog) }
    }

    fn promise(&mut self, reply: Reply) -> bool {
        let has_room = self.pending.len() < self.at_most;
        if has_room {
            self.pending.push(reply);
        }
        has_room
    }

    /// The one whose instant is first.
    pub fn next(&self) -> Option<&Reply> {
        self.pending.iter().min_by_key(|reply| reply.at)
    }

    /// Takes the one whose instant is first.
    pub fn take(&mut self) -> Option<Reply> {
        let first = self.next().copied()?;
        self.pending.retain(|reply| *reply != first);
        self.taken = Some(first);
        Some(first)
    }

    /// The one that was taken came too late: it goes into the slave's slot two uses later. In the next, a slave that
    /// repeats its request sends; two later it is silent again, for the reply to that. `false` when it is given up.
    pub fn put_off(&mut self, line: &TimeLine) -> bool {
        let Some(late) = self.taken.take() else { return false };
        // Who was held up for long may have been asked again meanwhile.
        if self.pending.iter().any(|reply| reply.to == late.to) {
            return true;
        }
        let cycles = late.period * 2;
        let later = Reply {
            at: late.at + line.period * i64::from(cycles),
            cycle: late.cycle.wrapping_add(cycles),
            put_off: late.put_off + 1,
            ..late
        };
        late.put_off < PUT_OFF_AT_MOST && self.promise(later)
    }

    /// This station waits for none any more.
    pub fn forget(&mut self, station: Address) {
        let promised = self.pending.len();
        self.pending.retain(|reply| reply.to != station);
        self.broken += (promised - self.pending.len()) as u64;
    }

    /// Who gives the time no more answers nobody: stations ask whose Synchronisation they hear.
    pub fn clear(&mut self) {
        self.broken += self.pending.len() as u64;
        self.pending.clear();
        self.taken = None;
    }

    /// How many were promised and could not be kept so far.
    pub fn broken(&self) -> u64 {
        self.broken
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tdma::line::Drift;
    use rtnet::time::{GlobalTime, Offset};

    const A: Address = station(9);
    const B: Address = station(10);

    const fn station(last: u8) -> Address {
        Address([2, 0, 0, 0, 0, last])
    }

    fn at(micros: u64) -> Instant {
        Instant::from_nanos(micros * 1_000)
    }

    /// Cycle `cycle` began at 3 ms and so many more.
    fn line(cycle: u32) -> TimeLine {
        TimeLine {
            cycle,
            start: at(3_000 + 1_000 * u64::from(cycle)),
            sched: GlobalTime::default(),
            period: Span::from_millis(1),
            offset: Offset::default(),
            drift: Drift::NONE,
        }
    }

    #[test]
    fn requests_are_answered_in_the_order_of_their_instants() {
        let mut replies = Replies::of(DEFAULT_MAX_REQUESTS);
        replies.ask(&line(0), at(3_500), A, 1, 3, 200_000).unwrap();
        replies.ask(&line(0), at(3_600), B, 2, 2, 700_000).unwrap();
        assert_eq!(replies.next().unwrap().at, at(5_700));
        assert_eq!(replies.take().unwrap().request_xmit, 2);
        assert_eq!(replies.take().unwrap().at, at(6_200));
        assert_eq!(replies.take(), None);
    }

    #[test]
    fn a_late_reply_is_put_off_by_two_uses_of_the_slot_and_given_up_at_last() {
        let (mut replies, line) = (Replies::of(DEFAULT_MAX_REQUESTS), line(1));
        // Asked in cycle 1 for cycle 4: a slot that is used in every third.
        replies.ask(&line, at(4_400), A, 7, 4, 400_000).unwrap();
        assert_eq!(replies.take().unwrap().at, at(7_400));
        assert!(replies.put_off(&line));
        let later = *replies.next().unwrap();
        assert_eq!((later.at, later.cycle, later.request_xmit), (at(13_400), 10, 7));
        assert!(!replies.put_off(&line), "only what was taken");
        let times = (0..).take_while(|_| replies.take().is_some() && replies.put_off(&line)).count();
        assert_eq!(times, usize::from(PUT_OFF_AT_MOST) - 1);
    }

    #[test]
    fn who_asks_again_is_answered_once() {
        let (mut replies, line) = (Replies::of(DEFAULT_MAX_REQUESTS), line(1));
        let (first, second) = ((at(4_400), 7, 2), (at(6_400), 8, 4));
        let ask = |replies: &mut Replies, (rx, xmit, cycle)| replies.ask(&line, rx, A, xmit, cycle, 400_000);
        // It is noticed in time that the first reply is late; or only when the second request is there.
        for noticed_at_once in [true, false] {
            ask(&mut replies, first).unwrap();
            replies.take().unwrap();
            if noticed_at_once {
                assert!(replies.put_off(&line));
            }
            ask(&mut replies, second).unwrap();
            if !noticed_at_once {
                assert!(replies.put_off(&line));
            }
            let Reply { request_xmit, at: when, .. } = replies.take().unwrap();
            assert_eq!((request_xmit, when, replies.next()), (8, at(7_400), None));
        }
    }

    #[test]
    fn what_was_promised_and_is_not_sent_is_counted() {
        let (mut replies, line) = (Replies::of(DEFAULT_MAX_REQUESTS), line(1));
        let mut ask = |from, cycle| replies.ask(&line, at(4_400), from, 0, cycle, 400_000).unwrap();
        ask(A, 3);
        (11..15).for_each(|last| ask(station(last), 4));
        ask(B, 5);
        ask(B, 6);
        assert_eq!(replies.broken(), 1, "who asks again waits for the second only");
        assert_eq!(replies.take().map(|reply| reply.to), Some(A));
        replies.forget(A);
        assert_eq!(replies.broken(), 1, "it is being sent");
        replies.forget(B);
        replies.clear();
        assert_eq!((replies.broken(), replies.next()), (6, None));
    }

    #[test]
    fn impossible_requests_are_refused_by_reason() {
        let mut replies = Replies::of(DEFAULT_MAX_REQUESTS);
        let mut stations = (0..=255).map(station).cycle();
        let mut ask = |cycle, offset| {
            let from = stations.next().unwrap_or(A);
            replies.ask(&line(0), at(3_500), from, 0, cycle, offset)
        };
        assert_eq!(ask(0, 400_000), Err(Refusal::ReplyOverdue));
        for back in (0..=31).map(|bit| 1 << bit) {
            // Such a cycle's instant may be before the clock's beginning: modulo 2^64 far ahead.
            assert_eq!(ask(0u32.wrapping_sub(back), 0), Err(Refusal::ReplyOverdue), "{back} cycles ago");
        }
        assert_eq!(ask(2_000, 0), Err(Refusal::ReplyImplausible));
        assert_eq!(ask(2, 1_000_000), Err(Refusal::ReplyImplausible));
        assert_eq!(ask(2, u64::MAX), Err(Refusal::ReplyImplausible));
        for _ in 0..DEFAULT_MAX_REQUESTS {
            assert_eq!(ask(2, 0), Ok(()));
        }
        assert_eq!(ask(2, 0), Err(Refusal::ReplyBacklog));
    }
}
