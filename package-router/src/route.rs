//! Where on the LAN a mailbox is: static routes, from one file for all stations (paper 3.2).
//!
//! ```text
//! to Pilot(0/1).3 ─► 0.Pilot.1.3   10.0.0.2     the most specific that matches, and no other:
//!                    0.Pilot.1     10.0.0.3     names before patterns, places further left before those right
//!                    0.*.*         10.0.0.4
//!                    no route, or one to this station itself ─► the next layer
//! to Pilot(1/1)      of another system than the station's: no route leads there ─► the next layer
//! ```
//!
//! An entry that leads to the station that reads it leads nowhere there, so that all can have the same file; it still keeps what
//! it names from a less specific one, which would lead away.
//!
//! ```
//! use core::net::Ipv4Addr;
//! use package_router::route::{Own, Routes};
//!
//! let own = Own { station: Ipv4Addr::new(10, 0, 0, 2), system: 0 };
//! let arm = Ipv4Addr::new(10, 0, 0, 3);
//! let file = r#"
//!     [[route]]
//!     to = "0.Pilot.*"          # system, class, instance, and perhaps local: a number, or '*' for any
//!     station = "10.0.0.2"      # its address
//!
//!     [[route]]
//!     to = "0.*.*"
//!     station = "arm"           # or its name
//! "#;
//! let stations = |name: &str| (name == "arm").then_some(arm);
//! let mut routes = Routes::parse(file, "routes.toml", own, stations)?;
//! assert_eq!(routes.find("Gyro(0/1)".parse()?), Some(arm));
//! assert_eq!(routes.find("Pilot(0/1)".parse()?), None, "it is here, if it is anywhere");
//!
//! routes.add("0.Gyro.1".parse()?, Ipv4Addr::new(10, 0, 0, 4))?;
//! assert_eq!(routes.find("Gyro(0/1)".parse()?), Some(Ipv4Addr::new(10, 0, 0, 4)));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use core::cmp::Reverse;
use core::fmt;
use core::net::Ipv4Addr;

use serde::Deserialize;
use toml::Spanned;
use toml::de::DeValue;

use crate::name::{FileError, MailboxName, Pattern, Source, Specificity};

/// Routes of a station: as many as there are stations in its table, if each takes one. All are looked through for a package.
pub const MOST_ROUTES: usize = rtnet::ip::route::DEFAULT_HOSTS;

/// Mailboxes, and the station where they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Route {
    /// Which.
    pub to: Pattern,
    /// Its IP address.
    pub station: Ipv4Addr,
}

/// The station that has routes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Own {
    /// Its IP address.
    pub station: Ipv4Addr,
    /// The system of all stations of its LAN. Mailboxes of others are reached by the next layer.
    pub system: u8,
}

/// The routes of one station, the most specific first. Their memory is reserved at the start.
#[derive(Clone, Debug)]
pub struct Routes {
    own: Own,
    routes: Vec<Route>,
}

/// Why a route could not be changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RouteError {
    /// No room.
    #[error(
        "the table of routes is full: it takes {MOST_ROUTES}; remove one, or let a pattern stand for several"
    )]
    Full,
    /// Nobody could be there.
    #[error("{0} is no station's address: {1}")]
    NotAStation(Ipv4Addr, &'static str),
    /// No station of this LAN has such mailboxes.
    #[error(
        "{0} is not of this station's system, and packages for other systems go by the TCP router: remove the route, or give all stations \
         of this LAN that system (--package-system)"
    )]
    OtherSystem(Pattern),
    /// It is not there.
    #[error("there is no route to {0}: name it as the list of routes does")]
    Unknown(Pattern),
}

impl Routes {
    /// None yet, for that station.
    pub fn new(own: Own) -> Self {
        Self { own, routes: Vec::with_capacity(MOST_ROUTES) }
    }

    /// Reads what `text` says, of a file that messages call `file`, for the station `own`. `resolve` returns the address of a station's
    /// name.
    pub fn parse(
        text: &str,
        file: &str,
        own: Own,
        resolve: impl Fn(&str) -> Option<Ipv4Addr>,
    ) -> Result<Self, FileError> {
        let source = Source { file, text };
        let mut routes = Self::new(own);
        // Where each stands, in the order of the routes.
        let mut places: Vec<usize> = Vec::new();
        for RouteEntry { to, station } in entries(&source)? {
            let (at, name, to) = (to.span().start, station.get_ref(), *to.get_ref());
            let address = name.parse().ok().or_else(|| resolve(name)).ok_or_else(|| {
                let what =
                    format!("'{name}' is neither an IPv4 address, as 10.0.0.3, nor the name of a station");
                source.wrong(station.span().start, what)
            })?;
            match routes.place(to) {
                Ok(place) if routes.routes[place].station != address => {
                    let (line, before) = (source.line(places[place]), routes.routes[place].station);
                    let what =
                        format!("{to} leads to {before} by line {line} and to {address} by this: keep one");
                    return Err(source.wrong(at, what));
                }
                Ok(_) => continue,
                Err(place) => places.insert(place, at),
            }
            let refuse = |error| match error {
                RouteError::NotAStation(..) => source.wrong(station.span().start, error),
                _ => source.wrong(at, error),
            };
            routes.add(to, address).map_err(refuse)?;
        }
        Ok(routes)
    }

    /// Which station has a mailbox, if a route says so and it is not this one.
    #[inline]
    pub fn find(&self, name: MailboxName) -> Option<Ipv4Addr> {
        self.of(name).map(|route| route.station)
    }

    /// The route that [`Self::find`] follows.
    #[inline]
    pub fn of(&self, name: MailboxName) -> Option<&Route> {
        if self.is_of_other_system(name) {
            return None;
        }
        let route = self.routes.iter().find(|route| route.to.matches(name))?;
        (route.station != self.own.station).then_some(route)
    }

    /// Whether a mailbox is of another system: no route leads there.
    pub fn is_of_other_system(&self, name: MailboxName) -> bool {
        name.system() != self.own.system
    }

    /// Adds a route, or lets the one there is to the same mailboxes lead elsewhere, and returns where it led.
    pub fn add(&mut self, to: Pattern, station: Ipv4Addr) -> Result<Option<Ipv4Addr>, RouteError> {
        check_station(station)?;
        if to.system().is_some_and(|system| system != self.own.system) {
            return Err(RouteError::OtherSystem(to));
        }
        match self.place(to) {
            Ok(place) => Ok(Some(core::mem::replace(&mut self.routes[place].station, station))),
            Err(_) if self.routes.len() == MOST_ROUTES => Err(RouteError::Full),
            Err(place) => {
                self.routes.insert(place, Route { to, station });
                Ok(None)
            }
        }
    }

    /// Removes the route to exactly these mailboxes, and returns where it led.
    pub fn remove(&mut self, to: Pattern) -> Result<Ipv4Addr, RouteError> {
        let place = self.place(to).map_err(|_| RouteError::Unknown(to))?;
        Ok(self.routes.remove(place).station)
    }

    /// All, the most specific first.
    pub fn iter(&self) -> core::slice::Iter<'_, Route> {
        self.routes.iter()
    }
    /// How many there are.
    pub fn len(&self) -> usize {
        self.routes.len()
    }
    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.routes.is_empty()
    }
    /// How many of them lead to this station itself, and so nowhere.
    pub fn to_itself(&self) -> usize {
        self.routes.iter().filter(|route| route.station == self.own.station).count()
    }

    fn place(&self, to: Pattern) -> Result<usize, usize> {
        let order = |of: Pattern| -> (Reverse<Specificity>, Pattern) { (Reverse(of.specificity()), of) };
        self.routes.binary_search_by_key(&order(to), |route| order(route.to))
    }
}

impl<'a> IntoIterator for &'a Routes {
    type Item = &'a Route;
    type IntoIter = core::slice::Iter<'a, Route>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl fmt::Display for Route {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} -> {}", self.to, self.station)
    }
}

/// A line for each, the most specific first.
impl fmt::Display for Routes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.routes.iter().try_for_each(|route| {
            let itself = if route.station == self.own.station { " (this station)" } else { "" };
            writeln!(f, "{route}{itself}")
        })
    }
}

fn check_station(address: Ipv4Addr) -> Result<(), RouteError> {
    let why = match address {
        _ if address.is_loopback() => "it is a loopback address",
        _ if address.is_multicast() => "it is a multicast address",
        _ if address.is_unspecified() => "it is the unspecified address",
        _ if address.is_broadcast() => "it is the broadcast address",
        _ => return Ok(()),
    };
    Err(RouteError::NotAStation(address, why))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RouteFile {
    #[serde(default)]
    route: Vec<RouteEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RouteEntry {
    to: Spanned<Pattern>,
    station: Spanned<String>,
}

fn entries(source: &Source<'_>) -> Result<Vec<RouteEntry>, FileError> {
    let tables = source.tables()?;
    // What is no table would be read as one by the order of what it holds.
    let in_brackets = |value: &DeValue<'_>| {
        value.as_array().is_some_and(|routes| routes.iter().all(|route| route.get_ref().is_table()))
    };
    match tables.get_ref().get_key_value("route") {
        Some((key, value)) if !in_brackets(value.get_ref()) => Err(source
            .wrong(key.span().start, "there may be more than one route: each is written below [[route]]")),
        _ => source.read::<RouteFile>(tables).map(|file| file.route),
    }
}

#[cfg(test)]
mod tests;
