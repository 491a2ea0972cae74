//! Wake-up latencies as live stations recorded them, for hosts of simulations to draw from.

use std::path::Path;

use anyhow::{Context, Result};
use rtnet::sim::Recorded;
use serde::Deserialize;

use crate::scenario::read_text;

/// The part of a report that says how late stations woke.
#[derive(Deserialize)]
struct Report {
    wake_latency: Vec<(u64, u64, u64)>,
}

/// Reads the wake-up latencies of a report, or of a file that holds no more than those.
pub fn load(path: &Path) -> Result<Recorded> {
    let text = read_text(path).with_context(|| format!("{} cannot be read", path.display()))?;
    let report: Report = serde_json::from_str(&text).with_context(|| {
        format!("{} has no wake_latency: write one with `rtnet lab run --json FILE`", path.display())
    })?;
    Recorded::new(report.wake_latency)
        .with_context(|| format!("{}: its wake_latency is empty, or cannot be", path.display()))
}
