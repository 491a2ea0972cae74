//! Mailboxes and packages as people see them.

use std::fmt::Write as _;
use std::net::Ipv4Addr;

use package_router::component::{MailboxSeen, SenderSeen};
use package_router::mailbox::WhenFull;
use package_router::wire::Head;
use serde::Serialize;

use crate::report::text::grouped;

#[derive(Serialize)]
pub(super) struct RouteShown {
    pub to: String,
    pub station: Ipv4Addr,
}

/// A package that came.
#[derive(Serialize)]
pub(super) struct Came {
    pub from: String,
    pub kind: i8,
    pub priority: u8,
    pub id: u8,
    pub bytes: usize,
    pub body: String,
}

impl Came {
    pub fn of(head: &Head, body: &[u8]) -> Self {
        let body_text = String::from_utf8_lossy(body).into_owned();
        let Head { kind, priority, id, from, .. } = *head;
        Self { from: from.to_string(), kind, priority, id, bytes: body.len(), body: body_text }
    }

    pub fn describe(&self) -> String {
        let Self { from, kind, priority, id, bytes, body } = self;
        let body = body.escape_debug();
        format!(
            "{from}: type {kind}, priority {priority}, id {id}, {bytes} bytes{}{body}",
            if *bytes > 0 { ": " } else { "" }
        )
    }
}

/// What questions showed.
#[derive(Serialize)]
pub(super) struct Trips {
    pub to: String,
    pub asked: u64,
    pub came: u64,
    pub min_ns: Option<u64>,
    pub p50_ns: Option<u64>,
    pub p99_ns: Option<u64>,
    pub max_ns: Option<u64>,
}

impl Trips {
    pub fn describe(&self) -> String {
        let Self { to, asked, came, .. } = self;
        let mut text = format!("{to}: {asked} asked, {came} answered\n");
        let us = |nanos: u64| nanos as f64 / 1000.0;
        if let (Some(min), Some(p50), Some(p99), Some(max)) =
            (self.min_ns, self.p50_ns, self.p99_ns, self.max_ns)
        {
            let [min, p50, p99, max] = [min, p50, p99, max].map(us);
            let _ = writeln!(text, "round trip: min {min:.1}, p50 {p50:.1}, p99 {p99:.1}, max {max:.1} us");
        }
        text
    }
}

/// A mailbox as it is shown.
#[derive(Serialize)]
pub(super) struct Shown {
    pub name: String,
    pub process: u32,
    pub slots: usize,
    pub largest_body: usize,
    pub senders_at_most: usize,
    pub replaces: bool,
    pub waiting: u64,
    pub most: u64,
    pub received: u64,
    pub cleaned: u64,
    pub forged: u64,
    pub nonsense: u64,
    pub latency_p50_ns: Option<u64>,
    pub latency_p99_ns: Option<u64>,
    pub latency_max_ns: Option<u64>,
    pub senders: Vec<SenderShown>,
}

#[derive(Serialize)]
pub(super) struct SenderShown {
    pub from: String,
    pub sent: u64,
    pub waiting: u64,
    pub full: u64,
    pub too_large: u64,
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
        let _ = writeln!(
            text,
            "  from send to receive: p50 {p50:.1}, p99 {p99:.1}, max {max:.1} us, each a quarter too long at the most"
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
