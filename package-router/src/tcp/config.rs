//! A router's file.
//!
//! ```
//! use package_router::tcp::config::RouterFile;
//!
//! let file = RouterFile::parse(
//!     r#"
//!         name = "router"              # default: this
//!         system = 1                   # of its clients' mailboxes; default: 0
//!         insecure = false             # true: other hosts may connect without a key
//!         metrics = "127.0.0.1:9100"   # figures for Prometheus; default: none
//!
//!         [[listen]]                   # default: one, this
//!         address = "127.0.0.1:2000"
//!
//!         [[listen]]
//!         address = "0.0.0.0:2001"
//!         keys = "keys/router"         # by TLS: a directory that `rtnet router keys` has made
//!
//!         [[link]]                     # to the router of another system
//!         router = "10.2.0.1:2001"
//!         keys = "keys/client"         # by TLS; default: in the clear
//!         systems = [2]                # default: all that no other link names
//!
//!         [limits]                     # default: these
//!         connections = 10000
//!         names = 1024                 # mailboxes of one connection
//!         all_names = 100000           # mailboxes of all
//!         queue = 4194304              # bytes that wait for one connection, 262144 or more
//!         memory = 268435456           # bytes that wait for all, and of packages whose end has not come
//!
//!         [[register]]                 # without any, all may register any name
//!         peer = "10.0.0.0/8"          # clients from there; default: all
//!         names = ["0.Pilot.*"]
//!
//!         [[send]]                     # without any, all may send to all
//!         from = ["0.Pilot.*"]
//!         to = ["0.Chassis.*"]         # may reply
//!     "#,
//!     "router.toml",
//! )?;
//! assert_eq!((file.listen[0].address.port(), file.limits.names), (2000, 1024));
//! assert!(file.listen[1].keys.is_some());
//! # Ok::<(), package_router::name::FileError>(())
//! ```

use core::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::collections::BTreeSet;
use std::path::PathBuf;

use serde::Deserialize;
use toml::Spanned;

use super::address::Address;
use super::router::Limits;
use super::rules::{RegisterRule, Rules, SendRule};
use crate::name::{FileError, Source};
use crate::wire::MAX_LEN;

/// Where peers of this protocol look for a router.
pub const PORT: u16 = 2000;

/// The configuration of a router.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RouterFile {
    /// Its name on its host, if the file gives one.
    pub name: Option<String>,
    /// Where it listens.
    pub listen: Vec<Listen>,
    /// Whether it may listen where other hosts reach it.
    pub insecure: bool,
    /// The address of its figures for Prometheus, if there is one.
    pub metrics: Option<SocketAddr>,
    /// The system of its clients' mailboxes.
    pub system: u8,
    /// Its links to routers of other systems.
    pub links: Vec<Link>,
    /// Its limits.
    pub limits: Limits,
    /// Its rules for registration and sending.
    pub rules: Rules,
}

/// Without a file: on this host only, at the usual port.
impl Default for RouterFile {
    fn default() -> Self {
        let here = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), PORT);
        Self {
            name: None,
            listen: vec![Listen { address: here, keys: None }],
            insecure: false,
            metrics: None,
            system: 0,
            links: Vec::new(),
            limits: Limits::default(),
            rules: Rules::default(),
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    name: Option<String>,
    #[serde(default)]
    insecure: bool,
    metrics: Option<SocketAddr>,
    #[serde(default)]
    system: u8,
    #[serde(default)]
    link: Vec<Spanned<Link>>,
    #[serde(default)]
    listen: Vec<Listen>,
    #[serde(default)]
    limits: LimitsFile,
    #[serde(default)]
    register: Vec<RegisterRule>,
    #[serde(default)]
    send: Vec<SendRule>,
}

/// A place to listen at.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Listen {
    /// The address.
    pub address: SocketAddr,
    /// The directory of the router's keys, if clients come by TLS.
    pub keys: Option<PathBuf>,
}

/// A link to the router of another system.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Link {
    /// That router.
    pub router: Address,
    /// The directory of a client's keys, if it is reached by TLS.
    pub keys: Option<PathBuf>,
    /// The systems whose mailboxes are reached by it; none: all that no other link names.
    #[serde(default)]
    pub systems: BTreeSet<u8>,
}

#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct LimitsFile {
    connections: Option<Spanned<usize>>,
    names: Option<Spanned<usize>>,
    all_names: Option<Spanned<usize>>,
    queue: Option<Spanned<usize>>,
    memory: Option<Spanned<usize>>,
}

impl RouterFile {
    /// Reads what `text` says, of a file that messages call `file`.
    pub fn parse(text: &str, file: &str) -> Result<Self, FileError> {
        let source = Source { file, text };
        let File { name, insecure, metrics, system, link, listen, limits, register, send } =
            source.read(source.tables()?)?;
        let default = Self::default();
        let at_least = |given: Option<Spanned<usize>>, default: usize, least: usize| match given {
            Some(given) if *given.get_ref() < least => {
                let what = format!("{} is too few: make it {least} or more", given.get_ref());
                Err(source.wrong(given.span().start, what))
            }
            given => Ok(given.map_or(default, Spanned::into_inner)),
        };
        let limits = Limits {
            connections: at_least(limits.connections, default.limits.connections, 1)?,
            names: at_least(limits.names, default.limits.names, 1)?,
            all_names: at_least(limits.all_names, default.limits.all_names, 1)?,
            queue: at_least(limits.queue, default.limits.queue, MAX_LEN)?,
            memory: at_least(limits.memory, default.limits.memory, MAX_LEN)?,
        };
        let listen = match listen.is_empty() {
            true => default.listen,
            false => listen,
        };
        for (place, this) in link.iter().enumerate() {
            let before = link[..place].iter().map(Spanned::get_ref);
            if let Some(what) = this.get_ref().contradicts(system, before) {
                return Err(source.wrong(this.span().start, what));
            }
        }
        let links = link.into_iter().map(Spanned::into_inner).collect();
        let rules = Rules { register, send };
        Ok(Self { name, listen, insecure, metrics, system, links, limits, rules })
    }

    /// The first link that leads to one of its own addresses, as far as both are numbers.
    pub fn link_to_itself(&self) -> Option<&Address> {
        let leads_here = |router: &&Address| self.listen.iter().any(|listen| is_at(router, listen.address));
        self.links.iter().map(|link| &link.router).find(leads_here)
    }

    /// The first address that other hosts reach without a key, unless they may.
    pub fn exposed(&self) -> Option<SocketAddr> {
        let mut plain =
            self.listen.iter().filter(|listen| listen.keys.is_none()).map(|listen| listen.address);
        let exposed = plain.find(|address| !address.ip().is_loopback());
        exposed.filter(|_| !self.insecure)
    }
}

impl Link {
    /// A contradiction to the rest of its file, if there is one.
    fn contradicts<'a>(&self, system: u8, mut before: impl Iterator<Item = &'a Self>) -> Option<String> {
        let Self { router, systems, .. } = self;
        if systems.contains(&system) {
            return Some(format!(
                "the link to {router} leads to system {system}, which is this router's own"
            ));
        }
        before.find_map(|other| {
            if other.router == *router {
                return Some(format!("there are two links to {router}: name all its systems in one `[[link]]`"));
            }
            if systems.is_empty() && other.systems.is_empty() {
                return Some(format!(
                    "the links to {} and {router} both lead to all other systems: add `systems` to one of them",
                    other.router
                ));
            }
            let both = systems.intersection(&other.systems).next()?;
            Some(format!("the links to {} and {router} both lead to system {both}", other.router))
        })
    }
}

fn is_at(router: &Address, listener: SocketAddr) -> bool {
    router.port == listener.port()
        && router.host.parse().is_ok_and(|host: IpAddr| {
            host == listener.ip() || host.is_loopback() && listener.ip().is_unspecified()
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(text: &str) -> String {
        RouterFile::parse(text, "r.toml").unwrap_err().to_string()
    }

    #[test]
    fn an_empty_file_is_no_file() {
        assert_eq!(RouterFile::parse("", "r.toml"), Ok(RouterFile::default()));
        let here = Listen { address: "127.0.0.1:2000".parse().unwrap(), keys: None };
        assert_eq!(RouterFile::default().listen, [here]);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_place() {
        assert!(
            refused("listn = 1").starts_with("r.toml:1:1: unknown field `listn`"),
            "{}",
            refused("listn = 1")
        );
        let text = "[limits]\nconnections = 5\nqueue = 1000";
        assert_eq!(refused(text), "r.toml:3:9: 1000 is too few: make it 262144 or more");
        assert!(refused("[[listen]]\naddress = \"here\"").starts_with("r.toml:2:11: "));
        assert!(refused("[limits]\nnames = 0").contains("make it 1 or more"));
        assert!(
            refused("[[link]]\nrouter = \"a b\"").starts_with("r.toml:2:10: 'a b' is no address of a router")
        );
        let own = refused("system = 2\n[[link]]\nrouter = \"there\"\nsystems = [1, 2]");
        assert!(
            own.contains("the link to there:2000 leads to system 2, which is this router's own"),
            "{own}"
        );
        let link =
            |router: &str, systems: &str| format!("[[link]]\nrouter = \"{router}\"\nsystems = [{systems}]\n");
        for (text, words) in [
            (link("a", "2") + &link("a", "3"), "r.toml:4:1: there are two links to a:2000"),
            (
                link("a", "2, 3") + &link("b", "3"),
                "r.toml:4:1: the links to a:2000 and b:2000 both lead to system 3",
            ),
            (
                link("a", "") + &link("b", ""),
                "r.toml:4:1: the links to a:2000 and b:2000 both lead to all other systems",
            ),
        ] {
            assert!(refused(&text).starts_with(words), "{}", refused(&text));
        }
        assert!(RouterFile::parse(&(link("a", "") + &link("b", "3")), "r.toml").is_ok());
        let listen = "[[listen]]\naddress = \"0.0.0.0:2001\"\n";
        for (text, leads_here) in [
            (listen.to_owned() + &link("127.0.0.1:2001", "2"), true),
            (listen.to_owned() + &link("127.0.0.1:2000", "2"), false),
            (listen.to_owned() + &link("10.0.0.1:2001", "2"), false),
            (link("127.0.0.1", "2"), true),
        ] {
            let file = RouterFile::parse(&text, "r.toml").unwrap();
            assert_eq!(file.link_to_itself().is_some(), leads_here, "{text}");
        }
        let network = refused("[[register]]\nnames = []\npeer = \"10.0.0.0/64\"");
        assert!(network.starts_with("r.toml:3:8: '10.0.0.0/64' is no network"), "{network}");
        assert!(refused("[[send]]\nfrom = [\"0.Nobody.1\"]\nto = []").starts_with("r.toml:2:"));
    }

    #[test]
    fn other_hosts_reach_a_router_only_if_they_may() {
        let of = |insecure: bool, address: &str| {
            let text = format!("insecure = {insecure}\n[[listen]]\naddress = \"{address}\"");
            let with_keys = format!("{text}\nkeys = \"k\"");
            assert_eq!(RouterFile::parse(&with_keys, "r.toml").unwrap().exposed(), None, "by TLS");
            RouterFile::parse(&text, "r.toml").unwrap().exposed().is_some()
        };
        let open = ["0.0.0.0:2000", "10.0.0.1:1", "[::]:2000"];
        assert_eq!(open.map(|address| of(false, address)), [true; 3]);
        assert_eq!(open.map(|address| of(true, address)), [false; 3]);
        assert_eq!(
            ["127.0.0.1:0", "127.9.9.9:2000", "[::1]:2000"].map(|address| of(false, address)),
            [false; 3]
        );
    }
}
