//! Which job is next, and what becomes of those whose time passes undone.

use rtnet::discipline::EventKind;
use rtnet::time::{Instant, Span};

use super::anew::Purpose;
use super::job::Job;
use super::line::{LINE_GOOD_FOR, TimeLine};
use super::master::Master;
use super::slot::Turn;
use super::{LatePolicy, Role, Tdma};

/// Who slept for longer tells of so many cycles, or jobs: more than there is room for, and few enough to go through at once.
const TOLD_AT_MOST: i64 = 10_000;

impl Tdma {
    /// The job whose instant is first; at the same instant a Synchronisation before a reply before data.
    pub(super) fn next_job(&self) -> Option<Job> {
        let line = self.line()?;
        let turns = || match self.slots.first().filter(|_| self.calibrates()) {
            Some(first) => {
                let only = (!self.has_given_the_time()).then_some(first.id);
                self.slots.next_turn(line, only).map(|turn| match self.purpose(&turn) {
                    Purpose::Request | Purpose::Data if turn.id == first.id => Job::Request(turn),
                    _ => Job::Data(turn),
                })
            }
            None => self.slots.next_turn(line, None).map(|turn| match self.purpose(&turn) {
                Purpose::Request => Job::Request(turn),
                Purpose::Data if self.said_in(&turn).is_some() => Job::Answer(turn),
                Purpose::Data if self.owes_late_reply() => Job::ReplyInTurn(self.tolerant(turn, line)),
                Purpose::Data | Purpose::Reply => Job::Data(self.tolerant(turn, line)),
            }),
        };
        match &self.role {
            Role::Detached => None,
            Role::Slave(_) => turns(),
            Role::Master(master) => {
                let config = master.config();
                let sync = next_sync(master);
                let reply = master.replies().next().map(|reply| Job::Reply {
                    cycle: reply.cycle,
                    at: reply.at,
                    latest: reply.at + config.reply_latest,
                });
                // Replies and slots of one cycle come after its Synchronisation, which begins it.
                let behind = self.part_job().into_iter().chain(self.reply_behind_sync());
                sync.into_iter().chain(behind).chain(reply).chain(turns()).min_by_key(Job::at)
            }
        }
    }

    fn owes_late_reply(&self) -> bool {
        matches!(&self.role, Role::Master(master) if master.is_active() && master.replies().next_late().is_some())
    }

    /// The late reply that follows this station's Synchronisation, if that has left.
    fn reply_behind_sync(&self) -> Option<Job> {
        let ((cycle, at), Role::Master(master)) = (self.reply_in?, &self.role) else { return None };
        Some(Job::ReplyBehindSync { cycle, at, latest: at + master.config().behind_sync?.latest })
    }

    /// Whether its first slot is used for calibration, and no other.
    pub(super) fn calibrates(&self) -> bool {
        self.follower().is_some_and(|follower| follower.calibration().delay().is_none())
    }

    fn tolerant(&self, turn: Turn, line: &TimeLine) -> Turn {
        match self.late {
            LatePolicy::Skip => turn,
            LatePolicy::Send => Turn { latest: turn.at + line.period, ..turn },
        }
    }

    /// The next job if its time has come. Jobs that must not or can no longer be done pass on the way.
    pub(super) fn due(&mut self, now: Instant) -> Option<Job> {
        // The slave has asked again, or this station no longer gives the time.
        if self.reply_in.is_some() && !self.owes_late_reply() {
            self.reply_in = None;
        }
        for passed in 0.. {
            if passed == TOLD_AT_MOST {
                self.leave_out(now);
            }
            let job = self.next_job()?;
            if job.chosen_at(self.lead) > now {
                return None;
            }
            let calibrates = self.calibrates();
            let is_left =
                matches!(job, Job::Data(turn) if calibrates || self.purpose(&turn) == Purpose::Reply);
            // A station that slept through a slot missed it for that, whatever was heard meanwhile.
            if is_left {
                self.calibrates_in(&job);
            } else if now > job.latest() {
                self.missed(&job, now - job.latest());
            } else if !self.may_do(&job) {
                let kind = self.silent_by(&job);
                if kind == EventKind::SlotSilent {
                    self.silent = Some((job.cycle(), job.at()));
                }
                self.counters.slots_silent += 1;
                self.events.note_job(&job, kind, Span::ZERO);
            } else {
                return Some(job);
            }
            self.pass(&job, now);
            self.postpone(&job);
        }
        None
    }

    /// What else was slept through before this cycle is counted, and not told of one by one.
    fn leave_out(&mut self, now: Instant) {
        self.leave_out_a_switch(now);
        let cycle = self.cycle_at(now);
        let turns = self.slots.jump(cycle);
        if !self.calibrates() {
            self.counters.overruns += turns;
        }
        if let Role::Master(master) = &mut self.role {
            self.counters.syncs_skipped += master.jump(cycle);
        }
    }

    /// Who slept through the begin of another schedule begins it when it was: what comes after is on its cycles.
    fn leave_out_a_switch(&mut self, now: Instant) {
        let Some(from) = self.change.as_ref().and_then(|change| change.sealed_for()) else { return };
        if (self.cycle_at(now).wrapping_sub(from) as i32) < 0 {
            return;
        }
        if let Role::Master(master) = &mut self.role {
            self.counters.syncs_skipped += master.jump(from);
            self.begin_cycle(from, now);
        }
    }

    /// Whoever has, had its turns, too, which it misses while it calibrates for the first time.
    pub(super) fn has_given_the_time(&self) -> bool {
        matches!(&self.role, Role::Master(master) if master.has_spoken())
    }

    /// A turn that carries no data, since the delay is measured anew, a reply may come, or this station's own goes in it. Who
    /// calibrates for the first time has no turns yet, but for one that has given the time without.
    pub(super) fn calibrates_in(&mut self, job: &Job) {
        if self.calibrates() && !self.has_given_the_time() {
            return;
        }
        self.counters.slots_calibrating += 1;
        self.events.note_job(job, EventKind::CalibrationTurn, Span::ZERO);
    }

    /// Another line is followed from `until` on: the turns that it does not have any more are missed. Where its cycles
    /// are numbered on, those are the ones that begin before; else those of the old line that were slept through. Who
    /// made way was silent in them, however long ago they were.
    pub(super) fn leave(&mut self, left: &TimeLine, line: &TimeLine, until: Instant, made_way: bool) {
        let until = until.min(left.start + left.period * TOLD_AT_MOST);
        while let Some(turn) = self.slots.next_turn(left, None) {
            let offset = turn.at - left.start_of(turn.cycle);
            let numbered_on = line.ahead(turn.cycle).unsigned_abs() <= LINE_GOOD_FOR.unsigned_abs();
            let over = if numbered_on { line.start_of(turn.cycle) + offset } else { turn.latest };
            if until <= over {
                break;
            }
            let job = Job::Data(turn);
            // What it slept through it was late for, whatever the line.
            if self.purpose(&turn) == Purpose::Reply {
                self.calibrates_in(&job);
            } else if until > turn.latest && !made_way {
                self.missed(&job, until - turn.latest);
            } else {
                self.counters.slots_silent += 1;
                self.events.note_job(&job, EventKind::TurnLeft, Span::ZERO);
            }
            self.slots.pass(&turn);
        }
    }

    /// The line of a primary that has made way, if it has had none since.
    pub(super) fn left_when_it_made_way(&mut self) -> Option<TimeLine> {
        let Role::Master(master) = &mut self.role else { return None };
        master.take_left()
    }

    /// Nothing is sent any more in the role that there is: the turns that are still to come up to `cycle` are none of the
    /// next one's. Who calibrates has had none since that began.
    pub(super) fn leave_until(&mut self, cycle: u32, now: Instant) {
        let Some(line) = self.line().copied() else { return };
        // What somebody else says of cycles that have not come is no turn of this station's.
        let next = line.cycle_at(now).wrapping_add(1);
        let cycle = if (cycle.wrapping_sub(next) as i32) > 0 { next } else { cycle };
        let told_from = if self.calibrates() {
            cycle.wrapping_add(1)
        } else {
            cycle.wrapping_sub(TOLD_AT_MOST as u32 - 1)
        };
        let untold = self.slots.jump(told_from);
        if !self.calibrates() {
            self.counters.slots_silent += untold;
        }
        while let Some(turn) = self.slots.next_turn(&line, None) {
            if cycle.wrapping_sub(turn.cycle) as i32 >= 0 {
                self.counters.slots_silent += 1;
                self.events.note_job(&Job::Data(turn), EventKind::TurnLeft, Span::ZERO);
                self.slots.pass(&turn);
            } else {
                break;
            }
        }
    }

    /// A calibration reply that was not sent goes where this station may send anyway: real stations never repeat a request.
    pub(super) fn postpone(&mut self, job: &Job) {
        if let (true, Role::Master(master)) = (job.is_reply(), &mut self.role) {
            master.replies_mut().postpone();
        }
    }

    /// Whether a turn that must not be used is so for want of a Synchronisation, or of a schedule.
    fn silent_by(&self, job: &Job) -> EventKind {
        if self.may_follow(job) { EventKind::ScheduleUnsure } else { EventKind::SlotSilent }
    }

    fn may_do(&self, job: &Job) -> bool {
        job.turn().is_none_or(|turn| self.schedule_allows(turn.cycle)) && self.may_follow(job)
    }

    fn may_follow(&self, job: &Job) -> bool {
        let Some((slave, turn)) = self.follower().zip(job.turn()) else { return true };
        let fits = slave
            .line()
            .is_some_and(|line| self.slots.get(turn.id).is_some_and(|slot| slot.offset < line.period));
        fits && slave.may_send(turn.cycle)
    }

    /// The job's time is over, whether it was done or not.
    pub(super) fn pass(&mut self, job: &Job, now: Instant) {
        if let (Some(turn), Some(change)) = (job.turn(), &mut self.change)
            && self.slots.first().is_some_and(|first| first.id == turn.id)
        {
            change.turn_is_over();
        }
        match (job, &mut self.role) {
            (&Job::Sync { cycle, .. }, Role::Master(master)) => {
                master.advance();
                self.begin_cycle(cycle, now);
            }
            (Job::Part { .. }, _) => self.part_in = None,
            (Job::Reply { .. }, Role::Master(master)) => drop(master.replies_mut().take()),
            (Job::ReplyBehindSync { .. }, Role::Master(master)) => {
                self.reply_in = None;
                master.replies_mut().take_late();
            }
            (Job::ReplyInTurn(turn), Role::Master(master)) => {
                master.replies_mut().take_late();
                self.slots.pass(turn);
            }
            (Job::Request(turn) | Job::Data(turn) | Job::Answer(turn), _) => self.slots.pass(turn),
            _ => {}
        }
    }

    /// A backup that gives the time hears another at `rx`: it makes way, and comes back no more to Synchronisations that it
    /// has slept through.
    pub(super) fn miss_syncs_before(&mut self, rx: Instant) {
        let Role::Master(master) = &self.role else { return };
        let makes_way = master.is_active() && master.config().backup.is_some();
        let Some((job, line)) = next_sync(master).zip(master.line()).filter(|_| makes_way) else { return };
        let (first, late, period) = (job.cycle(), rx - job.latest(), line.period);
        let slept_through = (late + period).nanos().div_euclid(period.nanos()).clamp(0, TOLD_AT_MOST);
        for cycles in 0..slept_through {
            self.counters.syncs_skipped += 1;
            let cycle = first.wrapping_add(cycles as u32);
            self.events.note(cycle, EventKind::SyncSkipped, late - period * cycles);
        }
    }

    /// The kernel dropped the job's frame. A cycle whose Synchronisation was dropped is one without, as if the
    /// master had skipped it, and is counted with those.
    pub(super) fn guard_dropped(&mut self, job: &Job, late: Span) {
        self.counters.guard_drops += 1;
        let is_sync = matches!(job, Job::Sync { .. });
        self.counters.syncs_skipped += u64::from(is_sync);
        let kind = if is_sync { EventKind::SyncDropped } else { EventKind::GuardDropped };
        self.events.note_job(job, kind, late);
    }

    pub(super) fn missed(&mut self, job: &Job, late: Span) {
        let kind = match job {
            Job::Sync { .. } => {
                self.counters.syncs_skipped += 1;
                EventKind::SyncSkipped
            }
            // `Replies::postpone` counts it, once.
            Job::Reply { .. } | Job::ReplyBehindSync { .. } => EventKind::Overrun,
            // The next one brings another.
            Job::Part { .. } => {
                self.counters.parts_late += 1;
                self.change.iter_mut().for_each(|change| change.part_is_owed());
                return;
            }
            Job::Request(_) | Job::ReplyInTurn(_) | Job::Data(_) | Job::Answer(_) => {
                self.counters.overruns += 1;
                EventKind::Overrun
            }
        };
        self.events.note_job(job, kind, late);
    }
}

fn next_sync(master: &Master) -> Option<Job> {
    let config = master.config();
    master.next_sync().map(|(cycle, at, sched)| Job::Sync {
        cycle,
        at,
        latest: at + config.sync_latest,
        sched,
        is_backups: config.backup.is_some(),
    })
}
