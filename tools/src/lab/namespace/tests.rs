//! These need root, and say SKIP without.

use std::process::Command;

use pnet_datalink::{Channel, Config, DataLinkReceiver, DataLinkSender};

use super::*;

const A: [u8; 6] = [0x02, 0, 0, 0, 0, 0x0a];
const B: [u8; 6] = [0x02, 0, 0, 0, 0, 0x0b];
const C: [u8; 6] = [0x02, 0, 0, 0, 0, 0x0c];
const BROADCAST: [u8; 6] = [0xff; 6];

/// IEEE 802 local experimental EtherType 1.
const ETHER_TYPE: [u8; 2] = [0x88, 0xb5];

fn is_root() -> bool {
    let root = nix::unistd::geteuid().is_root();
    if !root {
        let _ = std::io::Write::write_all(&mut std::io::stderr(), b"SKIP: needs root\n");
    }
    root
}

fn three_stations() -> (Segment, [Namespace; 3]) {
    let mut segment = Segment::new().unwrap();
    let stations = [A, B, C].map(|mac| {
        let station = Namespace::new().unwrap();
        segment.attach(&station, &format!("port{}", mac[5]), "rt0", mac).unwrap();
        station
    });
    (segment, stations)
}

fn packet_socket(station: &Namespace) -> (Box<dyn DataLinkSender>, Box<dyn DataLinkReceiver>) {
    let open = || {
        let interface = pnet_datalink::interfaces().into_iter().find(|i| i.name == "rt0").unwrap();
        let config =
            Config { read_timeout: Some(Duration::from_secs(20)), promiscuous: false, ..Config::default() };
        let Channel::Ethernet(sender, receiver) = pnet_datalink::channel(&interface, config).unwrap() else {
            panic!("not an Ethernet channel")
        };
        (sender, receiver)
    };
    station.run(open).unwrap()
}

fn frame(destination: [u8; 6], source: [u8; 6], payload: u8) -> Vec<u8> {
    [&destination[..], &source[..], &ETHER_TYPE[..], &[payload; 46][..]].concat()
}

#[test]
fn frames_reach_their_addressee_and_broadcasts_everyone() {
    if !is_root() {
        return;
    }
    let (_segment, stations) = three_stations();
    let [(mut a, _), (_, mut b), (_, mut c)] = stations.each_ref().map(packet_socket);
    let (unicast, broadcast) = (frame(B, A, 1), frame(BROADCAST, A, 2));
    a.send_to(&unicast, None).unwrap().unwrap();
    a.send_to(&broadcast, None).unwrap().unwrap();
    // The first frame that anyone receives is ours: the stack itself says nothing.
    assert_eq!(b.next().unwrap(), unicast);
    assert_eq!(b.next().unwrap(), broadcast);
    assert_eq!(c.next().unwrap(), broadcast);
}

#[test]
fn bridge_does_not_learn() {
    if !is_root() {
        return;
    }
    let (_segment, stations) = three_stations();
    let [(mut a, mut from_a), (mut b, _), (_, mut c)] = stations.each_ref().map(packet_socket);
    let stranger = [0x02, 0, 0, 0, 0, 0xdd];
    let (introduction, reply) = (frame(BROADCAST, stranger, 1), frame(stranger, B, 2));
    a.send_to(&introduction, None).unwrap().unwrap();
    assert_eq!(c.next().unwrap(), introduction);
    b.send_to(&reply, None).unwrap().unwrap();
    // Had the bridge learnt that the stranger is at a, the reply would not reach c.
    assert_eq!(c.next().unwrap(), reply);
    assert_eq!(from_a.next().unwrap(), reply);
}

#[test]
fn attached_station_is_up_with_its_mac_and_known_to_the_bridge() {
    if !is_root() {
        return;
    }
    let (mut segment, station) = (Segment::new().unwrap(), Namespace::new().unwrap());
    segment.attach(&station, "a", "rt0", A).unwrap();
    let link = station.netlink().unwrap().link("rt0").unwrap();
    assert_eq!(link.mac, Some(A));
    assert!(link.operational);
    let mut netlink = segment.namespace().netlink().unwrap();
    let port = netlink.link("a").unwrap();
    assert!(port.operational && port.forwarding);
    assert_eq!(port.bridge, Some(netlink.link_index(segment.bridge_name()).unwrap()));
    assert_eq!(netlink.static_fdb(port.index).unwrap(), [A]);
    // A port can be taken out (`lo` is no bridge, but the old bridge loses the port) and put back.
    assert!(netlink.set_master(port.index, 1).is_err());
    assert_eq!(netlink.link("a").unwrap().bridge, None);
    netlink.set_master(port.index, port.bridge.unwrap()).unwrap();
    assert_eq!(netlink.link("a").unwrap().bridge, port.bridge);
    assert!(segment.detach("br0").is_err());
    segment.detach("a").unwrap();
    assert!(station.netlink().unwrap().link("rt0").is_err());
}

#[test]
fn process_started_inside_lives_inside() {
    if !is_root() {
        return;
    }
    let (mut segment, station) = (Segment::new().unwrap(), Namespace::new().unwrap());
    segment.attach(&station, "a", "rt0", A).unwrap();
    let devices = station.run(|| Command::new("cat").arg("/proc/self/net/dev").output()).unwrap().unwrap();
    assert!(String::from_utf8_lossy(&devices.stdout).contains("rt0:"));
}

#[test]
fn dropped_handles_leave_nothing_behind() {
    if !is_root() {
        return;
    }
    let links = || Netlink::open().unwrap().links().unwrap();
    let before = links();
    let (mut segment, station) = (Segment::new().unwrap(), Namespace::new().unwrap());
    segment.attach(&station, "a", "rt0", A).unwrap();
    assert_eq!(links(), before);
    let mut survivor = station.netlink().unwrap();
    assert!(survivor.link("rt0").is_ok());
    drop(segment);
    // The segment's namespace takes the wire with it; the kernel does so from a work queue.
    let gone = (0..2_000).any(|_| {
        thread::sleep(Duration::from_millis(10));
        survivor.link("rt0").is_err()
    });
    assert!(gone);
    drop((survivor, station));
    assert_eq!(links(), before);
}

#[test]
fn refusals_name_the_interface_and_the_remedy() {
    if !is_root() {
        return;
    }
    let (mut segment, station) = (Segment::new().unwrap(), Namespace::new().unwrap());
    let mut refused = |port: &str, interface: &str, mac: [u8; 6]| {
        format!("{:#}", segment.attach(&station, port, interface, mac).unwrap_err())
    };
    let long = refused("a", "sixteen-bytes-xx", A);
    assert!(long.contains("`sixteen-bytes-xx` has 16 bytes, the kernel takes at most 15"), "{long}");
    let multicast = refused("a", "rt0", BROADCAST);
    assert!(multicast.contains("ff:ff:ff:ff:ff:ff cannot be a station's"), "{multicast}");
    let taken = refused("br0", "rt0", A);
    assert!(taken.contains("choose another name"), "{taken}");
    segment.attach(&station, "a", "rt0", A).unwrap();
    let second = format!("{:#}", segment.attach(&station, "b", "rt0", B).unwrap_err());
    println!("{second}");
    assert!(second.contains("choose another name"), "{second}");
    let double = format!("{:#}", segment.attach(&station, "b", "rt1", A).unwrap_err());
    assert!(double.contains("another station has this MAC"), "{double}");
    assert!(station.netlink().unwrap().link("rt1").is_err(), "a failed wire was left behind");
}

#[test]
fn without_root_the_remedy_is_named() {
    if nix::unistd::geteuid().is_root() {
        let _ = std::io::Write::write_all(&mut std::io::stderr(), b"SKIP: needs a user other than root\n");
        return;
    }
    let refused = format!("{:#}", Namespace::new().unwrap_err());
    assert!(refused.contains("needs root (CAP_SYS_ADMIN): run it as root"), "{refused}");
}

#[test]
fn panic_inside_goes_on_outside() {
    if !is_root() {
        return;
    }
    let station = Namespace::new().unwrap();
    let outcome = std::panic::catch_unwind(|| station.run(|| panic!("inside")));
    assert!(outcome.is_err());
}
