//! One address for real-time sockets and Linux: what cannot be is refused, and two hosts that share theirs.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::process::Output;
use std::time::{Duration, Instant};

use serde_json::Value;
use socket2::{Domain, Protocol, Socket, Type};
use tools::lab::namespace::Namespace;

use crate::host::network;
use crate::rtnet;
use crate::station::{Medium, PATIENCE, Station};

const IP_A: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);
const IP_B: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 2);
/// More than all buffers take, and more than a second of turns.
const BYTES: usize = 300_000;
/// What keeps Linux from the interface.
const ASKED: [&str; 2] = ["rp_filter", "arp_ignore"];

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn station(arguments: &[&str]) -> Output {
    let slave = ["station", "--interface", "nosuch0", "--slave", "--rounds", "0", "--vnic-proxy"];
    rtnet().args(slave).args(arguments).output().unwrap()
}

#[test]
fn a_proxy_that_cannot_be_is_refused_with_what_to_do() {
    for (arguments, why) in [
        (&["--vnic", "--vnic-mode", "tun"][..], "give it one by --ip"),
        (&["--vnic", "--ip", "10.0.0.2/24"], "add --vnic-mode tun"),
        (&["--vnic", "--ip", "10.0.0.2/24", "--vnic-mode", "tap"], "add --vnic-mode tun"),
        (
            &["--vnic", "10.0.0.3/24", "--ip", "10.0.0.2/24", "--vnic-mode", "tun"],
            "shares the station's own address, 10.0.0.2/24: leave 10.0.0.3/24 out",
        ),
        (
            &["--vnic", "--ip", "10.0.0.2/24", "--vnic-mode", "tun", "--vnic-forward"],
            "'--vnic-proxy' cannot be used with '--vnic-forward'",
        ),
        (&["--ip", "10.0.0.2/24"], "--vnic"),
    ] {
        let output = station(arguments);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(why), "{message}");
    }
}

/// A station with a proxy.
fn start(namespace: &Namespace, role: &[&str], slots: &[&str], name: &str, ip: Ipv4Addr) -> Station {
    let other =
        if ip == IP_A { format!("{IP_B}=02:00:00:00:00:0b") } else { format!("{IP_A}=02:00:00:00:00:0a") };
    let ip = format!("{ip}/24");
    let mut arguments = vec!["--interface", "rt0", "--name", name];
    arguments.extend(role);
    slots.iter().for_each(|slot| arguments.extend(["--slot", slot]));
    arguments.extend(["--ip", &ip, "--route", &other, "--vnic", "--vnic-mode", "tun", "--vnic-proxy"]);
    Station::start(namespace, &arguments)
}

fn vnic(name: &str, verb: &[&str]) -> Output {
    rtnet().args(["vnic", "-S", name]).args(verb).output().unwrap()
}

fn status(name: &str) -> Value {
    let output = vnic(name, &["status", "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    crate::schema::read(&output.stdout)
}

fn asked(namespace: &Namespace) -> [String; 2] {
    let read = |name| std::fs::read_to_string(format!("/proc/sys/net/ipv4/conf/rt0/{name}")).unwrap();
    namespace.run(|| ASKED.map(|name| read(name).trim().to_owned())).unwrap()
}

/// Sends back all that comes by one connection.
fn echo_server(listener: TcpListener) -> std::thread::JoinHandle<()> {
    std::thread::spawn(move || {
        let (mut stream, from) = listener.accept().unwrap();
        assert_eq!(from.ip(), IP_B);
        let mut room = [0; 4096];
        while let Ok(len @ 1..) = stream.read(&mut room) {
            stream.write_all(&room[..len]).unwrap();
        }
    })
}

fn tcp(medium: &Medium) {
    let listener = medium.a.run(|| TcpListener::bind((IP_A, 5_001))).unwrap().unwrap();
    let server = echo_server(listener);
    let to = SocketAddrV4::new(IP_A, 5_001).into();
    let connected = medium.b.run(|| TcpStream::connect_timeout(&to, PATIENCE)).unwrap();
    let mut stream = connected.expect("Linux answers by its proxy");
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let sent: Vec<u8> = (0..BYTES).map(|n| (n * 7 + n / 251) as u8).collect();
    let mut writes = stream.try_clone().unwrap();
    let content = sent.clone();
    let writer = std::thread::spawn(move || {
        writes.write_all(&content).unwrap();
        writes.shutdown(std::net::Shutdown::Write).unwrap();
    });
    let mut came = Vec::new();
    stream.read_to_end(&mut came).unwrap();
    assert!(came == sent, "{} of {BYTES} bytes came back", came.len());
    writer.join().unwrap();
    server.join().unwrap();
}

/// A datagram of Linux's, in fragments, to a port that no real-time socket has.
fn udp(medium: &Medium) {
    let hears = medium.a.run(|| UdpSocket::bind((IP_A, 5_002))).unwrap().unwrap();
    let sends = medium.b.run(|| UdpSocket::bind((IP_B, 5_003))).unwrap().unwrap();
    hears.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
    let (data, mut room) = ([7; 4_000], [0; 5_000]);
    let deadline = Instant::now() + PATIENCE;
    loop {
        sends.send_to(&data, (IP_A, 5_002)).unwrap();
        match hears.recv_from(&mut room) {
            Ok((len, from)) => break assert_eq!((len, from), (4_000, SocketAddrV4::new(IP_B, 5_003).into())),
            Err(_) => assert!(Instant::now() < deadline, "no datagram came"),
        }
    }
}

/// The kernel asks, and the other station's stack answers, once.
fn echo(medium: &Medium) {
    let open = || {
        std::fs::write("/proc/sys/net/ipv4/ping_group_range", "0 2147483647").unwrap();
        Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::ICMPV4)).unwrap()
    };
    let socket: UdpSocket = medium.b.run(open).unwrap().into();
    socket.set_read_timeout(Some(Duration::from_secs(1))).unwrap();
    // What was asked before may be answered late: each question has its number, and its answers are its own.
    let is_answered = |number| {
        let mut room = [0; 100];
        while let Ok((len, from)) = socket.recv_from(&mut room) {
            assert_eq!((len, from.ip(), room[0], room[8]), (9, IP_A.into(), 0, 42));
            if room[7] == number {
                return true;
            }
        }
        false
    };
    let deadline = Instant::now() + PATIENCE;
    let asked = (1..=u8::MAX).find(|&number| {
        assert!(Instant::now() < deadline, "no echo came");
        socket.send_to(&[8, 0, 0, 0, 0, 0, 0, number, 42], (IP_A, 0)).unwrap();
        is_answered(number)
    });
    assert!(!is_answered(asked.unwrap()), "the kernel of the other has answered, too");
}

#[test]
fn two_stations_share_their_addresses_with_linux() {
    network("two_stations_share_their_addresses_with_linux", || {
        let medium = Medium::new();
        let (is_master, is_slave) = (["--master", "--cycle", "2ms"], ["--slave", "--rounds", "10"]);
        let a = start(&medium.a, &is_master, &["0=300us", "1=600us"], "proxy-a", IP_A);
        a.wait_for("master_active");
        let b = start(&medium.b, &is_slave, &["0=1ms", "1=1400us"], "proxy-b", IP_B);
        b.wait_for("locked, cycle");
        assert_eq!([asked(&medium.a), asked(&medium.b)].concat(), ["1"; 4]);

        let ping =
            rtnet().args(["ping", "-S", "proxy-b", "10.0.0.1", "-c", "5", "-i", "20ms", "--json"]).output();
        let ping = ping.unwrap();
        assert_eq!(ping.status.code(), Some(0), "{}{}", text(&ping.stdout), text(&ping.stderr));
        echo(&medium);
        udp(&medium);
        tcp(&medium);
        let ping =
            rtnet().args(["ping", "-S", "proxy-a", "10.0.0.2", "-c", "5", "-i", "20ms"]).output().unwrap();
        assert_eq!(ping.status.code(), Some(0), "{}", text(&ping.stderr));

        for name in ["proxy-a", "proxy-b"] {
            let status = status(name);
            assert_eq!(
                (&status["mode"], &status["proxy"], &status["mtu"]),
                (&"tun".into(), &true.into(), &1500.into())
            );
            let count = |name: &str| status["counters"][name].as_u64().unwrap();
            assert!(count("proxied_in") > 200 && count("proxied_out") > 200, "{status:#}");
            assert_eq!(status["lost"]["device_refused"], 0, "{status:#}");
            let shown = text(&vnic(name, &["status"]).stdout);
            assert!(shown.contains("(proxy, up): 10.0.0.") && shown.contains("proxied_out"), "{shown}");
        }
        let refused = vnic("proxy-a", &["set", "--address", "10.0.0.9/24"]);
        assert_eq!(refused.status.code(), Some(2));
        assert!(
            text(&refused.stderr).contains("has the address of its station"),
            "{}",
            text(&refused.stderr)
        );
        for mtu in [1400, 1500] {
            let set = vnic("proxy-a", &["set", "--mtu", &mtu.to_string()]);
            assert_eq!(set.status.code(), Some(0), "{}", text(&set.stderr));
            assert_eq!(status("proxy-a")["mtu"], mtu);
        }
        assert_eq!([a.end(), b.end()], [Some(0), Some(0)]);
        assert_eq!([asked(&medium.a), asked(&medium.b)].concat(), ["0"; 4]);
    });
}

#[test]
fn what_a_killed_proxy_leaves_the_next_station_at_its_interface_puts_back() {
    network("what_a_killed_proxy_leaves_the_next_station_at_its_interface_puts_back", || {
        let medium = Medium::new();
        let direct = ["--discipline", "direct"];
        let proxy = |name| {
            let station = start(&medium.a, &direct, &[], name, IP_A);
            station.wait_for("Ctrl-C ends it");
            station
        };
        let plain = |namespace, name| {
            let station =
                Station::start(namespace, &[&direct[..], &["--interface", "rt0", "--name", name]].concat());
            station.wait_for("Ctrl-C ends it");
            station
        };
        let kill = |mut station: Station| {
            station.child.kill().unwrap();
            station.child.wait().unwrap();
        };
        // Who comes next has the name of who was killed, too: nothing is left of it. What is somebody's own stays.
        medium.a.run(|| std::fs::write("/proc/sys/net/ipv4/conf/rt0/rp_filter", "1").unwrap()).unwrap();
        kill(proxy("killed-1"));
        assert_eq!(asked(&medium.a), ["1", "1"]);
        assert_eq!(plain(&medium.b, "elsewhere").end(), Some(0));
        assert_eq!(asked(&medium.a), ["1", "1"], "another interface, of another namespace");
        assert_eq!(plain(&medium.a, "killed-1").end(), Some(0));
        assert_eq!(asked(&medium.a), ["1", "0"], "put back, by one without a proxy");
        medium.a.run(|| std::fs::write("/proc/sys/net/ipv4/conf/rt0/rp_filter", "0").unwrap()).unwrap();
        kill(proxy("killed-2"));
        let next = proxy("killed-2");
        assert_eq!(asked(&medium.a), ["1", "1"]);
        let mut second =
            Station::start(&medium.a, &[&direct[..], &["--interface", "rt0", "--name", "second"]].concat());
        second.wait_for("the interface 'rt0' has a station already, killed-2");
        assert_eq!(second.ended().and_then(|status| status.code()), Some(2));
        assert_eq!(asked(&medium.a), ["1", "1"], "a proxy that runs keeps what it has");
        assert_eq!(next.end(), Some(0));
        assert_eq!(asked(&medium.a), ["0", "0"], "as before the one that was killed");
    });
}

#[test]
fn stations_without_rtmac_share_their_addresses_with_linux() {
    network("stations_without_rtmac_share_their_addresses_with_linux", || {
        let medium = Medium::new();
        let direct = ["--discipline", "direct"];
        let stations = [(&medium.a, "proxy-d", IP_A), (&medium.b, "proxy-e", IP_B)];
        let stations = stations.map(|(namespace, name, ip)| start(namespace, &direct, &[], name, ip));
        let deadline = Instant::now() + PATIENCE;
        while ["proxy-d", "proxy-e"].iter().any(|name| !vnic(name, &["status"]).status.success()) {
            assert!(Instant::now() < deadline, "they do not answer");
            std::thread::sleep(Duration::from_millis(20));
        }
        echo(&medium);
        udp(&medium);
        tcp(&medium);
        assert_eq!(stations.map(Station::end), [Some(0); 2]);
    });
}

#[test]
fn an_interface_with_an_address_of_linux_has_no_proxy() {
    network("an_interface_with_an_address_of_linux_has_no_proxy", || {
        let medium = Medium::new();
        let mut netlink = medium.a.netlink().unwrap();
        let index = netlink.link_index("rt0").unwrap();
        netlink.add_address(index, IP_A, 24).unwrap();
        let a = start(&medium.a, &["--master", "--cycle", "5ms"], &["0=1ms", "1=2ms"], "proxy-c", IP_A);
        let line = a.wait_for("no VNIC");
        assert!(line.contains("Linux has an address on 'rt0' itself, 10.0.0.1/24"), "{line}");
    });
}

#[test]
fn a_master_with_a_proxy_that_makes_way_for_another_leaves_the_interface_to_linux_as_it_was() {
    let test = "a_master_with_a_proxy_that_makes_way_for_another_leaves_the_interface_to_linux_as_it_was";
    network(test, || {
        let medium = Medium::new();
        let _first = Station::master(&medium, "proxy-first");
        let cycle = ["--master", "--cycle", "5ms"];
        let mut second = start(&medium.b, &cycle, &["0=300us", "1=600us"], "proxy-second", IP_B);
        assert_eq!(second.ended().and_then(|status| status.code()), Some(1));
        second.wait_for("another master (02:00:00:00:00:0a) is active on this medium");
        assert_eq!(asked(&medium.b), ["0"; 2]);
    });
}
