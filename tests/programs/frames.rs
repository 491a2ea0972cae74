//! Whole frames: what programs see of them, and what of a socket's options is in them.

use rtnet::api::PacketSocket;
use rtnet::socket::Sender;
use rtnet::wire::ethernet::{Address, EtherType, HEADER_LEN};
use rtnet::wire::ipv4;
use tests::ends::End;
use tests::stacks::address;

use super::*;

const OWN: EtherType = EtherType(0x88b6);
const OTHER: EtherType = EtherType(0x88b7);

/// A frame of station 1 for station 0, padded as on the medium.
fn frame(ether_type: EtherType) -> Vec<u8> {
    let header = [address(0).0, address(1).0].concat();
    let mut frame = [&header[..], &ether_type.0.to_be_bytes(), b"content"].concat();
    frame.resize(60, 0);
    frame
}

/// A datagram of station 1 for a port of station 0.
fn datagram(data: &[u8]) -> Vec<u8> {
    let mut sender = End::new((address(1), ip(1)));
    sender.knows((address(0), ip(0)));
    let socket = sender.socket(9, 1);
    sender.send(socket, data, Some(SocketAddrV4::new(ip(0), PORT))).unwrap();
    sender.leaves(1).remove(0)
}

fn packet(site: &Site, mode: LinkMode, link_type: LinkType) -> PacketSocket {
    let socket = site.station.packet(mode, link_type).unwrap();
    socket.set_timeout(Some(PATIENCE));
    socket
}

/// What has come, and the sender's address and type.
fn receive(socket: &PacketSocket) -> (Vec<u8>, (Address, EtherType)) {
    let mut room = [0; 2_000];
    let received = socket.receive(&mut room).unwrap();
    let Sender::Link(from) = received.from else { panic!("{received:?}") };
    (room[..received.len].to_vec(), (from.address, from.ether_type))
}

#[test]
fn a_program_receives_and_sends_whole_frames_in_raw_mode_and_their_content_otherwise() {
    let site = Site::new();
    let raw = packet(&site, LinkMode::Raw, LinkType::Only(OWN));
    let content = packet(&site, LinkMode::Datagram, LinkType::Only(OTHER));
    let (own, other) = (frame(OWN), frame(OTHER));
    site.coming.lock().unwrap().extend([own.clone(), other.clone()]);
    assert_eq!(receive(&raw), (own.clone(), (address(1), OWN)));
    assert_eq!(receive(&content), (other[HEADER_LEN..].to_vec(), (address(1), OTHER)));
    assert_eq!(number(raw.try_receive(&mut [])), Errno::EAGAIN, "one of another type is not for it");

    // As it is, be its sender who it may.
    raw.send(&own).unwrap();
    site.left(1);
    content.send_to(b"content", address(1), OTHER).unwrap();
    let from_here = [&address(1).0[..], &address(0).0, &other[12..]].concat();
    assert_eq!(site.left(2), [own, from_here]);
}

#[test]
fn a_tap_of_all_types_sees_what_other_sockets_receive_and_they_receive_it_all_the_same() {
    let site = Site::new();
    let tap = packet(&site, LinkMode::Raw, LinkType::All);
    let own = packet(&site, LinkMode::Datagram, LinkType::Only(OWN));
    let [_, udp] = site.sockets();
    udp.set_timeout(Some(PATIENCE));
    let all = [frame(OWN), datagram(b"for a port"), frame(OTHER)];
    site.coming.lock().unwrap().extend(all.clone());
    let seen = [(); 3].map(|()| receive(&tap));
    assert_eq!(seen.each_ref().map(|(frame, _)| frame), all.each_ref());
    assert_eq!(seen.map(|(_, (_, ether_type))| ether_type), [OWN, EtherType::IPV4, OTHER]);
    assert_eq!(receive(&own).0, frame(OWN)[HEADER_LEN..]);
    let mut room = [0; 20];
    let len = udp.receive(&mut room).unwrap().len;
    assert_eq!(&room[..len], b"for a port");
}

#[test]
fn a_sockets_type_of_service_is_in_the_headers_of_what_it_sends() {
    let site = Site::new();
    let (usual, urgent) = (site.station.udp().unwrap(), site.station.udp().unwrap());
    let to = SocketAddrV4::new(ip(1), 9);
    urgent.set_tos(0xb8);
    // Two fragments.
    urgent.send_to(&[7; 2_000], to).unwrap();
    site.left(2);
    usual.send_to(b"as usual", to).unwrap();
    site.left(3);
    urgent.set_tos(0x10);
    urgent.send_to(b"from now on", to).unwrap();
    let tos = site.left(4).into_iter().map(|frame| ipv4::parse(&frame[HEADER_LEN..]).unwrap().0.tos());
    assert_eq!(tos.collect::<Vec<_>>(), [0xb8, 0xb8, 0, 0x10]);
}
