//! The clients, all on one thread.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use hdrhistogram::Histogram;
use serde_json::{Value, json};

use crate::protocols::Protocol;

/// Not measured: the first trips.
const WARM: usize = 1_000;
/// Packages of one write.
const BATCH: usize = 64;
/// Packages of a pair that are on their way at the most: no router drops any.
const ON_THE_WAY: usize = 4_096;
/// A router that has not passed a package on in such a time has lost it.
pub const PATIENCE: Duration = Duration::from_secs(10);
/// Connections that say nothing.
const SILENT: usize = 1_000;

/// A client that has joined.
pub fn joined(protocol: &dyn Protocol, at: SocketAddr, me: u32) -> Result<TcpStream> {
    let begun = Instant::now();
    let mut stream = loop {
        match TcpStream::connect(at) {
            // It was started a moment ago.
            Err(error) if error.kind() == ErrorKind::ConnectionRefused && begun.elapsed() < PATIENCE => {
                std::thread::sleep(Duration::from_millis(20));
            }
            connected => break connected.context("the router does not listen")?,
        }
    };
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    protocol.join(&mut stream, me).with_context(|| format!("client {me}"))?;
    Ok(stream)
}

/// Round trips between the first and the last of `clients` clients.
pub fn trips(protocol: &dyn Protocol, at: SocketAddr, time: Duration, clients: u32) -> Result<Value> {
    let mut all = (0..clients).map(|me| joined(protocol, at, me)).collect::<Result<Vec<_>>>()?;
    let last = clients - 1;
    let (there, back) = (protocol.package(last, 0), protocol.package(0, last));
    let mut room = vec![0; protocol.comes(last).max(protocol.comes(0))];
    let mut times = Histogram::<u64>::new(3)?;
    let mut once = |all: &mut [TcpStream]| -> Result<u64> {
        let begun = Instant::now();
        all[0].write_all(&there)?;
        all[last as usize].read_exact(&mut room[..protocol.comes(last)])?;
        all[last as usize].write_all(&back)?;
        all[0].read_exact(&mut room[..protocol.comes(0)])?;
        Ok(begun.elapsed().as_nanos() as u64)
    };
    for _ in 0..WARM {
        once(&mut all)?;
    }
    let begun = Instant::now();
    while begun.elapsed() < time {
        times.record(once(&mut all)?)?;
    }
    let at = |share| times.value_at_quantile(share);
    Ok(json!({ "n": times.len(), "p50": at(0.5), "p99": at(0.99), "p999": at(0.999) }))
}

struct Pair {
    sender: TcpStream,
    receiver: TcpStream,
    batch: Vec<u8>,
    /// Bytes of the batch that have left.
    left: usize,
    sent: usize,
    comes: usize,
    /// Bytes that have come.
    came: usize,
}

impl Pair {
    /// Sends and reads what goes without waiting; tells whether anything did.
    fn turn(&mut self, room: &mut [u8]) -> Result<bool> {
        let mut moved = false;
        while self.left > 0 || self.sent - self.came / self.comes + BATCH <= ON_THE_WAY {
            match self.sender.write(&self.batch[self.left..]) {
                Ok(length) => {
                    moved = true;
                    self.left += length;
                    if self.left == self.batch.len() {
                        (self.left, self.sent) = (0, self.sent + BATCH);
                    }
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) => return Err(error).context("a sender"),
            }
        }
        match self.receiver.read(room) {
            Ok(0) => anyhow::bail!("the router has closed a receiver"),
            Ok(length) => {
                self.came += length;
                moved = true;
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(error) => return Err(error).context("a receiver"),
        }
        Ok(moved)
    }
}

/// Packages received per second by `pairs` receivers.
pub fn rate(protocol: &dyn Protocol, at: SocketAddr, time: Duration, pairs: u32) -> Result<Value> {
    let mut all = (0..pairs)
        .map(|pair| {
            let (from, to) = (2 * pair, 2 * pair + 1);
            let (sender, receiver) = (joined(protocol, at, from)?, joined(protocol, at, to)?);
            sender.set_nonblocking(true)?;
            receiver.set_nonblocking(true)?;
            let batch = protocol.package(to, from).repeat(BATCH);
            Ok(Pair { sender, receiver, batch, left: 0, sent: 0, comes: protocol.comes(to), came: 0 })
        })
        .collect::<Result<Vec<_>>>()?;
    let mut room = vec![0; 256 << 10];
    let (mut begun, mut warm, mut moved) = (Instant::now(), true, Instant::now());
    let mut before = 0;
    let came = |all: &[Pair]| all.iter().map(|pair| pair.came / pair.comes).sum::<usize>();
    while begun.elapsed() < time {
        let mut any = false;
        for pair in &mut all {
            any |= pair.turn(&mut room)?;
        }
        if any {
            moved = Instant::now();
        } else {
            ensure!(moved.elapsed() < PATIENCE, "packages have been lost");
            std::thread::yield_now();
        }
        if warm && begun.elapsed() > time / 4 {
            (warm, begun, before) = (false, Instant::now(), came(&all));
        }
    }
    let seconds = begun.elapsed().as_secs_f64();
    Ok(json!({ "rate": (came(&all) - before) as f64 / seconds, "n": came(&all) - before }))
}

/// Memory of the router's process for a client that has joined and does nothing, bytes.
pub fn idle(protocol: &dyn Protocol, at: SocketAddr, pid: u32, count: u32) -> Result<Value> {
    let _one = joined(protocol, at, 0)?;
    let before = resident(pid)?;
    let all = (1..=count).map(|me| joined(protocol, at, me)).collect::<Result<Vec<_>>>()?;
    let grown = resident(pid)?.saturating_sub(before);
    Ok(json!({ "bytes": grown as f64 / all.len() as f64, "n": all.len() }))
}

fn resident(pid: u32) -> Result<u64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status"))?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).context("no VmRSS")?;
    let kib: u64 = line.split_whitespace().nth(1).context("no VmRSS")?.parse()?;
    Ok(kib << 10)
}

/// Clients that are a burden, until they are killed: one is sent to and does not read, one sends a byte a second, a thousand say
/// nothing.
pub fn abuse(protocol: &dyn Protocol, at: SocketAddr) -> Result<Value> {
    const DEAF: u32 = 900_000;
    let _silent = (0..SILENT).map(|_| TcpStream::connect(at)).collect::<std::io::Result<Vec<_>>>()?;
    let (_deaf, mut sender, mut slow) =
        (joined(protocol, at, DEAF)?, joined(protocol, at, DEAF + 1)?, joined(protocol, at, DEAF + 2)?);
    let batch = protocol.package(DEAF, DEAF + 1).repeat(BATCH);
    println!("{}", json!({ "ready": true }));
    let begin = protocol.begin();
    for turn in 0.. {
        // A thousand packages a second for the one that does not read.
        sender.write_all(&batch)?;
        std::thread::sleep(Duration::from_millis(64));
        if turn % 16 == 0 {
            slow.write_all(begin.get(turn / 16..=turn / 16).unwrap_or_default())?;
        }
    }
    Ok(Value::Null)
}
