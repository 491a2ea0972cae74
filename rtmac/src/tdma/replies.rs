//! The calibration replies that a master owes.
//!
//! ```text
//!  asked ──► due at the instant asked for ──► sent
//!                 │ not sent then, or another schedule is in use by then
//!                 ▼
//!               late ──► sent once, in the next slot of the master's own, which nobody else may use; a master without slots
//!                        sends it behind its own Synchronisation, where the sync window has room
//! ```
//!
//! A real station never repeats a request. It has one outstanding, and knows the reply by the request's stamp, whenever and
//! wherever that comes. The slot that it asked for is its own again once the instant has passed.

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

/// A reply that was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply {
    pub at: Instant,
    pub to: Address,
    pub cycle: u32,
    pub request_xmit: u64,
    pub reception: Instant,
    /// It was not sent at its instant, and goes where this station may send anyway.
    is_late: bool,
}

/// All of them.
pub struct Replies {
    pending: Vec<Reply>,
    at_most: usize,
    /// The one that is being sent.
    taken: Option<Reply>,
    /// When the schedule that is in use began: who asked before asked for an instant of another one.
    since: Instant,
    /// Not sent at the instant that was asked for.
    late: u64,
    /// Promised, and not sent.
    broken: u64,
}

impl Replies {
    /// None yet, and so many at a time.
    pub fn of(at_most: usize) -> Self {
        let pending = Vec::with_capacity(at_most);
        Self { pending, at_most, taken: None, since: Instant::default(), late: 0, broken: 0 }
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
        let is_late = rx < self.since;
        if !is_late && offset >= line.period.nanos() as u64 || ahead > i64::from(MAX_REPLY_AHEAD) {
            return Err(Refusal::ReplyImplausible);
        }
        let at = if is_late { rx } else { line.start_of(cycle) + Span::from_nanos(offset as i64) };
        // Cycles that are long over may have begun before the clock did: their instants mean nothing.
        if ahead < 0 || at < rx {
            return Err(Refusal::ReplyOverdue);
        }
        // A station that asks again waits for nothing that was promised before, and takes nobody's place.
        self.forget(from);
        if self.pending.len() >= self.at_most {
            return Err(Refusal::ReplyBacklog);
        }
        self.late += u64::from(is_late);
        self.pending.push(Reply { at, to: from, cycle, request_xmit, reception: rx, is_late });
        Ok(())
    }

    /// The one whose instant is first, of those that are not late.
    pub fn next(&self) -> Option<&Reply> {
        self.first(false)
    }

    /// The one that is late since the longest.
    pub fn next_late(&self) -> Option<&Reply> {
        self.first(true)
    }

    fn first(&self, is_late: bool) -> Option<&Reply> {
        self.pending.iter().filter(|reply| reply.is_late == is_late).min_by_key(|reply| reply.at)
    }

    /// Takes [`next`](Self::next).
    pub fn take(&mut self) -> Option<Reply> {
        self.take_first(false)
    }

    /// Takes [`next_late`](Self::next_late).
    pub fn take_late(&mut self) -> Option<Reply> {
        self.take_first(true)
    }

    fn take_first(&mut self, is_late: bool) -> Option<Reply> {
        self.taken = self.first(is_late).copied();
        self.pending.retain(|reply| Some(*reply) != self.taken);
        self.taken
    }

    /// The one that was taken was not sent. It is late, unless the station has asked again meanwhile.
    pub fn postpone(&mut self) {
        let Some(late) = self.taken.take() else { return };
        self.late += u64::from(!late.is_late);
        if self.pending.iter().any(|reply| reply.to == late.to) {
            return;
        }
        if self.pending.len() < self.at_most {
            self.pending.push(Reply { is_late: true, ..late });
        } else {
            self.broken += 1;
        }
    }

    /// Another schedule is in use from `since` on: whose the instants are that were asked for nobody knows.
    pub fn postpone_all(&mut self, since: Instant) {
        for reply in self.pending.iter_mut().filter(|reply| !reply.is_late) {
            reply.is_late = true;
            self.late += 1;
        }
        self.since = since;
    }

    /// This station waits for none any more.
    pub fn forget(&mut self, station: Address) {
        self.give_up(|reply| reply.to == station);
    }

    /// What is late is not sent: this station has no place of its own for it.
    pub fn drop_late(&mut self) {
        self.give_up(|reply| reply.is_late);
    }

    /// Who gives the time no more answers nobody: stations ask whose Synchronisation they hear.
    pub fn clear(&mut self) {
        self.give_up(|_| true);
        self.taken = None;
    }

    fn give_up(&mut self, which: impl Fn(&Reply) -> bool) {
        let promised = self.pending.len();
        self.pending.retain(|reply| !which(reply));
        self.broken += (promised - self.pending.len()) as u64;
    }

    /// How many were not sent at the instant that was asked for so far.
    pub fn late(&self) -> u64 {
        self.late
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
    fn a_reply_that_was_not_sent_is_late_until_it_is() {
        let (mut replies, line) = (Replies::of(DEFAULT_MAX_REQUESTS), line(1));
        replies.ask(&line, at(4_400), A, 7, 4, 400_000).unwrap();
        assert_eq!(replies.take().unwrap().at, at(7_400));
        replies.postpone();
        for _ in 0..100 {
            assert_eq!(replies.next(), None, "nobody waits for it at an instant");
            let late = replies.take_late().unwrap();
            assert_eq!((late.at, late.cycle, late.request_xmit), (at(7_400), 4, 7));
            replies.postpone();
        }
        replies.take_late().unwrap();
        assert_eq!((replies.next_late(), replies.broken()), (None, 0), "it is sent once");
    }

    #[test]
    fn a_station_that_asks_again_is_answered_once() {
        let (mut replies, line) = (Replies::of(DEFAULT_MAX_REQUESTS), line(1));
        let (first, second) = ((at(4_400), 7, 2), (at(6_400), 8, 4));
        let ask = |replies: &mut Replies, (rx, xmit, cycle)| replies.ask(&line, rx, A, xmit, cycle, 400_000);
        // It is noticed in time that the first reply is late; or only when the second request is there.
        for noticed_at_once in [true, false] {
            ask(&mut replies, first).unwrap();
            replies.take().unwrap();
            if noticed_at_once {
                replies.postpone();
            }
            ask(&mut replies, second).unwrap();
            if !noticed_at_once {
                replies.postpone();
            }
            let Reply { request_xmit, at: when, .. } = replies.take().unwrap();
            assert_eq!((request_xmit, when, replies.next(), replies.next_late()), (8, at(7_400), None, None));
        }
    }

    #[test]
    fn another_schedule_makes_late_what_was_asked_before_it() {
        let (mut replies, line) = (Replies::of(DEFAULT_MAX_REQUESTS), line(1));
        replies.ask(&line, at(4_400), A, 1, 3, 400_000).unwrap();
        replies.postpone_all(at(5_000));
        // Received late; its offset may be beyond the cycle that is in use by now.
        replies.ask(&line, at(4_900), B, 2, 2, 1_700_000).unwrap();
        replies.ask(&line, at(5_100), station(11), 3, 3, 300_000).unwrap();
        assert_eq!(replies.next().map(|reply| reply.request_xmit), Some(3));
        assert_eq!(replies.take_late().map(|reply| reply.request_xmit), Some(2));
        assert_eq!(replies.take_late().map(|reply| reply.request_xmit), Some(1));
        assert_eq!((replies.next_late(), replies.broken()), (None, 0));
    }

    #[test]
    fn a_master_without_a_place_drops_only_what_is_late() {
        let (mut replies, line) = (Replies::of(DEFAULT_MAX_REQUESTS), line(1));
        replies.ask(&line, at(4_400), A, 1, 2, 400_000).unwrap();
        replies.ask(&line, at(4_400), B, 2, 3, 400_000).unwrap();
        replies.take().unwrap();
        replies.postpone();
        replies.drop_late();
        assert_eq!((replies.next_late(), replies.broken()), (None, 1));
        assert_eq!(replies.next().map(|reply| reply.to), Some(B));
    }

    #[test]
    fn what_was_promised_and_is_not_sent_is_counted() {
        let (mut replies, line) = (Replies::of(DEFAULT_MAX_REQUESTS), line(1));
        let mut ask = |from, cycle| replies.ask(&line, at(4_400), from, 0, cycle, 400_000).unwrap();
        ask(A, 3);
        (11..15).for_each(|last| ask(station(last), 4));
        ask(B, 5);
        ask(B, 6);
        assert_eq!(replies.broken(), 1, "a station that asks again waits for the second only");
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
