//! The part of it that gives stations VNICs: with addresses of their own, or as proxies, with those that the stations have.

use serde::Deserialize;
use toml::Spanned;
use vnic::peers::Prefix;

use super::stations::StationFile;
use super::{FileError, Source};
use crate::cli::{VnicMode, of_a_device};
use crate::scenario::VnicPlan;
use crate::station::stack::OwnIp;

/// The addresses of a station's VNIC: one, or a list, which may be empty.
#[derive(Deserialize)]
#[serde(
    untagged,
    expecting = "expected an address, as \"10.1.0.2/24\", or a list of addresses, which may be empty"
)]
pub(super) enum VnicFile {
    One(String),
    Several(Vec<String>),
}

impl Source<'_> {
    /// The VNIC of a station with this address, if it is to have one. `mode` is what the file says of all.
    pub(super) fn vnic(
        &self,
        station: &StationFile,
        ip: Option<OwnIp>,
        mode: Option<&Spanned<VnicMode>>,
    ) -> Result<Option<VnicPlan>, FileError> {
        let StationFile { vnic, vnic_proxy, name, .. } = station;
        let addresses = vnic.as_ref().map(|said| self.prefixes(said)).transpose()?;
        let Some(proxy) = vnic_proxy.as_ref().filter(|said| *said.get_ref()) else {
            let mode = mode.map_or(VnicMode::default(), |mode| *mode.get_ref());
            return Ok(addresses.map(|addresses| VnicPlan { addresses, mode, proxy: false }));
        };
        let name = name.get_ref();
        let Some(OwnIp { ip, prefix }) = ip else {
            let what = format!(
                "vnic_proxy shares the address of '{name}' with Linux, and it has none: give it one by ip, or all stations by \
                 network, as in network = \"10.0.0.0/24\""
            );
            return Err(self.impossible(proxy.span().start, what));
        };
        if let Some(mode) = mode.filter(|mode| *mode.get_ref() == VnicMode::Tap) {
            let what = format!(
                "vnic_proxy of '{name}' is about packets of IP, without an Ethernet of their own: write vnic_mode = \"tun\", or \
                 leave it out"
            );
            return Err(self.impossible(mode.span().start, what));
        }
        let own = Prefix { ip: ip.into(), length: prefix };
        if let Some(other) = addresses.iter().flatten().find(|other| **other != own) {
            let what = format!(
                "vnic_proxy shares the address that '{name}' has, {own}, and {other} is another: leave vnic out, or vnic_proxy"
            );
            return Err(
                self.impossible(vnic.as_ref().map_or(proxy.span().start, |said| said.span().start), what)
            );
        }
        Ok(Some(VnicPlan { addresses: Vec::new(), mode: VnicMode::Tun, proxy: true }))
    }

    fn prefixes(&self, file: &Spanned<VnicFile>) -> Result<Vec<Prefix>, FileError> {
        let said = match file.get_ref() {
            VnicFile::One(one) => std::slice::from_ref(one),
            VnicFile::Several(several) => several,
        };
        let refuse = |error: String| self.impossible(file.span().start, error);
        said.iter().map(|said| of_a_device(said).map_err(refuse)).collect()
    }

    /// No two have the same address, and what is said of all is said of somebody.
    pub(super) fn check_vnics(
        &self,
        file: &[Spanned<StationFile>],
        plans: &[Option<VnicPlan>],
        mode: Option<&Spanned<VnicMode>>,
    ) -> Result<(), FileError> {
        if let Some(mode) = mode.filter(|_| plans.iter().all(Option::is_none)) {
            let what = "no station has a VNIC that this could be about: give some of them vnic = \"10.1.0.1/24\", or leave it out";
            return Err(self.impossible(mode.span().start, what));
        }
        let addresses = |i: usize| plans[i].iter().flat_map(|plan| &plan.addresses);
        for (i, entry) in file.iter().enumerate() {
            for own in addresses(i) {
                let same = |other: &usize| addresses(*other).any(|others| others.ip == own.ip);
                let Some(other) = (0..i).find(same) else { continue };
                let [one, two] = [&file[other], entry].map(|of| of.get_ref().name.get_ref());
                let what = format!(
                    "the VNICs of '{one}' and '{two}' would both have {}: give one of them another",
                    own.ip
                );
                let said = entry.get_ref().vnic.as_ref().map_or(entry.span(), Spanned::span);
                return Err(self.impossible(said.start, what));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of two stations, with something at the top and something in the first, which is the master.
    fn vnics(top: &str, first: &str) -> Result<Vec<Option<VnicPlan>>, String> {
        let text = format!(
            "cycle = \"1ms\"\n{top}\n[[station]]\nname = \"m\"\nrole = \"master\"\n{first}\n[[station]]\nname = \"arm\"\n\
             role = \"slave\"\n"
        );
        let scenario = Source::new("net.toml", &text).parse().map_err(|error| error.to_string())?;
        Ok(scenario.stations.into_iter().map(|station| station.vnic).collect())
    }

    #[test]
    fn a_station_has_a_vnic_or_a_proxy_if_it_says_so() {
        let tunnel = |addresses: &[&str], mode| {
            let addresses = addresses.iter().map(|said| said.parse().unwrap()).collect();
            Some(VnicPlan { addresses, mode, proxy: false })
        };
        let proxy = Some(VnicPlan { addresses: vec![], mode: VnicMode::Tun, proxy: true });
        let network = "network = \"10.0.0.0/24\"";
        let network_and_tun = "network = \"10.0.0.0/24\"\nvnic_mode = \"tun\"";
        for (top, first, expected) in [
            ("", "", None),
            ("", "vnic = []", tunnel(&[], VnicMode::Tap)),
            ("vnic_mode = \"tun\"", "vnic = \"10.1.0.1/24\"", tunnel(&["10.1.0.1/24"], VnicMode::Tun)),
            (
                "",
                "vnic = [\"10.1.0.1/24\", \"fd00::1/64\"]",
                tunnel(&["10.1.0.1/24", "fd00::1/64"], VnicMode::Tap),
            ),
            (network, "vnic_proxy = true", proxy.clone()),
            (network_and_tun, "vnic = \"10.0.0.1/24\"\nvnic_proxy = true", proxy.clone()),
            ("", "ip = \"10.0.0.7/24\"\nvnic = []\nvnic_proxy = true", proxy),
            (network, "vnic_proxy = false", None),
        ] {
            assert_eq!(vnics(top, first).unwrap(), [expected, None], "{top} {first}");
        }
    }

    #[test]
    fn a_proxy_that_cannot_be_names_key_station_and_remedy() {
        let (network, proxy) = ("network = \"10.0.0.0/24\"", "vnic_proxy = true");
        for (top, first, expected) in [
            (
                "",
                proxy,
                "net.toml:6:14: vnic_proxy shares the address of 'm' with Linux, and it has none: give it one by ip, or all \
                 stations by network",
            ),
            (
                &format!("{network}\nvnic_mode = \"tap\"")[..],
                proxy,
                "net.toml:3:13: vnic_proxy of 'm' is about packets of IP, without an Ethernet of their own: write vnic_mode",
            ),
            (
                network,
                "vnic_proxy = true\nvnic = [\"10.0.0.1/24\", \"10.1.0.1/24\"]",
                "net.toml:7:8: vnic_proxy shares the address that 'm' has, 10.0.0.1/24, and 10.1.0.1/24 is another: leave vnic",
            ),
            (network, "vnic_proxy = \"yes\"", "net.toml:6:14: "),
            (network, "vnic = \"10.1.0\"", "net.toml:6:8: '10.1.0' is no IP address with a prefix length"),
        ] {
            let error = vnics(top, first).unwrap_err();
            assert!(error.starts_with(expected), "{top} {first}: {error}");
        }
    }

    #[test]
    fn vnics_that_cannot_be_name_the_place_and_the_remedy() {
        for (top, first, expected) in [
            (
                "",
                "vnic = true",
                "net.toml:6:8: expected an address, as \"10.1.0.2/24\", or a list of addresses",
            ),
            (
                "",
                "vnic = \"10.1.0.2\"",
                "net.toml:6:8: '10.1.0.2' reaches no other station: say of which network, as in 10.1.0.2/24",
            ),
            ("", "vnic = \"224.0.0.1/24\"", "net.toml:6:8: 224.0.0.1/24 is the address of a group"),
            (
                "vnic_mode = \"tun\"",
                "",
                "net.toml:2:13: no station has a VNIC that this could be about: give some of",
            ),
            (
                "",
                "vnic = \"10.1.0.2/24\"\n[[station]]\nname = \"leg\"\nrole = \"slave\"\nvnic = [\"fd00::1/64\", \"10.1.0.2/16\"]",
                "net.toml:10:8: the VNICs of 'm' and 'leg' would both have 10.1.0.2: give one of them another",
            ),
        ] {
            let error = vnics(top, first).unwrap_err();
            assert!(error.starts_with(expected), "{top} {first}: {error}");
        }
    }
}
