//! What a ring does, before anybody runs it: how long anything takes at the most. All of it is arithmetic.

use rtmac::token::bound::recovery_bound;
use rtnet::wire::ethernet::HEADER_LEN;
use serde::Serialize;

use super::figures::{Bounds, span};
use crate::report::document::document;
use crate::report::screen::{WIDTH_MIN, sections};
use crate::report::text::{Column, cut, list, paragraph, table};
use crate::scenario::{RingScenario, StationPlan};

/// Stations that are listed, on the screen.
const ROWS_SHOWN: usize = 32;
const NAME_MAX: usize = 16;

/// A ring, and what it does. Times are in nanoseconds, shares from 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RingPlan {
    /// The medium's, bits per second.
    pub rate: u64,
    /// How long each may send at a time.
    pub hold_ns: i64,
    /// How long each keeps the token at the least.
    pub rest_ns: i64,
    /// How late a host may be, each time.
    pub late_ns: i64,
    /// How long a token takes to another station at the most.
    pub delay_ns: i64,
    /// How long anything takes at the most.
    pub bounds: Bounds,
    /// With so many stations dead at once, one behind the other, the holder among them: from then to the next frame.
    pub recovery_by_dead_ns: Vec<i64>,
    /// One entry per station, in the order in which the token goes round.
    pub stations: Vec<Place>,
    /// What cannot work, with the sum that shows it; nothing of a ring that does.
    pub refused: Vec<String>,
}

document!(RingPlan, "ring-plan", ring_plan_has_its_schema);

/// A station's place in a ring.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Place {
    /// Its name.
    pub station: String,
    /// The most that its program queues in the longest round, on the air; its usual frame takes what is left.
    pub queued_ns: i64,
    /// The share of what it may send that this is.
    pub load: f64,
}

impl RingPlan {
    /// Of a ring that can be.
    pub fn of(scenario: &RingScenario) -> Self {
        let ring = &scenario.ring;
        let bounds = Bounds::of(ring);
        let place = |station: &StationPlan| Place::of(station, scenario, bounds.rotation_ns);
        let stations: Vec<Place> = scenario.network.stations.iter().map(place).collect();
        let refused =
            stations.iter().filter_map(|place| place.overloaded(ring.hold.nanos(), bounds.rotation_ns));
        Self {
            rate: ring.rate.bits_per_second(),
            hold_ns: ring.hold.nanos(),
            rest_ns: ring.rest.nanos(),
            late_ns: ring.late.nanos(),
            delay_ns: ring.delay.nanos(),
            bounds,
            recovery_by_dead_ns: (1..ring.stations.len())
                .map(|dead| recovery_bound(ring, dead, 0).nanos())
                .collect(),
            refused: refused.collect(),
            stations,
        }
    }

    /// Whether nothing speaks against it.
    pub fn works(&self) -> bool {
        self.refused.is_empty()
    }
}

impl Place {
    fn of(station: &StationPlan, scenario: &RingScenario, round_ns: i64) -> Self {
        let rate = scenario.ring.rate;
        let queued = station.flows.iter().map(|flow| {
            let air = rate.air_time(HEADER_LEN + flow.payload).nanos();
            let times = i128::from(round_ns) / i128::from(flow.every_ns) + 1;
            i128::from(air) * times * i128::from(flow.burst)
        });
        let queued_ns = i64::try_from(queued.sum::<i128>()).unwrap_or(i64::MAX);
        let load = queued_ns as f64 / scenario.ring.hold.nanos() as f64;
        Self { station: station.name.clone(), queued_ns, load }
    }

    fn overloaded(&self, hold_ns: i64, round_ns: i64) -> Option<String> {
        (self.queued_ns > hold_ns).then(|| {
            format!(
                "{} queues up to {} on the air in the longest round, {}, and may send {} of it: let it send less, or longer \
                 (token_hold), or the others shorter",
                self.station,
                span(self.queued_ns),
                span(round_ns),
                span(hold_ns)
            )
        })
    }
}

/// In plain text, no line longer than `width` columns (less than [`WIDTH_MIN`] counts as that).
pub fn render(plan: &RingPlan, width: usize) -> String {
    let width = width.max(WIDTH_MIN);
    sections(&[
        headline(plan, width),
        bounds(plan, width),
        stations(plan, width),
        dead(plan, width),
        verdict(plan, width),
    ])
}

fn headline(plan: &RingPlan, width: usize) -> Vec<String> {
    let items = [
        format!("{} stations in a ring", plan.stations.len()),
        "no slots, no cycle, no master".into(),
        format!("{} Mbit/s", plan.rate as f64 / 1e6),
        format!("hold {}", span(plan.hold_ns)),
        format!("rest {}", span(plan.rest_ns)),
        format!("late {}", span(plan.late_ns)),
        format!("delay {}", span(plan.delay_ns)),
    ];
    list("", &items, width)
}

fn bounds(plan: &RingPlan, width: usize) -> Vec<String> {
    let of = &plan.bounds;
    let rows = [
        ("round", of.rotation_ns, "from one time that the token comes to a station to the next"),
        ("with one absent", of.rotation_one_absent_ns, "the same, where it is invited in vain"),
        ("most urgent frame", of.access_delay_ns, "from being queued to being sent, at every station"),
        ("recovery", of.recovery_ns, "from the death of the token's holder to the next frame"),
        ("two tokens", of.doubling_ns, "from when they hear each other to one"),
        ("return", of.rejoin_ns, "of a station that was absent, until the token comes to it"),
    ];
    let columns = [
        Column::left(["", "at the most"], rows.iter().map(|(name, ..)| (*name).to_owned())),
        Column::right(["", "time"], rows.iter().map(|(_, ns, _)| span(*ns))),
        Column::left(["", "of what"], rows.iter().map(|(.., what)| (*what).to_owned())),
    ];
    table(&columns, width)
}

fn stations(plan: &RingPlan, width: usize) -> Vec<String> {
    let rows = &plan.stations[..plan.stations.len().min(ROWS_SHOWN)];
    let columns = [
        Column::left(["", "station"], rows.iter().map(|place| cut(&place.station, NAME_MAX))),
        Column::right(["queued in a", "round, on the air"], rows.iter().map(|place| span(place.queued_ns))),
        Column::right(
            ["of what", "it may send"],
            rows.iter().map(|place| format!("{:.1} %", place.load * 100.0)),
        ),
        Column::right(["wait of the", "most urgent"], rows.iter().map(|_| span(plan.bounds.access_delay_ns))),
        Column::right(
            ["recovery if it", "dies with the token"],
            rows.iter().map(|_| span(plan.bounds.recovery_ns)),
        ),
    ];
    let mut lines = table(&columns, width);
    if plan.stations.len() > rows.len() {
        lines.push(format!("... and {} more: --json has all", plan.stations.len() - rows.len()));
    }
    lines
}

fn dead(plan: &RingPlan, width: usize) -> Vec<String> {
    let all = plan.recovery_by_dead_ns.iter().zip(1..).take(4);
    let items: Vec<String> = all.map(|(ns, dead)| format!("{dead} dead {}", span(*ns))).collect();
    if items.len() < 2 {
        Vec::new()
    } else {
        list("recovery, of neighbours that die at once: ", &items, width)
    }
}

fn verdict(plan: &RingPlan, width: usize) -> Vec<String> {
    if plan.works() {
        let text = format!(
            "WORKS: these bounds hold as long as hosts are no later than {}, tokens take no longer than {}, and clocks run apart by no \
             more than 500 ppm",
            span(plan.late_ns),
            span(plan.delay_ns)
        );
        return paragraph("", &text, width);
    }
    plan.refused.iter().flat_map(|why| paragraph("DOES NOT WORK: ", why, width)).collect()
}
