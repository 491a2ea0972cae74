//! Those that ask the kernel do so in a network namespace of their own, with the two ends of a veth; they need root, and
//! say SKIP without.

mod shaping;
mod watch;

use std::io::Write;
use std::net::{IpAddr, Ipv4Addr, UdpSocket};
use std::thread;

use netlink_packet_core::{NLM_F_ACK, NLM_F_CREATE, NLM_F_DUMP, NLM_F_EXCL};
use netlink_packet_route::RouteNetlinkMessage;
use netlink_packet_route::address::{AddressAttribute, AddressMessage};
use netlink_packet_route::link::{InfoData, InfoKind, InfoVeth, LinkAttribute, LinkInfo, LinkMessage};
use nix::errno::Errno;
use nix::sched::{CloneFlags, unshare};

use super::*;

const A: &str = "a0";
const B: &str = "b0";
/// The kernel numbers devices one after the other, from 1.
const NOWHERE: u32 = 9999;
const ADDRESS: [u8; 6] = [2, 0, 0, 0, 0, 0x0a];

/// Runs the test on a thread that is alone in a new network namespace.
pub(crate) fn in_a_namespace(name: &'static str, test: fn()) {
    let alone = move || match unshare(CloneFlags::CLONE_NEWNET) {
        Ok(()) => test(),
        Err(errno) => {
            let _ = writeln!(std::io::stderr(), "SKIP {name}: no network namespace: {errno}");
        }
    };
    if let Err(panic) = thread::spawn(alone).join() {
        std::panic::resume_unwind(panic);
    }
}

fn add(name: &str, kind: Vec<LinkInfo>) {
    let mut link = LinkMessage::default();
    link.attributes = vec![LinkAttribute::IfName(name.into()), LinkAttribute::LinkInfo(kind)];
    let flags = NLM_F_ACK | NLM_F_CREATE | NLM_F_EXCL;
    Exchange::open().unwrap().request("add it", RouteNetlinkMessage::NewLink(link), flags, &[]).unwrap();
}

/// The indices of the two ends.
pub(crate) fn veth(links: &mut Links) -> [u32; 2] {
    let mut peer = LinkMessage::default();
    peer.attributes = vec![LinkAttribute::IfName(B.into())];
    add(A, vec![LinkInfo::Kind(InfoKind::Veth), LinkInfo::Data(InfoData::Veth(InfoVeth::Peer(peer)))]);
    [A, B].map(|name| links.find(name).unwrap().expect("it was added").index)
}

/// Both ends are up, and what is sent to `10.0.0.255` leaves at the first.
fn broadcasting(links: &mut Links) -> ([u32; 2], UdpSocket) {
    let ends = veth(links);
    for end in ends {
        links.set_up(end, true).unwrap();
    }
    links.add_address(ends[0], [10, 0, 0, 1].into(), 24).unwrap();
    let socket = UdpSocket::bind("10.0.0.1:0").unwrap();
    socket.set_broadcast(true).unwrap();
    socket.connect("10.0.0.255:9").unwrap();
    (ends, socket)
}

#[test]
fn a_device_is_found_by_its_name_and_its_number() {
    in_a_namespace("a_device_is_found_by_its_name_and_its_number", || {
        let mut links = Links::open().unwrap();
        let [a, _] = veth(&mut links);
        let found = links.find(A).unwrap().unwrap();
        assert_eq!((found.index, found.name.as_str(), found.mtu, found.is_up), (a, A, 1500, false));
        assert!(found.address.is_some());
        assert_eq!(links.get(a).unwrap(), Some(found));
        assert_eq!(links.find("nothing").unwrap(), None);
        assert_eq!(links.get(NOWHERE).unwrap(), None);
        let refused = links.find("sixteen-bytes-xx").unwrap_err();
        assert!(refused.to_string().ends_with(": an interface's name has at most 15 bytes"), "{refused}");
    });
}

#[test]
fn a_device_is_set_to_what_is_asked_for() {
    in_a_namespace("a_device_is_set_to_what_is_asked_for", || {
        let mut links = Links::open().unwrap();
        let [a, _] = veth(&mut links);
        links.set_mtu(a, 1496).unwrap();
        links.set_hardware_address(a, ADDRESS).unwrap();
        links.set_queue_length(a, 16).unwrap();
        links.set_up(a, true).unwrap();
        let link = links.get(a).unwrap().unwrap();
        assert_eq!((link.mtu, link.address, link.is_up), (1496, Some(ADDRESS), true));
        assert_eq!(queue_length(a), Some(16));
        links.set_up(a, false).unwrap();
        assert!(!links.get(a).unwrap().unwrap().is_up);
    });
}

fn queue_length(index: u32) -> Option<u32> {
    let mut question = LinkMessage::default();
    question.header.index = index;
    let question = RouteNetlinkMessage::GetLink(question);
    let replies = Exchange::open().unwrap().request("ask", question, NLM_F_ACK, &[]).unwrap();
    let [RouteNetlinkMessage::NewLink(link)] = replies.as_slice() else { panic!("{replies:?}") };
    link.attributes.iter().find_map(|attribute| match attribute {
        LinkAttribute::TxQueueLen(length) => Some(*length),
        _ => None,
    })
}

#[test]
fn a_refusal_says_what_was_wanted_and_why_it_is_not_to_be() {
    in_a_namespace("a_refusal_says_what_was_wanted_and_why_it_is_not_to_be", || {
        let mut links = Links::open().unwrap();
        let refused = links.set_mtu(NOWHERE, 1000).unwrap_err();
        let text = "cannot set the MTU of interface #9999 to 1000: no such interface in the namespace";
        assert_eq!((refused.to_string().as_str(), refused.errno()), (text, Some(Errno::ENODEV)));
        let source = std::error::Error::source(&refused).expect("the errno").to_string();
        assert_eq!(source, "No such device (os error 19)");
        assert!(!refused.is_unsupported());

        let [a, _] = veth(&mut links);
        let refused = links.set_mtu(a, usize::MAX).unwrap_err();
        assert_eq!(
            (refused.errno(), refused.said.as_deref()),
            (Some(Errno::EINVAL), Some("mtu greater than device maximum"))
        );
        let refused = links.set_hardware_address(a, [1, 0, 0, 0, 0, 1]).unwrap_err();
        let text = "cannot give interface #3 the address 01:00:00:00:00:01: the first byte must be even";
        assert!(refused.to_string().starts_with(&text.replace("#3", &format!("#{a}"))), "{refused}");
    });
}

#[test]
fn a_device_has_the_addresses_that_it_was_given_and_they_are_there_at_once() {
    let name = "a_device_has_the_addresses_that_it_was_given_and_they_are_there_at_once";
    in_a_namespace(name, || {
        let mut links = Links::open().unwrap();
        let [a, b] = veth(&mut links);
        // The kernel gives a device that is up an IPv6 address of its own: these stay down.
        let (v4, v6): (IpAddr, IpAddr) = ([10, 0, 0, 1].into(), "fd00::1".parse().unwrap());
        assert_eq!(links.addresses(a).unwrap(), []);
        for _ in 0..2 {
            links.add_address(a, v4, 24).unwrap();
        }
        assert_eq!(links.addresses(a).unwrap(), [(v4, 24)]);
        assert_eq!(broadcast_of(a), Some([10, 0, 0, 255].into()));
        assert_eq!((links.addresses(b).unwrap(), links.addresses(NOWHERE).unwrap()), (vec![], vec![]));

        match links.add_address(a, v6, 64) {
            Ok(()) => {
                links.add_address(a, v6, 64).unwrap();
                let refused = links.add_address(a, v6, 48).unwrap_err();
                let text = "it has this address with another prefix length: take that away";
                assert!(refused.to_string().ends_with(text), "{refused}");
                assert_eq!(links.addresses(a).unwrap(), [(v4, 24), (v6, 64)]);
                links.remove_address(a, v6, 64).unwrap();
            }
            Err(refused) => {
                let _ = writeln!(std::io::stderr(), "SKIP IPv6: {refused}");
            }
        }
        links.remove_address(a, v4, 24).unwrap();
        assert_eq!(links.addresses(a).unwrap(), []);

        let refused = links.remove_address(a, v4, 24).unwrap_err();
        assert_eq!(refused.errno(), Some(Errno::EADDRNOTAVAIL));
        let refused = links.add_address(a, v4, 33).unwrap_err();
        assert!(
            refused.to_string().ends_with("with IPv6 128, and the address is a single station's"),
            "{refused}"
        );
        assert_eq!(links.add_address(NOWHERE, v4, 24).unwrap_err().errno(), Some(Errno::ENODEV));
    });
}

fn broadcast_of(index: u32) -> Option<Ipv4Addr> {
    let question = RouteNetlinkMessage::GetAddress(AddressMessage::default());
    let replies = Exchange::open().unwrap().request("list", question, NLM_F_DUMP, &[]).unwrap();
    let attributes = replies.into_iter().filter_map(|reply| match reply {
        RouteNetlinkMessage::NewAddress(message) if message.header.index == index => Some(message.attributes),
        _ => None,
    });
    attributes.flatten().find_map(|attribute| match attribute {
        AddressAttribute::Broadcast(address) => Some(address),
        _ => None,
    })
}

#[test]
fn what_one_end_sends_the_other_receives() {
    in_a_namespace("what_one_end_sends_the_other_receives", || {
        let mut links = Links::open().unwrap();
        let ([a, b], socket) = broadcasting(&mut links);
        let mut sent_and_received =
            || [a, b].map(|end| links.get(end).unwrap().unwrap().statistics).map(|s| [s.sent, s.received]);
        let [[sent, _], [_, received]] = sent_and_received();
        for _ in 0..10 {
            socket.send(&[0; 100]).unwrap();
        }
        // Linux sends what it likes besides: IPv6's own.
        let [[sent_now, _], [_, received_now]] = sent_and_received();
        assert!(sent_now >= sent + 10 && received_now >= received + 10, "{sent_now} {received_now}");
    });
}

#[test]
fn a_request_that_the_kernel_does_not_know_is_unsupported() {
    let refused =
        |errno| Refused::because("do it", Some("why".into()), errno, &[(Errno::ENOENT, "a remedy")]);
    let of_rights = format!("cannot do it: why: {}", rtnet::live::rights::remedy(&["CAP_NET_ADMIN"]));
    for (errno, is_unsupported, text) in [
        (Errno::ENOENT, true, "cannot do it: why: a remedy"),
        (Errno::EOPNOTSUPP, true, "cannot do it: why"),
        (Errno::EPERM, false, &of_rights),
    ] {
        let refused = refused(errno);
        assert_eq!((refused.is_unsupported(), refused.to_string().as_str()), (is_unsupported, text));
    }
}
