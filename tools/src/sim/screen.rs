//! What only a simulation knows, as a person reads it.

use super::expect::Checked;
use super::figures::{SimFigures, Simulation};
use crate::report::text::{about, grouped, list, micros};

/// The frames around a place where something was not as expected.
#[derive(Default)]
pub struct Around {
    /// The line of the file that expects it.
    pub line: usize,
    /// The cycle.
    pub cycle: u32,
    /// The frames.
    pub frames: Vec<String>,
}

/// Lines no longer than `width` columns: what was simulated, what became of it, what was expected.
pub fn render(figures: &SimFigures, around: Option<&Around>, width: usize) -> String {
    let simulation = &figures.simulation;
    let head = format!(
        "simulated {} with seed {}, and measured {} of it: {} frames",
        about(simulation.virtual_ns),
        simulation.seed,
        about(simulation.measured_ns),
        grouped(simulation.frames)
    );
    let mut lines = vec![head];
    lines.extend(list("medium: ", &medium(simulation), width));
    let ends = states(simulation).into_iter().chain(relock(simulation)).collect::<Vec<_>>();
    lines.extend(list("at the end: ", &ends, width));
    if !simulation.expectations.is_empty() {
        lines.push(String::new());
        lines.extend(simulation.expectations.iter().map(expectation));
    }
    if let Some(Around { line, cycle, frames }) = around {
        lines.push(String::new());
        lines.push(format!("the frames around cycle {cycle}, for line {line}:"));
        lines.extend(frames.iter().map(|line| format!("  {line}")));
    }
    lines.join("\n") + "\n"
}

/// What was seen of the medium.
pub(crate) fn medium(simulation: &Simulation) -> Vec<String> {
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

/// How long it took until all were synchronised again.
fn relock(simulation: &Simulation) -> Option<String> {
    match simulation.relock_cycles {
        Some(0) => None,
        Some(_) if simulation.events == 0 => None,
        Some(cycles) => Some(format!("all synchronised {cycles} cycles after the last event")),
        None => Some("not all synchronised".into()),
    }
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
    let (expected, found, verdict) = of_expectation(checked);
    format!("line {:>3}: {expected}: {found}: {verdict}", checked.line)
}

/// What was expected of whom, what was found, and whether it is that.
pub(crate) fn of_expectation(checked: &Checked) -> (String, String, String) {
    let Checked { expected, station, priority, found, holds, cycle, .. } = checked;
    let of = station.as_ref().map_or(String::new(), |name| format!(" of {name}"));
    let at = priority.map_or(String::new(), |priority| format!(" at priority {priority}"));
    let verdict = match (holds, cycle) {
        (true, _) => "as expected".to_owned(),
        (false, Some(cycle)) => format!("NOT AS EXPECTED, see cycle {cycle}"),
        (false, None) => "NOT AS EXPECTED, in no cycle that could be shown".to_owned(),
    };
    (format!("{expected}{of}{at}"), found.to_string(), verdict)
}
