//! `rtnet station --metrics`: a station's figures for Prometheus.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};

use package_router::component::Component;
use package_router::mailbox::Shape;
use package_router::name::{Class, MailboxName};
use serde_json::Value;
use tools::lab::namespace::Namespace;

use crate::cell::{json, text, wait_until};
use crate::host::{shared, unique};
use crate::rights::assert_gives_up_all;
use crate::router::{Router, has_joined};
use crate::rtnet;
use crate::station::{Medium, Station};

/// Groups of counters that are in `rtnet stat --json` of this station, by that name.
const GROUPS: [&str; 6] = ["station", "port", "refused", "programs", "stack", "loopback"];

/// A page as a client of this namespace reads it.
fn page(namespace: &Namespace, at: SocketAddr) -> String {
    let read = move || {
        let mut client = TcpStream::connect(at).unwrap();
        client.write_all(b"GET /metrics HTTP/1.1\r\nHost: here\r\n\r\n").unwrap();
        let mut answer = String::new();
        client.read_to_string(&mut answer).unwrap();
        answer
    };
    let answer = namespace.run(read).unwrap();
    assert!(answer.starts_with("HTTP/1.1 200 OK\r\n"), "{answer}");
    answer
}

/// The value behind this name and these labels.
fn value(page: &str, name: &str) -> Option<f64> {
    let line = page.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '))?;
    Some(line.parse().unwrap())
}

/// Where a station's figures are.
fn figures_of(station: &Station) -> SocketAddr {
    let line = station.wait_for("figures for Prometheus are at ");
    let at = line.rsplit_once("http://").and_then(|(_, at)| at.strip_suffix("/metrics"));
    at.unwrap_or_else(|| panic!("{line}")).parse().unwrap()
}

/// The counters of these groups, by group and name.
fn counters(stat: &Value) -> BTreeMap<(&'static str, String), f64> {
    let of = |group| {
        let counts = stat[group].as_object().unwrap();
        counts.iter().map(move |(name, n)| ((group, name.clone()), n.as_f64().unwrap()))
    };
    GROUPS.into_iter().flat_map(of).collect()
}

#[test]
fn a_station_has_figures_for_prometheus() {
    shared("a_station_has_figures_for_prometheus", || {
        let medium = Medium::new();
        let name = unique("figures");
        let role = ["--interface", "rt0", "--master", "--cycle", "5ms", "--sync-window", "800us"];
        let more = ["--ip", "10.0.0.1/24", "--metrics", "127.0.0.1:0", "--name", &name];
        let master = Station::start(&medium.a, &[&role[..], &more].concat());
        let at = figures_of(&master);
        master.wait_for("master_active");
        assert_gives_up_all(master.child.id());

        let stat = || counters(&json(rtnet().args(["stat", "-S", &name, "--json"])));
        wait_until("it gives the time", || stat()[&("station", "syncs_sent".into())] > 10.0);
        let before = stat();
        let page = page(&medium.a, at);
        let after = stat();
        for ((group, reason), least) in &before {
            let figure = format!("rtnet_events_total{{group=\"{group}\",reason=\"{reason}\"}}");
            let shown = value(&page, &figure).unwrap_or_else(|| panic!("{figure}: {page}"));
            let most = after[&(*group, reason.clone())];
            assert!((*least..=most).contains(&shown), "{figure}: {least} <= {shown} <= {most}");
        }
        for (figure, expected) in [("locked", 1.0), ("link_up", 1.0), ("silent_parts", 0.0)] {
            assert_eq!(value(&page, &format!("rtnet_{figure}")), Some(expected), "{page}");
        }
        assert!(value(&page, "rtnet_cpu_seconds_total") > Some(0.0), "{page}");
        assert_eq!(master.end(), Some(0));
    });
}

/// By the names that its router has, too.
#[test]
fn a_station_at_a_router_has_its_figures() {
    shared("a_station_at_a_router_has_its_figures", || {
        let medium = Medium::new();
        let router = ["--listen", "127.0.0.1:0", "--metrics", "127.0.0.1:0"];
        let router = medium.a.run(|| Router::start("figures", &router)).unwrap();
        let (name, at) = (unique("figures"), router.at.to_string());
        let net = ["--interface", "rt0", "--discipline", "nomac", "--ip", "10.0.0.1/24", "--name", &name];
        let more = ["--packages", "--router", &at, "--metrics", "127.0.0.1:0"];
        let station = Station::start(&medium.a, &[&net[..], &more].concat());
        let at = [figures_of(&station), router.figures.unwrap()];
        has_joined(&name);
        let component = Component::named(&name).unwrap();
        let own = MailboxName::new(0, Class(0x80), 1, 0);
        let _mailbox = component.mailbox(own, Shape::new(8, 64)).unwrap();
        for at in at {
            let has = |figure: &str, expected: f64| value(&page(&medium.a, at), figure) == Some(expected);
            wait_until("it is registered", || has("rtnet_mailboxes", 1.0));
            assert!(has("rtnet_connections", 1.0) && has("rtnet_waiting_packages", 0.0));
            assert!(value(&page(&medium.a, at), "rtnet_up_seconds") > Some(0.0));
        }
        let lost = "rtnet_events_total{group=\"tcp_lost_at_router\",reason=\"nobody_there\"}";
        assert_eq!(value(&page(&medium.a, at[0]), lost), Some(0.0));
        assert_eq!(station.end(), Some(0));
    });
}

#[test]
fn an_address_for_figures_that_cannot_be_is_refused() {
    let role = ["station", "--interface", "rt0", "--slave", "--slot", "0=1ms", "--metrics"];
    for (at, expected) in [
        ("0.0.0.0:9100", "other hosts reach 0.0.0.0:9100"),
        ("0.0.0.0:9100", "a reverse proxy or an SSH tunnel (`ssh -L 9100:127.0.0.1:9100 HOST`)"),
        ("localhost:9100", "'localhost:9100' is no IP address with a port: write one, as 127.0.0.1:9100"),
    ] {
        let refused = rtnet().args(role).arg(at).output().unwrap();
        let message = text(&refused.stderr);
        assert!(refused.status.code() == Some(2) && message.contains(expected), "{message}");
    }
    shared("an_address_for_figures_that_cannot_be_is_refused", || {
        let medium = Medium::new();
        let other = medium.a.run(|| TcpListener::bind("127.0.0.1:0").unwrap()).unwrap();
        let at = other.local_addr().unwrap().to_string();
        let mut second = rtnet();
        second.args(role).arg(&at);
        let refused = medium.a.run(move || second.output().unwrap()).unwrap();
        let message = text(&refused.stderr);
        assert!(
            refused.status.code() == Some(2) && message.contains("choose another --metrics"),
            "{message}"
        );
    });
}
