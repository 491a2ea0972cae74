//! Hosts behind a VNIC: a bridge of its device with another one, as for a machine's second port.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use rtnet::wire::ethernet::EtherType;
use tools::lab::namespace::Namespace;

use super::{are_there, done, shared, status_of};
use crate::cell::wait_until;
use crate::host::unique;
use crate::observe::each_frame;
use crate::rtnet;
use crate::station::Station;

/// Of the two stations.
const A: &str = "02:00:00:00:00:0a";
const B: &str = "02:00:00:00:00:0b";
/// Of the host, and as the bytes of frames.
const HOST: &str = "02:00:00:00:00:99";
const OF_HOST: [u8; 6] = [2, 0, 0, 0, 0, 0x99];
const OF_A: [u8; 6] = [2, 0, 0, 0, 0, 0xa];
const OF_B: [u8; 6] = [2, 0, 0, 0, 0, 0xb];
const AT_HOST: &str = "10.1.0.9";
const AT_B: &str = "10.1.0.2";

fn output_in(namespace: &Namespace, words: &[&str]) -> Output {
    namespace.run(|| Command::new(words[0]).args(&words[1..]).output()).unwrap().unwrap()
}

fn does(namespace: &Namespace, words: &str) {
    let words: Vec<_> = words.split_whitespace().collect();
    done(output_in(namespace, &words));
}

/// A wire between two namespaces.
fn wire(one: &Namespace, interface: &str, mac: &str, other: &Namespace, its: &str, its_mac: &str) {
    let path = other.path();
    does(
        one,
        &format!(
            "ip link add {interface} address {mac} type veth peer name {its} address {its_mac} netns {}",
            path.display()
        ),
    );
    does(one, &format!("ip link set {interface} up"));
    does(other, &format!("ip link set {its} up"));
}

/// A station in `a`, with a host behind its VNIC, and one in `b`.
struct Behind {
    host: Namespace,
    b: Namespace,
    name_of_b: String,
    _stations: [Station; 2],
    _a: Namespace,
}

impl Behind {
    fn start(forward: &[&str]) -> Self {
        let [a, b, host] = [(); 3].map(|()| Namespace::new().unwrap());
        // No bridge of theirs: it would know where the host is, or not.
        wire(&a, "rt0", A, &b, "rt0", B);
        wire(&a, "port", "02:00:00:00:00:98", &host, "eth0", HOST);
        let [name_of_a, name_of_b] = ["a", "b"].map(|which| unique(&format!("behind-{which}")));
        let start = |namespace, name: &str, more: &[&str]| {
            let options = ["--interface", "rt0", "--discipline", "nomac", "--name", name, "--vnic"];
            let station = Station::start(namespace, &[&options, more].concat());
            station.wait_for("Ctrl-C ends it");
            station
        };
        let stations = [start(&a, &name_of_a, forward), start(&b, &name_of_b, &[&format!("{AT_B}/24")])];
        does(&a, "ip link add br0 type bridge");
        for port in ["vnic0", "port"] {
            does(&a, &format!("ip link set {port} master br0"));
        }
        does(&a, "ip link set br0 up");
        does(&host, &format!("ip address add {AT_HOST}/24 dev eth0"));
        Self { host, b, name_of_b, _stations: stations, _a: a }
    }

    /// What the host's pings look like at the other station: who sends the frames that carry an echo request.
    fn sources(&self, dir: &Path) -> Vec<[u8; 6]> {
        let pcap: PathBuf = dir.join("frames.pcapng");
        let mut dump = rtnet();
        dump.args(["dump", "--interface", "rt0", "--duration", "2s", "--write"]).arg(&pcap);
        let mut dump = self.b.run(move || dump.spawn()).unwrap().unwrap();
        // For as long as that listens, whenever it begins to. Where its source is lost no answer comes: what it asks by
        // ARP is seen all the same.
        let status = loop {
            output_in(&self.host, &["ping", "-c", "3", "-i", "0.2", "-W", "1", AT_B]);
            if let Some(status) = dump.try_wait().unwrap() {
                break status;
            }
        };
        assert!(status.success());
        let mut sources = Vec::new();
        each_frame(&pcap, |_, frame| {
            let (source, kind) = (&frame[6..12], &frame[12..14]);
            let names_host = frame.windows(4).any(|ip| ip == [10, 1, 0, 9]);
            if names_host && kind == EtherType::RTMAC.0.to_be_bytes() && source != OF_B {
                sources.push(source.try_into().unwrap());
            }
        });
        sources
    }

    fn host_is_reached(&self) -> bool {
        output_in(&self.b, &["ping", "-c", "1", "-W", "1", AT_HOST]).status.success()
    }
}

#[test]
fn a_host_behind_a_vnic_that_forwards_keeps_its_source_and_is_reached() {
    let test = "a_host_behind_a_vnic_that_forwards_keeps_its_source_and_is_reached";
    shared(test, || {
        if !are_there(test, &[("ip", "iproute2")]) {
            return;
        }
        let (behind, dir) = (Behind::start(&["--vnic-forward"]), tempfile::tempdir().unwrap());
        wait_until("it is reached", || behind.host_is_reached());
        let sources = behind.sources(dir.path());
        assert!(!sources.is_empty() && sources.iter().all(|source| *source == OF_HOST), "{sources:x?}");
        assert!(status_of(&behind.name_of_b)["counters"]["received"].as_u64() > Some(0));
    });
}

#[test]
fn a_host_behind_a_vnic_that_does_not_forward_loses_its_source_as_with_rtnet() {
    let test = "a_host_behind_a_vnic_that_does_not_forward_loses_its_source_as_with_rtnet";
    shared(test, || {
        if !are_there(test, &[("ip", "iproute2")]) {
            return;
        }
        let (behind, dir) = (Behind::start(&[]), tempfile::tempdir().unwrap());
        let sources = behind.sources(dir.path());
        assert!(!sources.is_empty() && sources.iter().all(|source| *source == OF_A), "{sources:x?}");
        assert!(!behind.host_is_reached(), "nobody hears what is for it");
    });
}
