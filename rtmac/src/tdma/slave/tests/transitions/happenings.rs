//! How things happen to a slave.

use super::*;
use crate::tdma::tests::as_station::{as_station, become_it};
use crate::tdma::tests::{OWN, master_config};
use crate::tdma::{MasterConfig, NewRole, Role, RoleConfig};

impl Seat {
    /// Lets it happen; what comes of it, and the cycle that it is then.
    pub(super) fn meet(&mut self, happening: Happening) -> (Answer, u32) {
        let (heard, next) = (self.heard, self.next);
        let of_sync = |result: Result<Followed, Refusal>| result.map_or_else(Answer::Refused, Answer::Sync);
        let synced = |answer| (answer, next);
        match happening {
            Happening::NextSync => synced(of_sync(self.bench.hear(next, 0))),
            Happening::AnothersSync => synced(of_sync(self.hear_backup(next, 0))),
            Happening::HeldUpSync => synced(of_sync(self.bench.hear(next, HELD_UP))),
            Happening::JumpedSync => synced(of_sync(self.bench.hear(next, JUMPED))),
            Happening::RenumberedSync => {
                let start = u64::from(next) * PERIOD;
                synced(of_sync(self.bench.hear_from_line(next + 5_000, start, 0)))
            }
            Happening::RepeatedSync => synced(of_sync(self.bench.hear(heard, 900))),
            Happening::BackupsRepeat => synced(of_sync(self.hear_backup(heard, 200_000))),
            Happening::ImplausibleSync => synced(of_sync(self.hear_hour_off(next))),
            Happening::Reply => (self.reply(0, 0), next - 1),
            Happening::ForeignReply => (self.reply(1, 0), next - 1),
            Happening::ImplausibleReply => (self.reply(0, u64::MAX / 4), next - 1),
            Happening::HalfACycle => self.wait(0),
            Happening::OneCycleMore => self.wait(1),
            Happening::TwoCyclesMore => self.wait(2),
            Happening::AThousandCyclesMore => self.wait(1_000),
            Happening::Forget => {
                self.bench.slave.forget();
                (Answer::Nothing, next - 1)
            }
            Happening::Resume => {
                let line = *Bench::in_state(SyncState::Locked).slave.line().unwrap();
                self.bench.slave.resume(TimeLine { cycle: next - 1, ..line });
                (Answer::Nothing, next - 1)
            }
            Happening::Detach => (self.become_it([NewRole::detached()]), next - 1),
            Happening::DetachAndAttach => {
                let follow = SlaveConfig { rounds: 0, ..*self.bench.slave.config() };
                let attached = NewRole::attached(RoleConfig::Slave(follow)).unwrap();
                (self.become_it([NewRole::detached(), attached]), next - 1)
            }
            Happening::BecomePrimary => (self.become_master(None), next - 1),
            Happening::BecomeBackup => (self.become_master(Some(Span::from_micros(200))), next - 1),
        }
    }

    fn become_master(&mut self, backup: Option<Span>) -> Answer {
        let role = RoleConfig::Master(MasterConfig { backup, ..master_config() });
        self.become_it([NewRole::attached(role).unwrap()])
    }

    /// By commands to the station, one after the other.
    fn become_it<const N: usize>(&mut self, roles: [NewRole; N]) -> Answer {
        let now = Instant::from_nanos(u64::from(self.next - 1) * PERIOD + PERIOD / 2);
        let Bench { slave, events } = &mut self.bench;
        let other = Slave::new(*slave.config());
        let mut role = Role::Slave(core::mem::replace(slave, other));
        let (became, before) = as_station(OWN, &mut role, events, |station| {
            let mut became = roles.into_iter().map(|role| become_it(station, now, role));
            let (first, before) = became.next().expect("a command");
            (became.last().map_or(first, |(last, _)| last), before)
        });
        // What it is now, if that follows; else what it was, which whoever asked has back.
        match (role, before) {
            (Role::Slave(this), _) | (_, Role::Slave(this)) => *slave = this,
            _ => unreachable!("it was a slave"),
        }
        Answer::Becomes(became)
    }

    /// From a backup on the same line, so much later than its cycle's start.
    fn hear_backup(&mut self, cycle: u32, late: i64) -> Result<Followed, Refusal> {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * PERIOD + AHEAD);
        let late = Span::from_nanos(late);
        let rx = Instant::from_nanos(u64::from(cycle) * PERIOD) + late;
        self.bench.slave.on_sync(rx, BACKUP, cycle, sched + late, sched, &mut self.bench.events)
    }

    /// Scheduled for an hour later.
    fn hear_hour_off(&mut self, cycle: u32) -> Result<Followed, Refusal> {
        let (rx, xmit) = (u64::from(cycle) * PERIOD, GlobalTime::from_nanos(u64::from(cycle) * PERIOD));
        let sched = xmit + Span::from_millis(3_600_000);
        let Bench { slave, events } = &mut self.bench;
        slave.on_sync(Instant::from_nanos(rx), MASTER, cycle, xmit, sched, events)
    }

    /// A request leaves; the reply is to one that left `other` later, and says that it was received then.
    fn reply(&mut self, other: u64, received: u64) -> Answer {
        let Bench { slave, events } = &mut self.bench;
        let sent = u64::from(self.next - 1) * PERIOD + 400_000;
        slave.calibration_mut().begin_round();
        slave.calibration_mut().sent(Instant::from_nanos(sent));
        match slave.on_reply(Instant::from_nanos(sent + 1_400), sent + other, received, 0, events) {
            Ok(true) => Answer::Calibrated,
            Ok(false) => Answer::Nothing,
            Err(reason) => Answer::Refused(reason),
        }
    }

    /// Until the middle of the cycle that it is, or so many later.
    fn wait(&mut self, cycles: u32) -> (Answer, u32) {
        let cycle = self.next - 1 + cycles;
        self.bench.wait_until(u64::from(cycle) * PERIOD + PERIOD / 2);
        (Answer::Nothing, cycle)
    }
}
