//! A router's figures for Prometheus.

use package_router::tcp::router::Status;

use crate::metrics::{CONNECTIONS, EVENTS, Figures, MAILBOXES, UP, WAITING};

/// All of them, in the text format.
pub fn figures(status: &Status, up_seconds: f64) -> String {
    let sum = |of: fn(&package_router::tcp::router::ClientStatus) -> usize| {
        status.clients.iter().map(of).sum::<usize>()
    };
    let oldest = status.clients.iter().filter_map(|client| client.oldest).max().unwrap_or(0);
    let mut figures = Figures::default();
    figures.gauge(UP, up_seconds);
    figures.gauge(CONNECTIONS, status.clients.len());
    figures.gauge(MAILBOXES, sum(|client| client.names.len()));
    figures.gauge(WAITING, sum(|client| client.waiting));
    figures.gauge(["rtnet_waiting_bytes", "Their bytes."], sum(|client| client.waiting_bytes));
    figures.gauge(["rtnet_oldest_seconds", "Time that the oldest of them has waited."], oldest as f64 / 1e3);
    let counters = status.counters.each().map(|(name, n)| (["router", name], n));
    let counters = counters.chain(status.endings.iter().map(|(reason, n)| (["closed", *reason], *n)));
    figures.counters(EVENTS, ["group", "reason"], counters);
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
            "rtnet_up_seconds 1.5",
            "rtnet_connections 0",
            "rtnet_mailboxes 0",
            "rtnet_events_total{group=\"router\",reason=\"queue_full\"} 0",
            "rtnet_events_total{group=\"closed\",reason=\"stranger\"} 0",
        ] {
            assert!(text.lines().any(|of| of == line), "{line}: {text}");
        }
    }
}
