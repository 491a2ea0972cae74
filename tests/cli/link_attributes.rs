//! A station and its interface's attributes: its MTU, its address, the bridge that it is a port of, and another
//! station that has it already.

use std::net::{Ipv4Addr, SocketAddrV4};

use nix::errno::Errno;
use rtnet::api::{Station as Attached, UdpSocket};
use rtnet::socket::{LinkMode, LinkType};
use rtnet::wire::ethernet::{Address, EtherType};
use serde_json::Value;
use tools::lab::namespace::Namespace;
use vnic::netlink::{Links, Refused};

use crate::host::{shared, unique};
use crate::rtnet;
use crate::station::{B, Medium, PATIENCE, Station, wait_until};

const IP: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(10, 0, 0, 2)];
const PORT: u16 = 36_000;

/// A station without slots, with an address.
fn direct(namespace: &Namespace, name: &str, ip: Ipv4Addr) -> Station {
    let ip = format!("{ip}/24");
    let arguments = ["--interface", "rt0", "--discipline", "direct", "--name", name, "--ip", &ip];
    let station = Station::start(namespace, &arguments);
    station.wait_for("Ctrl-C ends it");
    station
}

/// Changes the interface of this namespace.
fn change(namespace: &Namespace, what: impl FnOnce(&mut Links, u32) -> Result<(), Refused> + Send) {
    let change = || {
        let mut links = Links::open()?;
        let index = links.find("rt0")?.map_or(0, |link| link.index);
        what(&mut links, index)
    };
    namespace.run(change).unwrap().unwrap();
}

fn link_of(name: &str) -> Value {
    let output = rtnet().args(["if", "-S", name, "--json"]).output().unwrap();
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Waits until `rtnet if` shows an MTU.
fn wait_for_mtu(station: &Station, name: &str, mtu: usize) {
    station.wait_for(&format!("{name}: the interface 'rt0' has an MTU of {mtu}"));
    let shown = link_of(name);
    let payload = mtu.min(1_500);
    assert_eq!(
        (&shown["mtu"], &shown["channels"]["0"]["payload"]),
        (&mtu.into(), &payload.into()),
        "{shown:#}"
    );
}

fn open(name: &str) -> UdpSocket {
    let socket = Attached::named(name).unwrap().udp().unwrap();
    socket.bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT)).unwrap();
    socket.set_timeout(Some(PATIENCE));
    socket
}

#[test]
fn an_mtu_that_changes_while_a_station_runs_is_followed() {
    shared("an_mtu_that_changes_while_a_station_runs_is_followed", || {
        let medium = Medium::new();
        let names = [unique("mtu-a"), unique("mtu-b")];
        let _a = direct(&medium.a, &names[0], IP[0]);
        let b = direct(&medium.b, &names[1], IP[1]);
        let route = |of: &str, to: Ipv4Addr, address: &str| {
            let status = rtnet().args(["route", "-S", of, "add", &to.to_string(), address]).status().unwrap();
            assert!(status.success());
        };
        route(&names[1], IP[0], "02:00:00:00:00:0a");
        let [hearing, sending] = [open(&names[0]), open(&names[1])];
        let frames = Attached::named(&names[1]).unwrap();
        let frames = frames.packet(LinkMode::Datagram, LinkType::Only(EtherType::EXPERIMENTAL)).unwrap();
        for mtu in [1_000, 9_000, 300, 1_500] {
            change(&medium.b, |links, index| links.set_mtu(index, mtu));
            wait_for_mtu(&b, &names[1], mtu);
            let (data, mut room) = ([7; 1_400], [0; 2_000]);
            sending.send_to(&data, SocketAddrV4::new(IP[0], PORT)).unwrap();
            let received = hearing.receive(&mut room).unwrap();
            assert_eq!(room[..received.len], data, "at an MTU of {mtu}");
            // A frame that cannot go in fragments is refused, and its program hears of it.
            frames.send_to(&data, Address([2, 0, 0, 0, 0, 0xa]), EtherType::EXPERIMENTAL).unwrap();
            wait_until("the frame was taken", &names[1], |_| frames.is_drained());
            let error = frames.take_error().and_then(|error| error.raw_os_error()).map(Errno::from_raw);
            assert_eq!(error, (mtu < 1_400).then_some(Errno::EMSGSIZE), "at an MTU of {mtu}");
        }
    });
}

#[test]
fn a_port_of_a_bridge_is_refused_and_named_while_it_runs() {
    shared("a_port_of_a_bridge_is_refused_and_named_while_it_runs", || {
        let medium = Medium::new();
        let name = unique("bridged");
        let station = Station::slave_of_nobody(&medium.b, &name);
        let mut netlink = medium.b.netlink().unwrap();
        netlink.add_bridge("br0").unwrap();
        let [port, bridge] = ["rt0", "br0"].map(|name| netlink.link_index(name).unwrap());
        netlink.set_master(port, bridge).unwrap();
        station.wait_for("'rt0' is a port of the bridge 'br0', which takes all frames that come: use 'br0'");
        wait_until("its state is shown", &name, |status| status["link"] == "bridge port");
        netlink.set_master(port, 0).unwrap();
        station.wait_for("the interface 'rt0' is the station's again");
        netlink.set_master(port, bridge).unwrap();
        station.end();
        for role in [&["--slave", "--slot", "0=1ms"][..], &["--master", "--cycle", "5ms", "--slot", "0=1ms"]]
        {
            let arguments = [&["--interface", "rt0", "--name", &name][..], role].concat();
            let mut refused = Station::start(&medium.b, &arguments);
            refused.wait_for("rtnet: the interface 'rt0' is a port of the bridge 'br0'");
            assert_eq!(refused.ended().and_then(|status| status.code()), Some(2));
        }
    });
}

#[test]
fn another_address_of_the_interface_is_named_with_the_remedy() {
    shared("another_address_of_the_interface_is_named_with_the_remedy", || {
        let medium = Medium::new();
        let name = unique("readdressed");
        let station = Station::slave_of_nobody(&medium.b, &name);
        change(&medium.b, |links, index| links.set_hardware_address(index, [2, 0, 0, 0, 0, 0xc]));
        station.wait_for("has the address 02:00:00:00:00:0c now, and the station has 02:00:00:00:00:0b");
        wait_until("its state is shown", &name, |status| status["link"] == "other address");
        change(&medium.b, |links, index| links.set_hardware_address(index, B));
        station.wait_for("the interface 'rt0' is the station's again");
    });
}

#[test]
fn a_second_station_at_an_interface_is_refused() {
    shared("a_second_station_at_an_interface_is_refused", || {
        let medium = Medium::new();
        let name = unique("first");
        let mut first = Station::slave_of_nobody(&medium.b, &name);
        let start = |discipline: &str| {
            let arguments = ["--interface", "rt0", "--name", &unique("second"), "--discipline", discipline];
            Station::start(&medium.b, &arguments)
        };
        for discipline in ["direct", "nomac"] {
            let mut second = start(discipline);
            let line = second.wait_for("rtnet: ");
            let holder = format!("'rt0' has a station already, {name} (process {})", first.child.id());
            assert!(line.contains(&holder) && line.contains("end that one"), "{line}");
            assert_eq!(second.ended().and_then(|status| status.code()), Some(2));
        }
        // It is free again however the first one ends.
        first.child.kill().unwrap();
        first.child.wait().unwrap();
        start("direct").wait_for("Ctrl-C ends it");
        // One that was killed leaves its socket and its lock.
        for end in ["sock", "lock"] {
            std::fs::remove_file(format!("/run/rtnet/{name}.{end}")).unwrap();
        }
    });
}
