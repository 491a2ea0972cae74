//! What only a simulation knows, as a person reads it.

use super::expect::Checked;
use super::run::Simulation;
use crate::report::text::{about, grouped, list, micros};

/// Lines no longer than `width` columns: what was simulated, what became of it, what was expected.
pub fn render(simulation: &Simulation, around: &[String], width: usize) -> String {
    let head = format!(
        "simulated {} with seed {}: {} frames",
        about(simulation.virtual_ns),
        simulation.seed,
        grouped(simulation.frames)
    );
    let mut lines = vec![head];
    lines.extend(list("medium: ", &medium(simulation), width));
    let masters = masters(simulation);
    if !masters.is_empty() {
        lines.extend(list("masters: ", &masters, width));
    }
    lines.extend(list("at the end: ", &states(simulation), width));
    if !simulation.expectations.is_empty() {
        lines.push(String::new());
        lines.extend(simulation.expectations.iter().map(expectation));
    }
    if !around.is_empty() {
        lines.push(String::new());
        lines.push("the frames around the first of them:".into());
        lines.extend(around.iter().map(|line| format!("  {line}")));
    }
    lines.join("\n") + "\n"
}

fn medium(simulation: &Simulation) -> Vec<String> {
    let counted = [
        (simulation.collisions, "destroyed by a hub"),
        (simulation.queue_full, "without room in a switch"),
        (simulation.lost, "lost"),
        (simulation.duplicated, "duplicated"),
        (simulation.corrupted, "corrupted"),
        (simulation.reordered, "overtaken"),
    ];
    let gap = simulation.smallest_gap_ns.map(|gap| format!("smallest gap {} us", micros(gap)));
    let counted = counted.iter().filter(|(n, _)| *n > 0);
    gap.into_iter().chain(counted.map(|(n, what)| format!("{} {what}", grouped(*n)))).collect()
}

fn masters(simulation: &Simulation) -> Vec<String> {
    let mut items = Vec::new();
    if simulation.takeovers > 0 {
        let (n, cycles) = (simulation.takeovers, simulation.takeover_cycles);
        items.push(format!("{} times another one, within {cycles} cycles", grouped(n)));
    }
    if simulation.rival_cycles > 0 {
        items.push(format!("two at once for {} cycles", simulation.rival_cycles));
    }
    if simulation.syncs_missing > 0 {
        items.push(format!("{} cycles without a sync", grouped(simulation.syncs_missing)));
    }
    match simulation.relock_cycles {
        Some(0) => {}
        Some(cycles) => items.push(format!("all locked {cycles} cycles after the last event")),
        None => items.push("not all locked again".into()),
    }
    items
}

fn states(simulation: &Simulation) -> Vec<String> {
    let mut items: Vec<(String, usize)> = Vec::new();
    for station in &simulation.stations {
        let state = if station.gives_time { "master" } else { &station.state };
        match items.iter_mut().find(|(of, _)| of == state) {
            Some((_, n)) => *n += 1,
            None => items.push((state.into(), 1)),
        }
    }
    items.into_iter().map(|(state, n)| format!("{n} {state}")).collect()
}

fn expectation(checked: &Checked) -> String {
    let Checked { line, expected, station, found, holds, cycle } = checked;
    let of = station.as_ref().map_or(String::new(), |name| format!(" of {name}"));
    let place = cycle.map_or(String::new(), |cycle| format!(", first in cycle {cycle}"));
    let verdict = if *holds { "as expected" } else { "NOT AS EXPECTED" };
    format!("line {line:>3}: {expected}{of}: {found}{place}: {verdict}")
}
