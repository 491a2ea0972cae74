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

use rtnet::time::Span;
use rtnet::wire::ethernet;

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

    fn misplaced(&self, slot: &Slot) -> Option<Conflict> {
        let (owner, id, offset) = (slot.owner.clone(), slot.id, slot.offset);
        if offset < self.sync_window {
            return Some(Conflict::InSyncWindow { owner, id, offset, sync_window: self.sync_window });
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
    let common = gcd(a.period.max(1), b.period.max(1));
    a.phase % common == b.phase % common
}

fn gcd(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { gcd(b, a % b) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FAST: Rate = Rate::from_bits_per_second(100_000_000);

    fn slot(owner: &str, offset: i64, phase: u32, period: u32) -> Slot {
        Slot { owner: owner.into(), id: 0, offset: Span::from_micros(offset), phase, period, size: 86 }
    }

    fn schedule(slots: Vec<Slot>) -> Schedule {
        let (cycle, sync_window) = (Span::from_millis(1), Span::from_micros(50));
        Schedule { cycle, sync_window, rate: FAST, guard: Span::from_micros(20), slots }
    }

    #[test]
    fn air_time_counts_24_bytes_more_and_at_least_60() {
        assert_eq!(FAST.air_time(100).nanos(), 9_920);
        assert_eq!(FAST.air_time(1), FAST.air_time(60));
        assert_eq!(FAST.air_time(1514).nanos(), 123_040);
        assert_eq!(Rate::from_bits_per_second(3_000_000_000).air_time(60).nanos(), 224);
    }

    #[test]
    fn neighbours_that_touch_do_not_overlap() {
        let end = 100_000 + 9_920 + 20_000;
        let touching = Slot { offset: Span::from_nanos(end), ..slot("b", 0, 0, 1) };
        assert_eq!(schedule(vec![slot("a", 100, 0, 1), touching.clone()]).conflicts(), []);
        let closer = Slot { offset: Span::from_nanos(end - 1), ..touching };
        let found = schedule(vec![closer, slot("a", 100, 0, 1)]).conflicts();
        assert_eq!(found.len(), 1);
        assert_eq!(
            found[0].to_string(),
            "slot 0 of a and slot 0 of b overlap: 100us + frame 9.92us + guard band 20us = 129.92us, but b \
             begins at 129.919us"
        );
    }

    #[test]
    fn slots_share_a_time_when_their_phases_never_meet() {
        let shared =
            |pa, na, pb, nb| schedule(vec![slot("a", 100, pa, na), slot("b", 100, pb, nb)]).conflicts();
        assert_eq!(shared(0, 2, 1, 2), []);
        assert_eq!(shared(0, 2, 1, 4), []);
        assert_eq!(shared(0, 2, 1, 3).len(), 1, "0 mod 2 and 1 mod 3 meet in cycle 4");
        assert_eq!(shared(0, 2, 2, 4).len(), 1);
    }

    #[test]
    fn a_slot_in_the_sync_window_or_beyond_the_cycle_is_a_conflict() {
        assert!(matches!(
            schedule(vec![slot("a", 49, 0, 1)]).conflicts()[..],
            [Conflict::InSyncWindow { .. }]
        ));
        assert_eq!(schedule(vec![slot("a", 970, 0, 1)]).conflicts(), []);
        assert!(matches!(
            schedule(vec![slot("a", 971, 0, 1)]).conflicts()[..],
            [Conflict::BeyondCycle { .. }]
        ));
    }

    #[test]
    fn a_cycle_too_short_prints_the_sum() {
        let (cycle, window) = (Span::from_micros(100), Span::from_micros(50));
        let length = divide(cycle, window, FAST, 5, 86, None).unwrap();
        assert_eq!(length, Span::from_micros(10));
        let refused = divide(cycle, window, FAST, 6, 86, None).unwrap_err();
        assert!(
            refused.to_string().contains("50us + 6 x (frame 9.92us + guard band 0ns) = 109.52us"),
            "{refused}"
        );
    }

    #[test]
    fn utilisation_is_the_share_of_time_on_the_air() {
        let with_one = schedule(vec![slot("a", 100, 0, 2)]).utilisation();
        assert!((with_one - (6_720.0 + 9_920.0 / 2.0) / 1e6).abs() < 1e-9);
    }

    #[test]
    fn clocks_have_ten_microseconds_at_either_end_or_a_part_of_what_is_shorter_or_longer() {
        let shares =
            [(8, 20, 5), (8, 40, 10), (8, 118, 10), (8, 120, 10), (8, 240, 20), (32, 200, 40), (32, 100, 25)];
        for (stations, guard, share) in shares {
            let [guard, share] = [guard, share].map(Span::from_micros);
            let found = (clock_share(guard, stations), latest(guard, stations));
            assert_eq!(found, (share, guard - share * 2), "{stations} stations, {guard}");
        }
        assert_eq!((clock_share(Span::ZERO, 8), latest(Span::ZERO, 8)), (Span::ZERO, Span::ZERO));
    }

    #[test]
    fn the_guard_band_covers_drift_over_the_bridged_cycle() {
        let of = Uncertainty {
            drift_ppb: 100_000,
            cycle: Span::from_millis(1),
            holdover: 1,
            lateness: Span::from_micros(3),
            stamp_error: Span::ZERO,
        };
        // 100 ppm over two cycles and the calibration's half, for either neighbour.
        assert_eq!(guard_band(of).nanos(), 2 * (250 + 2) + 3_000);
    }
}
