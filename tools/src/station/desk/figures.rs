//! A station's figures for Prometheus: the counters of `rtnet stat`, and how it follows its master's time.

use std::collections::BTreeMap;

use rtmac::tdma::TdmaStatus;
use rtnet::discipline::SyncState;
use rtnet::time::Span;

use super::Desk;
use crate::control::{CountersShown, TcpShown, VnicCounted};
use crate::metrics::{CONNECTIONS, EVENTS, Figures, MAILBOXES, UP, WAITING};
use crate::station::wire::LinkState;

/// Counts that go down, too, by group and name, with the gauge that each is: there is no such counter.
const LEVELS: [(&str, &str, [&str; 2]); 6] = [
    ("station", "queued", ["rtnet_waiting_frames", "Frames that wait to be sent."]),
    ("tcp", "mailboxes", MAILBOXES),
    (
        "tcp",
        "mailboxes_waiting",
        ["rtnet_mailboxes_waiting", "Mailboxes that are to be registered at the TCP router."],
    ),
    ("tcp", "waiting", WAITING),
    ("vnic_filter", "waiting", ["rtnet_vnic_waiting_packets", "Packets that Linux holds for the VNIC."]),
    ("vnic_filter", "waiting_bytes", ["rtnet_vnic_waiting_bytes", "Their bytes."]),
];

/// Counters by group and name.
type Groups<'a> = Vec<(&'static str, &'a BTreeMap<String, u64>)>;

impl Desk {
    /// All figures, in the text format; none before the real-time thread has left its first snapshot.
    pub fn figures(&mut self) -> Option<String> {
        self.look();
        let newest = self.newest.as_ref()?;
        let asked = self.sockets.are_there().then(|| self.sockets.counters());
        let is_silent = matches!(asked, Some(Err(_)));
        let own = asked.and_then(Result::ok).unwrap_or_default();
        let counters = self.with_those_below(self.with_those_beside(own), newest);
        let mut figures = Figures::default();
        figures.gauge(UP, self.begun.elapsed().as_secs_f64());
        figures.gauge(
            ["rtnet_link_up", "Whether frames can pass at the interface."],
            u8::from(self.link() == LinkState::Up),
        );
        figures.counter(
            ["rtnet_cpu_seconds_total", "Processor time of the real-time thread."],
            newest.cpu as f64 / 1e9,
        );
        if let Some(tdma) = newest.status.tdma() {
            of_time(&mut figures, tdma);
        }
        of_counters(&mut figures, &counters, is_silent);
        Some(figures.into_text())
    }
}

/// How a station in time slots follows its master.
fn of_time(figures: &mut Figures, tdma: &TdmaStatus) {
    let seconds = |span: Span| span.nanos() as f64 / 1e9;
    let is_locked = tdma.state == SyncState::Locked;
    figures.gauge(
        ["rtnet_locked", "Whether the station is synchronised, and no sync is missing."],
        u8::from(is_locked),
    );
    figures.gauge(["rtnet_missing_syncs", "Cycles since the last sync that was followed."], tdma.missing);
    figures.gauge(
        ["rtnet_deviation_seconds", "Difference of the last sync and the time line."],
        seconds(tdma.deviation),
    );
    if let Some(bound) = tdma.error_bound {
        figures
            .gauge(["rtnet_error_bound_seconds", "Largest error of the start of a cycle."], seconds(bound));
    }
    if let Some(drift) = tdma.drift_ppb {
        let help = "Gain of the station's clock on the master's, per second.";
        figures.gauge(["rtnet_drift_ratio", help], drift as f64 / 1e9);
    }
}

/// Counters, and what of them goes down, too.
fn of_counters(figures: &mut Figures, shown: &CountersShown, is_silent: bool) {
    let is_unknown = shown.vnic.as_ref().is_some_and(|vnic| vnic.unknown.is_some());
    let help =
        "Parts of the station (sockets, VNIC) whose counters are missing here: they did not answer in time.";
    figures.gauge(["rtnet_silent_parts", help], u8::from(is_silent) + u8::from(is_unknown));
    if let Some(tcp) = &shown.tcp {
        figures.gauge(CONNECTIONS, u8::from(tcp.connected));
    }
    let groups = groups(shown);
    let count = |group: &str, name: &str| {
        let mut counts = groups.iter().filter(|(of, _)| *of == group).map(|(_, counts)| counts);
        counts.find_map(|counts| counts.get(name)).copied()
    };
    for (group, name, gauge) in LEVELS {
        if let Some(now) = count(group, name) {
            figures.gauge(gauge, now);
        }
    }
    let is_level = |group: &str, name: &str| LEVELS.iter().any(|level| (level.0, level.1) == (group, name));
    let all = groups.iter().flat_map(|(group, counts)| {
        let grow = counts.iter().filter(|(name, _)| !is_level(group, name));
        grow.map(|(name, n)| ([*group, name.as_str()], *n))
    });
    figures.counters(EVENTS, ["group", "reason"], all);
}

/// Without those of each socket: sockets come and go.
fn groups(shown: &CountersShown) -> Groups<'_> {
    let CountersShown {
        name: _,
        station,
        port,
        refused,
        programs,
        stack,
        loopback,
        sockets: _,
        tcp,
        packages,
        vnic,
    } = shown;
    let mut groups = vec![
        ("station", station),
        ("port", port),
        ("refused", refused),
        ("programs", programs),
        ("stack", stack),
        ("loopback", loopback),
    ];
    groups.extend(packages.iter().map(|counts| ("packages", counts)));
    if let Some(TcpShown { counters, lost, lost_at_router, .. }) = tcp {
        groups.extend([("tcp", counters), ("tcp_lost", lost), ("tcp_lost_at_router", lost_at_router)]);
    }
    if let Some(VnicCounted { counters, lost, filter, unknown: _ }) = vnic {
        groups.extend([("vnic", counters), ("vnic_lost", lost), ("vnic_filter", filter)]);
    }
    groups
}

#[cfg(test)]
mod tests {
    use rtmac::tdma::{DEFAULT_LEAD, LatePolicy, RoleConfig, SlaveConfig, Tdma, TdmaConfig};
    use rtnet::Discipline;
    use rtnet::wire::ethernet::Address;

    use super::*;

    fn counts(all: &[(&str, u64)]) -> BTreeMap<String, u64> {
        all.iter().map(|&(name, n)| (name.to_owned(), n)).collect()
    }

    #[test]
    fn counters_have_group_and_reason_and_levels_are_gauges() {
        let shown = CountersShown {
            station: counts(&[("frames_sent", 7), ("queued", 2)]),
            tcp: Some(TcpShown {
                connected: true,
                counters: counts(&[("packages_out", 5), ("mailboxes", 3), ("waiting", 4)]),
                lost: counts(&[("queue_full", 1)]),
                ..TcpShown::default()
            }),
            vnic: Some(VnicCounted { unknown: Some("it has ended".into()), ..VnicCounted::default() }),
            ..CountersShown::default()
        };
        let mut figures = Figures::default();
        of_counters(&mut figures, &shown, true);
        let text = figures.into_text();
        let lines: Vec<&str> = text.lines().filter(|line| !line.starts_with('#')).collect();
        assert_eq!(
            lines,
            [
                "rtnet_silent_parts 2",
                "rtnet_connections 1",
                "rtnet_waiting_frames 2",
                "rtnet_mailboxes 3",
                "rtnet_waiting_packages 4",
                "rtnet_events_total{group=\"station\",reason=\"frames_sent\"} 7",
                "rtnet_events_total{group=\"tcp\",reason=\"packages_out\"} 5",
                "rtnet_events_total{group=\"tcp_lost\",reason=\"queue_full\"} 1",
            ]
        );
    }

    #[test]
    fn time_is_in_seconds_and_left_out_if_unknown() {
        let tdma = TdmaConfig {
            address: Address::default(),
            role: RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() }),
            slots: Vec::new(),
            max_slot_id: 7,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        };
        let waits = Tdma::new(&tdma).unwrap().status();
        let text = |status: &TdmaStatus| {
            let mut figures = Figures::default();
            of_time(&mut figures, status);
            figures.into_text()
        };
        let before = text(&waits);
        assert!(before.contains("\nrtnet_locked 0\n") && !before.contains("error_bound"), "{before}");
        let follows = TdmaStatus {
            state: SyncState::Locked,
            error_bound: Some(Span::from_nanos(7_250)),
            drift_ppb: Some(-12_500),
            ..waits
        };
        let after = text(&follows);
        for line in ["rtnet_locked 1", "rtnet_error_bound_seconds 0.00000725", "rtnet_drift_ratio -0.0000125"]
        {
            assert!(after.lines().any(|of| of == line), "{line}: {after}");
        }
    }
}
