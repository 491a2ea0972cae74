//! The kernel's own stack as both ends, and sockperf as the program.

use std::net::Ipv4Addr;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use serde_json::{Map, Value};
use tools::lab::namespace::Namespace;

use crate::{Cores, MESSAGE, STATION_PRIORITY, Way};

pub const ADDRESS: [[u8; 6]; 2] = [[2, 0, 0, 0, 1, 1], [2, 0, 0, 0, 1, 2]];
const IP: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 0, 1, 1), Ipv4Addr::new(10, 0, 1, 2)];
const PORT: &str = "11111";
/// Until a server hears.
const STARTS: Duration = Duration::from_millis(300);

/// Tells each host its address and where the other one is: nobody has to ask.
pub fn introduce(hosts: &[Namespace; 2]) -> Result<()> {
    for (number, host) in hosts.iter().enumerate() {
        let mut netlink = host.netlink()?;
        let index = netlink.link_index("rt0")?;
        netlink.add_address(index, IP[number], 24)?;
        netlink.add_neighbour(index, IP[1 - number], ADDRESS[1 - number])?;
    }
    Ok(())
}

/// Killed when it is not needed any more.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

pub fn trips(hosts: &[Namespace; 2], way: Way, cores: Cores, time: Duration) -> Result<Value> {
    let spawn = |number: usize, arguments: &[&str]| {
        let mut command = sockperf(way, cores[number], arguments);
        hosts[number]
            .run(|| command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn())
    };
    let server = spawn(1, &["server", "-i", &IP[1].to_string(), "-p", PORT])?;
    let _server = Server(server.context("sockperf, by taskset and chrt")?);
    std::thread::sleep(STARTS);
    // It counts whole seconds.
    let (to, size) = (IP[1].to_string(), MESSAGE.to_string());
    let time = (time.as_secs_f64().ceil() as u64).max(1).to_string();
    let client = spawn(0, &["ping-pong", "-i", &to, "-p", PORT, "-m", &size, "-t", &time, "--full-rtt"])?;
    let output = client.context("sockperf")?.wait_with_output()?;
    let said = String::from_utf8_lossy(&output.stdout);
    ensure!(output.status.success(), "sockperf: {said}{}", String::from_utf8_lossy(&output.stderr));
    figures(&said).with_context(|| format!("sockperf said nothing of percentiles: {said}"))
}

/// On its core, at the stations' priority, or, to spin, at none.
fn sockperf(way: Way, core: usize, arguments: &[&str]) -> Command {
    let mut command = Command::new("taskset");
    command.args(["-c", &core.to_string(), "chrt"]);
    match way.priority(STATION_PRIORITY) {
        Some(priority) => command.args(["-f", &priority.to_string()]),
        None => command.args(["-o", "0"]),
    };
    command.arg("sockperf").args(arguments);
    if way == Way::Spin {
        command.arg("--nonblocked");
    }
    command
}

/// From lines such as `sockperf: ---> percentile 99.000 =   32.421`, in microseconds, and how many messages it counted.
fn figures(said: &str) -> Option<Value> {
    let mut figures = Map::new();
    let counted = |what: &str| -> Option<u64> {
        let (_, number) = said.split_once(what)?;
        number.split(|c: char| !c.is_ascii_digit()).next()?.parse().ok()
    };
    figures.insert("n".into(), counted("ReceivedMessages=")?.into());
    figures.insert("lost".into(), counted("# dropped messages = ")?.into());
    for line in said.lines() {
        let Some((what, value)) = line.rsplit_once('=') else { continue };
        let name = match what.rsplit_once("---> ").map(|(_, what)| what.trim()) {
            Some("<MIN> observation") => "min",
            Some("percentile 50.000") => "p50",
            Some("percentile 99.000") => "p99",
            Some("percentile 99.900") => "p999",
            Some("<MAX> observation") => "max",
            _ => continue,
        };
        let micros: f64 = value.trim().parse().ok()?;
        figures.insert(name.into(), (micros * 1_000.0).into());
    }
    (figures.len() == 7).then_some(Value::Object(figures))
}
