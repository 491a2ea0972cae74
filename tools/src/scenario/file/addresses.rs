//! The part of it that gives stations addresses of the Internet Protocol: by their places in one network, or one by one.

use std::net::Ipv4Addr;

use rtnet::ip::route::Network;
use toml::Spanned;

use super::stations::{FileRole, StationFile};
use super::{FileError, NetworkFile, Source};
use crate::scenario::places::{self, TooSmall};
use crate::station::stack::OwnIp;

impl Source<'_> {
    /// The address of each station that has one, in the order of the file. With a `network` all have: the master the first
    /// one, the others the next in their order, but for those that say their own.
    pub(super) fn addresses(&self, file: &NetworkFile) -> Result<Vec<Option<OwnIp>>, FileError> {
        let network = file.network.as_ref().map(|said| self.network(said, file.station.len())).transpose()?;
        let is_master = |entry: &Spanned<StationFile>| entry.get_ref().role == FileRole::Master;
        let master = file.station.iter().position(is_master).unwrap_or(0);
        let mut own = Vec::new();
        for (i, entry) in file.station.iter().enumerate() {
            let place = match i {
                i if i == master => 0,
                before if before < master => before + 1,
                behind => behind,
            };
            own.push(match (&entry.get_ref().ip, network) {
                (Some(said), _) => Some(self.own(said, network)?),
                (None, Some(network)) => Some(self.by_place(file, network, place as u32)?),
                (None, None) => None,
            });
        }
        for (i, entry) in file.station.iter().enumerate() {
            let same =
                |other: &usize| own[i].is_some() && own[*other].map(|of| of.ip) == own[i].map(|of| of.ip);
            let Some(other) = (0..i).find(same) else { continue };
            let others = file.station[other].get_ref();
            // One of the two says its own: by their places no two have the same.
            let said = entry.get_ref().ip.as_ref().or(others.ip.as_ref());
            let (ip, names) = (own[i].map_or(Ipv4Addr::UNSPECIFIED, |own| own.ip), [others, entry.get_ref()]);
            let [one, two] = names.map(|of| of.name.get_ref());
            let what =
                format!("'{one}' and '{two}' would both have the address {ip}: give one of them another");
            return Err(self.impossible(said.unwrap_or(&entry.get_ref().name).span().start, what));
        }
        Ok(own)
    }

    /// One with room for so many.
    fn network(&self, said: &Spanned<String>, stations: usize) -> Result<Network, FileError> {
        let at = said.span().start;
        let network: Network = said.get_ref().parse().map_err(|error| self.impossible(at, error))?;
        let small = |small: TooSmall| format!("{small}: write network = \"{}\"", small.larger);
        places::check(network, stations).map_err(|error| self.impossible(at, small(error)))?;
        Ok(network)
    }

    fn by_place(&self, file: &NetworkFile, network: Network, place: u32) -> Result<OwnIp, FileError> {
        let at = file.network.as_ref().map_or(0, |said| said.span().start);
        places::address(network, place).map_err(|error| self.impossible(at, error))
    }

    /// What a station says of its own; in a network the prefix is that one's.
    fn own(&self, said: &Spanned<String>, network: Option<Network>) -> Result<OwnIp, FileError> {
        let refuse = |what: String| self.impossible(said.span().start, what);
        let text = said.get_ref();
        let Some(network) = network else { return text.parse().map_err(|error| refuse(format!("{error}"))) };
        let whole = if text.contains('/') { text.clone() } else { format!("{text}/{}", network.prefix()) };
        let own: OwnIp = whole.parse().map_err(|error| refuse(format!("{error}")))?;
        if !network.contains(own.ip) || own.prefix != network.prefix() {
            return Err(refuse(format!(
                "{text} is none of the network {network} that all stations are in: write one of its addresses, or leave out \
                 network and give every station its own"
            )));
        }
        Ok(own)
    }
}
