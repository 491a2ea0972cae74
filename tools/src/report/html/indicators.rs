//! The performance indicators of IEC 61784-2, each with what it is here, and of how many; where one was not measured, why.

use rtnet::sim::Joint;
use rtnet::wire::ethernet::HEADER_LEN;

use super::Sheet;
use super::markup::{Table, count, section, us};
use crate::judge::closely::regular::Largest;
use crate::report::figures::Role;
use crate::scenario::{SlotPlan, StationPlan};

/// What the slots of RTnet are for: real-time frames, and the tunnel's.
const RT_SLOT: u8 = 0;
const NON_RT_SLOT: u8 = 1;

/// One of them.
pub struct Indicator {
    /// The standard's.
    pub name: &'static str,
    /// With its unit.
    pub value: String,
    /// Of how many; none where nothing was counted.
    pub n: Option<u64>,
    /// What it is, or why there is none.
    pub definition: String,
}

/// Of a network with slots: all of them.
pub fn html(sheet: &Sheet<'_>) -> String {
    table([
        delivery(sheet),
        delivery_with_a_loss(sheet),
        stations(sheet.figures.stations, "Stations of the network, the master included."),
        topology(joint(sheet)),
        switches(joint(sheet)),
        throughput(&sheet.kept.regular.real_time, measured_ns(sheet), "in slots"),
        non_rte(sheet),
        time_sync(sheet),
        non_time_sync(sheet),
        recovery(sheet),
    ])
}

fn joint(sheet: &Sheet<'_>) -> Option<Joint> {
    sheet.simulation.map(|_| sheet.scenario.conditions.joint)
}

fn measured_ns(sheet: &Sheet<'_>) -> u64 {
    sheet.figures.cycles.saturating_mul(sheet.figures.cycle_ns)
}

/// Their section.
pub fn table(all: impl IntoIterator<Item = Indicator>) -> String {
    let mut table = Table::new("", 4, &["indicator", "value", "n", "what it is here"]).of_prose();
    for Indicator { name, value, n, definition } in all {
        table.row([name.to_owned(), value, n.map_or("–".into(), count), definition]);
    }
    let note = "As this run has them; the standard’s names. What an application’s own stack adds at either end is not in them.";
    section("indicators", "IEC 61784-2 performance indicators", note, &table.html())
}

/// The largest of what was measured.
pub fn measured(of: Largest, unit_name: &'static str, definition: String, why_not: &str) -> Indicator {
    match of.span {
        Some(span) => {
            Indicator { name: unit_name, value: us(Some(span.nanos())) + " µs", n: Some(of.n), definition }
        }
        None => not_measured(unit_name, why_not),
    }
}

/// One that there is none of.
pub fn not_measured(name: &'static str, why: &str) -> Indicator {
    Indicator { name, value: "not measured".into(), n: None, definition: why.into() }
}

fn delivery(sheet: &Sheet<'_>) -> Indicator {
    let queued = sheet.figures.queueing.iter().filter_map(|of| of.delay_ns.max.zip(Some(of)));
    let queued = queued.map(|(max, of)| {
        format!(
            " Queued by programs at priority {}, until on the wire: {} µs (n {}).",
            of.priority,
            us(Some(max)),
            count(of.delay_ns.n)
        )
    });
    let what = "The longest that a value was under way which had just missed its slot’s frame: from the begin of that one to the \
                end of the slot’s next frame on the medium, t(n) − t(n−1) + air time, no turn missed between.";
    let Largest { span, n } = sheet.kept.regular.delivery_with_misses;
    let missed = span.map_or(String::new(), |span| {
        format!(
            " Not in it: {} with turns missed between, the longest {} µs.",
            count(n),
            us(Some(span.nanos()))
        )
    });
    let definition = what.to_owned() + &missed + &queued.collect::<String>();
    measured(
        sheet.kept.regular.delivery,
        "Delivery time, max, no frame lost",
        definition,
        "no slot had two frames in successive turns",
    )
}

fn delivery_with_a_loss(sheet: &Sheet<'_>) -> Indicator {
    let what = "The same where the frame between is lost: to the end of the one after it, t(n) − t(n−2) + air time, also where a turn \
                was missed.";
    let why_not = "no slot had frames two turns apart";
    measured(
        sheet.kept.regular.delivery_with_a_loss,
        "Delivery time, max, one frame lost",
        what.into(),
        why_not,
    )
}

/// How many there are.
pub fn stations(n: u64, what: &str) -> Indicator {
    Indicator { name: "Number of end-stations", value: count(n), n: None, definition: what.into() }
}

/// What simulated wires lead to; none: a lab's.
pub fn topology(joint: Option<Joint>) -> Indicator {
    let (value, what) = match joint {
        None => ("star", "Virtual Ethernet pairs to one bridge of the kernel."),
        Some(Joint::Bridge) => ("star", "Simulated wires to one bridge, which adds no delay."),
        Some(Joint::Hub) => ("bus", "Simulated: one hub, a single collision domain."),
        Some(Joint::Switch { .. }) => ("star", "Simulated wires to one store-and-forward switch."),
    };
    Indicator { name: "Basic network topology", value: value.into(), n: None, definition: what.into() }
}

/// See [`topology`].
pub fn switches(joint: Option<Joint>) -> Indicator {
    let n = u8::from(joint != Some(Joint::Hub));
    let definition = "Between any two stations.".into();
    Indicator { name: "Number of switches between end-stations", value: n.to_string(), n: None, definition }
}

/// Of payload and frames of each station in so many nanoseconds, which left as `how` says.
pub fn throughput(of: &[(u64, u64)], ns: u64, how: &str) -> Indicator {
    let name = "Throughput RTE";
    let (octets, frames) = of.iter().fold((0, 0), |(a, b), (c, d)| (a + c, b + d));
    if ns == 0 || frames == 0 {
        return not_measured(name, "no frame of a station was seen");
    }
    let per_second = |octets: u64| count((u128::from(octets) * 1_000_000_000 / u128::from(ns)) as u64);
    let largest = of.iter().map(|(octets, _)| *octets).max().unwrap_or(0);
    let definition = format!(
        "Payload behind the Ethernet header that left {how}, of all stations together; the most on the link of one: {} octets/s. \
         What was offered and seen, not the most that there is room for.",
        per_second(largest)
    );
    Indicator { name, value: per_second(octets) + " octets/s", n: Some(frames), definition }
}

fn non_rte(sheet: &Sheet<'_>) -> Indicator {
    let scenario = sheet.scenario;
    let tunnels: Vec<&StationPlan> = scenario.stations.iter().filter(|plan| plan.has_tunnel()).collect();
    let name = "Non-RTE bandwidth";
    if tunnels.is_empty() {
        let definition = "No station has a VNIC, so that nothing but real-time frames may be sent.".into();
        return Indicator { name, value: "0 %".into(), n: None, definition };
    }
    let share = |slot: &SlotPlan| {
        let air = scenario.rate.air_time(slot.size + HEADER_LEN).nanos() as f64;
        air / (scenario.cycle.nanos() as f64 * f64::from(slot.period))
    };
    let percent = tunnels.iter().flat_map(|plan| non_rt_slots(plan)).map(share).sum::<f64>() * 100.0;
    let (octets, frames) = sheet.kept.regular.tunnelled;
    let definition = format!(
        "Worked out, not measured: the share of the medium’s time that frames of full size take in the slots that VNICs may use; what \
         is real-time goes first there. Of {} VNICs; {} octets in {} frames were tunnelled.",
        tunnels.len(),
        count(octets),
        count(frames)
    );
    Indicator { name, value: format!("{percent:.2} %"), n: None, definition }
}

/// Slot 1, or, where there is none, the one that it is an alias of; and what is joined to it.
fn non_rt_slots(plan: &StationPlan) -> impl Iterator<Item = &SlotPlan> {
    let has_own = plan.slots.iter().any(|slot| slot.id == NON_RT_SLOT);
    let id = if has_own { NON_RT_SLOT } else { RT_SLOT };
    plan.slots.iter().filter(move |slot| slot.id == id || slot.joint == Some(id))
}

fn time_sync(sheet: &Sheet<'_>) -> Indicator {
    let name = "Time synchronisation accuracy";
    let of = &sheet.figures.sync_error_ns;
    let Some((min, max)) = of.min.zip(of.max) else {
        return not_measured(name, "no station told what it takes global time for");
    };
    let definition = "The most by which two stations’ estimates of global time can have differed: largest − smallest sync error over the \
                      run and all stations, the master’s being 0; at one moment it may have been less.";
    Indicator {
        name,
        value: us(Some(max.max(0) - min.min(0))) + " µs",
        n: Some(of.n),
        definition: definition.into(),
    }
}

fn non_time_sync(sheet: &Sheet<'_>) -> Indicator {
    let what = "The largest difference between the slot errors of two frames of one cycle: how far what stations do on the cycle’s \
                trigger is apart, their offsets taken off.";
    let why_not = "no cycle had two frames";
    measured(sheet.kept.cycles.spread, "Non-time-based synchronisation accuracy", what.into(), why_not)
}

fn recovery(sheet: &Sheet<'_>) -> Indicator {
    let (name, figures) = ("Redundancy recovery time", sheet.figures);
    let has_backup = sheet.scenario.stations.iter().any(|plan| plan.role == Role::Backup);
    if figures.takeovers == 0 {
        let why = if has_backup {
            "no other station had to take the master’s place in this run"
        } else {
            "no station is a backup"
        };
        return not_measured(name, why);
    }
    let ns = u64::from(figures.takeover_cycles).saturating_mul(figures.cycle_ns);
    let definition = format!(
        "From the last Synchronisation of one master to the first of the next, whole cycles: {} at the most; 1 is none missing.",
        figures.takeover_cycles
    );
    Indicator { name, value: us(Some(ns as i64)) + " µs", n: Some(figures.takeovers), definition }
}
