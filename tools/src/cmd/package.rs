//! `rtnet mailbox` and `rtnet package`.

mod bench;
mod counts;
mod shown;
mod way;
mod ways;

use std::io::Write as _;
use std::net::Ipv4Addr;
use std::time::Duration;

use anyhow::{Context, anyhow};
use package_router::component::{
    Component, Error, Mailbox, MailboxSeen, ReceiveError, Sender, Times, socket_of,
};
use package_router::mailbox::{LARGEST_BODY, Shape};
use package_router::name::{MailboxName, Pattern};
use package_router::route::Route;
use package_router::wire::{Head, OK};

use super::Failure;
use super::interface::{asked, unasked};
use super::tdma::found_of;
use crate::cli::{
    MailboxArgs, MailboxVerb, PackageRouteVerb, PackageVerb, PackageVerbArgs, WhichOf, duration,
};
use crate::control::{Directory, StackReply, StackRequest, TcpShown};
use crate::report::document::{Document, Documents};
use counts::Counts;
use shown::{Came, RouteShown, Shown, Trips, list, stat, watched};
use way::Way;
use ways::{WayName, WayShown};

/// Slots of a mailbox that somebody looks into by hand.
const SLOTS: usize = 64;
/// Its largest body: a package of one frame; `receive` says what to do about longer ones.
const BODY: usize = 4096;

/// The connection of a station's packages to its TCP router.
fn connection(which: &WhichOf) -> Result<Option<TcpShown>, Failure> {
    let which = found_of(which)?;
    match asked(&which, StackRequest::Counters)? {
        StackReply::Counters(shown) => Ok(shown.tcp),
        _ => Err(unasked(&which)),
    }
}

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
    let (component, json) = (attach(&args.which)?, args.which.json);
    match &args.verb {
        MailboxVerb::List => {
            super::print_all(json, &looked_at(&component, None)?, list).map_err(Failure::Run)?;
        }
        MailboxVerb::Stat { name } => {
            let rows = looked_at(&component, *name)?;
            super::print_all(json, &rows, |rows| rows.iter().map(stat).collect()).map_err(Failure::Run)?;
        }
        MailboxVerb::Watch { name, every, count } => {
            let mut before = looked_at(&component, *name)?;
            for _ in 0..count.unwrap_or(u64::MAX) {
                std::thread::sleep(duration(*every));
                let rows = looked_at(&component, *name)?;
                let text = match json {
                    true => super::in_line(&Documents(&rows))?,
                    false => rows.iter().map(|row| watched(row, &before)).collect(),
                };
                super::say(&text).map_err(Failure::Run)?;
                before = rows;
            }
        }
    }
    Ok(0)
}

/// All mailboxes, or one that is there.
fn looked_at(component: &Component, name: Option<MailboxName>) -> Result<Vec<Shown>, Failure> {
    let seen = component.mailboxes().map_err(run)?;
    let is_meant = |seen: &&MailboxSeen| name.is_none_or(|name| seen.name == name);
    let rows: Vec<_> = seen.iter().filter(is_meant).map(Shown::of).collect();
    match name.filter(|_| rows.is_empty()) {
        Some(name) => {
            let what = format!("{name} is no mailbox of this station: see `rtnet mailbox list`");
            Err(Failure::Usage(anyhow!(what)))
        }
        None => Ok(rows),
    }
}

/// Sends and receives packages, and says where they go.
pub fn package(args: &PackageVerbArgs) -> Result<u8, Failure> {
    let component = attach(&args.which)?;
    let json = args.which.json;
    match &args.verb {
        PackageVerb::Send { to, body, kind, priority, from } => {
            let Way { mailbox: _mailbox, mut sender } = Way::of(&component, *from, *to, 1)?;
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
        PackageVerb::Receive { name, count, timeout, echo, quiet } => {
            let mut mailbox = component.mailbox(*name, Shape::new(SLOTS, BODY)).map_err(usage)?;
            let counts = Counts::of(*quiet, json).map_err(Failure::Run)?;
            let (count, timeout) = (count.unwrap_or(u64::MAX), timeout.map(duration));
            let receiving = Receiving { count, timeout, echo: *echo, json };
            return receive(&mut mailbox, &component.times(), &receiving, counts);
        }
        PackageVerb::Bench(bench) => return bench::bench(&component, &args.which, bench),
        PackageVerb::Ping { to, count, interval, size, timeout, from } => {
            check_size(*size)?;
            let mut way = Way::of(&component, *from, *to, *size)?;
            let told = ping(&mut way, *count, (duration(*interval), duration(*timeout)), *size)?;
            super::print(json, &told, Trips::describe).map_err(Failure::Run)?;
            return Ok(u8::from(told.came == 0));
        }
        PackageVerb::Route { name: Some(name), verb: None } => {
            let shown = WayShown::of(*name, component.way(*name), || connection(&args.which))?;
            super::print(json, &shown, WayShown::describe).map_err(Failure::Run)?;
            return Ok(u8::from(shown.way == WayName::None));
        }
        PackageVerb::Route { name: None, verb: None } => {
            let routes = component.routes().map_err(run)?;
            let routes: Vec<_> = routes
                .iter()
                .map(|Route { to, station }| RouteShown { to: to.to_string(), station: *station })
                .collect();
            super::print_all(json, &routes, |routes| {
                routes.iter().map(|route| format!("{}={}\n", route.to, route.station)).collect()
            })
            .map_err(Failure::Run)?;
        }
        PackageVerb::Route { verb: Some(PackageRouteVerb::Add { route: (to, station) }), .. } => {
            component.add_route(*to, *station).map_err(usage)?;
        }
        PackageVerb::Route { verb: Some(PackageRouteVerb::Delete { to }), .. } => {
            component.delete_route(*to).map_err(usage)?
        }
    }
    Ok(0)
}

fn attach(which: &WhichOf) -> Result<Component, Failure> {
    let place = found_of(which)?.place;
    let control = Directory::of_user().map_err(Failure::Usage)?.station(&place);
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

fn check_size(size: usize) -> Result<(), Failure> {
    if size > LARGEST_BODY {
        let what = format!("a body of {size} bytes: a package carries {LARGEST_BODY} at the most");
        return Err(Failure::Usage(anyhow!(what)));
    }
    Ok(())
}

/// What `receive` is to do.
struct Receiving {
    count: u64,
    timeout: Option<Duration>,
    echo: bool,
    json: bool,
}

fn receive(
    mailbox: &mut Mailbox,
    times: &Times,
    receiving: &Receiving,
    mut counts: Counts,
) -> Result<u8, Failure> {
    let Receiving { count, timeout, echo, json } = *receiving;
    let mut answers: Vec<Sender> = Vec::new();
    for _ in 0..count {
        let package = match mailbox.receive(timeout) {
            Ok(package) => package,
            Err(ReceiveError::TimedOut) => {
                counts.tell().map_err(Failure::Run)?;
                return Ok(1);
            }
            Err(error) => return Err(Failure::Run(anyhow!(error))),
        };
        let (head, body, journey) = (*package.head(), package.body().to_vec(), times.journey(&package));
        drop(package);
        counts.note(&head, body.len());
        if echo && head.is_command() {
            // One that cannot be answered is shown all the same.
            if let Some(sender) = answer_to(mailbox, &mut answers, head.from) {
                let told = counts.answer(&head);
                let sent = sender.send_with(&head.answer(OK), told.as_deref().unwrap_or(&body));
                counts.note_answer(sent.is_ok());
            }
        }
        if counts.is_quiet() {
            continue;
        }
        let came = Came::of(&head, &body, &journey);
        let line = if json { super::in_line(&Document::of(&came))? } else { came.describe() + "\n" };
        let mut out = std::io::stdout().lock();
        out.write_all(line.as_bytes())
            .and_then(|()| out.flush())
            .context("standard output")
            .map_err(Failure::Run)?;
    }
    counts.tell().map_err(Failure::Run)?;
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
    way: &mut Way,
    count: u64,
    (interval, timeout): (Duration, Duration),
    size: usize,
) -> Result<Trips, Failure> {
    let (body, mut times) = (vec![0x55; size], Vec::new());
    for n in 0..count {
        if n > 0 {
            std::thread::sleep(interval);
        }
        let told = way.ask(1, &body, timeout)?;
        times.extend(told.map(|told| told.took.as_nanos() as u64));
    }
    times.sort_unstable();
    let quantile =
        |share: f64| times.get(((share * times.len() as f64).ceil() as usize).saturating_sub(1)).copied();
    Ok(Trips {
        to: way.sender.to().to_string(),
        asked: count,
        came: times.len() as u64,
        min_ns: times.first().copied(),
        p50_ns: quantile(0.5),
        p99_ns: quantile(0.99),
        max_ns: times.last().copied(),
    })
}
