//! What is asked of a device, and what others do to it, in a network namespace of the test's own.

use std::net::IpAddr;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};

use nix::sys::eventfd::EventFd;
use rtnet::live::interface::Interface;
use rtnet::wire::ethernet::Address;

use super::super::super::{Change, Options};
use super::*;
use crate::netlink::tests::{in_a_namespace, veth};
use crate::netlink::{Link, Links};
use crate::peers::Prefix;
use crate::tunnel::{Config, MTU, Tunnel, new};

const NAME: &str = "vnic0";
const STATION: Address = Address([2, 0, 0, 0, 0, 1]);

/// A VNIC that no thread runs.
struct Alone {
    vnic: Vnic,
    /// As others have it.
    links: Links,
    told: Arc<Mutex<Vec<String>>>,
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
            notes: None,
        };
        let bell = || Arc::new(EventFd::new().unwrap());
        let told = Arc::new(Mutex::new(Vec::new()));
        let lines = told.clone();
        let tell = Box::new(move |line: &str| lines.lock().unwrap().push(line.to_owned()));
        let vnic = Vnic::open(options, mouth, [bell(), bell()], Arc::default(), tell).unwrap();
        Self { vnic, links, told, _tunnel: tunnel }
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

    /// What its thread does once something is heard.
    fn hear(&mut self) {
        while let Some(heard) = self.vnic.watch.next() {
            self.vnic.hear(&heard);
        }
        self.vnic.look();
    }

    /// Linux's own of a link are of no interest here.
    fn addresses(&mut self) -> Vec<String> {
        let all = self.links.addresses(self.vnic.index).unwrap().into_iter();
        let all = all.map(|(ip, length)| Prefix { ip, length }.to_string());
        let mut all: Vec<_> = all.filter(|address| !address.starts_with("fe80")).collect();
        all.sort();
        all
    }

    fn link(&mut self) -> Link {
        self.links.get(self.vnic.index).unwrap().expect("it is there")
    }

    fn told(&self) -> Vec<String> {
        std::mem::take(&mut self.told.lock().unwrap())
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

        // Nor does it where nothing is done, as the second is not there.
        alone.change(&["10.1.0.6/24"], &[]).unwrap();
        let refused = alone.change(&["10.2.0.1/24"], &["10.1.0.4/24", "10.9.0.9/24"]).unwrap_err();
        assert!(refused.contains("it has no such address"), "{refused}");
        // Nor where all is undone, as somebody else has given it the last with another prefix.
        let others = IpAddr::from([0xfd00, 0, 0, 0, 0, 0, 0, 5]);
        alone.links.add_address(alone.vnic.index, others, 64).unwrap();
        alone.change(&["10.2.0.1/24", "fd00::5/48"], &["10.1.0.4/24"]).unwrap_err();
        assert_eq!(alone.addresses(), ["10.1.0.4/24", "10.1.0.6/24", "fd00::5/64"]);
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

#[test]
fn an_ethernet_address_that_somebody_sets_is_set_back_and_told() {
    in_a_namespace("an_ethernet_address_that_somebody_sets_is_set_back_and_told", || {
        const OTHER: [u8; 6] = [2, 0, 0, 0, 0, 0x99];
        let mut alone = Alone::new(&[], false);
        alone.hear();
        assert_eq!((alone.told(), alone.link().address), (vec![], Some(STATION.0)));
        alone.links.set_hardware_address(alone.vnic.index, OTHER).unwrap();
        alone.hear();
        let line = "the address of 'vnic0' was set to 02:00:00:00:00:99 by somebody: set back to 02:00:00:00:00:01, its station's";
        assert_eq!((alone.told(), alone.link().address), (vec![line.into()], Some(STATION.0)));
        assert_eq!(alone.vnic.status().unwrap().device.unwrap().address, Some(STATION));
        // Before it is heard.
        alone.links.set_hardware_address(alone.vnic.index, OTHER).unwrap();
        alone.vnic.obey(&Order::Up).unwrap();
        assert_eq!(alone.link().address, Some(STATION.0));
    });
}

#[test]
fn with_hosts_behind_it_a_device_may_have_any_ethernet_address() {
    in_a_namespace("with_hosts_behind_it_a_device_may_have_any_ethernet_address", || {
        const OTHER: [u8; 6] = [2, 0, 0, 0, 0, 0x99];
        let mut alone = Alone::new(&[], true);
        assert_eq!(alone.link().address, Some(STATION.0));
        alone.links.set_hardware_address(alone.vnic.index, OTHER).unwrap();
        alone.hear();
        alone.vnic.obey(&Order::Up).unwrap();
        assert_eq!((alone.told(), alone.link().address), (vec![], Some(OTHER)));
    });
}

#[test]
fn an_mtu_that_somebody_sets_is_set_back_and_told() {
    in_a_namespace("an_mtu_that_somebody_sets_is_set_back_and_told", || {
        let mut alone = Alone::new(&["fd00::2/64"], false);
        alone.set_mtu(1300);
        alone.hear();
        assert_eq!(alone.told(), [""; 0]);
        for mtu in [1000, 1450] {
            alone.links.set_mtu(alone.vnic.index, mtu).unwrap();
            alone.hear();
            let line = format!(
                "the MTU of 'vnic0' was set to {mtu} by somebody: set back to 1300; `rtnet vnic set --mtu` sets it"
            );
            assert_eq!((alone.told(), alone.link().mtu), (vec![line], 1300));
        }
        alone.follow();
        assert_eq!(alone.addresses(), ["fd00::2/64"]);
    });
}

#[test]
fn what_linux_takes_away_for_a_moment_is_given_again() {
    in_a_namespace("what_linux_takes_away_for_a_moment_is_given_again", || {
        let mut alone = Alone::new(&["fd00::2/64"], false);
        let index = alone.vnic.index;
        alone.hear();
        alone.follow();
        for times in [0, 1] {
            match times {
                0 => [1000, MTU].map(|mtu| alone.links.set_mtu(index, mtu).unwrap()),
                _ => [false, true].map(|is_up| alone.links.set_up(index, is_up).unwrap()),
            };
            assert_eq!(alone.addresses(), [""; 0]);
            alone.hear();
            alone.follow();
            assert_eq!((alone.addresses(), alone.told()), (vec!["fd00::2/64".into()], vec![]));
        }
    });
}

#[test]
fn who_has_missed_something_looks_at_all_of_the_device() {
    in_a_namespace("who_has_missed_something_looks_at_all_of_the_device", || {
        let mut alone = Alone::new(&[], false);
        alone.links.set_mtu(alone.vnic.index, 1000).unwrap();
        alone.links.set_hardware_address(alone.vnic.index, [2, 0, 0, 0, 0, 0x99]).unwrap();
        alone.vnic.hear(&Heard::Missed);
        alone.vnic.look();
        let link = alone.link();
        assert_eq!((link.mtu, link.address, alone.told().len()), (MTU, Some(STATION.0), 2));
    });
}

#[test]
fn an_mtu_that_could_not_be_set_is_tried_again() {
    in_a_namespace("an_mtu_that_could_not_be_set_is_tried_again", || {
        let mut alone = Alone::new(&[], false);
        alone.vnic.mouth.shared.mtu.store(1000, Ordering::Relaxed);
        let index = std::mem::replace(&mut alone.vnic.index, 9999);
        for _ in 0..2 {
            alone.follow();
        }
        let line = "the MTU of 'vnic0' does not follow the slots: cannot set the MTU of 'vnic0' to 1000: no such interface \
                    in the namespace";
        assert_eq!(alone.told(), [line]);
        alone.vnic.index = index;
        alone.follow();
        assert_eq!(alone.link().mtu, 1000);
    });
}

#[test]
fn an_address_that_could_not_be_given_is_tried_again() {
    in_a_namespace("an_address_that_could_not_be_given_is_tried_again", || {
        let mut alone = Alone::new(&["fd00::2/64"], false);
        let index = alone.vnic.index;
        alone.set_mtu(600);
        alone.set_mtu(MTU);
        let own = "fd00::2".parse().unwrap();
        alone.links.remove_address(index, own, 64).unwrap();
        // Somebody is in the way.
        alone.links.add_address(index, own, 48).unwrap();
        alone.vnic.owes_addresses = true;
        for _ in 0..2 {
            alone.follow();
        }
        let line = "'vnic0' lacks an address: cannot give 'vnic0' the address fd00::2/64: ";
        let told = alone.told();
        assert!(told.len() == 1 && told[0].starts_with(line), "{told:?}");
        alone.links.remove_address(index, own, 48).unwrap();
        alone.follow();
        assert_eq!(alone.addresses(), ["fd00::2/64"]);
    });
}

#[test]
fn a_slot_too_small_for_linux_is_told_of_once_and_in_the_status() {
    in_a_namespace("a_slot_too_small_for_linux_is_told_of_once_and_in_the_status", || {
        let mut alone = Alone::new(&[], false);
        let line = "the slot takes 60 bytes of inner payload, a device of Linux at least 68: what is longer is lost; make slot 1, \
                    or what stands for it, 72 or more";
        for (takes, remarks) in [(60, vec![line]), (68, vec![]), (60, vec![line])] {
            alone.vnic.mouth.shared.mtu.store(takes, Ordering::Relaxed);
            alone.follow();
            alone.follow();
            assert_eq!(
                (alone.told(), alone.link().mtu),
                (remarks.iter().map(|line| line.to_string()).collect(), 68)
            );
            assert_eq!(alone.vnic.status().unwrap().remarks, remarks);
        }
    });
}

#[test]
fn a_name_that_somebody_else_has_taken_is_said_with_what_can_be_done() {
    in_a_namespace("a_name_that_somebody_else_has_taken_is_said_with_what_can_be_done", || {
        let mut alone = Alone::new(&[], false);
        let told = |refused: OpenError| refused.to_string();
        for (name, why) in [
            ("b0", "the name 'b0' is taken: choose another by `--vnic-name`"),
            (NAME, "the name 'vnic0' is taken: choose another by `--vnic-name`"),
            (".", "'.' is no name for a device"),
            ("a%s", "'a%s' is no name for a device"),
            ("a/b", "'a/b' is no name for a device"),
        ] {
            let refused = Device::open(Some(name), Mode::Tap).err().map(told).expect(name);
            assert!(refused.starts_with(&format!("no VNIC: {why}")), "{refused}");
        }
        alone.links.set_up(alone.vnic.index, false).unwrap();
        alone.vnic.lose_device();
        let line = "the VNIC's device 'vnic0' was deleted or moved to another namespace by somebody: `rtnet vnic up` makes it \
                    anew";
        assert_eq!(alone.told(), [line]);
        // Nobody is behind it, but it outlives its maker: its driver would have it.
        let device = Device::open(Some(NAME), Mode::Tap).unwrap();
        device.outlive();
        drop(device);
        let refused = alone.vnic.obey(&Order::Up).unwrap_err().to_string();
        let remedy = "free it (`ip link set vnic0 down name ANOTHER`), or start the station anew with another `--vnic-name`";
        assert_eq!(refused, format!("no VNIC: the name 'vnic0' is taken meanwhile: {remedy}"));
    });
}

#[test]
fn an_mtu_that_no_tunnel_takes_is_refused() {
    in_a_namespace("an_mtu_that_no_tunnel_takes_is_refused", || {
        let mut alone = Alone::new(&[], false);
        let refused = alone.set(Change { mtu: Some(1497), ..Change::default() }).unwrap_err();
        let line = "an MTU of 1497 is too much: say 1496 or less (a tunnel takes 1496, a proxy 1500)";
        assert_eq!((refused.as_str(), alone.vnic.options.mtu), (line, MTU));
    });
}
