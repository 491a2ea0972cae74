use super::*;
use crate::name::Class;
use proptest::prelude::*;
use std::collections::BTreeMap;

const OWN: Own = Own { station: station(1), system: 0 };

const fn station(number: u8) -> Ipv4Addr {
    Ipv4Addr::new(10, 0, 0, number)
}

fn name(text: &str) -> MailboxName {
    text.parse().unwrap()
}

fn pattern(text: &str) -> Pattern {
    text.parse().unwrap()
}

/// Lines of `pattern station` as a file.
fn file(lines: &[&str]) -> String {
    let entry = |line: &&str| {
        let (to, station) = line.split_once(' ').unwrap();
        format!("[[route]]\nto = '{to}'\nstation = '{station}'\n")
    };
    lines.iter().map(entry).collect()
}

fn resolve(name: &str) -> Option<Ipv4Addr> {
    (name == "arm").then_some(station(3))
}

fn read(text: &str) -> Result<Routes, FileError> {
    Routes::parse(text, "routes.toml", OWN, resolve)
}

fn routes(lines: &[&str]) -> Routes {
    read(&file(lines)).unwrap()
}

fn refused(text: &str) -> String {
    read(text).unwrap_err().to_string()
}

#[test]
fn the_most_specific_route_wins_in_whatever_order_they_stand() {
    let mut lines = [
        "0.Pilot.1.3 10.0.0.2",
        "0.Pilot.1 10.0.0.3",
        "0.Pilot.* 10.0.0.4",
        "*.Pilot.1 10.0.0.5",
        "0.*.* 10.0.0.6",
        "*.*.* 10.0.0.7",
    ];
    for _ in 0..lines.len() {
        lines.rotate_left(1);
        let routes = routes(&lines);
        for (to, number) in [("Pilot(0/1).3", 2), ("Pilot(0/1)", 3), ("Pilot(0/2).3", 4), ("Gyro(0/1)", 6)] {
            assert_eq!(routes.find(name(to)), Some(station(number)), "{to}");
        }
    }
}

#[test]
fn of_patterns_that_say_as_much_the_one_further_left_wins() {
    let lines = ["*.Pilot.1 10.0.0.2", "0.*.1 10.0.0.3", "0.Pilot.* 10.0.0.4"];
    assert_eq!(routes(&lines).find(name("Pilot(0/1)")), Some(station(4)));
    assert_eq!(routes(&lines[..2]).find(name("Pilot(0/1)")), Some(station(3)));
}

#[test]
fn no_route_leads_to_a_mailbox_of_another_system() {
    let one = Own { system: 1, ..OWN };
    let text = file(&["1.Pilot.* 10.0.0.2", "*.*.* 10.0.0.3"]);
    let routes = Routes::parse(&text, "routes.toml", one, resolve).unwrap();
    assert_eq!(routes.find(name("Pilot(1/4)")), Some(station(2)));
    assert_eq!(routes.find(name("Gyro(1/4)")), Some(station(3)));
    for other in ["Pilot(0/4)", "Gyro(2/4)"] {
        assert_eq!(routes.find(name(other)), None);
        assert!(routes.is_of_other_system(name(other)));
    }
    let error = refused(&text);
    assert!(error.starts_with("routes.toml:2:6: 1.Pilot.* is not of this station's system, and "), "{error}");
    let by_hand = Routes::new(OWN).add(pattern("1.Pilot.0"), station(2));
    assert_eq!(by_hand, Err(RouteError::OtherSystem(pattern("1.Pilot.0"))));
}

#[test]
fn where_no_route_leads_there_is_none() {
    assert_eq!(Routes::new(OWN).find(name("Pilot(0/1)")), None);
    let routes = routes(&["0.Pilot.1.0 10.0.0.2"]);
    assert_eq!(routes.find(name("Pilot(0/1)")), Some(station(2)));
    for other in ["Pilot(0/1).1", "Pilot(0/2)", "Gyro(0/1)", "Pilot(1/1)"] {
        assert_eq!(routes.find(name(other)), None, "{other}");
    }
}

#[test]
fn a_route_to_the_station_itself_leads_nowhere_and_is_not_overruled_by_a_wider_one() {
    let routes = routes(&["0.Pilot.1 10.0.0.1", "0.Pilot.* 10.0.0.2"]);
    assert_eq!((routes.len(), routes.to_itself()), (2, 1));
    assert_eq!(routes.find(name("Pilot(0/1)")), None, "else it would go to a station that does not have it");
    assert_eq!(routes.find(name("Pilot(0/2)")), Some(station(2)));
    assert_eq!(routes.to_string(), "0.Pilot.1 -> 10.0.0.1 (this station)\n0.Pilot.* -> 10.0.0.2\n");
}

#[test]
fn one_file_does_for_all_stations() {
    let text = file(&["0.Pilot.* 10.0.0.1", "0.Gyro.* 10.0.0.2", "0.Ladar.* arm"]);
    for own in 1..=3 {
        let routes =
            Routes::parse(&text, "routes.toml", Own { station: station(own), ..OWN }, resolve).unwrap();
        let found = ["Pilot(0/0)", "Gyro(0/0)", "Ladar(0/0)"].map(|to| routes.find(name(to)));
        let expected = [1, 2, 3].map(|number| (number != own).then_some(station(number)));
        assert_eq!((found, routes.to_itself()), (expected, 1));
    }
}

#[test]
fn a_station_that_is_no_address_and_has_no_name_is_named_with_its_line() {
    let text = file(&["0.Pilot.* arm", "0.Gyro.* leg"]);
    let what = "is neither an IPv4 address, as 10.0.0.3, nor the name of a station";
    assert_eq!(refused(&text), format!("routes.toml:6:11: 'leg' {what}"));
    assert_eq!(refused(&file(&["0.Gyro.* 10.0.0.256"])), format!("routes.toml:3:11: '10.0.0.256' {what}"));
    assert_eq!(refused(&file(&["0.Gyro.* "])), format!("routes.toml:3:11: '' {what}"));
}

#[test]
fn an_address_where_nobody_can_be_is_refused_in_a_file_and_by_hand() {
    for (address, why) in [
        ("127.0.0.1", "loopback"),
        ("224.0.0.1", "multicast"),
        ("0.0.0.0", "unspecified"),
        ("255.255.255.255", "broadcast"),
    ] {
        let error = refused(&file(&[&format!("0.Gyro.* {address}")]));
        assert!(
            error.starts_with(&format!("routes.toml:3:11: {address} is no station's address: it is ")),
            "{error}"
        );
        assert!(error.contains(why), "{error}");
        assert!(Routes::new(OWN).add(pattern("0.Gyro.*"), address.parse().unwrap()).is_err());
    }
}

#[test]
fn a_pattern_that_leads_to_two_stations_is_refused_and_to_one_twice_is_not() {
    let error = refused(&file(&["0.Gyro.* 10.0.0.2", "0.Pilot.* 10.0.0.2", "0.0x1e.*.* arm"]));
    assert_eq!(
        error,
        "routes.toml:8:6: 0.Gyro.* leads to 10.0.0.2 by line 2 and to 10.0.0.3 by this: keep one"
    );
    assert_eq!(routes(&["0.Pilot.* arm", "Pilot(0/*) 10.0.0.3"]).len(), 1);
    let with_itself = refused(&file(&["0.Gyro.* 10.0.0.1", "0.Gyro.* 10.0.0.2"]));
    assert!(with_itself.starts_with("routes.toml:5:6: "), "at each station alike: {with_itself}");
}

#[test]
fn what_is_no_route_says_where_and_how_it_should_be() {
    for (text, says) in [
        (
            "[[route]]\nto = 'Pilt(0/1)'\nstation = 'arm'",
            "2:6: 'Pilt(0/1)' is no pattern of mailbox names: no class is called 'Pilt'",
        ),
        (
            "[[route]]\nto = '0.Pilot'\nstation = 'arm'",
            "2:6: '0.Pilot' is no pattern of mailbox names: expected one as",
        ),
        ("[[route]]\nstation = 'arm'", "1:1: missing field `to`"),
        ("\n[[route]]\nto = '0.Pilot.*'", "2:1: missing field `station`"),
        (
            "[[route]]\nto = '0.Pilot.*'\nstation = 'arm'\nvia = 'leg'",
            "4:1: unknown field `via`, expected `to` or `station`",
        ),
        ("[[routes]]\nto = '0.Pilot.*'", "1:3: unknown field `routes`, expected `route`"),
        (
            "[route]\nto = '0.Pilot.*'",
            "1:2: there may be more than one route: each is written below [[route]]",
        ),
        ("route = ['0.Pilot.*']", "1:1: there may be more than one route: each is written below [[route]]"),
        (
            "route = [['0.Pilot.*', 'arm']]",
            "1:1: there may be more than one route: each is written below [[route]]",
        ),
        ("[[route]]\nto = 7\n", "2:6: invalid type: integer `7`, expected a string"),
        ("[[route]\n", "1:9: unclosed array table, expected `]`"),
    ] {
        let error = refused(text);
        assert!(error.starts_with(&format!("routes.toml:{says}")), "{error}");
    }
    assert!(read("").unwrap().is_empty());
}

#[test]
fn routes_change_while_all_others_stay() {
    let mut routes = routes(&["0.Pilot.* 10.0.0.2", "0.Gyro.* 10.0.0.3"]);
    assert_eq!(routes.add(pattern("0.Pilot.1"), station(4)), Ok(None));
    assert_eq!(routes.add(pattern("Pilot(0/*)"), station(5)), Ok(Some(station(2))), "it leads elsewhere now");
    let found = |routes: &Routes| ["Pilot(0/1)", "Pilot(0/2)", "Gyro(0/1)"].map(|to| routes.find(name(to)));
    assert_eq!(found(&routes), [Some(station(4)), Some(station(5)), Some(station(3))]);
    assert_eq!(routes.remove(pattern("0.Pilot.1")), Ok(station(4)));
    assert_eq!(found(&routes), [Some(station(5)), Some(station(5)), Some(station(3))]);
    assert_eq!(
        routes.add(pattern("0.Pilot.*"), OWN.station),
        Ok(Some(station(5))),
        "the component moves here"
    );
    assert_eq!(found(&routes), [None, None, Some(station(3))]);
    let unknown = routes.remove(pattern("0.Pilot.1"));
    assert_eq!(unknown, Err(RouteError::Unknown(pattern("0.Pilot.1"))));
    assert_eq!(
        routes.iter().map(|route| route.to).collect::<Vec<_>>(),
        (&routes).into_iter().map(|r| r.to).collect::<Vec<_>>()
    );
}

#[test]
fn the_table_is_bounded_in_a_file_and_by_hand() {
    let lines: Vec<String> =
        (0..=MOST_ROUTES).map(|n| format!("0.{}.{} 10.0.0.2", n / 256, n % 256)).collect();
    let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
    let mut routes = routes(&lines[..MOST_ROUTES]);
    let reserved = routes.routes.capacity();
    assert_eq!(routes.len(), MOST_ROUTES);
    assert_eq!(routes.add(pattern("0.Pilot.0"), station(2)), Err(RouteError::Full));
    assert_eq!(routes.add(pattern("0.0.0"), station(3)), Ok(Some(station(2))), "a full table can be changed");
    assert_eq!(routes.routes.capacity(), reserved, "no memory was taken");
    let error = refused(&file(&lines));
    let line = 3 * MOST_ROUTES + 2;
    assert!(
        error.starts_with(&format!("routes.toml:{line}:6: the table of routes is full: it takes 256")),
        "{error}"
    );
}

proptest! {
    #[test]
    fn finds_what_the_best_of_all_matching_routes_says(
        steps in prop::collection::vec((prop::array::uniform4(prop::option::of(0u8..3)), 1u8..6, any::<bool>()), 0..60),
        names in prop::collection::vec(prop::array::uniform4(0u8..4), 1..20),
    ) {
        let mut routes = Routes::new(OWN);
        let mut model: BTreeMap<Pattern, Ipv4Addr> = BTreeMap::new();
        for ([system, class, instance, local], number, adds) in steps {
            let to = Pattern::new(system, class.map(Class), instance, local);
            if system.is_some_and(|system| system != OWN.system) {
                prop_assert_eq!(routes.add(to, station(number)), Err(RouteError::OtherSystem(to)));
            } else if adds || number < 3 {
                prop_assert_eq!(routes.add(to, station(number)), Ok(model.insert(to, station(number))));
            } else {
                prop_assert_eq!(routes.remove(to).ok(), model.remove(&to));
            }
        }
        prop_assert_eq!(routes.len(), model.len());
        for [system, class, instance, local] in names {
            let name = MailboxName::new(system, Class(class), instance, local);
            let matching = model.iter().filter(|(to, _)| to.matches(name));
            let best = matching.max_by_key(|(to, _)| to.specificity()).map(|(_, station)| *station);
            let best = best.filter(|&station| station != OWN.station && system == OWN.system);
            prop_assert_eq!(routes.find(name), best);
        }
        let lines: Vec<String> = routes.iter().map(|Route { to, station }| format!("{to} {station}")).collect();
        let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
        prop_assert_eq!(read(&file(&lines)).unwrap().routes, routes.routes, "what is shown is read as the same");
    }
}
