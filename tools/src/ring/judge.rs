//! What is made of a ring's frames. Pure: it is given frames and when they were on the medium, what happened to the stations,
//! and what they told.

mod seat;

use std::collections::BTreeMap;

use rtmac::token::RingConfig;
use rtmac::token::bound::{doubling_bound, recovery_bound, rotation_bound};
use rtmac::token::wire::{Kind, TOKEN, Token};
use rtnet::clock::{EmulatedClock, True};
use rtnet::discipline::EventKind;
use rtnet::time::Span;
use rtnet::wire::ethernet::{Address, HEADER_LEN, Header};

use super::recovery::{Recovery, Window};
use crate::judge::delivery::Passed;
use crate::scenario::Scenario;
use crate::station::traffic::Tag;
pub use seat::Seat;

/// Overlaps and recoveries that are kept one by one; what is beyond is unexplained.
const KEPT_MAX: usize = 100_000;

/// What became of tokens, as the medium showed it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tokens {
    /// Passed on.
    pub passed: u64,
    /// Sent to a station that was absent.
    pub invitations: u64,
    /// Sent once more.
    pub repeated: u64,
    /// Sent to the one behind, since the next showed no sign of it.
    pub skipped: u64,
    /// Claimed, since there was none.
    pub claimed: u64,
    /// Void, since another one stays.
    pub void: u64,
}

/// All that is seen of a ring.
pub struct Judge {
    config: RingConfig,
    seats: Vec<Seat>,
    tokens: Tokens,
    last: Option<Last>,
    /// Until when the medium is, and by whom.
    busy: Option<(True, Address)>,
    /// What is wrong just now.
    open: Option<Recovery>,
    /// How many times something has been.
    opened: u64,
    recoveries: Vec<Recovery>,
    overlaps: Vec<True>,
    overlaps_in_all: u64,
    windows: Vec<Window>,
    /// The longest round in which nothing was wrong.
    undisturbed: Option<Span>,
    /// Somebody was absent.
    was_absent: bool,
    dropped: u64,
    counting: bool,
    /// What counts, where frames come later than they were on the medium.
    within: Option<(True, True)>,
}

/// The token that stays of all that were on the medium.
#[derive(Clone, Copy)]
struct Last {
    at: True,
    token: Token,
    /// It is for one that was absent.
    invites: bool,
}

/// What comes of it all.
pub struct Judged {
    /// By station.
    pub seats: Vec<Seat>,
    /// Of all.
    pub tokens: Tokens,
    /// What was lost, and found again.
    pub recoveries: Vec<Recovery>,
    /// The last of them had not been found when the run ended.
    pub is_lost: bool,
    /// Times at which two frames were on the air at once.
    pub overlaps: u64,
    /// Of overlaps and recoveries: those without a known cause.
    pub unexplained: u64,
    /// How many recoveries had which.
    pub causes: BTreeMap<String, u64>,
    /// The longest round in which nothing was wrong, and how long it may be.
    pub undisturbed: Option<(Span, Span)>,
}

impl Judge {
    /// Of a ring whose stations have these clocks; nothing counts before [`Judge::begin`].
    pub fn new(config: RingConfig, scenario: &Scenario, clocks: &[EmulatedClock]) -> Self {
        let seat = |(clock, id): (&EmulatedClock, usize)| Seat::new(*clock, scenario.streams(id));
        let seats = clocks.iter().zip(0..).map(seat).collect();
        Self {
            config,
            seats,
            tokens: Tokens::default(),
            last: None,
            busy: None,
            open: None,
            opened: 0,
            recoveries: Vec::new(),
            overlaps: Vec::new(),
            overlaps_in_all: 0,
            windows: Vec::new(),
            undisturbed: None,
            was_absent: false,
            dropped: 0,
            counting: false,
            within: None,
        }
    }

    /// From here on all counts.
    pub fn begin(&mut self) {
        self.counting = true;
        self.open = None;
    }

    /// Only what is on the medium from then on counts, and before the other moment.
    pub fn count_within(&mut self, from: True, until: True) {
        self.within = Some((from, until));
    }

    /// Whether the token goes round all stations, as it says itself.
    pub fn all_present(&self) -> bool {
        self.last.is_some_and(|last| last.token.present.count_ones() == u32::from(last.token.size))
    }

    /// In this time the wire is out of who hears a station's frames.
    pub fn is_unheard(&mut self, sender: usize, from: True, until: True) {
        if let Some(seat) = self.seats.get_mut(sender) {
            seat.in_vain = (from, until);
        }
    }

    /// Up to here.
    pub fn end(&mut self) {
        self.counting = false;
    }

    /// A station's frames seen so far.
    pub fn passed(&self, station: usize, of: Option<u8>) -> Option<&Passed> {
        self.seats.get(station)?.passed.get(&of)
    }

    /// A number that none of a station's frames has come to.
    pub fn beyond(&self, station: usize) -> u64 {
        let all = self.seats.get(station).map(|seat| seat.passed.values().map(Passed::beyond).max());
        all.flatten().unwrap_or(0)
    }

    /// A station has another clock.
    pub fn set_clock(&mut self, station: usize, clock: EmulatedClock) {
        if let Some(seat) = self.seats.get_mut(station) {
            seat.clock = clock;
        }
    }

    /// A new process is in the place of a station's, and what was before is none of its.
    pub fn begins_anew(&mut self, station: usize) {
        if let Some(seat) = self.seats.get_mut(station) {
            seat.begins_anew(self.counting);
        }
    }

    /// Something happens to the network, and is over at `until`; what it does to the token shows for a while longer.
    pub fn happens(&mut self, from: True, until: True) {
        let shows = recovery_bound(&self.config, self.seats.len(), 0)
            + doubling_bound(&self.config, 0)
            + rotation_bound(&self.config, self.seats.len(), 1) * 2;
        let until = until.saturating_add(shows.nanos() as u64);
        match self.windows.last_mut() {
            Some(last) if last.from <= from && from <= last.until => last.until = last.until.max(until),
            _ => self.windows.push(Window { from, until }),
        }
    }

    /// A station tells of something.
    pub fn told(&mut self, station: usize, kind: EventKind) {
        use EventKind::*;
        let counting = self.counting || self.within.is_some();
        let Some(seat) = self.seats.get_mut(station).filter(|_| counting) else { return };
        *seat.told.entry(kind.name()).or_default() += 1;
        match kind {
            TokenOverdue | Overrun | StalledInSend | GuardDropped | SendFailed => seat.late += 1,
            // It was late, too, if the others had taken it to be absent by then.
            TokenGivenUp => seat.given_up += 1,
            _ => {}
        }
    }

    /// A frame begins on the medium.
    pub fn frame(&mut self, at: True, bytes: &[u8]) {
        if let Some((from, until)) = self.within {
            let counts = (from..until).contains(&at);
            if counts && !self.counting {
                self.open = None;
            }
            self.counting = counts;
        }
        let Some((header, _)) = Header::parse(bytes) else { return };
        let (source, air) = (header.source, self.config.rate.air_time(bytes.len()));
        self.occupy(at, air, source);
        let from = self.config.stations.iter().position(|&station| station == source);
        if header.ether_type() == TOKEN {
            match Token::parse(bytes) {
                Ok(token) if token.digest == self.config.digest() && Some(token.from.into()) == from => {
                    self.token(at, token);
                }
                _ => {}
            }
        } else if let (Some(from), Some((tag, _))) = (from, Tag::read(bytes)) {
            if tag.station() == from {
                let octets = bytes.len() - HEADER_LEN;
                self.seats[from].frame(at, air, (tag, octets), self.counting);
            }
            self.recovered(at, from);
        }
    }

    fn occupy(&mut self, at: True, air: Span, source: Address) {
        let until = at.saturating_add(air.nanos() as u64);
        if let Some((busy, by)) = self.busy
            && at < busy
            && by != source
            && self.counting
        {
            self.overlaps_in_all += 1;
            if self.overlaps.len() < KEPT_MAX {
                self.overlaps.push(at);
            }
        }
        if self.busy.is_none_or(|(busy, _)| until > busy) {
            self.busy = Some((until, source));
        }
    }

    fn token(&mut self, at: True, token: Token) {
        let counts = self.counting;
        let Some(last) = self.last else {
            self.last = Some(Last { at, token, invites: false });
            return;
        };
        let (mark, before) = (token.mark(), last.token.mark());
        let is_here = |token: &Token| token.present >> token.to & 1 == 1;
        let was_here = last.token.present >> token.to & 1 == 1;
        if mark.repeats(&before) {
            count(&mut self.tokens.repeated, counts);
            self.lost(last.at, (token.from == last.token.from).then_some(token.to));
            return;
        }
        if !mark.outlasts(&before) {
            count(&mut self.tokens.void, counts);
            return self.lost(at, None);
        }
        let invites = token.kind == Kind::Pass && is_here(&token) && !was_here;
        if token.kind == Kind::Claim {
            count(&mut self.tokens.claimed, counts);
            self.lost(last.at, Some(last.token.to));
        } else if token.from == last.token.from && token.from != last.token.to {
            self.seats[usize::from(last.token.to)].is_absent(counts);
            // Who was invited in vain costs only that.
            if !last.invites {
                count(&mut self.tokens.skipped, counts);
                self.lost(last.at, Some(last.token.to));
            }
        } else {
            count(&mut self.tokens.passed, counts);
            self.recovered(at, token.from.into());
        }
        if invites {
            count(&mut self.tokens.invitations, counts);
        }
        self.was_absent |= counts && token.present.count_ones() < u32::from(token.size);
        self.last = Some(Last { at, token, invites });
        // Whether one that is invited is there shows by its next one.
        if token.kind == Kind::Pass && !invites {
            self.came(at, token.to.into());
        }
    }

    /// The token goes to a station.
    fn came(&mut self, at: True, to: usize) {
        let before = self.seats[to].came.replace((at, self.opened));
        if !self.counting {
            return;
        }
        self.seats[to].visits += 1;
        if let Some((before, opened)) = before {
            let round = Span::from_nanos((at - before) as i64);
            self.seats[to].rotation.record(round.nanos());
            if opened == self.opened && self.open.is_none() {
                self.undisturbed = self.undisturbed.max(Some(round));
            }
        }
    }

    /// The token is not where it should be, since then; it was to be with this station.
    fn lost(&mut self, since: True, victim: Option<u8>) {
        self.opened += 1;
        if !self.counting {
            return;
        }
        let open = self.open.get_or_insert_with(|| Recovery::new(since));
        open.note(victim.map(usize::from));
    }

    /// A frame of a station: all is well again if that is who has the token.
    fn recovered(&mut self, at: True, from: usize) {
        let has_it = self.last.is_some_and(|last| match last.token.kind {
            Kind::Pass => usize::from(last.token.to) == from,
            Kind::Claim => usize::from(last.token.from) == from,
        });
        if !has_it {
            return;
        }
        let Some(open) = self.open.take() else { return };
        if self.recoveries.len() == KEPT_MAX {
            self.dropped += 1;
            return;
        }
        self.recoveries.push(open.over(at));
    }

    /// All has been seen and told.
    pub fn finish(mut self, now: True) -> Judged {
        let lost = self.open.take().map(|open| open.over(now));
        let is_lost = lost.is_some();
        self.recoveries.extend(lost);
        let mut late: Vec<u64> = self.seats.iter().map(|seat| seat.late + seat.given_up).collect();
        let (mut causes, mut unexplained) = (BTreeMap::<String, u64>::new(), self.dropped);
        let shows = doubling_bound(&self.config, 0) + recovery_bound(&self.config, 1, 0);
        let mut behind = None::<True>;
        for recovery in &mut self.recoveries {
            let is_known = self.windows.iter().any(|window| window.meets(recovery));
            let cause = if is_known {
                "event"
            } else if recovery.was_told(&mut late) {
                "late_host"
            } else if recovery.has_no_victim() && behind.is_some_and(|until| recovery.began <= until) {
                // Of two tokens one is void, which shows after the other was claimed.
                "doubled"
            } else {
                unexplained += 1;
                "unexplained"
            };
            recovery.cause = cause;
            behind = Some(recovery.ended.saturating_add(shows.nanos() as u64));
            *causes.entry(cause.to_owned()).or_default() += 1;
        }
        let is_known = |at: True| {
            let around = |recovery: &Recovery| {
                recovery.cause != "unexplained"
                    && (recovery.began..=recovery.ended.saturating_add(shows.nanos() as u64)).contains(&at)
            };
            self.windows.iter().any(|window| (window.from..=window.until).contains(&at))
                || self.recoveries.iter().any(around)
        };
        let known = self.overlaps.iter().filter(|at| is_known(**at)).count() as u64;
        unexplained += self.overlaps_in_all - known;
        let bound = rotation_bound(&self.config, self.seats.len(), usize::from(self.was_absent));
        causes.remove("unexplained");
        Judged {
            undisturbed: self.undisturbed.map(|longest| (longest, bound + self.config.delay)),
            seats: self.seats,
            tokens: self.tokens,
            recoveries: self.recoveries,
            is_lost,
            overlaps: self.overlaps_in_all,
            unexplained,
            causes,
        }
    }
}

fn count(count: &mut u64, counts: bool) {
    *count += u64::from(counts);
}

#[cfg(test)]
mod tests;
