//! `rtnet route`.

use std::net::Ipv4Addr;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use rtnet::ip::route::{Interface, Network, Routes};
use rtnet::wire::ethernet::Address;
use serde::Serialize;

use super::Failure;
use super::interface::{asked, check_asked, of_interface, unasked};
use super::tdma::found_of;
use crate::cli::{RouteArgs, RouteVerb, Which};
use crate::control::{RouteSaid, RoutesShown, StackReply, StackRequest, Way};
use crate::report::document::document;
use crate::report::text::{Column, table};
use crate::station::sockets::{Route, as_shown, parse};
use crate::station::stack::add;

/// Columns of the tables.
const WIDTH: usize = 100;
/// How long an answer is waited for, and how often to look for it.
const ANSWERED_WITHIN: Duration = Duration::from_secs(1);
const LOOK_EVERY: Duration = Duration::from_millis(5);
/// Characters of a line that is no route, in an error; a route has fewer.
const SHOWN_AT_MOST: usize = 60;
/// Routes in one request, which is short.
const AT_ONCE: usize = 8;

/// Looks at a station's routes, or changes them.
pub fn route(args: &RouteArgs) -> Result<u8, Failure> {
    let which = &found_of(&args.which)?;
    match &args.verb {
        RouteVerb::List => {
            super::print(which.json, &routes(which)?, list).map_err(Failure::Run)?;
            Ok(0)
        }
        RouteVerb::Add { route } => {
            let said = parse_words(&route.join(" ")).map_err(|why| Failure::Usage(anyhow!(why)))?;
            done(which, StackRequest::AddRoutes(vec![said]))
        }
        RouteVerb::Del { network } => delete(which, *network),
        RouteVerb::Solicit { ip } => solicit(which, *ip),
        RouteVerb::Get { ip } => get(which, *ip),
        RouteVerb::Load { file } => load(which, file),
    }
}

/// Reads `IP=MAC`.
pub fn parse_route(text: &str) -> Result<RouteSaid, String> {
    let (ip, address) = text.split_once('=').ok_or("write IP=MAC, as 10.0.0.7=02:00:00:00:00:07")?;
    match parse_words(&format!("{ip} {address}"))? {
        RouteSaid::Network { .. } => {
            Err("write IP=MAC; networks are for a file of routes, `--routes`".into())
        }
        host => Ok(host),
    }
}

/// Reads a file of routes, each with where it stands; a line that is none is named.
pub fn read_routes(file: &Path) -> anyhow::Result<Vec<(String, RouteSaid)>> {
    let bytes = std::fs::read(file).with_context(|| format!("{} cannot be read", file.display()))?;
    let text = String::from_utf8(bytes).map_err(|error| {
        let before = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let n = before.iter().filter(|&&byte| byte == b'\n').count() + 1;
        anyhow!("{}, line {n}: this is no text: write routes and comments in UTF-8", file.display())
    })?;
    let mut routes = Vec::new();
    for (line, n) in text.lines().zip(1..) {
        let line = line.split('#').next().unwrap_or_default().trim();
        if line.is_empty() {
            continue;
        }
        let place = format!("{}, line {n}", file.display());
        match parse_words(line) {
            Ok(route) => routes.push((place, route)),
            Err(why) => bail!("{place}: {why}"),
        }
    }
    Ok(routes)
}

fn parse_words(text: &str) -> Result<RouteSaid, String> {
    let none = || format!("'{}' is no route: write IP MAC, or NET/PREFIX via IP", shown(text));
    // What goes on with parts of it is to show them as they are.
    if text.len() > SHOWN_AT_MOST || text.contains(|char: char| char.is_control() && char != '\t') {
        return Err(none());
    }
    let ip = |text: &str| {
        text.parse::<Ipv4Addr>().map_err(|_| format!("'{text}' is no IPv4 address: write one, as 10.0.0.7"))
    };
    let said = match text.split_whitespace().collect::<Vec<_>>()[..] {
        [host, address] if !host.contains('/') => {
            let (ip, address) = (ip(host)?, address.parse::<Address>().map_err(|error| error.to_string())?);
            RouteSaid::Host { ip, address: address.to_string() }
        }
        [network, "via", gateway] => {
            let network: Network = network.parse().map_err(|error| format!("{error}"))?;
            RouteSaid::Network { network: network.to_string(), via: ip(gateway)? }
        }
        _ => return Err(none()),
    };
    // What no station takes is refused where it stands.
    parse(&said).map(|_| said)
}

/// The begin of what somebody wrote, such that no terminal takes it for commands.
fn shown(text: &str) -> String {
    let (begin, rest) = text.split_at(text.floor_char_boundary(SHOWN_AT_MOST));
    let more = if rest.is_empty() { "" } else { "..." };
    format!("{}{more}", begin.escape_debug())
}

/// Something was done.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct Done {
    /// It was.
    done: bool,
}

document!(Done, "done", done_has_its_schema);

fn done(which: &Which, request: StackRequest) -> Result<u8, Failure> {
    match asked(which, request)? {
        StackReply::Done => {
            let words = |_: &Done| format!("{}: done\n", which.place);
            super::print(which.json, &Done { done: true }, words).map_err(Failure::Run)?;
            Ok(0)
        }
        _ => Err(unasked(which)),
    }
}

fn routes(which: &Which) -> Result<RoutesShown, Failure> {
    match asked(which, StackRequest::Routes)? {
        StackReply::Routes(routes) => Ok(routes),
        _ => Err(unasked(which)),
    }
}

fn way(which: &Which, ip: Ipv4Addr) -> Result<Way, Failure> {
    match asked(which, StackRequest::Lookup(ip))? {
        StackReply::Way(way) => Ok(way),
        _ => Err(unasked(which)),
    }
}

fn delete(which: &Which, network: Network) -> Result<u8, Failure> {
    let RoutesShown { hosts, networks, .. } = routes(which)?;
    let is_host = hosts.iter().any(|host| Network::host(host.ip) == network);
    if !is_host && networks.iter().all(|there| there.network != network.to_string()) {
        let place = &which.place;
        return Err(Failure::Run(anyhow!(
            "station '{place}': there is no route to {network}: `rtnet route -S {place} list` shows those that there are"
        )));
    }
    done(which, StackRequest::DeleteRoute(network.to_string()))
}

fn solicit(which: &Which, ip: Ipv4Addr) -> Result<u8, Failure> {
    check_asked(which, &of_interface(which)?, ip)?;
    if !matches!(asked(which, StackRequest::Solicit(ip))?, StackReply::Done) {
        return Err(unasked(which));
    }
    let deadline = Instant::now() + ANSWERED_WITHIN;
    loop {
        let way = way(which, ip)?;
        if !way.is_awaited && way.address.is_some() {
            super::print(which.json, &way, describe_way).map_err(Failure::Run)?;
            return Ok(0);
        }
        if Instant::now() >= deadline {
            return Err(Failure::Run(anyhow!(
                "station '{}': nobody has said within {ANSWERED_WITHIN:?} that {ip} is theirs: see that its station \
                 runs, has this address, and a slot to answer in",
                which.place
            )));
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

fn get(which: &Which, ip: Ipv4Addr) -> Result<u8, Failure> {
    let way = way(which, ip)?;
    if way.address.is_none() {
        let place = &which.place;
        return Err(Failure::Run(anyhow!(
            "station '{place}': no route to {ip} (EHOSTUNREACH): add one (`rtnet route -S {place} add`), or ask for it \
             (`rtnet route -S {place} solicit {ip}`)"
        )));
    }
    super::print(which.json, &way, describe_way).map_err(Failure::Run)?;
    Ok(0)
}

/// What of a file was taken.
#[derive(Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
struct Loaded {
    /// So many routes.
    routes: usize,
}

document!(Loaded, "routes-loaded", routes_loaded_has_its_schema);

/// All of them are tried on a copy of the station's tables before the first is sent.
fn load(which: &Which, file: &Path) -> Result<u8, Failure> {
    let read = read_routes(file).map_err(Failure::Usage)?;
    let there = routes(which)?;
    let mut copy = copy_of(&there);
    for (place, said) in &read {
        let added = parse(said).and_then(|route| add(&mut copy, &route).map_err(|error| error.to_string()));
        added.map_err(|why| Failure::Usage(anyhow!("{place}: {why}; no route of the file is taken")))?;
    }
    let said: Vec<RouteSaid> = read.into_iter().map(|(_, said)| said).collect();
    for some in said.chunks(AT_ONCE) {
        if !matches!(asked(which, StackRequest::AddRoutes(some.to_vec()))?, StackReply::Done) {
            return Err(unasked(which));
        }
    }
    let loaded = Loaded { routes: said.len() };
    let words = |loaded: &Loaded| format!("{}: {} routes\n", which.place, loaded.routes);
    super::print(which.json, &loaded, words).map_err(Failure::Run)?;
    Ok(0)
}

fn copy_of(there: &RoutesShown) -> Routes {
    let own = Interface { address: Address::default(), ip: there.ip, prefix: there.prefix };
    let mut copy = Routes::new(own, there.hosts_at_most, there.networks_at_most);
    // Who was learned makes room for who is named. What was learned before a network was named stays.
    let hosts = there.hosts.iter().filter_map(as_shown).map(Route::Host);
    let networks =
        there.networks.iter().map(|of| RouteSaid::Network { network: of.network.clone(), via: of.via });
    for route in hosts.chain(networks.filter_map(|said| parse(&said).ok())) {
        // It has them: there is room.
        let _ = add(&mut copy, &route);
    }
    copy
}

fn list(routes: &RoutesShown) -> String {
    let RoutesShown { hosts, networks, hosts_at_most, networks_at_most, .. } = routes;
    let mut text = format!("{} of {hosts_at_most} host routes\n", hosts.len());
    if !hosts.is_empty() {
        let lines = table(
            &[
                Column::left(["", "host"], hosts.iter().map(|host| host.ip.to_string())),
                Column::left(["", "address"], hosts.iter().map(|host| host.address.clone())),
                Column::left(["", "known"], hosts.iter().map(|host| host.origin.clone())),
            ],
            WIDTH,
        );
        text += &(lines.join("\n") + "\n");
    }
    text += &format!("{} of {networks_at_most} network routes\n", networks.len());
    if !networks.is_empty() {
        let lines = table(
            &[
                Column::left(["", "network"], networks.iter().map(|route| route.network.clone())),
                Column::left(["", "via"], networks.iter().map(|route| route.via.to_string())),
            ],
            WIDTH,
        );
        text += &(lines.join("\n") + "\n");
    }
    text
}

fn describe_way(way: &Way) -> String {
    let address = way.address.as_deref().unwrap_or("nowhere");
    let via = way.via.map_or(String::new(), |via| format!(" via {via}"));
    format!("{} is at {address}{via}\n", way.ip)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::HostShown;

    #[test]
    fn a_table_full_of_who_was_learned_has_room_for_a_file() {
        let shown = |last: u8, origin: &str| HostShown {
            ip: [10, 0, 0, last].into(),
            address: format!("02:00:00:00:00:{last:02x}"),
            origin: origin.into(),
        };
        let there = RoutesShown {
            ip: [10, 0, 0, 1].into(),
            prefix: 24,
            hosts: vec![shown(2, "static"), shown(3, "learned"), shown(4, "solicited")],
            hosts_at_most: 3,
            networks: Vec::new(),
            networks_at_most: 1,
        };
        let mut copy = copy_of(&there);
        let mut load = |line| add(&mut copy, &parse(&parse_words(line).unwrap()).unwrap());
        load("10.0.0.5 02:00:00:00:00:05").unwrap();
        let full = load("10.0.0.6 02:00:00:00:00:06").unwrap_err().to_string();
        assert!(full.contains("start the station with a larger one (`rtnet station --hosts`"), "{full}");
        let left: Vec<u8> = copy.hosts().iter().map(|host| host.ip.octets()[3]).collect();
        assert_eq!(left, [2, 4, 5]);
    }

    #[test]
    fn a_bad_line_of_a_file_is_named_with_what_was_expected() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("routes");
        let good = "# stations\n10.0.0.7 02:00:00:00:00:07 # seven\n\n10.1.0.0/16 via 10.0.0.7\n";
        std::fs::write(&file, good).unwrap();
        let routes = read_routes(&file).unwrap();
        let host = RouteSaid::Host { ip: [10, 0, 0, 7].into(), address: "02:00:00:00:00:07".into() };
        let network = RouteSaid::Network { network: "10.1.0.0/16".into(), via: [10, 0, 0, 7].into() };
        assert_eq!(routes.iter().map(|(_, said)| said).collect::<Vec<_>>(), [&host, &network]);
        assert!(routes[1].0.ends_with("routes, line 4"), "{}", routes[1].0);
        for (bad, expected) in [
            ("10.0.0.7", "write IP MAC, or NET/PREFIX via IP"),
            ("10.0.0.7 02:00", "six bytes in hexadecimal"),
            ("10.0.0 02:00:00:00:00:07", "'10.0.0' is no IPv4 address"),
            ("10.1.0.1/16 via 10.0.0.7", "without bits behind the prefix"),
            ("10.1.0.0/16 to 10.0.0.7", "write IP MAC"),
        ] {
            std::fs::write(&file, format!("{good}{bad}\n")).unwrap();
            let error = read_routes(&file).unwrap_err().to_string();
            assert!(error.contains("routes, line 5: ") && error.contains(expected), "{error}");
        }
        std::fs::write(&file, [good.as_bytes(), b"10.0.0.8 02:00:00:00:00:08 # Achse \xfc\n"].concat())
            .unwrap();
        let error = read_routes(&file).unwrap_err().to_string();
        assert!(
            error.contains("routes, line 5: this is no text: write routes and comments in UTF-8"),
            "{error}"
        );
    }

    #[test]
    fn what_is_no_route_is_shown_short_and_gives_a_terminal_no_commands() {
        let why = parse_words(&format!("\u{1b}[2J{}", "x".repeat(5_000))).unwrap_err();
        assert!(why.starts_with("'\\u{1b}[2Jxxx") && why.len() < 150, "{why}");
        assert!(why.contains("...' is no route: write IP MAC"), "{why}");
        assert!(parse_words("10.0.0.7 02:00:00:00:00:0\u{7}").unwrap_err().contains("\\u{7}"));
        assert!(parse_words("10.0.0.7\t02:00:00:00:00:07").is_ok(), "in columns");
    }

    #[test]
    fn what_stands_behind_route_is_a_host() {
        assert!(parse_route("10.0.0.7=02:00:00:00:00:07").is_ok());
        assert!(parse_route("10.1.0.0/16 via=10.0.0.7").unwrap_err().starts_with("write IP=MAC"));
    }
}
