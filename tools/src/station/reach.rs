//! A station's name, and the socket by which it is asked.

use anyhow::Result;

use super::Options;
use crate::control::{Directory, Held, Place, Server};

/// Where a station can be looked at and changed.
#[derive(Default)]
pub(super) struct Reach {
    // Gone before the name is free again.
    pub server: Option<Server>,
    _name: Option<Held>,
    /// Why there is no such place.
    pub refused: Option<String>,
}

/// The station's name and its control socket, if any were asked for. A lab has seen to the names of its own stations.
pub(super) fn reach_as_asked(options: &Options) -> Result<Option<Reach>> {
    match (&options.lab, &options.name) {
        (Some(lab), _) => {
            let server = lab.control.as_deref().map(Server::bind).transpose()?;
            Ok(Some(Reach { server, ..Reach::default() }))
        }
        (None, name) => name.as_deref().map(reach_by).transpose(),
    }
}

/// The same by a name that nobody asked for: another station may have it, on an interface of another namespace.
pub(super) fn reach_by_interface(interface: &str) -> Reach {
    reach_by(interface).unwrap_or_else(|why| Reach {
        refused: Some(format!("nothing can be asked of this station, nor changed: {why:#}")),
        ..Reach::default()
    })
}

fn reach_by(name: &str) -> Result<Reach> {
    let directory = Directory::of_user()?;
    let held = directory.take_station(name)?;
    let server = Server::bind(&directory.station(&Place { lab: None, station: name.into() }))?;
    Ok(Reach { server: Some(server), _name: Some(held), refused: None })
}
