//! The arithmetic of slots: how long a frame is on the air, what fits into a cycle, and how wide the
//! guard band must be.
//!
//! ```text
//! cycle start                                                            next cycle start
//! |< sync window >|<------ slot ------>|<------ slot ------>| ... |
//!                 |air|<- guard band ->|
//!                     the clocks' share at either end, 10 us say; what lies between is for the host:
//!                     the latest begin is |guard band - both shares| after the slot's
//! ```

mod backlog;
mod bounds;
mod turns;
mod wait;

use rtnet::time::Span;
use rtnet::wire::ethernet;

use super::master::BACKUP_LOOKS_BEFORE;

pub use backlog::{Demand, load, most_waiting, worst_queueing};
pub use bounds::{Gap, drift_bound};
pub use turns::Turns;
pub use wait::{Wait, longest_between, round_trip, wait, worst_wait};

/// What clocks may be wrong by, slave to master: 5 us while a line is young, 2 us later, measured over veth. One that
/// changes its rate by 4 to 20 ppm at once may be off by twice as much until that is noticed.
const CLOCKS: Span = Span::from_micros(10);
/// The more there are, the longer a bridge takes to deliver a Synchronisation to the last of them, and the more that varies:
/// behind 32 ports clocks were ahead by as much as 35 us.
const CLOCKS_PER_STATION: Span = Span::from_nanos(1_250);
/// Long slots belong to long cycles, over which clocks drift farther: this part of the guard band at the least. Of short
/// ones clocks take this part at the most.
const CLOCK_PARTS: i64 = 12;
const CLOCK_PARTS_AT_MOST: i64 = 4;
/// A time step is this part of the guard band.
const STEP_PARTS: i64 = 4;

/// How fast the medium is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Rate(u64);

impl Rate {
    /// `bits` per second; at least 1.
    pub const fn from_bits_per_second(bits: u64) -> Self {
        assert!(bits > 0);
        Self(bits)
    }
    /// Bits per second.
    pub const fn bits_per_second(self) -> u64 {
        self.0
    }

    /// How long a frame of `len` bytes (without check sequence) occupies the medium, rounded up:
    /// (frame + 24 bytes) x 8 / rate; a frame has at least 60 bytes.
    pub fn air_time(self, len: usize) -> Span {
        let bits = (len.max(ethernet::MIN_FRAME) + ethernet::OVERHEAD) as u128 * 8;
        Span::from_nanos((bits * 1_000_000_000).div_ceil(u128::from(self.0)) as i64)
    }
}

/// One station's slot in a schedule.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Slot {
    /// Whose it is, for messages.
    pub owner: String,
    /// Its id at the owner.
    pub id: u8,
    /// Begin, from the cycle's start.
    pub offset: Span,
    /// Used in cycles with `cycle mod period == phase`.
    pub phase: u32,
    /// See `phase`; 1 is every cycle.
    pub period: u32,
    /// Largest payload behind the Ethernet header.
    pub size: usize,
}

/// A whole network's slots.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Schedule {
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// Reserved for the Synchronisation at the begin of each cycle.
    pub sync_window: Span,
    /// The medium's.
    pub rate: Rate,
    /// Kept free behind each frame.
    pub guard: Span,
    /// Who takes the primary's place, and how long after a cycle's start it sends if it must; in any order.
    pub backups: Vec<(String, Span)>,
    /// In any order.
    pub slots: Vec<Slot>,
}

/// Why a schedule cannot work, with the sum that shows it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Conflict {
    /// The cycle has no room for everything.
    #[error(
        "{slots} slots do not fit a cycle of {cycle}: sync window {sync_window} + {slots} x (frame {air} + \
         guard band {guard}) = {sum}; lengthen the cycle, or reduce stations, payload or guard band"
    )]
    DoesNotFit {
        /// How many.
        slots: usize,
        /// The cycle.
        cycle: Span,
        /// The Synchronisation's share.
        sync_window: Span,
        /// One frame's time on the air.
        air: Span,
        /// Behind each frame.
        guard: Span,
        /// What would be needed.
        sum: Span,
    },
    /// Two slots of one phase overlap.
    #[error(
        "slot {a_id} of {a} and slot {b_id} of {b} overlap: {a_offset} + frame {air} + guard band {guard} = \
         {a_end}, but {b} begins at {b_offset}"
    )]
    Overlap {
        /// Owner of the earlier.
        a: String,
        /// Its id.
        a_id: u8,
        /// Its begin.
        a_offset: Span,
        /// Its frame's time on the air.
        air: Span,
        /// Behind the frame.
        guard: Span,
        /// Where it ends.
        a_end: Span,
        /// Owner of the later.
        b: String,
        /// Its id.
        b_id: u8,
        /// Its begin.
        b_offset: Span,
    },
    /// A slot begins within the Synchronisation's window.
    #[error("slot {id} of {owner} begins at {offset}, inside the sync window of {sync_window}")]
    InSyncWindow {
        /// Whose.
        owner: String,
        /// Which.
        id: u8,
        /// Its begin.
        offset: Span,
        /// The window.
        sync_window: Span,
    },
    /// A backup looks while another master may still send.
    #[error(
        "backup {owner} sends {backup} after a cycle's start, but looks before, when {before} may still send its sync: let \
         it send {until} after it, or later"
    )]
    BackupTooEarly {
        /// Whose.
        owner: String,
        /// When it sends.
        backup: Span,
        /// The master that looks before it, or the primary.
        before: String,
        /// The end of that one's sync window, and the time to hear of it.
        until: Span,
    },
    /// In the cycle of a take-over a slot would be before its Synchronisation, or meet it.
    #[error(
        "slot {id} of {owner} begins at {offset}, but backup {backup} may send the sync until {until}: let all slots begin \
         later"
    )]
    BeforeBackup {
        /// Whose.
        owner: String,
        /// Which.
        id: u8,
        /// Its begin.
        offset: Span,
        /// The last of the backups.
        backup: String,
        /// The end of its sync window.
        until: Span,
    },
    /// A slot ends after the cycle.
    #[error(
        "slot {id} of {owner} ends after the cycle: {offset} + frame {air} + guard band {guard} = {end}, \
         the cycle is {cycle}"
    )]
    BeyondCycle {
        /// Whose.
        owner: String,
        /// Which.
        id: u8,
        /// Its begin.
        offset: Span,
        /// Its frame's time on the air.
        air: Span,
        /// Behind the frame.
        guard: Span,
        /// Where it ends.
        end: Span,
        /// The cycle.
        cycle: Span,
    },
}

impl Schedule {
    /// Time on the air of the largest frame of a slot.
    pub fn air_time(&self, slot: &Slot) -> Span {
        self.rate.air_time(slot.size + ethernet::HEADER_LEN)
    }

    /// Where a slot ends: frame and guard band.
    pub fn end(&self, slot: &Slot) -> Span {
        slot.offset + self.air_time(slot) + self.guard
    }

    /// All that is wrong with it: slots in the sync window, beyond the cycle, or over one another in
    /// some cycle.
    pub fn conflicts(&self) -> Vec<Conflict> {
        let mut found: Vec<Conflict> = self.slots.iter().filter_map(|slot| self.misplaced(slot)).collect();
        found.extend(self.backups_misplaced());
        let mut order: Vec<&Slot> = self.slots.iter().collect();
        order.sort_by_key(|slot| slot.offset);
        for (i, a) in order.iter().enumerate() {
            let overlapping = order[i + 1..].iter().filter(|b| b.offset < self.end(a) && phases_meet(a, b));
            found.extend(overlapping.map(|b| Conflict::Overlap {
                a: a.owner.clone(),
                a_id: a.id,
                a_offset: a.offset,
                air: self.air_time(a),
                guard: self.guard,
                a_end: self.end(a),
                b: b.owner.clone(),
                b_id: b.id,
                b_offset: b.offset,
            }));
        }
        found
    }

    /// Share of the time that frames of full size and the Synchronisation occupy, 0 to 1 and above.
    pub fn utilisation(&self) -> f64 {
        let share = |air: Span, period: u32| air.nanos() as f64 / f64::from(period);
        let data: f64 = self.slots.iter().map(|slot| share(self.air_time(slot), slot.period)).sum();
        (data + share(self.rate.air_time(0), 1)) / self.cycle.nanos() as f64
    }

    /// Every backup looks when the one before it may send no more, which goes on for a sync window.
    fn backups_misplaced(&self) -> Vec<Conflict> {
        let mut order: Vec<(String, Span)> = self.backups.clone();
        order.push(("the primary".into(), Span::ZERO));
        order.sort_by_key(|&(_, looks)| looks);
        let too_early = |pair: &[(String, Span)]| {
            let [(before, at), (owner, backup)] = pair else { return None };
            let (until, backup) = (*at + self.sync_window + BACKUP_LOOKS_BEFORE, *backup);
            let (owner, before) = (owner.clone(), before.clone());
            (backup < until).then_some(Conflict::BackupTooEarly { owner, backup, before, until })
        };
        order.windows(2).filter_map(too_early).collect()
    }

    /// When the last of them may send no more.
    fn last_backup(&self) -> Option<(&str, Span)> {
        let last = self.backups.iter().max_by_key(|&&(_, looks)| looks);
        last.map(|(owner, looks)| (owner.as_str(), *looks + self.sync_window))
    }

    fn misplaced(&self, slot: &Slot) -> Option<Conflict> {
        let (owner, id, offset) = (slot.owner.clone(), slot.id, slot.offset);
        if offset < self.sync_window {
            return Some(Conflict::InSyncWindow { owner, id, offset, sync_window: self.sync_window });
        }
        if let Some((backup, until)) = self.last_backup().filter(|&(_, until)| offset < until) {
            return Some(Conflict::BeforeBackup { owner, id, offset, backup: backup.into(), until });
        }
        let (air, guard, end, cycle) = (self.air_time(slot), self.guard, self.end(slot), self.cycle);
        (end > cycle).then_some(Conflict::BeyondCycle { owner, id, offset, air, guard, end, cycle })
    }
}

/// Divides what the sync window leaves of a cycle evenly: the length of each of `slots` slots for a
/// payload of `size` bytes, frame and guard band together. Without `guard` the guard band is the rest of
/// the slot; one that is given must fit, and what is beyond it stays free.
pub fn divide(
    cycle: Span,
    sync_window: Span,
    rate: Rate,
    slots: usize,
    size: usize,
    guard: Option<Span>,
) -> Result<Span, Conflict> {
    let air = rate.air_time(size + ethernet::HEADER_LEN);
    let least = guard.unwrap_or(Span::ZERO);
    let length = (cycle - sync_window) / slots.max(1) as i64;
    if length < air + least {
        let sum = sync_window + (air + least) * slots as i64;
        return Err(Conflict::DoesNotFit { slots, cycle, sync_window, air, guard: least, sum });
    }
    Ok(length)
}

/// What the guard band has to absorb.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Uncertainty {
    /// Largest rate error of a station's clock against true time, parts per billion.
    pub drift_ppb: i64,
    /// From one cycle's start to the next.
    pub cycle: Span,
    /// Cycles without a Synchronisation that are bridged.
    pub holdover: u32,
    /// How late a host may call `send`.
    pub lateness: Span,
    /// Error of one transmit or receive stamp.
    pub stamp_error: Span,
}

/// The guard band with which neighbours do not overlap: one may be late by its clock and its host
/// while the next is early by its clock.
///
/// As long as a station does not know its drift, a clock's error grows from the last Synchronisation on, over at
/// most one cycle and the bridged ones, and the calibrated delay is wrong by the drift over half a cycle, since a calibration
/// measures over one. The master's own drift moves both neighbours alike.
pub fn guard_band(of: Uncertainty) -> Span {
    let half_cycles = i128::from(2 * (1 + of.holdover) + 1);
    let drifted = i128::from(of.cycle.nanos()) * i128::from(of.drift_ppb) * half_cycles;
    // Rounding: a nanosecond for each of the two clocks and each of their two conversions.
    let clock = Span::from_nanos((drifted as u128).div_ceil(2_000_000_000) as i64 + 2) + of.stamp_error * 2;
    clock * 2 + of.lateness
}

/// How long after its begin a slot may still be used when `guard` lies behind its frame: the clocks' share is kept at
/// either end.
pub fn latest(guard: Span, stations: usize) -> Span {
    guard - clock_share(guard, stations) * 2
}

/// How far a frame may leave its slot's bounds before it intrudes on a neighbour's share, in a network of so many stations.
pub fn clock_share(guard: Span, stations: usize) -> Span {
    let clocks = CLOCKS.max(CLOCKS_PER_STATION * stations as i64);
    (guard / CLOCK_PARTS).max(clocks).min(guard / CLOCK_PARTS_AT_MOST)
}

/// How much a Synchronisation may disagree with the line of who has such slots before it is a time step. More than the
/// clocks' share, for what is held up on its way hardly moves a line.
pub fn step_limit(guard: Span) -> Span {
    guard / STEP_PARTS
}

/// Whether two slots are ever used in the same cycle.
fn phases_meet(a: &Slot, b: &Slot) -> bool {
    let common = gcd(a.period.max(1).into(), b.period.max(1).into());
    u64::from(a.phase) % common == u64::from(b.phase) % common
}

/// The greatest number that divides both.
pub fn gcd(a: u64, b: u64) -> u64 {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[cfg(test)]
mod tests;
