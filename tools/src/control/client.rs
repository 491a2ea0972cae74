//! The other end: one request, one reply.

use std::io::ErrorKind;
use std::net::Shutdown;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};
use package_router::name::Pattern;
use serde::Serialize;
use serde::de::DeserializeOwned;
use socket2::{Domain, SockAddr, Socket, Type};

use super::places::{Directory, Place};
use super::protocol::{Envelope, LabReply, LabRequest, LabStatus, Reply, Request, StationStatus, read};
use super::reply;
use super::router::{RouterReply, RouterRequest, RouterShown};
use super::sockets::{StackReply, StackRequest};

/// A control thread answers within milliseconds; one that does not is stopped or stuck.
const PATIENCE: Duration = Duration::from_secs(5);
/// A lab that ends waits for its stations, which may be stopped, or be closed slowly by a busy kernel.
const DOWN_WITHIN: Duration = Duration::from_secs(60);

/// Asks a station.
pub fn ask(directory: &Directory, place: &Place, request: Request) -> Result<Reply> {
    let path = directory.station(place);
    exchange(&path, request, PATIENCE)
        .map_err(|error| explain(error, "station", &place.to_string(), directory.stations()))
}

/// Puts a question to a station, whose answer may be waited for later; it is to be let in soon.
pub fn put(directory: &Directory, place: &Place, request: Request, within: Duration) -> Result<Question> {
    Question::put(&directory.station(place), request, within)
        .map_err(|error| explain(error, "station", &place.to_string(), directory.stations()))
}

/// Asks a lab.
pub fn ask_lab(directory: &Directory, lab: &str, request: LabRequest) -> Result<LabReply> {
    let path = directory.lab(lab);
    let within = if request == LabRequest::Down { DOWN_WITHIN } else { PATIENCE };
    exchange(&path, request, within).map_err(|error| {
        let explained = explain(error, "lab", lab, directory.labs());
        // It has its name before its network, and its socket only when that is up.
        match directory.keeper(lab).filter(|_| !path.exists()) {
            Some(pid) => anyhow!(
                "lab '{lab}' is coming up: ask again once it is, or end process {pid}, which is at it"
            ),
            None => explained,
        }
    })
}

/// How a station stands.
pub fn station_status(directory: &Directory, place: &Place) -> Result<StationStatus> {
    match ask(directory, place, Request::Status)? {
        Reply::Status(status) => Ok(*status),
        Reply::Refused(why) => Err(anyhow!("station '{place}': {why}")),
        _ => bail!("station '{place}' answers what it was not asked"),
    }
}

/// Asks a station about its sockets, addresses and routes.
pub fn ask_stack(directory: &Directory, place: &Place, request: StackRequest) -> Result<StackReply> {
    match ask(directory, place, Request::Stack(request))? {
        Reply::Stack(reply) => Ok(*reply),
        Reply::Refused(why) => Err(anyhow!("station '{place}': {why}")),
        _ => bail!("station '{place}' answers what it was not asked"),
    }
}

/// The status of a router, with the connections that have such a mailbox.
pub fn router_status(directory: &Directory, name: &str, mailbox: Option<Pattern>) -> Result<RouterShown> {
    let request = mailbox.map_or(RouterRequest::Status, |of| RouterRequest::StatusOf(of.to_string()));
    let reply = exchange(&directory.router(name), request, PATIENCE);
    match reply.map_err(|error| explain(error, "router", name, Vec::new()))? {
        RouterReply::Status(shown) => Ok(*shown),
        RouterReply::Refused(why) => Err(anyhow!("router '{name}': {why}")),
    }
}

/// How a lab goes.
pub fn lab_status(directory: &Directory, lab: &str) -> Result<LabStatus> {
    match ask_lab(directory, lab, LabRequest::Status)? {
        LabReply::Status(status) => Ok(*status),
        LabReply::Refused(why) => Err(anyhow!("lab '{lab}': {why}")),
        _ => bail!("lab '{lab}' answers what it was not asked"),
    }
}

/// Says what there is instead of what does not exist.
fn explain(error: anyhow::Error, what: &str, name: &str, mut instead: Vec<String>) -> anyhow::Error {
    let Some(kind) = error.downcast_ref::<std::io::Error>().map(std::io::Error::kind) else {
        return error.context(format!("{what} '{name}'"));
    };
    instead.retain(|other| other != name);
    let there = match instead.as_slice() {
        [] => "none runs here".to_owned(),
        some => format!("there is {}", some.join(", ")),
    };
    match kind {
        ErrorKind::NotFound => anyhow!("there is no {what} '{name}': {there}"),
        ErrorKind::ConnectionRefused => anyhow!("{what} '{name}' does not run any more: {there}"),
        ErrorKind::PermissionDenied => {
            anyhow!("{what} '{name}' belongs to another user: ask as the one who started it")
        }
        ErrorKind::WouldBlock | ErrorKind::TimedOut => {
            anyhow!(
                "{what} '{name}' has not answered in time: its process, or one it waits for, is stopped; what was asked is taken back"
            )
        }
        ErrorKind::ConnectionReset => {
            anyhow!("{what} '{name}' hung up: it has ended, or has too many clients; ask again")
        }
        _ => error.context(format!("{what} '{name}'")),
    }
}

fn exchange<A: Serialize, B: DeserializeOwned>(path: &Path, request: A, within: Duration) -> Result<B> {
    let reply = Question::put(path, request, within)?.answer(within)?;
    reply.ok_or_else(|| std::io::Error::from(ErrorKind::TimedOut).into())
}

/// What a read says that would have to wait, or was disturbed by a signal.
const NOT_YET: [ErrorKind; 3] = [ErrorKind::WouldBlock, ErrorKind::TimedOut, ErrorKind::Interrupted];

/// A request that was sent. Once it is dropped, or taken back, nobody begins with it any more.
pub struct Question {
    connection: Socket,
}

impl Question {
    /// Sends a request, as soon as there is room for it.
    pub fn put(path: &Path, request: impl Serialize, within: Duration) -> Result<Self> {
        let connection = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
        connection.set_write_timeout(Some(within))?;
        connection.connect(&SockAddr::unix(path)?)?;
        connection.send_with_flags(&Envelope::pack(request), nix::libc::MSG_NOSIGNAL)?;
        Ok(Self { connection })
    }

    /// The answer, if it comes in time.
    pub fn answer<B: DeserializeOwned>(&mut self, within: Duration) -> Result<Option<B>> {
        // A timeout of 0 would be for ever.
        self.connection.set_read_timeout(Some(within.max(Duration::from_micros(1))))?;
        match reply::receive(&self.connection) {
            Err(error) if NOT_YET.contains(&error.kind()) => Ok(None),
            Err(error) => Err(error.into()),
            Ok(reply) if reply.is_empty() => bail!(std::io::Error::from(ErrorKind::ConnectionReset)),
            Ok(reply) => read(&reply).map_err(|error| anyhow!(error)).context("its reply").map(Some),
        }
    }

    /// Takes the request back, if nobody has begun with it. The answer, which is still to come, tells.
    pub fn take_back(&self) {
        // Fails only where the other end has hung up, which the answer tells, too.
        let _ = self.connection.shutdown(Shutdown::Write);
    }
}
