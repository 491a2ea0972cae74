//! How a calibration gets to its places.

use super::*;

impl Place {
    pub(super) fn take(self, config: Config) -> Seat {
        let mut seat = Seat::new(config.of(if self == Place::WithoutRounds { 0 } else { ROUNDS }));
        if self != Place::NoLine {
            seat.hear_sync(MASTER, 0);
            seat.hear_sync(MASTER, 0);
        }
        match self {
            Place::NoLine | Place::Idle => {}
            Place::WithoutRounds => seat.pass_turn(),
            Place::Done => seat.calibrate(),
            Place::Anew | Place::AnewOutstanding | Place::AnewLastOutstanding | Place::AnewExhausted => {
                seat.calibrate();
                seat.command();
            }
            Place::Outstanding | Place::LastOutstanding | Place::Exhausted => {}
        }
        match self {
            Place::NoLine | Place::Idle | Place::Done | Place::WithoutRounds | Place::Anew => {}
            Place::Outstanding | Place::AnewOutstanding => {
                seat.ask(Happening::Sent);
            }
            Place::LastOutstanding | Place::AnewLastOutstanding => {
                seat.ask(Happening::Sent);
                seat.reply(0, 0);
                seat.ask(Happening::Sent);
            }
            Place::Exhausted | Place::AnewExhausted => {
                for _ in 0..ATTEMPTS {
                    seat.ask(Happening::Sent);
                }
            }
        }
        while seat.slave.next_event().is_some() {}
        seat
    }

    /// What there is to be seen of it before anything happens.
    pub(super) fn seen(self) -> (State, (usize, u32, u64)) {
        match self {
            Place::NoLine | Place::Idle => (State::Idle, (0, 0, 0)),
            Place::Outstanding => (State::Outstanding, (0, 1, 0)),
            Place::LastOutstanding => (State::Outstanding, (1, 2, 0)),
            Place::Exhausted => (State::Outstanding, (0, ATTEMPTS, u64::from(ATTEMPTS) - 1)),
            Place::Done | Place::WithoutRounds => (State::Done, (0, 0, 0)),
            Place::Anew => (State::AnewIdle, Place::Idle.seen().1),
            Place::AnewOutstanding => (State::AnewOutstanding, Place::Outstanding.seen().1),
            Place::AnewLastOutstanding => (State::AnewOutstanding, Place::LastOutstanding.seen().1),
            Place::AnewExhausted => (State::AnewOutstanding, Place::Exhausted.seen().1),
        }
    }
}

impl Config {
    fn of(self, rounds: u32) -> SlaveConfig {
        let Self { servo, on_master_change } = self;
        SlaveConfig { rounds, servo, on_master_change, ..SlaveConfig::default() }
    }
}
