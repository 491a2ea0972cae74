//! What is said of addresses: a file of routes, and arguments of `rtnet station`.

use std::fmt::Display;
use std::path::Path;

use tempfile::TempDir;
use tools::cmd::route::{parse_route, read_routes};
use tools::control::RouteSaid;
use tools::station::sockets::parse;
use tools::station::stack::{OwnIp, parse_ports};

use super::engine::{Target, fuzz, outcome};
use super::mutate;

thread_local! {
    /// Where the file is that is read: each target has its own thread.
    static FOLDER: TempDir = TempDir::new().expect("a folder");
}

/// Seeds of a target, one a line.
fn words(text: &str) -> Vec<Vec<u8>> {
    text.lines().map(|line| line.trim().as_bytes().to_vec()).collect()
}

/// Why not, without what was read and where.
fn refused(why: &str) -> u64 {
    assert!(!why.is_empty());
    let what = why.bytes().filter(u8::is_ascii_alphabetic).rev();
    outcome([0].into_iter().chain(what.take(20).map(u64::from)))
}

/// What is accepted is a route that a station takes, and reads the same as it is written.
fn accepted(said: &RouteSaid) -> u64 {
    assert!(parse(said).is_ok(), "{said:?}");
    let again = |text: String| parse_route(&text).unwrap_or_else(|why| panic!("{text}: {why}"));
    match said {
        RouteSaid::Host { ip, address } => {
            assert_eq!(again(format!("{ip}={address}")), *said);
            outcome([1, u64::from(ip.octets()[0] / 32), u64::from(address.as_bytes()[1] & 1)])
        }
        RouteSaid::Network { network, .. } => {
            outcome([2, network.split('/').nth(1).map_or(32, |prefix| prefix.parse().expect("a number"))])
        }
    }
}

#[test]
fn route_file_takes_any_text() {
    let seeds = [
        "10.0.0.7 02:00:00:00:00:07\n10.0.0.8 02:00:00:00:00:08 # the arm\n",
        "# where the others are\n\n  10.1.0.0/16 via 10.0.0.7\n0.0.0.0/0 via 10.0.0.8\r\n",
        "10.0.0.7\t02-00-00-00-00-07\n10.0.0.7/32 via 10.0.0.9\n10.1.0.1/16 via 10.0.0.9\n",
        "10.0.0.9 via\n",
    ];
    fuzz(&Target {
        name: "route_file",
        seeds: seeds.map(|seed| seed.as_bytes().to_vec()).to_vec(),
        has_corpus: true,
        mutate: mutate::text,
        run: |text| FOLDER.with(|folder| route_file(&folder.path().join("routes"), text)),
    });
}

fn route_file(file: &Path, bytes: &[u8]) -> Vec<u64> {
    std::fs::write(file, bytes).expect("room");
    let place = |line: usize| format!("{}, line {line}", file.display());
    let text = str::from_utf8(bytes);
    let lines: Vec<&str> = text.map_or(Vec::new(), |text| text.lines().collect());
    let says_something = |line: &&str| !line.split('#').next().unwrap_or_default().trim().is_empty();
    match read_routes(file) {
        Ok(routes) => {
            assert_eq!(routes.len(), lines.iter().filter(|line| says_something(line)).count());
            routes.iter().for_each(|(whence, _)| {
                let stands = (1..=lines.len()).find(|&line| *whence == place(line));
                assert!(stands.is_some_and(|line| says_something(&lines[line - 1])), "{whence}");
            });
            routes.iter().map(|(_, said)| accepted(said)).chain([routes.len().min(9) as u64]).collect()
        }
        Err(error) if text.is_err() => vec![refused(&error.to_string())],
        // The first line that is none is named.
        Err(error) => {
            let said = error.to_string();
            let named = (1..=lines.len()).find_map(|line| said.strip_prefix(&format!("{}: ", place(line))));
            vec![refused(named.unwrap_or_else(|| panic!("{said}")))]
        }
    }
}

#[test]
fn one_route_takes_any_text() {
    let seeds = words(
        "10.0.0.7=02:00:00:00:00:07
         255.255.255.255=ff:ff:ff:ff:ff:ff
         10.0.0.7 = 02:00:00:00:00:07
         10.0.0.7=10.0.0.8
         10.0.0.7",
    );
    fuzz(&Target {
        name: "one_route",
        seeds,
        has_corpus: true,
        mutate: mutate::text,
        run: |text| vec![of_text(text, parse_route, accepted)],
    });
}

#[test]
fn own_ip_takes_any_text() {
    let seeds = words(
        "10.0.0.1/24
         10.0.0.1
         192.168.7.255/16
         10.0.0.0/31
         10.0.0.255/24
         127.0.0.1/8
         224.0.0.1/4
         10.0.0.1/33",
    );
    fuzz(&Target {
        name: "own_ip",
        seeds,
        has_corpus: true,
        mutate: mutate::text,
        run: |text| vec![of_text(text, str::parse, own_ip)],
    });
}

/// It is one station's, and reads the same as it is written.
fn own_ip(own: &OwnIp) -> u64 {
    let OwnIp { ip, prefix } = *own;
    assert_eq!(format!("{ip}/{prefix}").parse().as_ref(), Ok(own));
    assert!((1..=32).contains(&prefix) && !ip.is_unspecified() && !ip.is_loopback(), "{own:?}");
    assert!(!ip.is_multicast() && !ip.is_broadcast(), "{own:?}");
    let all = u32::MAX.checked_shr(prefix.into()).unwrap_or(0);
    let which = ip.to_bits() & all;
    assert!(prefix >= 31 || (which != 0 && which != all), "{own:?} is no one station's");
    outcome([prefix.into(), u64::from(ip.octets()[0] / 64)])
}

#[test]
fn port_range_takes_any_text() {
    let seeds = words(
        "1024-1087
         1-65535
         65535-65535
         0-9
         9-8
         1024",
    );
    fuzz(&Target {
        name: "port_range",
        seeds,
        has_corpus: true,
        mutate: mutate::text,
        run: |text| {
            vec![of_text(text, parse_ports, |ports| {
                let (first, last) = (*ports.start(), *ports.end());
                assert!(first > 0 && first <= last);
                assert_eq!(parse_ports(&format!("{first}-{last}")).as_ref(), Ok(ports));
                outcome([1, first.ilog2().into(), last.ilog2().into()])
            })]
        },
    });
}

/// An argument: what is not UTF-8 does not come so far.
fn of_text<T, E: Display>(bytes: &[u8], parse: fn(&str) -> Result<T, E>, accepted: fn(&T) -> u64) -> u64 {
    match parse(&String::from_utf8_lossy(bytes)) {
        Ok(read) => accepted(&read),
        Err(error) => refused(&error.to_string()),
    }
}
