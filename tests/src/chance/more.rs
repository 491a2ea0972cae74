//! What is drawn behind all that was drawn first: longer holdover, slaves without a filter, numbers of cycles near 2^32, and
//! troubles of clocks, wires and a second primary. What is drawn anew is drawn behind this.

use rtmac::tdma::schedule::guard_band;
use rtmac::tdma::{HOLDOVER_CYCLES, MAX_HOLDOVER};
use rtnet::sim::{Random, StationId, Wander};
use rtnet::time::Span;
use tools::report::figures::Role;

use super::{DRIFT_PPB, Fault, Trouble, uncertainty};
use crate::networks::Plan;

/// Most cycles that are bridged.
const LONGEST_HOLDOVER: i64 = 20;
/// Cycle numbers begin anew so many cycles after the start, or sooner.
const WRAPS_WITHIN: i64 = 400;
/// The most that happens besides.
const MOST_MORE: u64 = 3;
/// A second primary has a part of the network for itself for long enough to speak, and for a backup to do so before.
const ALONE_AT_LEAST: Span = Span::from_millis(150);

/// Draws what stations are configured with.
pub(super) fn configure(random: &mut Random, plan: &mut Plan, faults: &[Fault]) {
    if random.happens(200_000) {
        let guard = plan.scenario.guard;
        // As long as clocks that do not know their drift stay within their share.
        let fits = |cycles: &i64| guard_band(uncertainty(plan.cycle(), *cycles as u32)) * 2 <= guard;
        let drawn = random.between(2, LONGEST_HOLDOVER);
        let cycles = (1..=drawn).rev().find(fits).unwrap_or(i64::from(HOLDOVER_CYCLES));
        plan.follow.holdover = (cycles as u32).min(MAX_HOLDOVER);
    }
    let mut slots = plan.scenario.stations.iter().flat_map(|station| &station.slots);
    // Behind the wrap the turns of others are elsewhere.
    if slots.all(|slot| slot.period.is_power_of_two()) && random.happens(200_000) {
        plan.first_cycle = Some(u32::MAX - random.between(0, WRAPS_WITHIN) as u32);
    }
    // They follow a Synchronisation that was held up, and take the mean of the rounds with it.
    if !faults.iter().any(|fault| matches!(fault.trouble, Trouble::Stalls(..))) && random.happens(150_000) {
        let slaves = (0..plan.stations()).filter(|&id| plan.scenario.stations[id].role == Role::Slave);
        plan.without_filter = slaves.filter(|_| random.happens(500_000)).collect();
    }
}

/// Draws what happens besides.
pub(super) fn happen(random: &mut Random, plan: &Plan, faults: &mut Vec<Fault>) {
    for _ in 0..random.below(MOST_MORE + 1) {
        let begins = random.between(1, 300) as u64;
        let lasts = random.between(1, 100) as u64;
        let Some(trouble) = trouble(random, plan, faults) else { continue };
        let ends = match trouble {
            Trouble::Step(..) => begins + 1,
            Trouble::Primary(..) => {
                begins + lasts + ALONE_AT_LEAST.nanos().div_euclid(plan.cycle().nanos()) as u64 + 10
            }
            _ => begins + lasts,
        };
        faults.push(Fault { trouble, begins, ends });
    }
    faults.sort_by_key(|fault| fault.begins);
}

/// `None` where what was drawn is not for this network.
fn trouble(random: &mut Random, plan: &Plan, faults: &[Fault]) -> Option<Trouble> {
    let some = random.below(plan.stations() as u64) as StationId;
    let ppm = random.between(1_000, 300_000) as u32;
    // A mean of rounds has one in it for which a clock was set, or a stamp was changed; so has a line without a filter.
    let filtered = plan.without_filter.is_empty();
    match random.below(5) {
        0 => Some(Trouble::Step(some, step(random))).filter(|_| filtered),
        1 => Some(Trouble::Wander(some, wander(random, plan, some))),
        2 => Some(Trouble::Doubles(some, ppm)),
        3 => Some(Trouble::Changes(some, ppm / 30)).filter(|_| filtered),
        _ => second_primary(random, plan, faults),
    }
}

/// Of every order of magnitude, from microseconds to a second.
fn step(random: &mut Random) -> Span {
    let most = 10_i64.pow(random.between(3, 9) as u32);
    Span::from_nanos(random.between(-most, most))
}

/// By no more than clocks are wrong.
fn wander(random: &mut Random, plan: &Plan, id: StationId) -> Wander {
    let around_ppb = plan.scenario.stations[id].clock_drift_ppb;
    Wander {
        every: Span::from_micros(random.between(1_000, 100_000)),
        step_ppb: random.between(1, 200),
        within_ppb: DRIFT_PPB - around_ppb.abs(),
        around_ppb,
    }
}

/// A slave is started anew as a primary, in a part of the network without the first one. One that is started beside a primary
/// never speaks: where the first one is started anew, or a cut may show them to each other at once, there is none.
fn second_primary(random: &mut Random, plan: &Plan, faults: &[Fault]) -> Option<Trouble> {
    let some = random.between(1, plan.stations() as i64 - 1) as StationId;
    let part: Vec<_> = (1..plan.stations()).filter(|&id| id == some || random.happens(500_000)).collect();
    let disturbs = |trouble: &Trouble| {
        matches!(trouble, Trouble::Crash(0) | Trouble::Cut(_) | Trouble::Primary(..) | Trouble::Changes(..))
    };
    let can_be = plan.scenario.stations[some].role == Role::Slave
        && !plan.without_filter.contains(&some)
        && !faults.iter().any(|fault| disturbs(&fault.trouble));
    can_be.then_some(Trouble::Primary(some, part))
}
