//! How things happen to a master.

use super::*;
use crate::tdma::tests::as_station::{as_station, become_it, hear_at};
use crate::tdma::{NewRole, Role, RoleConfig, Tdma};
use crate::wire::Message;

impl Seat {
    pub(super) fn meet(&mut self, happening: Happening) -> Answer {
        match happening {
            Happening::PrimarysSync => Answer::Follows(self.bench.hear(LOWER, self.next, PROMPT)),
            Happening::BackupsSync => Answer::Follows(self.bench.hear(LOWER, self.next, LATE)),
            Happening::HighersSync => Answer::Follows(self.bench.hear(HIGHER, self.next, PROMPT)),
            Happening::SyncBeside => self.hear_beside(1),
            Happening::TwoBeside => self.hear_beside(2),
            Happening::OwnInTime => self.own(Some(true)),
            Happening::OwnHeldUp => self.own(Some(false)),
            Happening::OwnMissed => self.own(None),
            Happening::Request => self.request(),
            Happening::Reply => self.reply(),
            Happening::Turn => self.turn(0, 300, true),
            Happening::TurnWithoutSlots => self.turn(0, 300, false),
            Happening::TwoMissing => self.turn(2, 300, true),
            Happening::LongSilence => self.turn(99, 300, true),
            Happening::AThousandMissing => {
                self.turn(2, 300, true);
                self.turn(1_100, 300, true)
            }
            Happening::Detach => self.become_it(NewRole::detached()),
            Happening::BecomeSlave => {
                let follow = SlaveConfig { rounds: 0, ..SlaveConfig::default() };
                self.become_it(NewRole::attached(RoleConfig::Slave(follow)).unwrap())
            }
            Happening::BecomeAnew => {
                let Bench { master, .. } = Bench::new(self.bench.master.config.backup);
                let config = master.config;
                let answer = self.become_it(NewRole::attached(RoleConfig::Master(config)).unwrap());
                assert_eq!(self.bench.master.next_sync(), None, "nothing stays of what it was");
                answer
            }
        }
    }

    /// So many in a row of a primary's whose cycles begin 0.3 ms later, and have other numbers; whether it is followed.
    fn hear_beside(&mut self, syncs: u32) -> Answer {
        let next = self.next;
        let (follows, own) = self.as_station(|station| {
            let mut follows = false;
            for cycle in next..next + syncs {
                let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000 + 300_000);
                let rx = at(u64::from(cycle) * 1_000 + 300) + PROMPT;
                let sync = Message::Sync { cycle: cycle.wrapping_sub(5_000), xmit: sched + PROMPT, sched };
                let heard = hear_at(station, rx, LOWER, sync);
                assert!(matches!(heard, Ok(()) | Err(Refusal::ForeignSync)), "{heard:?}");
                follows = heard.is_ok();
            }
            let Role::Master(master) = &station.role else { unreachable!("no command came") };
            (follows, master.next_sync().map(|(_, at, _)| at))
        });
        let last = at(u64::from(self.next + syncs - 1) * 1_000);
        Answer::Beside(follows, own.map(|own| (own - last).nanos().div_euclid(1_000_000)))
    }

    /// By a command to the station. It has promised a reply if it can.
    fn become_it(&mut self, role: NewRole) -> Answer {
        let now = self.last_sync() + Span::from_micros(300);
        let has_promised = self.request() == Answer::Promises;
        self.as_station(|station| {
            let (became, before) = become_it(station, now, role);
            let given_up = station.counters.replies_given_up;
            assert_eq!(given_up, u64::from(has_promised), "what it had promised is told of");
            let Role::Master(before) = before else { unreachable!("it was a master") };
            assert_eq!(before.replies().next(), None);
            if matches!(station.role, Role::Slave(_) | Role::Detached) {
                station.role = Role::Master(before);
            }
            Answer::Becomes(became)
        })
    }

    fn as_station<T>(&mut self, act: impl FnOnce(&mut Tdma) -> T) -> T {
        let Bench { master, events } = &mut self.bench;
        let other = Master::new(master.config);
        let mut role = Role::Master(core::mem::replace(master, other));
        let done = as_station(OWN, &mut role, events, act);
        let Role::Master(this) = role else { unreachable!("it is put back") };
        *master = this;
        done
    }

    /// Its own Synchronisation, in time or held up if it leaves at all.
    fn own(&mut self, left: Option<bool>) -> Answer {
        let Bench { master, events } = &mut self.bench;
        let Some((cycle, ..)) = master.next_sync() else { return Answer::Nothing };
        master.advance();
        if let Some(in_time) = left {
            master.sent(cycle, in_time, events);
        }
        Answer::Speaks
    }

    /// For a reply in the next cycle but one, as it numbers them.
    fn request(&mut self) -> Answer {
        let (now, master) = (self.last_sync(), &mut self.bench.master);
        let cycle = master.line().map_or(self.next, |line| line.cycle).wrapping_add(3);
        match master.on_request(now, HIGHER, 0, cycle, 400_000) {
            Ok(()) => Answer::Promises,
            Err(reason) => Answer::Refused(reason),
        }
    }

    /// To a request that has just left, by who follows.
    fn reply(&mut self) -> Answer {
        let sent = self.last_sync() + Span::from_micros(400);
        let Bench { master, events } = &mut self.bench;
        let Some(follower) = master.follower_mut() else { return Answer::Nothing };
        follower.calibration_mut().begin_round();
        follower.calibration_mut().sent(sent);
        match follower.on_reply(sent + Span::from_micros(2), sent.nanos(), 0, 0, events) {
            Ok(done) => {
                assert!(done, "it was the only round");
                Answer::Calibrated
            }
            Err(reason) => Answer::Refused(reason),
        }
    }

    /// So long after the last Synchronisation.
    fn turn(&mut self, cycles: u64, micros: u64, has_slots: bool) -> Answer {
        let now = self.last_sync() + Span::from_micros((cycles * 1_000 + micros) as i64);
        let Bench { master, events } = &mut self.bench;
        if master.on_timeout(now, has_slots, true, events) { Answer::Aligns } else { Answer::Nothing }
    }

    fn last_sync(&self) -> Instant {
        at(u64::from(self.next - 1) * 1_000)
    }
}
