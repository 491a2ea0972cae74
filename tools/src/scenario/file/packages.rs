//! The part of it that lets stations' programs send each other packages, in a lab.

use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};

use package_router::mailbox::LARGEST_BODY;
use package_router::priority::Priorities;
use package_router::route::{Own, Routes};
use package_router::tcp::address::NoAddress;
use package_router::tcp::keys::ClientKeys;
use toml::Spanned;

use super::source::read_text;
use super::{FileError, NetworkFile, Source};
use crate::scenario::{PackagesPlan, RouterPlan, StationPlan};

impl Source<'_> {
    /// What its stations' packages are to be: files that it names are beside it, and name stations as it does.
    pub(super) fn packages(
        &self,
        network: &NetworkFile,
        stations: &[StationPlan],
    ) -> Result<Option<PackagesPlan>, FileError> {
        let NetworkFile { packages, package_routes, package_priorities, package_times, .. } = network;
        if !packages.unwrap_or(false) {
            let NetworkFile { router, router_keys, router_body, package_system, .. } = network;
            let names = [package_routes, package_priorities, router, router_keys];
            let others = [
                package_times.as_ref().map(Spanned::span),
                router_body.as_ref().map(Spanned::span),
                package_system.as_ref().map(Spanned::span),
            ];
            let mut spans =
                names.into_iter().flatten().map(Spanned::span).chain(others.into_iter().flatten());
            return spans.next().map_or(Ok(None), |given| {
                let what = "this is about packages, and stations have none: write packages = true, too";
                Err(self.impossible(given.start, what))
            });
        }
        let resolve = |name: &str| {
            let station = stations.iter().find(|station| station.name == name)?;
            station.ip.map(|own| own.ip)
        };
        let system = network.package_system.as_ref().map_or(0, |said| *said.get_ref());
        let mut routes = Vec::new();
        if let Some(said) = package_routes {
            let (file, text) = self.beside(said)?;
            // Which is one's own each station says for itself.
            let own = Own { station: Ipv4Addr::UNSPECIFIED, system };
            let read = Routes::parse(&text, &file.display().to_string(), own, resolve);
            let read = read.map_err(|error| self.impossible(said.span().start, error))?;
            routes.extend(read.iter().copied());
        }
        let priorities = package_priorities.as_ref().map(|said| {
            let (file, text) = self.beside(said)?;
            let read = Priorities::parse(&text, &file.display().to_string());
            read.map(|_| file).map_err(|error| self.impossible(said.span().start, error))
        });
        let times = package_times.as_ref().is_none_or(|said| *said.get_ref());
        let (priorities, router) = (priorities.transpose()?, self.router(network)?);
        Ok(Some(PackagesPlan { routes, system, priorities, times, router }))
    }

    fn router(&self, network: &NetworkFile) -> Result<Option<RouterPlan>, FileError> {
        let NetworkFile { router, router_keys, router_body, .. } = network;
        let Some(router) = router else {
            let given = router_keys.as_ref().map(Spanned::span).or(router_body.as_ref().map(Spanned::span));
            return given.map_or(Ok(None), |given| {
                let what =
                    "this is about a TCP router, and stations have none: write router = \"HOST:PORT\", too";
                Err(self.impossible(given.start, what))
            });
        };
        let address = router.get_ref().parse();
        let address = address.map_err(|error: NoAddress| self.impossible(router.span().start, error))?;
        let keys = router_keys.as_ref().map(|given| {
            let directory = self.path_of(given.get_ref());
            let keys = ClientKeys::read(&directory);
            keys.map(|_| directory).map_err(|error| self.impossible(given.span().start, error))
        });
        let largest_body = router_body.as_ref().map(|given| match *given.get_ref() {
            bytes if bytes as usize <= LARGEST_BODY => Ok(bytes),
            bytes => {
                let what = format!("a body of {bytes} bytes is too long: {LARGEST_BODY} is the longest");
                Err(self.impossible(given.span().start, what))
            }
        });
        Ok(Some(RouterPlan { address, keys: keys.transpose()?, largest_body: largest_body.transpose()? }))
    }

    /// The path of a file or directory that is named from where this file is.
    fn path_of(&self, named: &str) -> PathBuf {
        Path::new(self.file).parent().unwrap_or(Path::new("")).join(named)
    }

    /// A file that is named from where this one is.
    fn beside(&self, said: &Spanned<String>) -> Result<(PathBuf, String), FileError> {
        let file = self.path_of(said.get_ref());
        let text = read_text(&file);
        let text = text.map_err(|why| {
            self.impossible(said.span().start, format!("{} cannot be read: {why}", file.display()))
        })?;
        Ok((file, text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const STATIONS: &str = "cycle = \"1ms\"\nnetwork = \"10.0.0.0/24\"\n[[station]]\nname = \"m\"\nrole = \"master\"\n\
                            [[station]]\nname = \"arm\"\nrole = \"slave\"\n";

    fn read(dir: &Path, head: &str) -> Result<Option<PackagesPlan>, String> {
        let file = dir.join("lab.toml");
        let text = format!("{head}\n{STATIONS}");
        let scenario = Source::new(file.to_str().unwrap(), &text).parse();
        scenario.map(|scenario| scenario.packages).map_err(|error| error.to_string())
    }

    #[test]
    fn routes_of_packages_name_stations_as_the_labs_file_does_and_are_beside_it() {
        let dir = tempfile::tempdir().unwrap();
        let dir = dir.path();
        fs::write(dir.join("routes.toml"), "[[route]]\nto = \"0.Pilot.*\"\nstation = \"arm\"\n").unwrap();
        fs::write(dir.join("urgent.toml"), "[class.Pilot]\nlevel = 3\n").unwrap();
        assert_eq!(read(dir, ""), Ok(None));
        assert_eq!(read(dir, "packages = false"), Ok(None));
        let plan = read(dir, "packages = true").unwrap().unwrap();
        assert_eq!((plan.routes.len(), plan.priorities, plan.times), (0, None, true));
        let plan = read(dir, "packages = true\npackage_times = false").unwrap().unwrap();
        assert!(!plan.times);
        let all = "packages = true\npackage_routes = \"routes.toml\"\npackage_priorities = \"urgent.toml\"";
        let plan = read(dir, all).unwrap().unwrap();
        assert_eq!(plan.routes[0].station, Ipv4Addr::new(10, 0, 0, 2));
        assert_eq!(plan.priorities, Some(dir.join("urgent.toml")));
        assert_eq!(plan.system, 0);
        let plan = read(dir, "packages = true\npackage_system = 255").unwrap().unwrap();
        assert_eq!(plan.system, 255);
        let plan =
            read(dir, "packages = true\nrouter = \"10.1.0.1\"\nrouter_body = 262128").unwrap().unwrap();
        let RouterPlan { address, keys, largest_body } = plan.router.unwrap();
        assert_eq!(
            (address.to_string().as_str(), keys, largest_body),
            ("10.1.0.1:2000", None, Some(262_128))
        );
    }

    #[test]
    fn packages_that_cannot_be_say_where_and_what_to_do() {
        let dir = tempfile::tempdir().unwrap();
        let dir = dir.path();
        fs::write(dir.join("routes.toml"), "[[route]]\nto = \"0.Pilot.*\"\nstation = \"leg\"\n").unwrap();
        fs::write(dir.join("other.toml"), "[[route]]\nto = \"1.Pilot.*\"\nstation = \"arm\"\n").unwrap();
        fs::write(dir.join("urgent.toml"), "[class.Pilot]\nlevel = 31\n").unwrap();
        for (head, told) in [
            ("package_routes = \"routes.toml\"", ":1:18: this is about packages, and stations have none"),
            ("package_times = true", ":1:17: this is about packages, and stations have none"),
            ("router = \"10.1.0.1\"", ":1:10: this is about packages, and stations have none"),
            ("router_body = 1", ":1:15: this is about packages, and stations have none"),
            ("packages = true\nrouter_body = 1", ":2:15: this is about a TCP router, and stations have none"),
            ("packages = true\nrouter = \"10.1.0.1:x\"", ":2:10: '10.1.0.1:x' is no address of a router"),
            (
                "packages = true\nrouter = \"10.1.0.1\"\nrouter_body = 262129",
                ":3:15: a body of 262129 bytes is too long: 262128 is the longest",
            ),
            ("packages = true\nrouter = \"10.1.0.1\"\nrouter_keys = \"none\"", ":3:15: "),
            ("packages = true\npackage_routes = \"none.toml\"", ":2:18: "),
            ("package_system = 1", ":1:18: this is about packages, and stations have none"),
            ("packages = true\npackage_routes = \"other.toml\"", "1.Pilot.* is not of this station's system"),
            ("packages = true\npackage_routes = \"routes.toml\"", "'leg' is neither an IPv4 address"),
            ("packages = true\npackage_priorities = \"urgent.toml\"", "urgent.toml:2"),
        ] {
            let error = read(dir, head).unwrap_err();
            assert!(error.contains(told), "{error}");
        }
    }
}
