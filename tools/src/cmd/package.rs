//! `rtnet mailbox` and `rtnet package`.

use std::fmt::Write as _;
use std::io::Write as _;
use std::net::Ipv4Addr;
use std::time::Instant;

use anyhow::{Context, anyhow};
use package_router::component::{
    Component, Error, Mailbox, MailboxSeen, ReceiveError, Sender, SenderSeen, socket_of,
};
use package_router::mailbox::{LARGEST_BODY, Shape};
use package_router::name::{MailboxName, Pattern};
use package_router::route::Route;
use package_router::wire::{Head, NOT_AVAILABLE};
use serde::Serialize;

use super::Failure;
use super::tdma::found_of;
use crate::cli::{
    MailboxArgs, MailboxVerb, PackageRouteVerb, PackageVerb, PackageVerbArgs, WhichOf, duration,
};
use crate::control::Directory;
use crate::report::text::grouped;

/// Slots of a mailbox that somebody looks into by hand.
const SLOTS: usize = 64;
/// Its largest body: a package of one frame; `receive` says what to do about longer ones.
const BODY: usize = 4096;

/// Reads `PATTERN=IP`.
pub fn parse_route(text: &str) -> Result<(Pattern, Ipv4Addr), String> {
    let (to, station) = text.split_once('=').ok_or_else(|| {
        format!("'{text}' is no route: write mailboxes and a station, as 0.Pilot.*=10.0.0.3")
    })?;
    let to = to.parse::<Pattern>().map_err(|error| error.to_string())?;
    let station =
        station.parse().map_err(|_| format!("'{station}' is no IPv4 address: write one, as 10.0.0.3"))?;
    Ok((to, station))
}

/// Looks at the mailboxes of a station.
pub fn mailbox(args: &MailboxArgs) -> Result<u8, Failure> {
    let seen = attach(&args.which)?.mailboxes().map_err(run)?;
    match &args.verb {
        MailboxVerb::List => {
            let rows: Vec<_> = seen.iter().map(Shown::of).collect();
            super::print(args.which.json, &rows, |rows| list(rows)).map_err(Failure::Run)?;
        }
        MailboxVerb::Stat { name } => {
            let rows: Vec<_> =
                seen.iter().filter(|seen| name.is_none_or(|name| seen.name == name)).map(Shown::of).collect();
            if let (Some(name), true) = (name, rows.is_empty()) {
                return Err(Failure::Usage(anyhow!(
                    "{name} is no mailbox of this station: see `rtnet mailbox list`"
                )));
            }
            super::print(args.which.json, &rows, |rows| rows.iter().map(stat).collect())
                .map_err(Failure::Run)?;
        }
    }
    Ok(0)
}

/// Sends and receives packages, and says where they go.
pub fn package(args: &PackageVerbArgs) -> Result<u8, Failure> {
    let component = attach(&args.which)?;
    let json = args.which.json;
    match &args.verb {
        PackageVerb::Send { to, body, kind, priority, from } => {
            let (_mailbox, mut sender) = way(&component, *from, *to, 1)?;
            let head =
                Head { kind: *kind, priority: priority.unwrap_or(sender.priority()), ..Head::default() };
            sender
                .send_with(&head, body.as_bytes())
                .map_err(|error| Failure::Run(anyhow!("{to}: {error}")))?;
            // What a station takes it sends in its next turn, as long as its socket is there.
            if !sender.is_here() {
                sender.drained().map_err(|error| Failure::Run(anyhow!("{to}: {error}")))?;
            }
        }
        PackageVerb::Receive { name, count, timeout, echo } => {
            let mut mailbox = component.mailbox(*name, Shape::new(SLOTS, BODY)).map_err(usage)?;
            return receive(&mut mailbox, count.unwrap_or(u64::MAX), timeout.map(duration), *echo, json);
        }
        PackageVerb::Ping { to, count, interval, size, timeout, from } => {
            if *size > LARGEST_BODY {
                return Err(Failure::Usage(anyhow!(
                    "a body of {size} bytes: a package carries {LARGEST_BODY} at the most"
                )));
            }
            let (mut mailbox, mut sender) = way(&component, *from, *to, *size)?;
            let told =
                ping(&mut mailbox, &mut sender, *count, (duration(*interval), duration(*timeout)), *size)?;
            super::print(json, &told, Trips::describe).map_err(Failure::Run)?;
            return Ok(u8::from(told.came == 0));
        }
        PackageVerb::Route { verb: None } => {
            let routes = component.routes().map_err(run)?;
            let routes: Vec<_> = routes
                .iter()
                .map(|Route { to, station }| RouteShown { to: to.to_string(), station: *station })
                .collect();
            super::print(json, &routes, |routes| {
                routes.iter().map(|route| format!("{}={}\n", route.to, route.station)).collect()
            })
            .map_err(Failure::Run)?;
        }
        PackageVerb::Route { verb: Some(PackageRouteVerb::Add { route: (to, station) }) } => {
            component.add_route(*to, *station).map_err(usage)?;
        }
        PackageVerb::Route { verb: Some(PackageRouteVerb::Delete { to }) } => {
            component.delete_route(*to).map_err(usage)?
        }
    }
    Ok(0)
}

fn attach(which: &WhichOf) -> Result<Component, Failure> {
    let place = found_of(which)?.place;
    let control = Directory::of_user().station(&place);
    Component::attach(&socket_of(&control)).map_err(|error| match &error {
        Error::Io(why)
            if matches!(why.kind(), std::io::ErrorKind::NotFound | std::io::ErrorKind::ConnectionRefused) =>
        {
            Failure::Usage(anyhow!(
                "station '{place}' has no packages: start it with --packages, or a lab with packages = true"
            ))
        }
        _ => Failure::Usage(anyhow!("station '{place}': {error}")),
    })
}

fn usage(error: Error) -> Failure {
    Failure::Usage(anyhow!(error))
}

fn run(error: Error) -> Failure {
    Failure::Run(anyhow!(error))
}

/// A mailbox for a while, and a way from there to another.
fn way(
    component: &Component,
    from: MailboxName,
    to: MailboxName,
    body: usize,
) -> Result<(Mailbox, Sender), Failure> {
    let mailbox = component.mailbox(from, Shape::new(8, body)).map_err(usage)?;
    let sender = mailbox.sender(to).map_err(usage)?;
    Ok((mailbox, sender))
}

fn receive(
    mailbox: &mut Mailbox,
    count: u64,
    timeout: Option<std::time::Duration>,
    echo: bool,
    json: bool,
) -> Result<u8, Failure> {
    let mut answers: Vec<Sender> = Vec::new();
    for _ in 0..count {
        let package = match mailbox.receive(timeout) {
            Ok(package) => package,
            Err(ReceiveError::TimedOut) => return Ok(1),
            Err(error) => return Err(Failure::Run(anyhow!(error))),
        };
        let (head, body) = (*package.head(), package.body().to_vec());
        drop(package);
        if echo && head.is_command() {
            // One that cannot be answered is shown all the same.
            if let Some(sender) = answer_to(mailbox, &mut answers, head.from) {
                let _ = sender.send_with(&head.answer(0), &body);
            }
        }
        let came = Came::of(&head, &body);
        let line = if json {
            serde_json::to_string(&came).context("JSON").map_err(Failure::Run)?
        } else {
            came.describe()
        };
        let mut out = std::io::stdout().lock();
        writeln!(out, "{line}")
            .and_then(|()| out.flush())
            .context("standard output")
            .map_err(Failure::Run)?;
    }
    Ok(0)
}

/// Who asks is bound to once.
fn answer_to<'a>(mailbox: &Mailbox, answers: &'a mut Vec<Sender>, to: MailboxName) -> Option<&'a mut Sender> {
    if !answers.iter_mut().any(|sender| sender.to() == to && sender.follow().is_ok()) {
        answers.retain(|sender| sender.to() != to);
        answers.push(mailbox.sender(to).ok()?);
    }
    answers.iter_mut().find(|sender| sender.to() == to)
}

fn ping(
    mailbox: &mut Mailbox,
    sender: &mut Sender,
    count: u64,
    (interval, timeout): (std::time::Duration, std::time::Duration),
    size: usize,
) -> Result<Trips, Failure> {
    let (body, mut times) = (vec![0x55; size], Vec::new());
    for n in 0..count {
        if n > 0 {
            std::thread::sleep(interval);
        }
        let begun = Instant::now();
        let id = sender.send(1, &body).map_err(|error| Failure::Run(anyhow!("{}: {error}", sender.to())))?;
        while let Some(left) = timeout.checked_sub(begun.elapsed()) {
            let head = match mailbox.receive(Some(left)) {
                Ok(package) => *package.head(),
                Err(ReceiveError::TimedOut) => break,
                Err(error) => return Err(Failure::Run(anyhow!(error))),
            };
            // One to an earlier question is too late.
            if head.id == id && head.from == sender.to() {
                if head.kind == NOT_AVAILABLE {
                    return Err(Failure::Run(anyhow!("{} is not there: its station says so", sender.to())));
                }
                times.push(begun.elapsed().as_nanos() as u64);
                break;
            }
        }
    }
    times.sort_unstable();
    let quantile =
        |share: f64| times.get(((share * times.len() as f64).ceil() as usize).saturating_sub(1)).copied();
    Ok(Trips {
        to: sender.to().to_string(),
        asked: count,
        came: times.len() as u64,
        min_ns: times.first().copied(),
        p50_ns: quantile(0.5),
        p99_ns: quantile(0.99),
        max_ns: times.last().copied(),
    })
}

#[derive(Serialize)]
struct RouteShown {
    to: String,
    station: Ipv4Addr,
}

/// A package that came.
#[derive(Serialize)]
struct Came {
    from: String,
    kind: i8,
    priority: u8,
    id: u8,
    bytes: usize,
    body: String,
}

impl Came {
    fn of(head: &Head, body: &[u8]) -> Self {
        let body_text = String::from_utf8_lossy(body).into_owned();
        let Head { kind, priority, id, from, .. } = *head;
        Self { from: from.to_string(), kind, priority, id, bytes: body.len(), body: body_text }
    }

    fn describe(&self) -> String {
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
struct Trips {
    to: String,
    asked: u64,
    came: u64,
    min_ns: Option<u64>,
    p50_ns: Option<u64>,
    p99_ns: Option<u64>,
    max_ns: Option<u64>,
}

impl Trips {
    fn describe(&self) -> String {
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
struct Shown {
    name: String,
    process: u32,
    slots: usize,
    largest_body: usize,
    senders_at_most: usize,
    replaces: bool,
    waiting: u64,
    most: u64,
    received: u64,
    cleaned: u64,
    forged: u64,
    nonsense: u64,
    latency_p50_ns: Option<u64>,
    latency_p99_ns: Option<u64>,
    latency_max_ns: Option<u64>,
    senders: Vec<SenderShown>,
}

#[derive(Serialize)]
struct SenderShown {
    from: String,
    sent: u64,
    waiting: u64,
    full: u64,
    too_large: u64,
    replaced: u64,
}

impl Shown {
    fn of(seen: &MailboxSeen) -> Self {
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
            replaces: seen.shape.when_full == package_router::mailbox::WhenFull::Replace,
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

fn list(rows: &[Shown]) -> String {
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

fn stat(row: &Shown) -> String {
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
