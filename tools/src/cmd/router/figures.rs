//! A router's figures for Prometheus.

use package_router::tcp::router::Status;

use crate::metrics::Figures;

/// Counters that say what went well: they have names of their own.
pub const TRAFFIC: [&str; 4] = ["packages_in", "bytes_in", "packages_out", "bytes_out"];

/// All of them, in the text format.
pub fn figures(status: &Status, up_seconds: f64) -> String {
    let sum = |of: fn(&package_router::tcp::router::ClientStatus) -> usize| {
        status.clients.iter().map(of).sum::<usize>()
    };
    let oldest = status.clients.iter().filter_map(|client| client.oldest).max().unwrap_or(0);
    let mut figures = Figures::default();
    figures.gauge("rtnet_router_up_seconds", "Time since the start.", up_seconds);
    figures.gauge("rtnet_router_connections", "Open connections.", status.clients.len());
    figures.gauge("rtnet_router_mailboxes", "Registered names.", sum(|client| client.names.len()));
    figures.gauge(
        "rtnet_router_waiting_packages",
        "Packages that wait in queues.",
        sum(|client| client.waiting),
    );
    figures.gauge("rtnet_router_waiting_bytes", "Their bytes.", sum(|client| client.waiting_bytes));
    figures.gauge(
        "rtnet_router_oldest_seconds",
        "Time that the oldest of them has waited.",
        oldest as f64 / 1e3,
    );
    let counters = &status.counters;
    figures.counter(
        "rtnet_router_packages_total",
        "Packages that were queued for their receivers.",
        counters.packages_out,
    );
    figures.counter("rtnet_router_bytes_total", "Their bytes.", counters.bytes_out);
    let others = counters.each().filter(|(name, _)| !TRAFFIC.contains(name)).map(|(name, n)| ([name], n));
    figures.counters("rtnet_router_events_total", "What did not go on, by reason.", ["reason"], others);
    figures.into_text()
}

#[cfg(test)]
mod tests {
    use package_router::tcp::router::{Limits, Router};

    use super::*;

    #[test]
    fn a_router_has_figures_without_a_connection() {
        let text = figures(&Router::new(Limits::default(), 0).status(0), 1.5);
        for line in [
            "rtnet_router_up_seconds 1.5",
            "rtnet_router_connections 0",
            "rtnet_router_events_total{reason=\"queue_full\"} 0",
        ] {
            assert!(text.lines().any(|of| of == line), "{line}: {text}");
        }
        assert!(!text.contains("packages_in"), "{text}");
    }
}
