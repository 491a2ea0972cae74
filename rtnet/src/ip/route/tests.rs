use super::*;

fn ip(text: &str) -> Ipv4Addr {
    text.parse().unwrap()
}

fn station(last: u8) -> Address {
    Address([2, 0, 0, 0, 0, last])
}

fn host(text: &str, last: u8, origin: Origin) -> HostRoute {
    HostRoute { ip: ip(text), address: station(last), origin }
}

fn network(text: &str, gateway: &str) -> NetworkRoute {
    NetworkRoute { network: text.parse().unwrap(), gateway: ip(gateway) }
}

fn routes() -> Routes {
    let own = Interface { address: station(1), ip: ip("10.0.0.1"), prefix: 24 };
    Routes::new(own, 4, 3)
}

#[test]
fn the_longest_prefix_wins_and_a_host_is_the_longest() {
    let mut routes = routes();
    for route in [host("10.0.0.3", 3, Origin::Static), host("10.0.0.4", 4, Origin::Static)] {
        routes.add_host(route).unwrap();
    }
    for route in [network("0.0.0.0/0", "10.0.0.3"), network("10.9.0.0/16", "10.0.0.4")] {
        routes.add_network(route).unwrap();
    }
    routes.add_network(network("10.9.1.0/24", "10.0.0.3")).unwrap();
    routes.add_host(host("10.9.1.7", 7, Origin::Static)).unwrap();
    for (destination, hop) in [
        ("10.0.0.1", Hop::Loopback),
        ("127.0.0.1", Hop::Loopback),
        ("10.0.0.255", Hop::Medium(Address::BROADCAST)),
        ("255.255.255.255", Hop::Medium(Address::BROADCAST)),
        ("10.0.0.3", Hop::Medium(station(3))),
        ("10.9.2.1", Hop::Medium(station(4))),
        ("10.9.1.1", Hop::Medium(station(3))),
        ("10.9.1.7", Hop::Medium(station(7))),
        ("192.168.1.1", Hop::Medium(station(3))),
    ] {
        assert_eq!(routes.lookup(ip(destination)), Some(hop), "{destination}");
    }
}

#[test]
fn who_has_no_route_is_not_asked_for() {
    let mut routes = routes();
    assert_eq!(routes.lookup(ip("10.0.0.9")), None, "a neighbour that nobody told of");
    routes.add_network(network("10.9.0.0/16", "10.0.0.9")).unwrap();
    assert_eq!(routes.lookup(ip("10.9.0.1")), None, "a gateway that nobody told of");
    assert_eq!(routes.lookup(ip("224.0.0.1")), None);
}

#[test]
fn what_was_said_by_hand_is_changed_by_hand() {
    let mut routes = routes();
    let by_hand = host("10.0.0.3", 3, Origin::Static);
    routes.add_host(by_hand).unwrap();
    let refused = routes.add_host(host("10.0.0.3", 9, Origin::Learned));
    assert_eq!(refused, Err(RouteError::IsStatic(ip("10.0.0.3"))));
    assert_eq!(routes.hosts(), [by_hand]);
    routes.add_host(host("10.0.0.3", 4, Origin::Solicited)).unwrap();
    routes.add_host(host("10.0.0.3", 9, Origin::Learned)).unwrap();
    assert_eq!(routes.hosts(), [host("10.0.0.3", 9, Origin::Learned)]);
}

#[test]
fn a_full_table_and_an_impossible_route_are_refused_by_name() {
    let mut routes = routes();
    for last in 2..6 {
        routes.add_host(host(&format!("10.0.0.{last}"), last, Origin::Static)).unwrap();
    }
    let full = routes.add_host(host("10.0.0.9", 9, Origin::Static)).unwrap_err();
    assert!(full.to_string().contains("host routes is full: it takes 4"), "{full}");
    routes.add_host(host("10.0.0.5", 9, Origin::Static)).unwrap();
    for (text, why) in [
        ("10.0.0.1", "own"),
        ("10.0.0.255", "broadcast"),
        ("224.0.0.1", "multicast"),
        ("0.0.0.0", "unspecified"),
        ("127.0.0.2", "loopback"),
    ] {
        let refused = routes.add_host(host(text, 3, Origin::Static)).unwrap_err();
        assert!(refused.to_string().contains(why), "{text}: {refused}");
    }
    let group = HostRoute { address: Address::BROADCAST, ..host("10.0.0.2", 2, Origin::Static) };
    assert_eq!(routes.add_host(group), Err(RouteError::Group(Address::BROADCAST)));
    for last in 1..4 {
        routes.add_network(network(&format!("10.{last}.0.0/16"), "10.0.0.2")).unwrap();
    }
    let full = routes.add_network(network("10.9.0.0/16", "10.0.0.2")).unwrap_err();
    assert!(full.to_string().contains("network routes is full: it takes 3"), "{full}");
}

#[test]
fn a_route_is_deleted_once() {
    let mut routes = routes();
    routes.add_host(host("10.0.0.3", 3, Origin::Learned)).unwrap();
    routes.add_network(network("10.9.0.0/16", "10.0.0.3")).unwrap();
    for text in ["10.0.0.3", "10.9.0.0/16"] {
        let network = text.parse().unwrap();
        assert_eq!(routes.delete(network), Ok(()));
        assert_eq!(routes.delete(network), Err(RouteError::Unknown(network)));
    }
    assert_eq!(routes.lookup(ip("10.9.1.1")), None);
}

#[test]
fn networks_are_read_as_they_are_written() {
    for text in ["10.0.0.7", "10.1.0.0/16", "0.0.0.0/0"] {
        assert_eq!(text.parse::<Network>().unwrap().to_string(), text);
    }
    for bad in ["", "10.0.0", "10.0.0.7/33", "10.0.0.7/24", "10.0.0.0/", "10.0.0.0/+8", "a/8"] {
        let error = bad.parse::<Network>().unwrap_err();
        assert!(error.to_string().contains(&format!("'{bad}'")), "{error}");
    }
}
