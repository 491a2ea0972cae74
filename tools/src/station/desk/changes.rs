//! Changes of slots and roles: what is asked for is completed, judged, handed to the real-time thread, and waited for.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rtmac::tdma::schedule::Rate;
use rtmac::tdma::{
    DEFAULT_ROUNDS, MasterConfig, NewRole, NewRounds, RoleConfig, RoleName, SlaveConfig, TdmaCommand,
};
use rtnet::live::Errand;
use rtnet::live::clock::realtime;
use rtnet::time::{GlobalTime, Offset, Span};

use super::Desk;
use crate::control::{Reply, RoleRequest, SlotChange};
use crate::scenario::{
    DEFAULT_RATE, DelayName, DelayPolicy, ServoName, default_sync_window, room_for_replies,
};
use crate::station::{OwnSlots, sync_latest};

/// A command is carried out after the next slot; a station that hears nothing looks ten times a second. Less than a lab
/// waits for its station.
pub(in crate::station) const ANSWER_WITHIN: Duration = Duration::from_millis(400);
/// How often to look for the answer: a cycle of the shortest that are in use.
pub(in crate::station) const LOOK_EVERY: Duration = Duration::from_micros(200);

impl Desk {
    /// What is not given of a slot stays as it is to be after every change that was asked for; a lab gives all.
    pub(super) fn set_slot(&mut self, change: &SlotChange) -> Reply {
        let before = self.own_slots.as_ref().and_then(|own| own.get(change.id)).map(|&slot| slot.into());
        let slot = change.over(before.as_ref()).config(self.latest);
        self.change(TdmaCommand::set_slot(slot), |own, heard| {
            let own = own.with(slot)?;
            own.check_slot(slot.id, heard).map(|()| own)
        })
    }

    pub(super) fn take_role(&mut self, role: RoleRequest, new: NewRole) -> Reply {
        let given = match role {
            RoleRequest::Master { cycle_ns } => Some(Span::from_nanos(cycle_ns)),
            RoleRequest::Slave { .. } | RoleRequest::Detached => None,
        };
        let given = given.map(|cycle| (cycle, self.sync_window(cycle)));
        self.change(TdmaCommand::Become(new), |own, _| {
            let own = own.giving(given);
            own.check().map(|()| own)
        })
    }

    /// What it keeps free for its Synchronisations as a master.
    fn sync_window(&self, cycle: Span) -> Span {
        default_sync_window(cycle, self.rate())
    }

    /// Who has no slots of its own to judge knows no rate.
    fn rate(&self) -> Rate {
        self.own_slots.as_ref().map_or(DEFAULT_RATE, OwnSlots::rate)
    }

    /// In as many rounds as the first time, unless it is said in how many.
    pub(super) fn calibrate(&mut self, rounds: Option<u32>) -> Reply {
        self.look();
        let tdma = self.newest.as_ref().and_then(|newest| newest.status.tdma());
        let configured = tdma.map(|tdma| tdma.rounds).filter(|&rounds| rounds > 0);
        match NewRounds::of(rounds.or(configured).unwrap_or(DEFAULT_ROUNDS)) {
            Ok(rounds) => self.change(TdmaCommand::Calibrate(rounds), |own, _| Ok(own.clone())),
            Err(refused) => Reply::Refused(refused.to_string()),
        }
    }

    /// Asks for a change that goes with the station's own slots: `to_be` says what becomes of them, by the cycle
    /// that was heard of a master, or why not.
    pub(super) fn change(
        &mut self,
        command: TdmaCommand,
        to_be: impl FnOnce(&OwnSlots, Option<Span>) -> Result<OwnSlots, String>,
    ) -> Reply {
        self.look();
        let newest = self.newest.as_ref().and_then(|newest| newest.status.tdma());
        let slave = newest.filter(|status| status.role == RoleName::Slave);
        let heard = slave.and_then(|slave| slave.period);
        match self.own_slots.as_ref().map(|own| to_be(own, heard)).transpose() {
            Ok(to_be) => self.command(command, to_be),
            Err(why) => Reply::Refused(why),
        }
    }

    /// Hands a command to the real-time thread, and waits for what becomes of it: what is refused will not happen later.
    fn command(&mut self, command: TdmaCommand, to_be: Option<OwnSlots>) -> Reply {
        if self.errands.send(command).is_err() {
            return Reply::Refused("the command before this one is not carried out yet: ask again".into());
        }
        match self.answered() {
            Ok(from) => {
                self.own_slots = to_be;
                Reply::Applied(from)
            }
            Err(why) => Reply::Refused(why),
        }
    }

    /// From which cycle on the command under way holds, or why it never will.
    fn answered(&self) -> Result<u32, String> {
        let deadline = Instant::now() + ANSWER_WITHIN;
        loop {
            std::thread::sleep(LOOK_EVERY);
            if let Some(Errand { result, .. }) = self.errands.take() {
                return result.unwrap_or(Ok(0)).map_err(|refused| refused.to_string());
            }
            // What cannot be taken back was begun with, and is answered as soon as that thread runs.
            if Instant::now() >= deadline && self.errands.take_back().is_some() {
                let within = ANSWER_WITHIN.as_millis();
                return Err(format!(
                    "nothing is changed: the real-time thread has not looked at it within {within}ms; ask again"
                ));
            }
            if Arc::strong_count(&self.errands) == 1 {
                return Err("its real-time thread has ended".into());
            }
        }
    }

    pub(super) fn role(&mut self, role: RoleRequest) -> Result<NewRole, rtmac::tdma::Refused> {
        match role {
            RoleRequest::Detached => Ok(NewRole::detached()),
            RoleRequest::Slave { rounds, servo, delay, holdover, on_master_change } => {
                let before = self.follow;
                NewRole::attached(RoleConfig::Slave(SlaveConfig {
                    rounds,
                    servo: servo.map_or(before.servo, ServoName::servo),
                    delay_of: delay.map(DelayName::delay_of).or(before.delay_of),
                    holdover: holdover.unwrap_or(before.holdover),
                    on_master_change: on_master_change
                        .map_or(before.on_master_change, DelayPolicy::on_master_change),
                    ..before
                }))
            }
            RoleRequest::Master { cycle_ns } => {
                let cycle = Span::from_nanos(cycle_ns);
                let window = self.sync_window(cycle);
                NewRole::attached(RoleConfig::Master(MasterConfig {
                    cycle,
                    sync_latest: sync_latest(window),
                    reply_latest: self.latest,
                    epoch: self.epoch(),
                    resume: None,
                    backup: None,
                    backups_from: None,
                    max_requests: self.max_requests,
                    behind_sync: room_for_replies(window, self.rate()),
                    follow: SlaveConfig { rounds: DEFAULT_ROUNDS, ..self.follow },
                }))
            }
        }
    }

    /// Global time goes on where this station knows it; else the wall clock's begins.
    fn epoch(&mut self) -> Offset {
        self.look();
        let newest = self.newest.as_ref().and_then(|newest| newest.status.tdma());
        let known = newest.and_then(|status| status.offset);
        known.unwrap_or_else(|| Offset::between(self.time.now(), GlobalTime::from_nanos(realtime())))
    }
}
