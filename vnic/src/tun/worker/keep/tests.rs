//! What is asked of a device, and what others do to it, in a network namespace of the test's own.

use std::sync::Arc;

use nix::sys::eventfd::EventFd;
use rtnet::live::interface::Interface;
use rtnet::wire::ethernet::Address;

use super::super::super::{Change, Options};
use super::*;
use crate::netlink::Links;
use crate::netlink::tests::{in_a_namespace, veth};
use crate::peers::Prefix;
use crate::tunnel::{Config, MTU, Tunnel, new};

const NAME: &str = "vnic0";
const STATION: Address = Address([2, 0, 0, 0, 0, 1]);

/// A VNIC that no thread runs.
struct Alone {
    vnic: Vnic,
    /// As others have it.
    links: Links,
    _tunnel: Tunnel,
}

fn all(addresses: &[&str]) -> Vec<Prefix> {
    addresses.iter().map(|address| address.parse().unwrap()).collect()
}

impl Alone {
    fn new(addresses: &[&str], keeps_source: bool) -> Self {
        let mut links = Links::open().unwrap();
        let [index, _] = veth(&mut links);
        links.set_up(index, true).unwrap();
        let interface = Interface { name: "a0".into(), index, address: STATION };
        let (tunnel, mouth) = new(Config { keeps_source, ..Config::of(STATION) });
        let options = Options {
            name: Some(NAME.into()),
            mode: Mode::Tap,
            addresses: all(addresses),
            mtu: MTU,
            peers: Vec::new(),
            interface,
        };
        let bell = || Arc::new(EventFd::new().unwrap());
        let tell = Box::new(|_: &str| ());
        let vnic = Vnic::open(options, mouth, [bell(), bell()], Arc::default(), tell).unwrap();
        Self { vnic, links, _tunnel: tunnel }
    }

    fn set(&mut self, change: Change) -> Result<(), String> {
        self.vnic.obey(&Order::Set(change)).map_err(|refused| refused.to_string())
    }

    fn change(&mut self, add: &[&str], remove: &[&str]) -> Result<(), String> {
        self.set(Change { add: all(add), remove: all(remove), ..Change::default() })
    }

    fn set_mtu(&mut self, mtu: usize) {
        self.set(Change { mtu: Some(mtu), ..Change::default() }).unwrap();
        self.follow();
    }

    /// A tenth of a second later.
    fn follow(&mut self) {
        self.vnic.looked -= std::time::Duration::from_secs(1);
        self.vnic.follow();
    }

    /// Linux's own of a link are of no interest here.
    fn addresses(&mut self) -> Vec<String> {
        let all = self.links.addresses(self.vnic.index).unwrap().into_iter();
        let all = all.map(|(ip, length)| Prefix { ip, length }.to_string());
        let mut all: Vec<_> = all.filter(|address| !address.starts_with("fe80")).collect();
        all.sort();
        all
    }
}

#[test]
fn an_address_that_goes_takes_no_other_of_its_network_along() {
    in_a_namespace("an_address_that_goes_takes_no_other_of_its_network_along", || {
        let mut alone = Alone::new(&["10.1.0.2/24"], false);
        alone.change(&["10.1.0.9/24"], &["10.1.0.2/24"]).unwrap();
        assert_eq!(alone.addresses(), ["10.1.0.9/24"]);
        alone.change(&["10.1.0.3/24", "10.1.0.4/24"], &[]).unwrap();
        // Also what somebody else has given it.
        alone.links.add_address(alone.vnic.index, [10, 1, 0, 5].into(), 24).unwrap();
        alone.change(&[], &["10.1.0.9/24"]).unwrap();
        assert_eq!(alone.addresses(), ["10.1.0.3/24", "10.1.0.4/24", "10.1.0.5/24"]);
        alone.change(&[], &["10.1.0.3/24", "10.1.0.5/24"]).unwrap();
        assert_eq!(alone.addresses(), ["10.1.0.4/24"]);

        // Nor does it where all is undone, as the second is not there.
        alone.change(&["10.1.0.6/24"], &[]).unwrap();
        let refused = alone.change(&["10.2.0.1/24"], &["10.1.0.4/24", "10.9.0.9/24"]).unwrap_err();
        assert!(refused.contains("it has no such address"), "{refused}");
        assert_eq!(alone.addresses(), ["10.1.0.4/24", "10.1.0.6/24"]);
        assert_eq!(alone.vnic.options.addresses, all(&["10.1.0.4/24", "10.1.0.6/24"]));
    });
}

#[test]
fn an_address_of_its_own_can_be_taken_away_also_where_the_device_lacks_it() {
    in_a_namespace("an_address_of_its_own_can_be_taken_away_also_where_the_device_lacks_it", || {
        let mut alone = Alone::new(&["10.1.0.2/24", "10.2.0.2/24"], false);
        alone.links.remove_address(alone.vnic.index, [10, 2, 0, 2].into(), 24).unwrap();
        alone.change(&[], &["10.2.0.2/24"]).unwrap();
        alone.vnic.obey(&Order::Up).unwrap();
        assert_eq!(alone.addresses(), ["10.1.0.2/24"]);
    });
}

#[test]
fn ipv6_waits_for_an_mtu_that_is_large_enough() {
    in_a_namespace("ipv6_waits_for_an_mtu_that_is_large_enough", || {
        let mut alone = Alone::new(&["fd00::2/64", "fd00::3/64"], false);
        assert_eq!(alone.vnic.status().unwrap().remarks, [""; 0]);
        alone.set_mtu(600);
        alone.change(&["fd00::9/64"], &["fd00::2/64"]).unwrap();
        assert_eq!(alone.addresses(), [""; 0]);
        let line = "IPv6 waits: it needs an MTU of 1280 (fd00::3/64, fd00::9/64)";
        assert_eq!(alone.vnic.status().unwrap().remarks, [line]);
        alone.set_mtu(1280);
        assert_eq!(alone.addresses(), ["fd00::3/64", "fd00::9/64"]);
        assert_eq!(alone.vnic.status().unwrap().remarks, [""; 0]);
    });
}

#[test]
fn an_address_of_ipv6_has_one_prefix() {
    in_a_namespace("an_address_of_ipv6_has_one_prefix", || {
        let mut alone = Alone::new(&["fd00::2/64"], false);
        for mtu in [MTU, 600] {
            alone.set_mtu(mtu);
            let refused = alone.change(&["fd00::2/48"], &[]).unwrap_err();
            let text = "it is to have fd00::2/64 already: take that away (`--no-address fd00::2/64`), or leave fd00::2/48 out";
            assert_eq!(refused, text);
        }
        alone.set_mtu(MTU);
        alone.change(&["fd00::2/48"], &["fd00::2/64"]).unwrap();
        assert_eq!(
            (alone.addresses(), &alone.vnic.options.addresses),
            (vec!["fd00::2/48".into()], &all(&["fd00::2/48"]))
        );
        // One that somebody else has given it.
        let other = "fd00::7".parse().unwrap();
        alone.links.add_address(alone.vnic.index, other, 64).unwrap();
        let refused = alone.change(&["fd00::7/48"], &[]).unwrap_err();
        assert!(
            refused.ends_with("it has this address with another prefix length: take that away"),
            "{refused}"
        );
        assert_eq!(alone.vnic.options.addresses, all(&["fd00::2/48"]));
    });
}

#[test]
fn no_device_has_the_address_of_a_group() {
    in_a_namespace("no_device_has_the_address_of_a_group", || {
        let mut alone = Alone::new(&[], false);
        for group in
            ["224.0.0.1/24", "255.255.255.255/32", "10.1.0.255/24", "0.0.0.0/0", "ff02::1/64", "::/0"]
        {
            let refused = alone.change(&[group], &[]).unwrap_err();
            let text =
                "is the address of a group, of all or of nobody: a device has one of its own, as 10.0.0.2/24";
            assert_eq!(refused, format!("{group} {text}"));
        }
        alone.change(&["10.1.0.1/31", "10.1.0.255/16"], &[]).unwrap();
    });
}
