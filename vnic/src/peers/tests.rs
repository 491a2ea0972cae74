use super::*;

const ITSELF: Address = Address([2, 0, 0, 0, 0, 0xa]);

fn table(own: &[&str], peers: &[&str]) -> Peers {
    let mut table = Peers::new(ITSELF, own.iter().map(|text| text.parse().unwrap()).collect());
    peers.iter().for_each(|text| table.add(text.parse().unwrap()).unwrap());
    table
}

fn packet(to: &str) -> Vec<u8> {
    match to.parse().unwrap() {
        IpAddr::V4(ip) => [&[0x45; 16][..], &ip.octets(), &[0; 8]].concat(),
        IpAddr::V6(ip) => [&[0x60; 24][..], &ip.octets(), &[0; 8]].concat(),
    }
}

#[test]
fn the_longest_prefix_says_whose_an_address_is() {
    let peers = [
        "10.0.0.0/24=02:00:00:00:00:01",
        "10.0.0.3=02:00:00:00:00:03",
        "0.0.0.0/0=02:00:00:00:00:09",
        "fd00::/64=02:00:00:00:00:06",
        "fd00::7=02:00:00:00:00:07",
    ];
    let table = table(&["10.0.0.2/24"], &peers);
    for (to, station) in [
        ("10.0.0.3", Some(3)),
        ("10.0.0.4", Some(1)),
        ("10.0.1.4", Some(9)),
        ("fd00::7", Some(7)),
        ("fd00::8", Some(6)),
        ("fd01::8", None),
    ] {
        let expected = station.map(|last| Address([2, 0, 0, 0, 0, last]));
        assert_eq!(table.station_of(&packet(to)), expected, "{to}");
    }
}

#[test]
fn groups_have_addresses_of_their_own_and_all_of_a_network_are_all() {
    let table = table(&["10.0.0.2/24", "fd00::2/64"], &[]);
    for (to, address) in [
        ("255.255.255.255", "ff:ff:ff:ff:ff:ff"),
        ("10.0.0.255", "ff:ff:ff:ff:ff:ff"),
        ("224.129.2.3", "01:00:5e:01:02:03"),
        ("ff02::1:ff00:3", "33:33:ff:00:00:03"),
    ] {
        assert_eq!(table.station_of(&packet(to)), Some(address.parse().unwrap()), "{to}");
    }
    assert_eq!(table.station_of(&packet("10.0.1.255")), None, "another network's");
}

#[test]
fn what_is_no_packet_goes_to_nobody() {
    let table = table(&[], &["0.0.0.0/0=02:00:00:00:00:01", "::/0=02:00:00:00:00:01"]);
    for bytes in [&[][..], &[0x45; 19], &[0x60; 39], &[0x20; 64]] {
        assert_eq!(table.station_of(bytes), None);
    }
}

#[test]
fn the_same_addresses_are_entered_once_and_the_table_ends() {
    let mut table = table(&[], &["10.0.0.3=02:00:00:00:00:03", "10.0.0.3=02:00:00:00:00:04"]);
    assert_eq!(table.all().count(), 1);
    assert_eq!(table.station_of(&packet("10.0.0.3")), Some(Address([2, 0, 0, 0, 0, 4])));
    let peer = |n: usize| Peer {
        network: Prefix { ip: Ipv4Addr::from_bits(n as u32).into(), length: 32 },
        station: Address([2, 0, 0, 0, 0, 1]),
    };
    (1..MOST).for_each(|n| table.add(peer(n)).unwrap());
    assert_eq!(table.add(peer(MOST)), Err(PeerError::Full));
    assert_eq!(table.add(peer(7)), Ok(()), "it is known");
    let group = Peer { station: Address::BROADCAST, ..peer(1) };
    assert_eq!(table.add(group), Err(PeerError::Group(Address::BROADCAST)));
    let itself = Peer { station: ITSELF, ..peer(1) };
    assert_eq!(table.add(itself), Err(PeerError::Itself(ITSELF)));
}

#[test]
fn what_is_no_prefix_and_no_peer_is_refused_with_what_was_meant() {
    for good in ["10.0.0.2/24", "10.0.0.2/32", "fd00::2/64", "::/0"] {
        assert_eq!(good.parse::<Prefix>().unwrap().to_string(), good);
    }
    for bad in ["", "10.0.0.2/33", "10.0.0/24", "fd00::2/129", "10.0.0.2/", "10.0.0.2/+1", "10.0.0.2/24/3"] {
        let error = bad.parse::<Prefix>().unwrap_err().to_string();
        assert!(error.contains(&format!("'{bad}'")) && error.contains("as 10.0.0.2/24"), "{error}");
    }
    assert_eq!(
        "10.0.0.3=02:00:00:00:00:03".parse::<Peer>().unwrap().to_string(),
        "10.0.0.3/32=02:00:00:00:00:03"
    );
    for (bad, part) in [("10.0.0.3", "'10.0.0.3'"), ("x=02:00:00:00:00:03", "'x'"), ("10.0.0.3=02", "'02'")] {
        let error = bad.parse::<Peer>().unwrap_err().to_string();
        assert!(error.contains(part), "{error}");
    }
}

const OTHER: Address = Address([2, 0, 0, 0, 0, 3]);
const THIRD: Address = Address([2, 0, 0, 0, 0, 4]);

fn request(sender: Address, from: [u8; 4], to: [u8; 4]) -> arp::Packet {
    arp::Packet::request(sender, from.into(), to.into())
}

#[test]
fn what_is_configured_for_one_address_goes_before_arp() {
    let configured = ["10.0.0.0/24=02:00:00:00:00:01", "10.0.0.4=02:00:00:00:00:04"];
    let mut table = table(&["10.0.0.2/24"], &configured);
    for last in [3, 4] {
        assert!(table.hear(&request(OTHER, [10, 0, 0, last], [10, 0, 0, 2])).is_some());
    }
    let station = |to: &str| table.station_of(&packet(to));
    assert_eq!([station("10.0.0.3"), station("10.0.0.4")], [Some(OTHER), Some(THIRD)]);
    assert_eq!(station("10.0.0.5"), Some(Address([2, 0, 0, 0, 0, 1])));
}

#[test]
fn arp_to_others_changes_only_who_is_known() {
    let mut table = table(&["10.0.0.2/24"], &[]);
    let announced = |table: &mut Peers, station| table.hear(&request(station, [10, 0, 0, 3], [10, 0, 0, 3]));
    assert_eq!((announced(&mut table, OTHER), table.station_of(&packet("10.0.0.3"))), (None, None));
    table.hear(&request(OTHER, [10, 0, 0, 3], [10, 0, 0, 2])).unwrap();
    assert_eq!(announced(&mut table, THIRD), None);
    assert_eq!(table.station_of(&packet("10.0.0.3")), Some(THIRD));
    let moved = table.with_own(vec!["10.9.0.2/24".parse().unwrap()]);
    assert_eq!((moved.station_of(&packet("10.0.0.3")), moved.all().count()), (None, 0));
}

#[test]
fn arp_of_no_neighbour_is_not_learned() {
    let mut table = table(&["10.0.0.2/24"], &[]);
    // One that looks whether its address is free, one from beyond the network, one with this device's address.
    for from in [[0, 0, 0, 0], [10, 0, 1, 3], [10, 0, 0, 2], [10, 0, 0, 255], [224, 0, 0, 1]] {
        assert!(table.hear(&request(OTHER, from, [10, 0, 0, 2])).is_some(), "{from:?} is answered");
    }
    for sender in [Address::BROADCAST, Address([1, 0, 0x5e, 0, 0, 1]), ITSELF] {
        assert_eq!(table.hear(&request(sender, [10, 0, 0, 3], [10, 0, 0, 2])), None, "{sender}");
    }
    assert_eq!(table.all().count(), 0);
}

#[test]
fn the_oldest_neighbour_makes_room_for_a_new_one() {
    let mut table = table(&["10.0.0.2/16"], &[]);
    let ip = |n: usize| [10, 0, 1 + (n / 256) as u8, (n % 256) as u8];
    for n in 0..=MOST {
        table.hear(&request(OTHER, ip(n), [10, 0, 0, 2])).unwrap();
    }
    let known = |n: usize| table.station_of(&packet(&Ipv4Addr::from(ip(n)).to_string()));
    assert_eq!(
        (table.all().count(), known(0), known(1), known(MOST)),
        (MOST, None, Some(OTHER), Some(OTHER))
    );
}

#[test]
fn only_unknown_neighbours_are_asked_for() {
    let table = table(&["fd00::2/64", "10.0.0.2/24"], &["10.0.0.4=02:00:00:00:00:04"]);
    let asked = table.question(&packet("10.0.0.3")).unwrap();
    assert_eq!(asked, request(ITSELF, [10, 0, 0, 2], [10, 0, 0, 3]));
    for to in ["10.0.0.4", "10.0.1.3", "10.0.0.2", "10.0.0.255", "224.0.0.1", "fd00::3"] {
        assert_eq!(table.question(&packet(to)), None, "{to}");
    }
}
