//! Mailboxes and packages as people see them.

use std::fmt::Write as _;
use std::net::Ipv4Addr;

use package_router::component::{MailboxSeen, SenderSeen};
use package_router::journey::Journey;
use package_router::mailbox::WhenFull;
use package_router::wire::Head;
use rtnet::time::{GlobalTime, Span};
use serde::Serialize;

use crate::report::document::document;
use crate::report::text::grouped;

#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct RouteShown {
    /// The mailbox, or all of a kind.
    pub to: String,
    /// The address of the station that has it.
    pub station: Ipv4Addr,
}

document!(RouteShown, "package-route", package_route_has_its_schema);

/// A package that came.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct Came {
    /// The mailbox that sent it.
    pub from: String,
    /// A document's kind is another thing.
    #[serde(rename = "type")]
    pub kind: i8,
    /// How urgent it is: larger is more.
    pub priority: u8,
    /// As the sender numbered it.
    pub id: u8,
    /// Length of its body.
    pub bytes: usize,
    /// The body, as UTF-8.
    pub body: String,
    /// In global time; unknown where nobody says so.
    pub sent_ns: Option<u64>,
    /// The last of it left the station of the sender.
    pub left_ns: Option<u64>,
    /// The last of it came to this station.
    pub came_ns: Option<u64>,
    /// It was in the mailbox.
    pub delivered_ns: Option<u64>,
    /// It was received.
    pub received_ns: Option<u64>,
    /// How old it was when it was received, and where that time went.
    pub age_ns: Option<i64>,
    /// From `sent_ns` to `left_ns`.
    pub slot_wait_ns: Option<i64>,
    /// From `left_ns` to `came_ns`.
    pub wire_ns: Option<i64>,
    /// From `came_ns` to `delivered_ns`.
    pub router_ns: Option<i64>,
    /// From `delivered_ns` to `received_ns`.
    pub mailbox_ns: i64,
}

document!(Came, "package", package_has_its_schema);

impl Came {
    pub fn of(head: &Head, body: &[u8], journey: &Journey) -> Self {
        let body_text = String::from_utf8_lossy(body).into_owned();
        let Head { kind, priority, id, from, .. } = *head;
        let (at, span) =
            (|at: Option<GlobalTime>| at.map(GlobalTime::nanos), |span: Option<Span>| span.map(Span::nanos));
        Self {
            from: from.to_string(),
            kind,
            priority,
            id,
            bytes: body.len(),
            body: body_text,
            sent_ns: at(journey.sent),
            left_ns: at(journey.left),
            came_ns: at(journey.came),
            delivered_ns: at(journey.delivered),
            received_ns: at(journey.received),
            age_ns: span(journey.age()),
            slot_wait_ns: span(journey.slot_wait()),
            wire_ns: span(journey.wire()),
            router_ns: span(journey.router()),
            mailbox_ns: journey.mailbox.nanos(),
        }
    }

    pub fn describe(&self) -> String {
        let Self { from, kind, priority, id, bytes, body, .. } = self;
        let body = body.escape_debug();
        format!(
            "{from}: type {kind}, priority {priority}, id {id}, {bytes} bytes{}{body}\n  {}",
            if *bytes > 0 { ": " } else { "" },
            self.journey()
        )
    }

    /// How old it is, and where the time went, as far as that is known.
    fn journey(&self) -> String {
        let age = self.age_ns.map_or("of unknown age".into(), |age| format!("{} old", us(age)));
        let parts = [
            ("waited for its slot", self.slot_wait_ns),
            ("on the wire", self.wire_ns),
            ("in the router", self.router_ns),
            ("in the mailbox", Some(self.mailbox_ns)),
        ];
        let parts: Vec<_> =
            parts.iter().filter_map(|(what, span)| span.map(|span| format!("{what} {}", us(span)))).collect();
        format!("{age}: {}", parts.join(", "))
    }
}

fn us(nanos: i64) -> String {
    format!("{:.1} us", nanos as f64 / 1000.0)
}

/// What questions showed.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct Trips {
    /// The mailbox that was asked.
    pub to: String,
    /// Questions.
    pub asked: u64,
    /// Answers.
    pub came: u64,
    /// From asking until the answer came: the shortest of all answers.
    pub min_ns: Option<u64>,
    /// The same, median.
    pub p50_ns: Option<u64>,
    /// The same, 99th percentile.
    pub p99_ns: Option<u64>,
    /// The same, the longest.
    pub max_ns: Option<u64>,
}

document!(Trips, "package-ping", package_ping_has_its_schema);

impl Trips {
    pub fn describe(&self) -> String {
        let Self { to, asked, came, .. } = self;
        let mut text = format!("{to}: {asked} asked, {came} answered\n");
        let us = |nanos: u64| nanos as f64 / 1000.0;
        if let (Some(min), Some(p50), Some(p99), Some(max)) =
            (self.min_ns, self.p50_ns, self.p99_ns, self.max_ns)
        {
            let [min, p50, p99, max] = [min, p50, p99, max].map(us);
            let _ = writeln!(
                text,
                "round trip: min {min:.1}, p50 {p50:.1}, p99 {p99:.1}, max {max:.1} us; n {came}, {} more without",
                asked - came
            );
        }
        text
    }
}

/// A mailbox as it is shown.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct Shown {
    /// Its name.
    pub name: String,
    /// The process that has it.
    pub process: u32,
    /// Packages that each sender may have waiting.
    pub slots: usize,
    /// Bytes of the longest body that a slot holds.
    pub largest_body: usize,
    /// Senders that it has room for.
    pub senders_at_most: usize,
    /// Whether a package of a full sender takes the place of its oldest; else it is refused.
    pub replaces: bool,
    /// Packages that wait now.
    pub waiting: u64,
    /// The most that ever waited.
    pub most: u64,
    /// Packages that were received.
    pub received: u64,
    /// Packages that were removed unread.
    pub cleaned: u64,
    /// Packages refused since they named another sender.
    pub forged: u64,
    /// Packages refused since they could not be read, and senders that wrote what cannot be read.
    pub nonsense: u64,
    /// How many packages were timed from send to receive: those that were received.
    pub latency_n: u64,
    /// From send to receive: median.
    pub latency_p50_ns: Option<u64>,
    /// The same, 99th percentile.
    pub latency_p99_ns: Option<u64>,
    /// The same, the longest.
    pub latency_max_ns: Option<u64>,
    /// Each sender.
    pub senders: Vec<SenderShown>,
}

document!(Shown, "mailbox", mailbox_has_its_schema);

#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub(super) struct SenderShown {
    /// Its name.
    pub from: String,
    /// Packages that it sent.
    pub sent: u64,
    /// Those of them that wait now.
    pub waiting: u64,
    /// Packages refused since all its slots were full.
    pub full: u64,
    /// Packages refused since no slot holds them.
    pub too_large: u64,
    /// Packages that newer ones replaced, unread.
    pub replaced: u64,
}

impl Shown {
    pub fn of(seen: &MailboxSeen) -> Self {
        let sender = |seen: &SenderSeen| SenderShown {
            from: seen.from.to_string(),
            sent: seen.sent,
            waiting: seen.waiting,
            full: seen.full,
            too_large: seen.too_large,
            replaced: seen.replaced,
        };
        Self {
            name: seen.name.to_string(),
            process: seen.process,
            slots: seen.shape.slots,
            largest_body: seen.shape.largest_body,
            senders_at_most: seen.shape.senders,
            replaces: seen.shape.when_full == WhenFull::Replace,
            waiting: seen.senders.iter().map(|sender| sender.waiting).sum(),
            most: seen.most,
            received: seen.received,
            cleaned: seen.cleaned,
            forged: seen.forged,
            nonsense: seen.nonsense,
            latency_n: seen.latencies.count(),
            latency_p50_ns: seen.latencies.quantile(0.5),
            latency_p99_ns: seen.latencies.quantile(0.99),
            latency_max_ns: seen.latencies.quantile(1.0),
            senders: seen.senders.iter().map(sender).collect(),
        }
    }
}

pub(super) fn list(rows: &[Shown]) -> String {
    if rows.is_empty() {
        return "no mailbox\n".into();
    }
    let row = |row: &Shown| {
        let Shown { name, process, slots, largest_body, senders, senders_at_most, waiting, .. } = row;
        format!(
            "{name}: process {process}, {slots} slots of {largest_body} bytes for each of {} senders of {senders_at_most}; {waiting} wait\n",
            senders.len()
        )
    };
    rows.iter().map(row).collect()
}

/// What has come of a mailbox since it was last looked at.
pub(super) fn watched(row: &Shown, before: &[Shown]) -> String {
    let refused =
        |row: &Shown| -> u64 { row.senders.iter().map(|sender| sender.full + sender.too_large).sum() };
    let last = before.iter().find(|last| last.name == row.name && last.process == row.process);
    let more = |of: &dyn Fn(&Shown) -> u64| grouped(of(row).saturating_sub(last.map_or(0, of)));
    let (received, refused) = (more(&|row| row.received), more(&refused));
    format!(
        "{}: {received} received, {refused} refused; {} wait, {} at the most\n",
        row.name, row.waiting, row.most
    )
}

pub(super) fn stat(row: &Shown) -> String {
    let mut text = list(std::slice::from_ref(row));
    let Shown { received, cleaned, most, forged, nonsense, .. } = row;
    let [received, cleaned, most, forged, nonsense] =
        [received, cleaned, most, forged, nonsense].map(|n| grouped(*n));
    let _ = writeln!(
        text,
        "  received {received}, cleaned {cleaned}, at most {most} waited; forged {forged}, nonsense {nonsense}"
    );
    if let (Some(p50), Some(p99), Some(max)) = (row.latency_p50_ns, row.latency_p99_ns, row.latency_max_ns) {
        let [p50, p99, max] = [p50, p99, max].map(|nanos| nanos as f64 / 1000.0);
        let replaced = row.senders.iter().map(|sender| sender.replaced).sum::<u64>();
        let _ = writeln!(
            text,
            "  from send to receive: p50 {p50:.1}, p99 {p99:.1}, max {max:.1} us, each a quarter too long at the most; n {}, {} more \
             cleaned, replaced or waiting",
            grouped(row.latency_n),
            grouped(row.cleaned + row.waiting + replaced)
        );
    }
    for sender in &row.senders {
        let SenderShown { from, sent, waiting, full, too_large, replaced } = sender;
        let [sent, full, too_large, replaced] = [sent, full, too_large, replaced].map(|n| grouped(*n));
        let _ = writeln!(
            text,
            "  {from}: sent {sent}, {waiting} wait; refused: full {full}, too large {too_large}; replaced {replaced}"
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use package_router::mailbox::{Origin, Stamps};

    fn shown(origin: Origin, left: Option<u64>, came: Option<u64>) -> Came {
        let at = |nanos: u64| GlobalTime::from_nanos(nanos);
        let stamps = Stamps { sent: 5, origin, left: left.map(at), came: came.map(at) };
        let head =
            Head { kind: 21, priority: 9, id: 3, from: "0.Pilot.0".parse().unwrap(), ..Head::default() };
        Came::of(&head, b"go", &Journey::of(&stamps, 4_000, Some([at(1_900_000), at(1_904_000)])))
    }

    #[test]
    fn questions_say_how_many_round_trips_are_without_a_time() {
        let [min_ns, p50_ns, p99_ns, max_ns] = [7_000; 4].map(Some);
        let trips = Trips { to: "Camera(0/0)".into(), asked: 3, came: 1, min_ns, p50_ns, p99_ns, max_ns };
        let words = "Camera(0/0): 3 asked, 1 answered\n\
                     round trip: min 7.0, p50 7.0, p99 7.0, max 7.0 us; n 1, 2 more without\n";
        assert_eq!(trips.describe(), words);
    }

    #[test]
    fn packages_of_a_mailbox_that_are_without_a_time_are_counted() {
        let sender = |replaced| SenderShown {
            from: "Pilot(0/0)".into(),
            sent: 10,
            waiting: 1,
            full: 0,
            too_large: 0,
            replaced,
        };
        let row = Shown {
            name: "Camera(0/0)".into(),
            process: 7,
            slots: 4,
            largest_body: 64,
            senders_at_most: 2,
            replaces: true,
            waiting: 2,
            most: 4,
            received: 11,
            cleaned: 2,
            forged: 0,
            nonsense: 0,
            latency_n: 11,
            latency_p50_ns: Some(1_000),
            latency_p99_ns: Some(2_000),
            latency_max_ns: Some(3_000),
            senders: vec![sender(2), sender(3)],
        };
        let text = stat(&row);
        assert!(text.contains("; n 11, 9 more cleaned, replaced or waiting\n"), "of 20 sent: {text}");
    }

    #[test]
    fn a_package_tells_its_age_and_where_the_time_went_as_far_as_that_is_known() {
        let sent = Origin::Elsewhere(Some(GlobalTime::from_nanos(1_000_000)));
        let whole = shown(sent, Some(1_750_500), Some(1_780_000));
        assert_eq!(
            whole.describe(),
            "Pilot(0/0): type 21, priority 9, id 3, 2 bytes: go\n  904.0 us old: waited for its slot 750.5 us, \
             on the wire 29.5 us, in the router 120.0 us, in the mailbox 4.0 us"
        );
        let unknown = shown(Origin::Elsewhere(None), None, Some(1_780_000)).describe();
        assert!(
            unknown.ends_with("\n  of unknown age: in the router 120.0 us, in the mailbox 4.0 us"),
            "{unknown}"
        );
        let here = shown(Origin::Here, None, None).describe();
        assert!(here.ends_with("\n  4.0 us old: in the mailbox 4.0 us"), "{here}");
        let json = serde_json::to_value(&whole).unwrap();
        assert_eq!(
            (&json["age_ns"], &json["slot_wait_ns"], &json["left_ns"]),
            (&904_000.into(), &750_500.into(), &1_750_500.into())
        );
    }
}
