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
    assert_eq!(table.all().len(), 1);
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
