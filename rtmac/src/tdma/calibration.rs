//! Measuring the delay from the master, in rounds.
//!
//! ```text
//!            request sent                   reply matches
//!  idle ──────────────────► outstanding ──────────────────► idle (one sample more), or done (the last)
//!   │ ▲                          │                                                     │
//!   └─┤ late, delayed,           │ no reply by the next turn: repeated                 │ a command; another master, if
//!     │ dropped, failed          │ one whose stamps cannot be: refused                 │ that is configured
//!     ├──────────────────────────┘ another line, another master: not waited for        │
//!     └────────────────────────────────────────────────────────────────────────────────┘
//! ```
//!
//! Three requests for each round, and 20 more, may be sent; instead of the next one that is told of, and everything starts
//! over. A reply to anything else is refused, and while Synchronisations are missing nothing changes: `transitions.rs` has
//! every state against everything that can happen.
//!
//! A delay that is known can be measured anew: it stays in use until the last round, or for good if the limit is reached.
//! Rounds with a master before this one count for the delay, which would be kept for this one, too; where each master's own
//! is to be measured, nothing stays of what is under way.
//!
//! RTnet takes the mean of all rounds, as a station does that follows as RTnet's do (`servo = "none"`), and never repeats a
//! lost one. Here the lower quartile counts, unless the median or the mean is asked for: one stamp that the host delayed by a
//! millisecond moves a mean of 100 by 10 us for good, and hold-ups only ever make a round longer. And where Synchronisations take longer than that, it is their delay that counts.

use rtnet::counters::Refusal;
use rtnet::time::{Instant, Span};

use super::follow::Servo;
use super::line::TimeLine;
use super::rate::Rate;
use super::report::{CalibrationReport, DelayOf, Tally};
use super::round::{self, Begun, Room, Round};

/// Rounds unless configured otherwise, as in RTnet.
pub const DEFAULT_ROUNDS: u32 = 100;
/// Most rounds that can be asked for: their samples are kept, and looked through when the last reply comes, which takes the
/// real-time thread 1.5 us of 100, 12 of 1000, and 83 of these, more than a lead: whatever is due then may be late once.
pub const MAX_ROUNDS: u32 = 10_000;
/// Requests per round before calibration is given up, and some for the begin.
const ATTEMPTS_PER_ROUND: u32 = 3;
const ATTEMPTS_EXTRA: u32 = 20;
/// Two syncs that make a line agree within this.
const QUICKER_WITHIN: Span = Span::from_micros(2);

/// A calibration: one that is done, one under way, or both while the delay is measured anew. What every turn looks at
/// comes first, together.
#[repr(C)]
pub struct Calibration {
    /// Of Synchronisations, once it is known.
    delay: Option<Span>,
    is_measuring: bool,
    /// Of a first calibration, and of one that another master asks for.
    rounds: u32,
    /// Whether syncs are filtered, and rounds, too.
    servo: Servo,
    /// What all rounds say together.
    delay_of: DelayOf,
    /// Of the one under way, or of the last.
    wanted: u32,
    /// For the rounds of the one under way, and the quicker ones of the last that are of the line that is followed.
    room: Room,
    /// The request's stamp on this station's clock, while its reply is awaited.
    outstanding: Option<Instant>,
    attempts: u32,
    tally: Tally,
    /// Lines that were followed since the first round: the master's clock of one is not that of another.
    line: u32,
    /// The delay of a frame for one station.
    one: Span,
    /// By how much the line was late that was followed meanwhile, were there no delay.
    of_line: Span,
    rate: Option<Rate>,
    /// In which cycle the last round was, while the rounds that are kept say something of the line.
    done: Option<u32>,
    report: Option<CalibrationReport>,
    repeats: u64,
}

impl Calibration {
    /// `rounds` of measuring, which say this together, for who follows by this servo; 0: no measuring, and a delay of 0.
    pub fn new(rounds: u32, servo: Servo, delay_of: DelayOf) -> Self {
        let rounds = rounds.min(MAX_ROUNDS);
        Self {
            rounds,
            servo,
            delay_of,
            wanted: rounds,
            is_measuring: rounds > 0,
            room: Room::of(rounds),
            outstanding: None,
            attempts: 0,
            tally: Tally::default(),
            line: 0,
            one: Span::ZERO,
            delay: (rounds == 0).then_some(Span::ZERO),
            of_line: Span::ZERO,
            rate: None,
            done: None,
            report: None,
            repeats: 0,
        }
    }

    /// How many are to be measured.
    pub fn rounds(&self) -> u32 {
        self.rounds
    }

    /// The delay from the master, once measured.
    pub fn delay(&self) -> Option<Span> {
        self.delay
    }

    /// The delay by which the line that was followed while it was measured anew is right. Where Synchronisations have begun
    /// to take longer, that line is still of those that did not.
    pub fn of_line(&self) -> Span {
        self.of_line
    }

    /// Whether the delay is being measured, for the first time or anew.
    pub fn is_measuring(&self) -> bool {
        self.is_measuring
    }

    /// Whether it is being measured while an older one is in use.
    pub fn measures_anew(&self) -> bool {
        self.is_measuring && self.delay.is_some()
    }

    /// Of the measuring under way: rounds so far, of how many.
    pub fn progress(&self) -> Option<(u32, u32)> {
        self.is_measuring.then_some((self.room.samples.len() as u32, self.wanted))
    }

    /// What the last calibration has shown, or the first so far.
    pub fn report(&self) -> Option<CalibrationReport> {
        self.report.or_else(|| self.tally.report(None))
    }

    /// How fast this clock gains on the master's, if the rounds were enough to show it, and stamped by the clock of its
    /// Synchronisations.
    pub fn rate(&self) -> Option<Rate> {
        self.rate
    }

    /// Requests that went unanswered and were repeated.
    pub fn repeats(&self) -> u64 {
        self.repeats
    }

    /// Measures anew, at least one round. A delay that is known stays until the last. Rounds that do not fit what is
    /// there take the place of `room`, which is left with what they do not need.
    pub fn measure_anew(&mut self, rounds: u32, room: &mut Room) {
        self.room.widen(rounds, room);
        self.wanted = rounds.min(self.room.samples.capacity() as u32);
        self.is_measuring = true;
        self.start_over();
    }

    /// The same in as many rounds as are configured, for which there is always room.
    pub fn repeat(&mut self) {
        if self.rounds > 0 {
            self.measure_anew(self.rounds, &mut Room::default());
        }
    }

    /// The rounds so far count no more.
    fn start_over(&mut self) {
        self.room.samples.clear();
        self.tally = Tally::default();
        (self.outstanding, self.attempts) = (None, 0);
    }

    /// A request may be sent now. `false`: too many had no answer; what was measured is forgotten, and a delay that is
    /// known is not measured anew any more.
    pub fn begin_round(&mut self) -> bool {
        if self.outstanding.take().is_some() {
            self.repeats += 1;
        }
        if self.attempts >= self.wanted * ATTEMPTS_PER_ROUND + ATTEMPTS_EXTRA {
            self.start_over();
            self.is_measuring = self.delay.is_none();
            return false;
        }
        self.attempts += 1;
        true
    }

    /// The request has left with this stamp.
    pub fn sent(&mut self, xmit: Instant) {
        self.outstanding = Some(xmit);
    }

    /// A reply, received at `rx` on the line of a Synchronisation that knows of no delay, and is so much later than the
    /// line that is followed; the delay once it was the last. A sample beyond the period is refused, whichever its sign.
    pub fn reply(
        &mut self,
        request_xmit: u64,
        reception: u64,
        xmit: u64,
        rx: Instant,
        line: &TimeLine,
        beside: Span,
    ) -> Result<Option<Span>, Refusal> {
        if self.outstanding.is_none_or(|sent| sent.nanos() != request_xmit) {
            return Err(Refusal::UnexpectedReply);
        }
        self.outstanding = None;
        let mut round = Round::new(request_xmit, reception, xmit, rx, line);
        (round.line, round.beside) = (self.line, beside);
        if round.delay.abs() > line.period {
            return Err(Refusal::ImplausibleReply);
        }
        self.tally.note(round.delay);
        self.room.samples.push(round);
        let is_last = self.room.samples.len() == self.wanted as usize;
        if is_last {
            self.conclude(line);
        }
        Ok(self.delay.filter(|_| is_last))
    }

    /// What all rounds say.
    fn conclude(&mut self, line: &TimeLine) {
        let delays = round::keep_quicker(&mut self.room.samples);
        self.report = self.tally.report(Some(delays));
        let one = match (self.delay_of, self.report) {
            (DelayOf::Mean, Some(report)) => report.mean,
            (DelayOf::Median, _) => delays.median,
            _ => delays.quartile,
        };
        match self.servo {
            Servo::None => (self.delay, self.of_line) = (Some(one), one),
            Servo::Linear => self.take_quicker(one, line),
        }
        self.is_measuring = false;
        self.start_over();
    }

    /// What the quicker ones say, of which one takes so long. Those on another line measured the delay as well, but tell
    /// nothing of this one.
    fn take_quicker(&mut self, one: Span, line: &TimeLine) {
        self.one = one;
        self.room.kept.clear();
        self.room.kept.extend(self.room.samples.iter().filter(|round| round.line == self.line));
        if self.room.kept.len() * 2 < self.room.samples.len() {
            self.room.kept.clear();
        }
        let of_syncs = |round: &Round| round.ahead_of(round.begun(), 0.0).abs() < line.period;
        self.rate = round::rate(&self.room.kept).filter(|_| self.room.kept.first().is_some_and(of_syncs));
        let apart = self.rate.map_or(0.0, |rate| -rate.gains);
        let late = |round: &Round| round.ahead_of(round.begun(), apart);
        let later = round::later(&mut self.room.kept, self.one, line.period, late);
        let delay = self.one + later.unwrap_or(Span::ZERO);
        self.of_line = later.and_then(|_| round::of_line(&mut self.room.kept, late)).unwrap_or(delay);
        self.delay = Some(delay);
        self.done = Some(line.cycle);
    }

    /// The line of the time of calibration is known better now than it was then: by how much the delay is longer than
    /// was believed, if that is more than half of what the line is `unsure` by. `begun` tells of a cycle by the number that it had, with that
    /// delay; the master's clock gains `apart` on this one.
    pub fn corrected(
        &mut self,
        period: Span,
        unsure: Span,
        apart: f64,
        begun: impl Fn(u32) -> Begun,
    ) -> Span {
        let (Some(before), Some(_)) = (self.delay, self.done) else { return Span::ZERO };
        let late = |round: &Round| before + round.ahead_of(begun(round.begun().cycle), apart);
        let later = round::later(&mut self.room.kept, self.one, period, late);
        let delay = later.map_or(before, |later| self.one + later);
        if (delay - before).abs() <= unsure / 2 {
            return Span::ZERO;
        }
        self.delay = Some(delay);
        delay - before
    }

    /// By how much the delay is shorter where syncs come earlier by `by`. `None` if that is not why they do: a sync is on its way for no
    /// less time than a frame for one station, and `by` is more, or there is no delay yet.
    pub fn quicker(&self, by: Span) -> Option<Span> {
        let at_most = self.delay? - self.one;
        let shorter = by.min(at_most);
        (shorter > Span::ZERO && by <= at_most + QUICKER_WITHIN).then_some(shorter)
    }

    /// Shortens the delay, and returns it. Rounds that are being measured say nothing of the syncs since.
    pub fn shorten(&mut self, by: Span) -> Span {
        self.line = self.line.wrapping_add(1);
        let delay = self.delay.unwrap_or(Span::ZERO) - by;
        self.delay = Some(delay);
        delay
    }

    /// The cycle of its last round, once done, as long as its rounds are of the line that is followed.
    pub fn done(&self) -> Option<u32> {
        self.done
    }

    /// The rounds that are done say nothing of the line any more.
    pub fn outdate(&mut self) {
        self.done = None;
    }

    /// Another line, or another master: the rounds so far say nothing of it, but how long their frames took. A reply that
    /// is still to come is of the old one. A delay that is known stays.
    pub fn leave_line(&mut self) {
        self.outdate();
        self.line = self.line.wrapping_add(1);
        (self.outstanding, self.attempts) = (None, 0);
    }

    /// Another master, whose delay is to be its own: of what is under way nothing stays.
    pub fn leave_master(&mut self) {
        self.leave_line();
        self.start_over();
    }
}

#[cfg(test)]
mod transitions;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tdma::SlaveConfig;
    use crate::tdma::line::Drift;
    use rtnet::time::{GlobalTime, Offset};

    /// Its Synchronisations tell nothing of the clock of these rounds.
    const LINE: TimeLine = TimeLine {
        cycle: 0,
        start: Instant::from_nanos(0),
        sched: GlobalTime::from_nanos(0),
        period: Span::from_millis(1),
        offset: Offset::between(Instant::from_nanos(0), GlobalTime::from_nanos(1 << 50)),
        drift: Drift::NONE,
    };

    /// A round whose reply comes after `delay` twice and the master's own 100 ns.
    fn round(of: &mut Calibration, at: u64, delay: u64) -> Result<Option<Span>, Refusal> {
        assert!(of.begin_round());
        of.sent(Instant::from_nanos(at));
        of.reply(at, 5_000, 5_100, Instant::from_nanos(at + 100 + 2 * delay), &LINE, Span::ZERO)
    }

    /// The delay of five rounds, of which one was delayed.
    fn measured(servo: Servo, delay_of: DelayOf) -> Option<i64> {
        let mut calibration = Calibration::new(5, servo, delay_of);
        for (i, delay) in [700, 710, 400_000, 690].into_iter().enumerate() {
            assert_eq!(round(&mut calibration, 1_000 * i as u64, delay), Ok(None));
        }
        let last = round(&mut calibration, 9_000, 705);
        assert_eq!(last, Ok(calibration.delay()));
        calibration.delay().map(Span::nanos)
    }

    #[test]
    fn one_held_up_stamp_does_not_move_the_delay() {
        assert_eq!(measured(Servo::Linear, DelayOf::Quartile), Some(700));
    }

    #[test]
    fn the_delay_is_what_is_asked_for_of_all_rounds_with_a_filter_and_without() {
        let mean = (700 + 710 + 400_000 + 690 + 705) / 5;
        for servo in [Servo::Linear, Servo::None] {
            for (delay_of, delay) in [(DelayOf::Quartile, 700), (DelayOf::Median, 705), (DelayOf::Mean, mean)]
            {
                assert_eq!(measured(servo, delay_of), Some(delay), "{servo:?} {delay_of:?}");
            }
        }
    }

    #[test]
    fn without_a_filter_the_delay_is_the_mean_of_all_rounds() {
        let config = SlaveConfig { servo: Servo::None, ..SlaveConfig::default() };
        assert_eq!(measured(config.servo, config.delay_of()), Some((700 + 710 + 400_000 + 690 + 705) / 5));
        assert_eq!(SlaveConfig::default().delay_of(), DelayOf::Quartile);
    }

    #[test]
    fn a_lost_reply_is_repeated_and_counted() {
        let mut calibration = Calibration::new(1, Servo::Linear, DelayOf::Quartile);
        assert!(calibration.begin_round());
        calibration.sent(Instant::from_nanos(10));
        assert!(calibration.begin_round(), "the reply never came");
        calibration.sent(Instant::from_nanos(20));
        let rx = Instant::from_nanos(40);
        assert_eq!(
            calibration.reply(10, 0, 0, rx, &LINE, Span::ZERO),
            Err(Refusal::UnexpectedReply),
            "of the lost round"
        );
        assert_eq!(calibration.reply(20, 0, 0, rx, &LINE, Span::ZERO), Ok(Some(Span::from_nanos(10))));
        assert_eq!(calibration.repeats(), 1);
        assert_eq!(
            calibration.reply(20, 0, 0, rx, &LINE, Span::ZERO),
            Err(Refusal::UnexpectedReply),
            "twice"
        );
    }

    #[test]
    fn a_round_that_began_on_a_line_that_was_left_is_no_sample_of_the_next() {
        let mut calibration = Calibration::new(1, Servo::Linear, DelayOf::Quartile);
        assert!(calibration.begin_round());
        calibration.sent(Instant::from_nanos(10));
        calibration.leave_line();
        let late = calibration.reply(10, 0, 0, Instant::from_nanos(40), &LINE, Span::ZERO);
        assert_eq!((late, calibration.delay()), (Err(Refusal::UnexpectedReply), None));
    }

    #[test]
    fn a_master_that_never_answers_ends_the_attempt() {
        let mut calibration = Calibration::new(2, Servo::Linear, DelayOf::Quartile);
        let attempts = (0..).take_while(|_| calibration.begin_round()).count();
        assert_eq!(attempts, 26);
        assert!(calibration.begin_round(), "and it starts over");
    }

    #[test]
    fn lying_stamps_are_refused() {
        let mut calibration = Calibration::new(1, Servo::Linear, DelayOf::Quartile);
        assert_eq!(round(&mut calibration, 0, 2_000_000), Err(Refusal::ImplausibleReply));
        assert!(calibration.begin_round());
        calibration.sent(Instant::from_nanos(7));
        let lie = calibration.reply(7, u64::MAX / 2, 3, Instant::from_nanos(9), &LINE, Span::ZERO);
        assert_eq!(lie, Err(Refusal::ImplausibleReply));
        assert_eq!(calibration.delay(), None);
    }

    #[test]
    fn no_rounds_are_done_at_once() {
        assert_eq!(Calibration::new(0, Servo::Linear, DelayOf::Quartile).delay(), Some(Span::ZERO));
    }
}
