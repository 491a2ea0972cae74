//! Stations in the foreground: without a TUN device, without the right to one, and two of them in one namespace.

use std::net::UdpSocket;
use std::process::Command;
use std::time::Duration;

use tools::lab::namespace::{Namespace, Segment};

use super::{are_there, refused, shared, status_of, vnic_of};
use crate::cell::{json, text, wait_until};
use crate::host::unique;
use crate::rtnet;
use crate::station::{Medium, Station};

/// A station with a VNIC, of which a shell in a mount namespace of its own has said `exec "$0" "$@"` in this way.
fn started_by(script: &str, medium: &Medium, name: &str) -> Station {
    let mut command = Command::new("unshare");
    command.args(["--mount", "sh", "-c", script, env!("CARGO_BIN_EXE_rtnet"), "station"]);
    command.args(["--interface", "rt0", "--discipline", "nomac", "--vnic", "10.1.0.1/24", "--name", name]);
    Station::run_after(&medium.a, command, || ())
}

#[test]
fn without_a_device_or_the_right_to_it_one_line_says_so_and_the_station_runs_on() {
    let test = "without_a_device_or_the_right_to_it_one_line_says_so_and_the_station_runs_on";
    shared(test, || {
        if !are_there(test, &[("unshare", "util-linux"), ("setpriv", "util-linux")]) {
            return;
        }
        let (medium, name) = (Medium::new(), unique("refused"));
        for (script, line) in [
            (
                "mount -t tmpfs none /dev/net && exec \"$0\" \"$@\"",
                "there is no /dev/net/tun: load the driver (`modprobe tun`, CONFIG_TUN)",
            ),
            (
                "mount -t tmpfs none /dev/net && mknod -m 000 /dev/net/tun c 10 200 && \
                 exec setpriv --bounding-set -dac_override \"$0\" \"$@\"",
                "/dev/net/tun: Permission denied (os error 13) (give this user the device file, `chmod`, or in a container \
                 `--device /dev/net/tun`)",
            ),
            (
                "exec setpriv --bounding-set -net_admin \"$0\" \"$@\"",
                "a device may not be made here: Operation not permitted (os error 1) (this process is root \
                 without CAP_NET_ADMIN: give it that, in a container by `--cap-add NET_ADMIN`, in a service by \
                 CapabilityBoundingSet=)",
            ),
        ] {
            let station = started_by(script, &medium, &name);
            assert_eq!(station.wait_for("VNIC"), format!("{name}: no VNIC: {line}"));
            for verb in [&["status"][..], &["up"], &["set", "--mtu", "900"]] {
                let message = refused(vnic_of(&name, verb));
                assert_eq!(message, format!("rtnet: station '{name}': no VNIC: {line}\n"));
            }
            assert_eq!(station.end(), Some(0));
        }
    });
}

#[test]
fn a_station_that_was_not_to_have_one_says_what_to_start_it_with() {
    shared("a_station_that_was_not_to_have_one_says_what_to_start_it_with", || {
        let (medium, name) = (Medium::new(), unique("plain"));
        let options = ["--interface", "rt0", "--discipline", "nomac", "--name", &name];
        let _station = started(&medium.a, &options);
        let message = refused(vnic_of(&name, &["status"]));
        assert!(message.ends_with("': it has no VNIC: start it with --vnic\n"), "{message}");
    });
}

/// Ticks that a process has had of any core, and how many of them make a second.
fn ticks_of(station: &Station) -> [u64; 2] {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", station.child.id())).unwrap();
    // Behind the name, which may have spaces, the 12th and 13th: proc(5).
    let (_, fields) = stat.rsplit_once(')').unwrap();
    let of = |field: usize| fields.split_whitespace().nth(field).unwrap().parse::<u64>().unwrap();
    let a_second = nix::unistd::sysconf(nix::unistd::SysconfVar::CLK_TCK).unwrap().unwrap();
    [of(11) + of(12), a_second as u64]
}

#[test]
fn a_station_without_a_master_sleeps_though_linux_has_something_to_send() {
    shared("a_station_without_a_master_sleeps_though_linux_has_something_to_send", || {
        for more in [&["--ip", "10.0.0.2/24"][..], &[]] {
            let (medium, name) = (Medium::new(), unique("alone"));
            let role =
                ["--interface", "rt0", "--slave", "--slot", "0=1ms", "--slot", "1=2ms", "--name", &name];
            let station = started(&medium.a, &[&role[..], &["--vnic", "10.1.0.1/24"], more].concat());
            // Who is the other? Linux asks, and its question waits for a slot.
            let ping =
                medium.a.run(|| Command::new("ping").args(["-c", "3", "-W", "1", "10.1.0.9"]).output());
            assert!(!ping.unwrap().unwrap().status.success());
            let pool = status_of(&name)["pool"].clone();
            assert!(pool["free"].as_u64() < pool["capacity"].as_u64(), "something waits: {pool}");
            let [before, a_second] = ticks_of(&station);
            std::thread::sleep(std::time::Duration::from_secs(1));
            let [after, _] = ticks_of(&station);
            assert!(after - before < a_second / 2, "{} of {a_second} ticks, with {more:?}", after - before);
        }
    });
}

fn started(namespace: &Namespace, options: &[&str]) -> Station {
    let station = Station::start(namespace, options);
    station.wait_for("Ctrl-C ends it");
    station
}

#[test]
fn two_stations_of_one_namespace_have_a_device_each() {
    shared("two_stations_of_one_namespace_have_a_device_each", || {
        let (host, other) = (Namespace::new().unwrap(), Namespace::new().unwrap());
        let mut segment = Segment::new().unwrap();
        segment.attach(&host, "port0", "rt0", [2, 0, 0, 0, 0, 0xa]).unwrap();
        segment.attach(&host, "port1", "rt1", [2, 0, 0, 0, 0, 0xb]).unwrap();
        segment.attach(&other, "port2", "rt0", [2, 0, 0, 0, 0, 0xc]).unwrap();
        let [a, b, c] = ["a", "b", "c"].map(|which| unique(&format!("two-{which}")));
        let nomac = |name, interface, more: &[&'static str]| {
            let all = ["--discipline", "nomac", "--name", name, "--interface", interface];
            [&all[..], more].concat()
        };
        let _a = started(&host, &nomac(&a, "rt0", &["--vnic", "10.1.0.1/24"]));
        let _b = started(&host, &nomac(&b, "rt1", &["--vnic", "10.2.0.1/24"]));
        let _c = started(&other, &nomac(&c, "rt0", &["--vnic", "10.1.0.3/24", "10.2.0.3/24"]));
        let devices = [&a, &b, &c].map(|name| status_of(name)["device"].as_str().unwrap().to_owned());
        assert_eq!(devices, ["vnic0", "vnic1", "vnic0"]);
        for to in ["10.1.0.1", "10.2.0.1"] {
            wait_until(to, || {
                let ping = || Command::new("ping").args(["-c", "1", "-W", "1", to]).output().unwrap();
                other.run(ping).unwrap().status.success()
            });
        }
        wait_until("it is known that there are no slots", || {
            status_of(&b)["not_held_back"] == "there are no slots"
        });
        let shown = status_of(&b);
        assert!(shown["counters"]["received"].as_u64() > Some(0), "{shown:#}");
    });
}

#[test]
fn a_station_with_a_vnic_and_no_sockets_shows_what_it_counts_and_its_pools() {
    shared("a_station_with_a_vnic_and_no_sockets_shows_what_it_counts_and_its_pools", || {
        let (medium, name) = (Medium::new(), unique("counts"));
        for with_ip in [&[][..], &["--ip", "10.0.0.1/24"]] {
            let options = ["--interface", "rt0", "--master", "--cycle", "5ms", "--slot", "0=1ms"];
            let vnic = ["--slot", "1=2ms,size=500", "--name", &name, "--vnic", "10.1.0.1/24"];
            let station = Station::start(&medium.a, &[&options[..], &vnic, with_ip].concat());
            station.wait_for("master_active");
            let stat = || json(rtnet().args(["stat", "-S", &name, "--json"]));
            wait_until("something was sent", || {
                let shown = stat();
                let counts = [&shown["vnic"]["counters"]["sent"], &shown["station"]["syncs_sent"]];
                counts.iter().all(|count| count.as_u64() > Some(0))
            });
            let shown = stat();
            assert!(
                shown["vnic"]["lost"].is_object() && shown["refused"]["no_protocol"].is_u64(),
                "{shown:#}"
            );
            assert_eq!(shown["stack"].as_object().unwrap().is_empty(), with_ip.is_empty(), "{shown:#}");
            let said = text(&rtnet().args(["stat", "-S", &name]).output().unwrap().stdout);
            assert!(said.contains("\nVNIC: ") && said.contains("\nVNIC, lost: "), "{said}");
            assert_eq!(said.contains("\nstack: "), !with_ip.is_empty(), "{said}");
            let pools = json(rtnet().args(["pool", "-S", &name, "--json"]));
            let names: Vec<_> =
                pools.as_array().unwrap().iter().map(|pool| pool["pool"].as_str().unwrap()).collect();
            assert_eq!((&names[..2], names.last()), (&["receive", "control"][..], Some(&"vnic")));
            assert_eq!(names.len() > 3, !with_ip.is_empty(), "{names:?}");
            // What is about addresses is for who has some.
            for verb in [&["if"][..], &["route", "list"]] {
                let done = rtnet().arg(verb[0]).args(["-S", &name]).args(&verb[1..]).output().unwrap();
                assert_eq!(done.status.success(), !with_ip.is_empty(), "{verb:?}");
            }
            assert_eq!(station.end(), Some(0));
        }
    });
}

#[test]
fn a_station_with_a_vnic_whose_interface_is_gone_ends_with_a_clear_line() {
    shared("a_station_with_a_vnic_whose_interface_is_gone_ends_with_a_clear_line", || {
        let (mut medium, name) = (Medium::new(), unique("gone"));
        let options = ["--interface", "rt0", "--discipline", "nomac", "--name", &name];
        let mut station = started(&medium.a, &[&options[..], &["--vnic", "10.1.0.1/24"]].concat());
        wait_until("it has its device", || status_of(&name)["state"] == "up");
        medium.segment.detach("port0").unwrap();
        assert_eq!(station.ended().and_then(|status| status.code()), Some(1));
        let line = station.wait_for("rtnet: ");
        assert!(line.contains("the interface 'rt0' is gone"), "{line}");
    });
}

#[test]
fn packets_and_frames_find_each_other_by_arp() {
    // No ping is needed: sockets of this process do.
    crate::host::shared("packets_and_frames_find_each_other_by_arp", || {
        let medium = Medium::new();
        let names = ["tap", "tun"].map(|mode| unique(&format!("arp-{mode}")));
        let common = ["--interface", "rt0", "--discipline", "nomac", "--vnic-name", "vnic0"];
        let tap = ["--vnic", "10.1.0.1/24", "--name", &names[0]];
        let _tap = started(&medium.a, &[&common[..], &tap].concat());
        let tun = ["--vnic-mode", "tun", "--vnic", "10.1.0.2/24", "--name", &names[1]];
        let with_packets = || started(&medium.b, &[&common[..], &tun].concat());
        let knows_the_tap = || status_of(&names[1])["peers"].to_string().contains("02:00:00:00:00:0a");
        let bound = |namespace: &Namespace, ip: &'static str| {
            let socket = namespace.run(move || UdpSocket::bind((ip, 4_000))).unwrap().unwrap();
            socket.set_read_timeout(Some(Duration::from_millis(200))).unwrap();
            socket
        };
        // A datagram there, and one back.
        let answers = |asks: &UdpSocket, other: &UdpSocket| {
            let mut room = [0; 8];
            asks.send_to(b"there?", other.local_addr().unwrap()).is_ok()
                && other.recv_from(&mut room).is_ok_and(|(_, from)| other.send_to(b"here", from).is_ok())
                && asks.recv_from(&mut room).is_ok()
        };
        // Linux behind the tap asks who has the address.
        let first = with_packets();
        let frames = bound(&medium.a, "10.1.0.1");
        let packets = bound(&medium.b, "10.1.0.2");
        wait_until("10.1.0.2 answers", || answers(&frames, &packets));
        assert!(knows_the_tap(), "it is learned");
        drop(packets);
        assert_eq!(first.end(), Some(0));
        // A new station knows nobody, and asks.
        let _again = with_packets();
        let packets = bound(&medium.b, "10.1.0.2");
        assert!(!knows_the_tap());
        wait_until("10.1.0.1 answers", || answers(&packets, &frames));
        assert!(knows_the_tap());
    });
}
