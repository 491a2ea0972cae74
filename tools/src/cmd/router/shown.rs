//! The status of a router, as text.

use std::collections::BTreeMap;

use package_router::tcp::account::Lost;

use crate::control::{ClientShown, LinkShown, RatesShown, RouterShown};
use crate::report::text::{Column, duration, grouped, table};

const WIDTH: usize = 120;
/// Counters of packages that went on: all others are shown together.
const TRAFFIC: [&str; 4] = ["packages_in", "bytes_in", "packages_out", "bytes_out"];

/// Connections that are shown unless all are asked for, those with the most bytes waiting; and mailboxes of each.
const CONNECTIONS: usize = 100;
const MAILBOXES: usize = 16;

/// A router's status, of 100 connections and 16 mailboxes of each, or of `all`; `is_chosen`: of those only that were asked for.
pub(super) fn describe(router: &RouterShown, is_chosen: bool, all: bool) -> String {
    let RouterShown { name, pid, listen, connections, names, waiting, .. } = router;
    let up = duration(router.up_ns);
    let mut lines = vec![format!(
        "router '{name}', process {pid}, at {} for {up}: {connections} connections, {names} mailboxes, {waiting} packages waiting",
        listen.join(", ")
    )];
    lines.extend(router.rates.map(
        |RatesShown { packages_out_per_s: packages, bytes_out_per_s: bytes, .. }| {
            format!(
                "{} packages and {} bytes a second, mean of the last round of 5 s",
                grouped(packages),
                grouped(bytes)
            )
        },
    ));
    lines.extend(router.links.iter().map(described));
    lines.extend(router.rules_error.iter().map(|why| {
        format!("its file was read again and has an error, so the rules before are in force: {why}")
    }));
    lines.extend(clients_of(router, is_chosen, all));
    let dropped = counted(router.counters.iter().filter(|(name, _)| !TRAFFIC.contains(&name.as_str())));
    if !dropped.is_empty() {
        lines.extend([String::new(), format!("counted since its start: {}", dropped.join(", "))]);
    }
    if !router.closed.is_empty() {
        let by_reason = counted(router.endings.iter());
        lines.extend([
            String::new(),
            format!("connections closed since its start: {}; the newest first:", by_reason.join(", ")),
        ]);
        lines.extend(router.closed.iter().map(|closed| {
            let [ago, open] = [closed.ago_ns, closed.open_ns].map(duration);
            format!("{} {ago} ago, after {open}: {}", closed.peer, closed.why)
        }));
    }
    lines.join("\n") + "\n"
}

/// Each count that is not 0, and its name.
fn counted<'a>(counts: impl Iterator<Item = (&'a String, &'a u64)>) -> Vec<String> {
    let counts = counts.filter(|(_, count)| **count > 0);
    counts.map(|(name, count)| format!("{} {}", name.replace('_', " "), grouped(*count))).collect()
}

fn described(link: &LinkShown) -> String {
    let systems: Vec<String> = link.systems.iter().map(u8::to_string).collect();
    let to = if systems.is_empty() { "that no other link names".into() } else { systems.join(", ") };
    let state = match (link.open, &link.last_error) {
        (true, None) => "open".into(),
        (true, Some(why)) => format!("open, but {why}"),
        (false, Some(why)) => format!("not open: {why}"),
        (false, None) => "not open yet".into(),
    };
    format!("link to {}, for systems {to}: {state}", link.router)
}

/// Packages of a client that were not passed on, for whatever reason.
fn lost(client: &ClientShown) -> u64 {
    let reasons = Lost::default();
    reasons.each().filter_map(|(reason, _)| client.counters.get(reason)).sum()
}

fn names_of(client: &ClientShown, most: usize) -> String {
    let shown = client.mailboxes.len().min(most);
    let more = client.mailboxes.len() - shown;
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    format!("{}{more}", client.mailboxes[..shown].join(" "))
}

/// The table of open connections.
fn clients_of(router: &RouterShown, is_chosen: bool, all: bool) -> Vec<String> {
    let (most, most_names) = if all { (usize::MAX, usize::MAX) } else { (CONNECTIONS, MAILBOXES) };
    let clients = &router.clients[..router.clients.len().min(most)];
    if clients.is_empty() {
        let nothing = [String::new(), "no connection has such a mailbox".into()];
        return if is_chosen { nothing.into() } else { Vec::new() };
    }
    let count = |of: &BTreeMap<String, u64>, name: &str| grouped(of.get(name).copied().unwrap_or(0));
    let column = |head: [&'static str; 2], of: &dyn Fn(&ClientShown) -> String| {
        Column::right(head, clients.iter().map(of))
    };
    let rate = |of: &ClientShown, take: fn(RatesShown) -> u64| {
        of.rates.map_or("-".into(), |rates| grouped(take(rates)))
    };
    let columns = [
        Column::left(["", "from"], clients.iter().map(|client| client.peer.clone())),
        column(["", "open"], &|client| duration(client.open_ns)),
        column(["packages", "in"], &|client| count(&client.counters, "packages_in")),
        column(["packages", "out"], &|client| count(&client.counters, "packages_out")),
        column(["packages", "lost"], &|client| grouped(lost(client))),
        column(["packages/s", "in"], &|client| rate(client, |rates| rates.packages_in_per_s)),
        column(["packages/s", "out"], &|client| rate(client, |rates| rates.packages_out_per_s)),
        column(["", "waiting"], &|client| grouped(client.waiting as u64)),
        column(["", "oldest"], &|client| client.oldest_ns.map_or("-".into(), duration)),
        Column::left(["", "mailboxes"], clients.iter().map(|client| names_of(client, most_names))),
    ];
    let mut lines = vec![String::new()];
    lines.extend(table(&columns, WIDTH));
    if router.clients.len() > clients.len() {
        lines.push(format!("... and {} more (--all shows them)", router.clients.len() - clients.len()));
    }
    lines
}

#[cfg(test)]
mod tests {
    use package_router::name::MailboxName;
    use package_router::tcp::router::{Ending, Limits, Rates, Router};
    use package_router::wire::Head;

    use super::*;

    #[test]
    fn closed_connections_and_refused_rules_are_shown() {
        let mut router = Router::new(Limits::default(), 0);
        let connection = router.connect("10.0.0.9:4000".parse().unwrap(), 0).unwrap();
        router.disconnect(connection, Ending::NoMemory, 5);
        router.refuse_rules("a.toml:3: no such key".into());
        let text = describe(&RouterShown::of("r", &[], 9, &router.status(9), None), false, false);
        for words in [
            "connections closed since its start: no memory 1; the newest first:",
            "counted since its start: rules refused 1",
            "its file was read again and has an error, so the rules before are in force: a.toml:3: no such key",
        ] {
            assert!(text.lines().any(|line| line == words), "{words}: {text}");
        }
    }

    /// A client has a package waiting, and has sent two in vain.
    #[test]
    fn status_shows_what_waits_and_what_is_lost() {
        let mut router = Router::new(Limits::default(), 0);
        let client = router.connect("10.0.0.9:4000".parse().unwrap(), 0).unwrap();
        let own = MailboxName(0x0018_0000);
        let package = |kind, to, body: &[u8]| {
            let head = Head::new(kind, MailboxName(to), if kind == 13 { MailboxName::NOBODY } else { own });
            [&head.with_body(body.len()).unwrap().to_bytes()[..], body].concat()
        };
        router.received(client, &package(13, 0, &own.0.to_le_bytes()), 0);
        router.write(client, |slices| Ok(slices.iter().map(|slice| slice.len()).sum())).unwrap();
        let all = [package(-6, 7, b""), package(-6, 8, b""), package(-6, own.0, b"1234")];
        router.received(client, &all.concat(), 1_000);
        let text = describe(&RouterShown::of("r", &[], 4_000, &router.status(4_000), None), false, false);
        let row = text.lines().find(|line| line.starts_with("10.0.0.9:4000")).unwrap();
        let figures: Vec<_> = row.split("  ").filter(|word| !word.is_empty()).map(str::trim).collect();
        assert_eq!(figures[1..], ["4s", "1", "1", "2", "-", "-", "1", "3s Pilot(0/0)"], "{text}");
    }

    #[test]
    fn rates_are_shown_for_each_connection_and_in_sum() {
        let mut router = Router::new(Limits::default(), 0);
        router.connect("10.0.0.9:4000".parse().unwrap(), 0).unwrap();
        let before = RouterShown::of("r", &[], 9, &router.status(9), None);
        assert!(before.rates.is_none() && !describe(&before, false, false).contains("a second"));
        let mut status = router.status(9);
        status.rates =
            Some(Rates { packages_in: 1, bytes_in: 2, packages_out: 30_000, bytes_out: 4_000_000 });
        status.clients[0].rates =
            Some(Rates { packages_in: 5_000, bytes_in: 6, packages_out: 70_000, bytes_out: 8 });
        let shown = RouterShown::of("r", &[], 9, &status, None);
        let text = describe(&shown, false, false);
        let sum = "30 000 packages and 4 000 000 bytes a second, mean of the last round of 5 s";
        assert!(text.lines().any(|line| line == sum), "{text}");
        let row = text.lines().find(|line| line.starts_with("10.0.0.9:4000")).unwrap();
        let figures: Vec<_> = row.split("  ").filter(|word| !word.is_empty()).map(str::trim).collect();
        assert_eq!(figures[1..], ["9ms", "0", "0", "0", "5 000", "70 000", "0", "-"], "{text}");
        let rates = shown.clients[0].rates.unwrap();
        assert_eq!((rates.bytes_in_per_s, rates.bytes_out_per_s), (6, 8));
    }
}
