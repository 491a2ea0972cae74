//! What there is to be seen of a station of a ring.

use rtnet::buf::PoolStatistics;
use rtnet::time::Span;

use super::rotation::Place;
use super::wire::Mark;

/// Everything that it counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Counters {
    /// Frames of data sent.
    pub frames_sent: u64,
    /// Times that it passed the token on.
    pub passes: u64,
    /// Times that it passed the token on to a station that was absent.
    pub invitations: u64,
    /// Tokens that it sent once more, since the next station showed no sign of it.
    pub repeats: u64,
    /// Stations that it took to be absent.
    pub skips: u64,
    /// Times that it claimed a token that was lost.
    pub claims: u64,
    /// Tokens heard for the first time.
    pub tokens_heard: u64,
    /// Tokens heard once more.
    pub repeats_heard: u64,
    /// Tokens that it gave up because another one stays.
    pub given_up: u64,
    /// Tokens that it lost because it was too late to pass them on.
    pub overdue: u64,
    /// Frames of data that came too late for a visit.
    pub overruns: u64,
    /// Frames sent although the clock read afterwards was beyond the last moment.
    pub stalled_in_send: u64,
    /// Frames that the kernel guard dropped.
    pub guard_drops: u64,
    /// Frames that the kernel refused.
    pub send_failed: u64,
    /// Events that nobody took in time.
    pub events_lost: u64,
}

impl Counters {
    /// Each with its name.
    pub fn named(&self) -> [(&'static str, u64); 15] {
        [
            ("frames_sent", self.frames_sent),
            ("passes", self.passes),
            ("invitations", self.invitations),
            ("repeats", self.repeats),
            ("skips", self.skips),
            ("claims", self.claims),
            ("tokens_heard", self.tokens_heard),
            ("repeats_heard", self.repeats_heard),
            ("given_up", self.given_up),
            ("overdue", self.overdue),
            ("overruns", self.overruns),
            ("stalled_in_send", self.stalled_in_send),
            ("guard_drops", self.guard_drops),
            ("send_failed", self.send_failed),
            ("events_lost", self.events_lost),
        ]
    }
}

/// Where the token is, as far as a station knows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TokenState {
    /// With others, or nowhere.
    Listening,
    /// It was lost, and is taken.
    Claiming,
    /// Here.
    Holding,
    /// Passed on, to one that has shown no sign of it yet.
    Passed,
}

impl TokenState {
    pub(super) fn of(place: &Place) -> Self {
        match place {
            Place::Listening => TokenState::Listening,
            Place::Claiming(_) => TokenState::Claiming,
            Place::Holding(_) => TokenState::Holding,
            Place::Passed(_) => TokenState::Passed,
        }
    }

    /// The state's name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            TokenState::Listening => "listening",
            TokenState::Claiming => "claiming",
            TokenState::Holding => "holding",
            TokenState::Passed => "passed",
        }
    }
}

/// A snapshot of a station of a ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TokenStatus {
    /// Where the token is.
    pub state: TokenState,
    /// The station's place in the ring, from 0 on.
    pub index: u8,
    /// Stations of the ring.
    pub size: u8,
    /// A bit for each that takes part, the lowest for place 0.
    pub present: u64,
    /// The token that was heard or sent last.
    pub mark: Option<Mark>,
    /// How often the token was here, modulo 2^32.
    pub visits: u32,
    /// From the last time but one that it came to the last.
    pub rotation: Option<Span>,
    /// The longest of these.
    pub longest_rotation: Option<Span>,
    /// Frames that wait now.
    pub queued: usize,
    /// How the pool of its tokens fares.
    pub pool: PoolStatistics,
    /// Everything that is counted.
    pub counters: Counters,
}
