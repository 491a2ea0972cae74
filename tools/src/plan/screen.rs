//! A plan as a person reads it, in a terminal; the verdict is the last line.

use super::host::percent;
use super::{LATENESS_LEAST, OnHost, Plan, RoundTrip, SlotRow, TimeTable, WaitRow, time};
use crate::doctor::verdict::LOAD_MAX;
use crate::report::screen::{WIDTH_MIN, sections};
use crate::report::text::{Column, cut, duration, grouped, list, paragraph, table};

/// Of longer tables the JSON has the rest.
const ROWS_SHOWN: usize = 60;
const PHASES_SHOWN: u64 = 16;
const NAME_MAX: usize = 16;
/// What stands for slots in the picture, in the order of their stations' first.
const KEYS: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrtuvwxyz0123456789";

/// In plain text, no line longer than `width` columns where it can be broken.
pub fn render(plan: &Plan, width: usize) -> String {
    let width = width.max(WIDTH_MIN);
    sections(&[
        headline(plan, width),
        picture(plan, width),
        slots(&plan.table, width),
        guard(plan, width),
        hosts(plan, width),
        backups(&plan.table, width),
        waits(&plan.waits, width),
        round_trips(plan, width),
        vnics(plan, width),
        plan.host.as_ref().map_or(Vec::new(), |host| on_host(host, width)),
        verdict(plan, width),
    ])
}

fn headline(plan: &Plan, width: usize) -> Vec<String> {
    let items = [
        format!("{} stations", grouped(plan.stations as u64)),
        format!("cycle {}", time(plan.cycle_ns)),
        format!("{} Mbit/s", plan.rate as f64 / 1e6),
        format!("{:.1} % of the time used", plan.utilisation * 100.0),
    ];
    list("", &items, width)
}

/// A line for each cycle until it repeats; a slot's key stands from its begin to its frame's end, at least once.
fn picture(plan: &Plan, width: usize) -> Vec<String> {
    let phases = plan.table.phases.unwrap_or(1);
    let shown = phases.min(PHASES_SHOWN);
    let label =
        |phase: u64| if phases == 1 { "cycle ".to_owned() } else { format!("cycle {}/{phases} ", phase + 1) };
    let indent = (0..shown).map(|phase| label(phase).len()).max().unwrap_or(0);
    let columns = width - indent - 2;
    let row = |phase| format!("{:<indent$}|{}|", label(phase), bar(plan, phase, columns));
    let mut lines: Vec<_> = (0..shown).map(row).collect();
    let more = match plan.table.phases {
        Some(phases) => phases - shown,
        None => 0,
    };
    if more > 0 {
        lines.push(format!("and {} cycles more until it repeats", grouped(more)));
    }
    if plan.table.phases.is_none() {
        lines.push("and more than 65 536 cycles until it repeats".to_owned());
    }
    let backups = if plan.table.backups.is_empty() { "" } else { "+ a backup's, " };
    let letters = "a station's letter its frame, - the guard band behind it, . free";
    lines.push(format!("{:indent$} # the sync's window, {backups}{letters}", ""));
    lines
}

fn bar(plan: &Plan, phase: u64, columns: usize) -> String {
    let mut bar = vec![b'.'; columns];
    let place = |ns: i64| ((ns as f64 / plan.cycle_ns as f64 * columns as f64) as usize).min(columns);
    let mut paint = |from: i64, until: i64, with: u8| {
        let (from, until) = (place(from).min(columns - 1), place(until));
        bar[from..until.max(from + 1)].fill(with);
    };
    paint(0, plan.sync_window_ns, b'#');
    plan.table.backups.iter().for_each(|row| paint(row.sends_ns, row.until_ns, b'+'));
    plan.table.phase(phase).for_each(|row| paint(row.begins_ns, row.ends_ns, b'-'));
    plan.table.phase(phase).for_each(|row| paint(row.begins_ns, row.frame_ends_ns, key(row)));
    String::from_utf8_lossy(&bar).into_owned()
}

/// What stands for a slot's station.
fn key(row: &SlotRow) -> u8 {
    KEYS[row.number % KEYS.len()]
}

fn slots(table: &TimeTable, width: usize) -> Vec<String> {
    let rows = &table.slots[..table.slots.len().min(ROWS_SHOWN)];
    let right = |head, of: &dyn Fn(&SlotRow) -> String| Column::right(head, rows.iter().map(of));
    let columns = [
        Column::left(
            ["", "station"],
            rows.iter().map(|row| format!("{} {}", char::from(key(row)), cut(&row.station, NAME_MAX))),
        ),
        right(["", "slot"], &SlotRow::name),
        right(["", "cycles"], &|row| {
            if row.period <= 1 { "all".into() } else { format!("{}/{}", row.phase + 1, row.period) }
        }),
        right(["", "begins"], &|row| time(row.begins_ns)),
        right(["frame", "ends"], &|row| time(row.frame_ends_ns)),
        right(["guard band", "ends"], &|row| time(row.ends_ns)),
        right(["free behind", "the frame"], &|row| time(row.free_ns)),
        right(["size", "bytes"], &|row| row.size.to_string()),
    ];
    shortened(self::table(&columns, width), table.slots.len(), "slots")
}

/// With a line that tells of rows that are not shown.
fn shortened(mut lines: Vec<String>, rows: usize, what: &str) -> Vec<String> {
    if rows > ROWS_SHOWN {
        lines.push(format!("and {} {what} more, see --json", grouped((rows - ROWS_SHOWN) as u64)));
    }
    lines
}

fn guard(plan: &Plan, width: usize) -> Vec<String> {
    let of = &plan.guard;
    let absorbs = if of.absorbs_stamps {
        format!(
            ": no frame meets another while each drifts by up to {:.0} ppm, a sync in a row is missing, and stamps and sends are right to {}",
            of.drift_ppb as f64 / 1e3,
            time(of.stamp_error_ns),
        )
    } else {
        format!(", less than two stamps that are wrong by {} each", time(of.stamp_error_ns))
    };
    let mut text = format!(
        "{} behind each frame. At either end {} of it are for clocks{absorbs}.",
        time(of.band_ns),
        time(of.clocks_ns)
    );
    if let Some(least) = plan.table.smallest_gap() {
        let until =
            least.free_until.as_ref().map_or("the cycle's end".to_owned(), |name| format!("that of {name}"));
        text += &format!(
            " Least is free behind slot {} of {}: {} until {until}.",
            least.slot,
            least.station,
            time(least.free_ns)
        );
    }
    paragraph("guard band: ", &text, width)
}

/// What the guard band leaves for hosts, and what they need of that.
fn hosts(plan: &Plan, width: usize) -> Vec<String> {
    let of = &plan.guard;
    let needs = match &plan.host {
        Some(_) => "what such a host needs stands below".to_owned(),
        None => format!(
            "{LATENESS_LEAST} are taken to be needed (--host decides by what `rtnet doctor --json` has measured)"
        ),
    };
    let text = format!(
        "{} are left: guard band {} - 2 x {} for clocks. A station that is later than that is silent; {needs}.",
        time(of.lateness_ns),
        time(of.band_ns),
        time(of.clocks_ns),
    );
    paragraph("for hosts: ", &text, width)
}

fn backups(table: &TimeTable, width: usize) -> Vec<String> {
    if table.backups.is_empty() {
        return Vec::new();
    }
    let row = |row: &super::BackupRow| {
        format!(
            "{} sends {} after a cycle's start, until {}",
            row.station,
            time(row.sends_ns),
            time(row.until_ns)
        )
    };
    let mut items: Vec<_> = table.backups.iter().map(row).collect();
    if let Some(first) = table.slots.first() {
        items.push(format!("the first slot begins at {}", time(first.begins_ns)));
    }
    list("backups: ", &items, width)
}

fn waits(waits: &[WaitRow], width: usize) -> Vec<String> {
    let rows = &waits[..waits.len().min(ROWS_SHOWN)];
    let right = |head, of: &dyn Fn(&WaitRow) -> String| Column::right(head, rows.iter().map(of));
    let dash = |of: Option<String>| of.unwrap_or_else(|| "-".to_owned());
    let columns = [
        Column::left(["", "station"], rows.iter().map(|row| cut(&row.station, NAME_MAX))),
        right(["", "slots"], &|row| row.slots.iter().map(u8::to_string).collect::<Vec<_>>().join("+")),
        right(["turns", "a second"], &|row| format!("{:.1}", row.turns_per_second)),
        right(["priority", "(0 first)"], &|row| {
            row.flow.map_or("first".into(), |flow| flow.priority.to_string())
        }),
        right(["", "queued"], &|row| {
            dash(row.flow.map(|flow| format!("{} every {}", flow.burst, duration(flow.every_ns))))
        }),
        right(["turns", "wanted"], &|row| dash(row.flow.map(|_| percent(row.load)))),
        right(["worst wait", "for the wire"], &|row| {
            if row.is_endless() { "for ever".into() } else { dash(row.worst_ns.map(time)) }
        }),
        right(["frames", "waiting"], &|row| dash(row.waiting.map(grouped))),
    ];
    let mut lines = shortened(table(&columns, width), waits.len(), "queues");
    let text = "From being queued to the begin of its slot, on hosts that are not late, where no turn is missed; `first` is whatever is \
                the first of its queue, and each frame before it takes a turn more.";
    lines.extend(paragraph("", text, width));
    lines
}

fn round_trips(plan: &Plan, width: usize) -> Vec<String> {
    let pairs = &plan.round_trips.pairs;
    let worst = |of: fn(&RoundTrip) -> Option<i64>| {
        let pair = pairs.iter().rev().max_by_key(|pair| of(pair))?;
        Some(format!("{} ({} asks {})", time(of(pair)?), pair.asks, pair.answers))
    };
    let ping = worst(|pair| pair.ping_ns).map(|worst| format!("ping {worst}"));
    let packages = worst(|pair| pair.packages_ns).map(|worst| format!("packages {worst}"));
    let mut items: Vec<_> = ping.into_iter().chain(packages).collect();
    if items.is_empty() {
        return Vec::new();
    }
    items.push(format!(
        "{} of it on the way each time; programs take no time here",
        time(plan.round_trips.way_ns)
    ));
    list("worst round trips: ", &items, width)
}

fn vnics(plan: &Plan, width: usize) -> Vec<String> {
    if plan.vnics.is_empty() {
        return Vec::new();
    }
    let rows = &plan.vnics[..plan.vnics.len().min(ROWS_SHOWN)];
    let right = |head, of: &dyn Fn(&super::VnicRow) -> String| Column::right(head, rows.iter().map(of));
    let columns = [
        Column::left(["", "VNIC of"], rows.iter().map(|row| cut(&row.station, NAME_MAX))),
        right(["", "slots"], &|row| row.slots.iter().map(u8::to_string).collect::<Vec<_>>().join("+")),
        right(["turns", "a second"], &|row| format!("{:.1}", row.turns_per_second)),
        right(["MTU", "bytes"], &|row| row.mtu.to_string()),
        right(["at most", "Mbit/s"], &|row| format!("{:.3}", row.bytes_per_second as f64 * 8.0 / 1e6)),
    ];
    shortened(table(&columns, width), plan.vnics.len(), "VNICs")
}

fn on_host(host: &OnHost, width: usize) -> Vec<String> {
    let missed = host.miss_share.map_or("more slots than was looked at".to_owned(), |share| {
        format!("up to {} of slots", percent(share))
    });
    let needs = host
        .needs_guard_ns
        .map_or(String::new(), |guard| format!("; a guard band of {} is enough", time(guard)));
    let core = if host.warm_core { "core kept warm" } else { "core not kept warm" };
    let lab = if host.holds_as_lab() { "which it has" } else { "which is more than it has" };
    let text = format!(
        "as measured, {core}: misses {missed} that may begin {} late, and {} are accepted{needs}. All stations on one such host, as a lab, \
         take {} of a core, {lab} ({} at the most).",
        time(host.lateness_ns),
        percent(host.miss_accepted),
        percent(host.load_as_lab),
        percent(LOAD_MAX),
    );
    paragraph("host: ", &text, width)
}

fn verdict(plan: &Plan, width: usize) -> Vec<String> {
    if let (true, Some(why)) = (plan.works(), plan.warned.first()) {
        return paragraph("WORKS ON FEW HOSTS: ", why, width);
    }
    if plan.works() {
        return vec![
            "WORKS: no slot meets another within these bounds, and all that is queued gets its turn".into(),
        ];
    }
    plan.refused.iter().flat_map(|why| paragraph("DOES NOT WORK: ", why, width)).collect()
}
