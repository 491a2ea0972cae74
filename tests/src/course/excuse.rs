//! Why frames may overlap, and how often at the most.

use rtnet::discipline::EventKind;
use rtnet::sim::StationId;

use super::{Course, RIVALS_LAST};
use crate::chance::{Case, Fault, LONGEST_HOLD_UP, Trouble};
use crate::judge::{Author, Frame, Kind};

/// A frame of a turn is known by its cycle, a request's only by its reply's: that is a period later.
const LONGEST_PERIOD: i32 = 4;
/// A frame that comes in others' time lies on one that is there already, and one more comes while it is.
const MEETS_AT_MOST: u64 = 2;

/// Who hears that its line is not the master's is silent after so many cycles.
const SILENT_AFTER: u64 = 3;

/// A cause for which two frames may overlap.
enum Excuse {
    /// A sender was held up behind its last look at the clock, and told of that.
    HeldUp,
    /// A reply to a station's former life, and what it asks, or is answered, since it was started anew.
    Crossed,
    /// The reply to a request that was changed on its way, or that was promised by a clock that was set since.
    Astray,
    /// Synchronisations of two primaries.
    Rivals,
    /// The lines of the two were apart.
    Apart,
}

/// What may set lines apart, until all are locked to one master again.
#[derive(Default)]
pub(super) struct Parted {
    /// Two masters gave the time on lines apart, or one on another line than the one before.
    pub grids: bool,
    /// Clocks of these stations were set.
    pub set: Vec<StationId>,
    /// Frames were changed on their way.
    pub changed: bool,
}

impl Case {
    /// So many Synchronisations of two primaries may overlap: after a cut they give the time side by side until one makes way,
    /// which has heard the other in a row. What keeps Synchronisations away may make a primary of who made way.
    fn rivals_within(&self) -> u64 {
        let rivals = self.faults.iter().filter(|fault| matches!(fault.trouble, Trouble::Primary(..)));
        let keeps_away = |fault: &&Fault| {
            matches!(fault.trouble, Trouble::Losses(_) | Trouble::Outages(..) | Trouble::Stalls(..))
        };
        let deaf: u64 = self.faults.iter().filter(keeps_away).map(|fault| fault.ends - fault.begins).sum();
        rivals.count() as u64 * (RIVALS_LAST + deaf)
    }

    /// So many replies may have been promised by clocks that are set since: one to each station.
    fn promised(&self) -> u64 {
        let sets = self.faults.iter().filter(|fault| matches!(fault.trouble, Trouble::Step(..)));
        sets.count() as u64 * self.hosts.len() as u64
    }

    /// Whether this station's clock was set while a reply may have been promised that is still to come.
    fn has_set(&self, station: StationId, cycle: u64) -> bool {
        // By a clock that was set back it is sent later by as much.
        let longest = LONGEST_PERIOD as u64 + self.set_back() / self.plan.cycle().nanos() as u64;
        self.faults.iter().any(|fault| {
            matches!(fault.trouble, Trouble::Step(of, _) if of == station)
                && (fault.begins..fault.ends + longest).contains(&cycle)
        })
    }

    /// Times that a station is started anew.
    fn starts(&self) -> u64 {
        let starts = |fault: &&Fault| matches!(fault.trouble, Trouble::Crash(_) | Trouble::Primary(..));
        self.faults.iter().filter(starts).count() as u64
    }

    /// In so many cycles frames of two whose lines are apart may overlap. After whatever set them apart a station goes on with
    /// its line as long as it bridges, or until it hears of another; where frames are changed on their way, again and again.
    pub(super) fn apart_within(&self) -> u64 {
        let is_master = |id: StationId| id == 0 || self.plan.backups.iter().any(|&(backup, _)| backup == id);
        let bridged = u64::from(self.plan.follow.holdover) + SILENT_AFTER;
        let parts = |fault: &Fault| match &fault.trouble {
            Trouble::Crash(id) if is_master(*id) => bridged,
            Trouble::Losses(_) if !self.plan.backups.is_empty() => bridged,
            Trouble::Cut(_) | Trouble::Step(..) | Trouble::Primary(..) => bridged,
            Trouble::Changes(..) => bridged + fault.ends - fault.begins,
            _ => 0,
        };
        self.faults.iter().map(parts).sum()
    }
}

impl Course<'_> {
    pub(super) fn judge(&mut self) -> Result<(), String> {
        let new = {
            let judge = self.lab.judge();
            let pairs = judge.overlaps.iter().zip(&judge.kinds).skip(self.judged);
            pairs.map(|(&(a, b), &(one, other))| ((a, one), (b, other))).collect::<Vec<_>>()
        };
        self.judged += new.len();
        let mut apart = 0;
        for (a, b) in new {
            match self.excuse(a, b) {
                Some(Excuse::HeldUp) => self.account.explained += 1,
                Some(Excuse::Crossed) => self.account.crossed += 1,
                Some(Excuse::Astray) => self.account.astray += 1,
                Some(Excuse::Rivals | Excuse::Apart) if self.are_severed(a.0, b.0) => {
                    self.account.severed += 1
                }
                Some(Excuse::Rivals) => self.account.rivals += 1,
                Some(Excuse::Apart) => apart += 1,
                None => {
                    let now = self.cycle;
                    return Err(format!("cycle {now}: {a:?} and {b:?} overlap without a cause"));
                }
            }
        }
        self.account.apart += apart;
        self.account.apart_cycles += u64::from(apart > 0);
        Ok(())
    }

    fn excuse(&self, a: Frame, b: Frame) -> Option<Excuse> {
        let astray = |frame: Frame| {
            let was_set = self.case.has_set(self.stations[frame.0.from], self.cycle);
            matches!(frame.1, Kind::Reply { astray: true, .. }) && (self.parted.changed || was_set)
        };
        if crossed(a, b) || crossed(b, a) {
            Some(Excuse::Crossed)
        } else if self.are_primaries(a, b) {
            Some(Excuse::Rivals)
        } else if self.was_held_up(a) || self.was_held_up(b) {
            Some(Excuse::HeldUp)
        } else if astray(a) || astray(b) {
            Some(Excuse::Astray)
        } else if self.lines_were_apart(a.0, b.0) {
            Some(Excuse::Apart)
        } else {
            None
        }
    }

    /// Whether they are Synchronisations of two.
    fn are_primaries(&self, a: Frame, b: Frame) -> bool {
        let (one, other) = (self.stations[a.0.from], self.stations[b.0.from]);
        let is_primary = |id| id == 0 || self.second == Some(id);
        one != other && is_primary(one) && is_primary(other) && (a.1, b.1) == (Kind::Sync, Kind::Sync)
    }

    /// Whether a cut is between the two: they do not meet.
    fn are_severed(&self, a: Author, b: Author) -> bool {
        let is_there = |of: Author| self.cut.contains(&self.stations[of.from]);
        !self.cut.is_empty() && is_there(a) != is_there(b)
    }

    fn lines_were_apart(&self, a: Author, b: Author) -> bool {
        let (a, b) = (self.stations[a.from], self.stations[b.from]);
        let was_set = self.parted.set.contains(&a) || self.parted.set.contains(&b);
        if a == b {
            // Its clock was set to where its next frame was due.
            return was_set;
        }
        (self.parted.grids || self.parted.changed || was_set) && self.beliefs.were_apart(a, b)
    }

    /// Whether its sender told that it was.
    fn was_held_up(&self, (of, kind): Frame) -> bool {
        self.lab.events.iter().any(|(id, event)| {
            let later = event.cycle.wrapping_sub(of.cycle) as i32;
            *id == of.from
                && match (kind, event.kind) {
                    (Kind::Sync | Kind::Data, EventKind::StalledInSend) => later == 0,
                    (Kind::Request(_), EventKind::StalledInSend) => (1 - LONGEST_PERIOD..=0).contains(&later),
                    // It was to leave in the cycle that was asked for, or in one before that in which it is seen.
                    (Kind::Reply { .. }, EventKind::ReplyStalled) => {
                        (-(LONGEST_HOLD_UP as i32)..=LONGEST_PERIOD).contains(&later)
                    }
                    _ => false,
                }
        })
    }

    /// That no more was excused than what happened can have caused.
    pub(super) fn check_excuses(&mut self) -> Result<(), String> {
        let held_up = |kind| matches!(kind, EventKind::StalledInSend | EventKind::ReplyStalled);
        let account = &mut self.account;
        account.held_up = self.lab.events.iter().filter(|(_, event)| held_up(event.kind)).count() as u64;
        account.late_replies = self.lab.judge().late_replies;
        account.changed = self.lab.network.traffic().corrupted;
        let excused = [
            (account.explained, MEETS_AT_MOST * account.held_up, "overlaps with frames that were held up"),
            (account.crossed, MEETS_AT_MOST * self.case.starts(), "overlaps with replies to a former life"),
            (
                account.astray,
                MEETS_AT_MOST * (account.changed + self.case.promised()),
                "overlaps with replies astray",
            ),
            (account.rivals, self.case.rivals_within(), "overlaps of two primaries' Synchronisations"),
            (
                account.apart_cycles,
                account.apart_within,
                "cycles with overlaps of two whose lines were apart",
            ),
        ];
        match excused.into_iter().find(|(were, at_most, _)| were > at_most) {
            Some((were, at_most, what)) => Err(format!("{were} {what}, which may be {at_most}")),
            None => Ok(()),
        }
    }
}

/// Whether both are of one station's calibration, and the other is a reply to what it asked before it was started anew.
fn crossed((author, one): Frame, (_, other): Frame) -> bool {
    let Kind::Reply { to, asked_by, .. } = other else { return false };
    match one {
        Kind::Request(of) => of == to && asked_by != Some(author.from),
        Kind::Reply { to: of, asked_by: by, .. } => of == to && asked_by != by,
        Kind::Sync | Kind::Data => false,
    }
}
