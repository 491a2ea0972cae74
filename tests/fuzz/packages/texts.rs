//! Files of priorities and routes, and names.

use super::*;

fn said(error: &str) -> u64 {
    assert!(error.starts_with("a.toml:"), "{error}");
    assert!(error.chars().count() < 1_000 && !error.chars().any(char::is_control), "{error:?}");
    // Places and figures are no other kind of mistake.
    outcome(error.bytes().filter(u8::is_ascii_alphabetic).take(40).map(u64::from))
}

#[test]
fn package_priorities_takes_any_text() {
    let file =
        "[class.Pilot]   # its name\ntask = 70\npackage = 231\nchannel = 2\n\n[class.0x80]\nlevel = 3\n";
    fuzz(&Target {
        name: "package_priorities",
        seeds: [file, "", "[class]\n", "class.Gyro.level = 30\n[class.1]\ntask = 99\npackage = 0\n"]
            .map(|text| text.as_bytes().to_vec())
            .into(),
        has_corpus: true,
        mutate: mutate::text,
        run: |text| vec![priorities(text)],
    });
}

fn priorities(bytes: &[u8]) -> u64 {
    let text = String::from_utf8_lossy(bytes);
    let priorities = match Priorities::parse(&text, "a.toml") {
        Err(error) => return said(&error.to_string()),
        Ok(priorities) => priorities,
    };
    let mut told = vec![u64::MAX];
    for class in (0..=255).map(Class) {
        let (package, level) = (priorities.package(class), priorities.level(class));
        assert_eq!((level, level.level()), (level_of(package), ((255 - package) / 8).min(30)));
        assert!(priorities.task(class).is_none_or(|task| (1..=99).contains(&task)));
        let is_rule = (priorities.task(class), package, priorities.channel(class))
            == (None, 255 - 8 * (class.0 >> 4), 0);
        // Of what is not named in any form the rule holds.
        let names_it = class.name().is_some_and(|name| text.to_lowercase().contains(&name.to_lowercase()));
        assert!(is_rule || names_it || text.contains(|digit: char| digit.is_ascii_digit()), "{class}");
        told.extend((!is_rule).then_some(u64::from(class.0)));
    }
    told.truncate(4);
    outcome(told)
}

#[test]
fn package_routes_takes_any_text() {
    let file = "[[route]]\nto = \"0.Pilot.*\"\nstation = \"10.0.0.2\"\n\n[[route]]\nto = \"0.*.*\"\nstation = \"arm\"\n\n\
                [[route]]\nto = \"Gyro(0/1).3\"\nstation = \"10.0.0.4\"\n";
    fuzz(&Target {
        name: "package_routes",
        seeds: [file, "", "route = []\n", "route = [{ to = '*.*.*', station = '10.0.0.9' }]\n"]
            .map(|text| text.as_bytes().to_vec())
            .into(),
        has_corpus: true,
        mutate: mutate::text,
        run: |text| vec![routes(text)],
    });
}

fn routes(bytes: &[u8]) -> u64 {
    let text = String::from_utf8_lossy(bytes);
    let own = Own { station: Ipv4Addr::new(10, 0, 0, 2), system: 0 };
    let stations = |name: &str| (name == "arm").then_some(Ipv4Addr::new(10, 0, 0, 3));
    let routes = match Routes::parse(&text, "a.toml", own, stations) {
        Err(error) => return said(&error.to_string()),
        Ok(routes) => routes,
    };
    assert!(routes.len() <= MOST_ROUTES);
    let all: Vec<_> = routes.iter().collect();
    for route in &all {
        assert_eq!(route.to.to_string().parse(), Ok(route.to), "read as it is shown");
        let is_station =
            !route.station.is_unspecified() && !route.station.is_multicast() && !route.station.is_broadcast();
        assert!(is_station, "{}", route.station);
    }
    for name in [0, 0x0018_0103, 0x0012_0000, 0x001e_0103, u32::MAX].map(MailboxName) {
        // Of all that match, as the text of the pattern says, that with most places, of those the further left.
        let places =
            |to: &Pattern| -> Vec<bool> { to.to_string().split('.').map(|place| place != "*").collect() };
        let matches = |to: &Pattern| {
            let exact = Pattern::exact(name).to_string();
            let (ours, theirs) = (to.to_string(), exact.split('.').collect::<Vec<_>>());
            ours.split('.').zip(theirs).all(|(ours, theirs)| ours == "*" || ours == theirs)
        };
        let best = all.iter().filter(|route| matches(&route.to)).max_by_key(|route| {
            let mut places = places(&route.to);
            places.resize(4, false);
            (places.iter().filter(|said| **said).count(), places)
        });
        let is_own = name.system() == own.system;
        let expected = best.map(|route| route.station).filter(|station| is_own && *station != own.station);
        assert_eq!(routes.find(name), expected, "{name}");
    }
    outcome([u64::MAX, routes.len() as u64, routes.to_itself() as u64])
}

#[test]
fn package_names_takes_any_text() {
    let texts = [
        "Odometry(0/1).3",
        "0.Odometry.1.3",
        "0.0x12.1.3",
        "0x00120103",
        "*.Pilot.*.3",
        "0xff(255/255).255",
        "*(*/*)",
        "255.255.255.255",
        "18(0x0/0X1).0",
        "PtzDrive",
        "0x80",
    ];
    let change = |random: &mut Random, input: &mut Vec<u8>, other: &[u8]| {
        const MARKS: &[u8] = b"0123456789abcdefxX.*()/+- ";
        let at = random.below(input.len() as u64 + 1) as usize;
        match random.below(4) {
            0 => input.insert(at, MARKS[random.below(MARKS.len() as u64) as usize]),
            1 if at < input.len() => input[at] = MARKS[random.below(MARKS.len() as u64) as usize],
            2 => mutate::text(random, input, other),
            _ => mutate::bytes(random, input, other),
        }
    };
    fuzz(&Target {
        name: "package_names",
        seeds: texts.map(|text| text.as_bytes().to_vec()).into(),
        has_corpus: true,
        mutate: change,
        run: |text| names(text).to_vec(),
    });
}

/// A place as another reads it: `Some(None)` is any.
fn place_by_another(text: &str, is_class: bool) -> Option<Option<u8>> {
    if text == "*" {
        return Some(None);
    }
    let named =
        Class::NAMED.iter().find(|(_, name)| is_class && name.to_lowercase() == text.to_ascii_lowercase());
    if let Some((class, _)) = named {
        return Some(Some(class.0));
    }
    let lower = text.to_ascii_lowercase();
    let (digits, base) = match lower.strip_prefix("0x") {
        Some(digits) => (digits, 16u32),
        None => (&*lower, 10),
    };
    let mut number = 0u32;
    for digit in digits.chars() {
        let digit = "0123456789abcdef".find(digit).filter(|&digit| digit < base as usize)?;
        number = (number * base + digit as u32).min(1_000);
    }
    (!digits.is_empty() && number < 256).then_some(Some(number as u8))
}

/// All four places; the last is `None` if it is not said.
fn places_by_another(text: &str) -> Option<[Option<Option<u8>>; 4]> {
    if let Some((class, rest)) = text.split_once('(') {
        let (system, rest) = rest.split_once('/')?;
        let (instance, local) = rest.split_once(')')?;
        let local =
            if local.is_empty() { None } else { Some(place_by_another(local.strip_prefix('.')?, false)?) };
        let [system, instance] = [system, instance].map(|text| place_by_another(text, false));
        return Some([Some(system?), Some(place_by_another(class, true)?), Some(instance?), local]);
    }
    let places: Vec<&str> = text.split('.').collect();
    match places[..] {
        [whole] => {
            let digits = whole.strip_prefix("0x").or_else(|| whole.strip_prefix("0X"))?;
            let is_number = !digits.is_empty() && digits.chars().all(|digit| digit.is_ascii_hexdigit());
            let number = u64::from_str_radix(digits.trim_start_matches('0'), 16);
            let number = if digits.trim_start_matches('0').is_empty() { Ok(0) } else { number };
            let number = u32::try_from(number.ok().filter(|_| is_number)?).ok()?;
            Some(number.to_be_bytes().map(|place| Some(Some(place))))
        }
        [system, class, instance] => Some([
            Some(place_by_another(system, false)?),
            Some(place_by_another(class, true)?),
            Some(place_by_another(instance, false)?),
            None,
        ]),
        [system, class, instance, local] => Some([
            Some(place_by_another(system, false)?),
            Some(place_by_another(class, true)?),
            Some(place_by_another(instance, false)?),
            Some(place_by_another(local, false)?),
        ]),
        _ => None,
    }
}

fn names(bytes: &[u8]) -> [u64; 3] {
    let text = String::from_utf8_lossy(bytes);
    let (name, pattern, class) =
        (text.parse::<MailboxName>(), text.parse::<Pattern>(), text.parse::<Class>());
    let theirs = places_by_another(&text);
    // A name has no '*', and where it says no local, it is 0; a pattern's is any then.
    let expected = theirs.and_then(|[system, class, instance, local]| {
        let local = local.unwrap_or(Some(0))?;
        Some(MailboxName(u32::from_be_bytes([system??, class??, instance??, local])))
    });
    assert_eq!(name.as_ref().ok().copied(), expected, "{text:?}");
    let expected = theirs.map(|[system, class, instance, local]| {
        let [system, class, instance, local] = [system, class, instance, local].map(Option::flatten);
        Pattern::new(system, class.map(Class), instance, local)
    });
    assert_eq!(pattern.as_ref().ok().copied(), expected, "{text:?}");
    let expected = place_by_another(&text, true).flatten().map(Class);
    assert_eq!(class.as_ref().ok().copied(), expected, "{text:?}");
    if let Ok(name) = &name {
        assert_eq!(name.to_string().parse(), Ok(*name));
        assert!(pattern.as_ref().is_ok_and(|pattern| pattern.matches(*name)));
    }
    if let Ok(pattern) = &pattern {
        assert_eq!(pattern.to_string().parse(), Ok(*pattern));
    }
    // What is wrong, without the text itself.
    let why = |error: &dyn std::fmt::Display| {
        let said = error.to_string();
        let why = said.rsplit_once(": expected").or(said.split_once("its ")).map_or("", |(_, why)| why);
        outcome(why.bytes().take(12).map(u64::from))
    };
    let known = |place: Option<Option<u8>>| place.map_or(2, |place| u64::from(place.is_none()));
    [
        name.as_ref().map_or_else(|error| why(error), |name| outcome([1, u64::from(name.local() == 0)])),
        pattern
            .as_ref()
            .map_or_else(|error| why(error), |_| outcome(theirs.into_iter().flatten().map(known))),
        class.as_ref().map_or_else(|error| why(error), |class| outcome([2, class.name().is_some().into()])),
    ]
}
