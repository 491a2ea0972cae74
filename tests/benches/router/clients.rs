//! The clients, all on one thread.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, ensure};
use hdrhistogram::Histogram;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags};
use serde_json::{Value, json};

use crate::protocols::Protocol;

/// Not measured: the first trips.
const WARM: usize = 1_000;
/// Packages of one write.
pub const BATCH: usize = 64;
/// Packages of a pair that are on their way at the most: no router drops any.
const ON_THE_WAY: usize = 4_096;
/// A router that has not passed a package on in such a time has lost it.
pub const PATIENCE: Duration = Duration::from_secs(10);

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

/// Clients of which the first and the last exchange packages. The others answer for their lives.
pub struct Trips {
    pair: [TcpStream; 2],
    others: Others,
    there: Vec<u8>,
    back: Vec<u8>,
    room: [Vec<u8>; 2],
}

impl Trips {
    pub fn join(protocol: &dyn Protocol, at: SocketAddr, clients: u32) -> Result<Self> {
        let last = clients - 1;
        let pair = [joined(protocol, at, 0)?, joined(protocol, at, last)?];
        let others = (1..last).map(|me| joined(protocol, at, me)).collect::<Result<Vec<_>>>()?;
        let others = Others::live(protocol, others)?;
        let (there, back) = (protocol.package(last, 0), protocol.package(0, last));
        let room = [last, 0].map(|to| vec![0; protocol.comes(to)]);
        let mut trips = Self { pair, others, there, back, room };
        for _ in 0..WARM {
            trips.once()?;
        }
        Ok(trips)
    }

    fn once(&mut self) -> Result<u64> {
        let Self { pair: [first, last], there, back, room: [at_last, at_first], .. } = self;
        let begun = Instant::now();
        first.write_all(there)?;
        last.read_exact(at_last)?;
        last.write_all(back)?;
        first.read_exact(at_first)?;
        Ok(begun.elapsed().as_nanos() as u64)
    }

    /// Round trips, one after the other.
    pub fn run(&mut self, time: Duration, times: &mut Histogram<u64>) -> Result<()> {
        let begun = Instant::now();
        while begun.elapsed() < time {
            times.record(self.once()?)?;
        }
        Ok(())
    }
}

/// Clients that do nothing but answer questions for signs of life, on a thread of their own.
#[derive(Default)]
struct Others {
    is_over: Arc<AtomicBool>,
    /// Returns how many were closed.
    thread: Option<JoinHandle<usize>>,
}

impl Others {
    fn live(protocol: &dyn Protocol, mut all: Vec<TcpStream>) -> Result<Self> {
        let answers = all.iter_mut().map(|client| protocol.watched(client)).collect::<Result<Vec<_>>>()?;
        let Some(answer) = answers.into_iter().flatten().next() else { return Ok(Self::default()) };
        let ready = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        for (client, stream) in all.iter().enumerate() {
            ready.add(stream, EpollEvent::new(EpollFlags::EPOLLIN, client as u64))?;
        }
        let is_over = Arc::new(AtomicBool::new(false));
        let ends = is_over.clone();
        let thread = std::thread::spawn(move || {
            let (mut events, mut room, mut closed) = ([EpollEvent::empty(); 64], [0; 1 << 10], 0);
            while !ends.load(Ordering::Relaxed) {
                let count = ready.wait(&mut events, 100u8).unwrap_or(0);
                for event in &events[..count] {
                    let mut client = &all[event.data() as usize];
                    let is_open =
                        matches!(client.read(&mut room), Ok(1..)) && client.write_all(&answer).is_ok();
                    if !is_open {
                        closed += 1;
                        let _ = ready.delete(client);
                    }
                }
            }
            closed
        });
        Ok(Self { is_over, thread: Some(thread) })
    }
}

impl Others {
    /// Ends them: their names are free then. An error if some have been closed before.
    fn end(mut self) -> Result<()> {
        self.is_over.store(true, Ordering::Relaxed);
        let closed = self
            .thread
            .take()
            .map_or(Ok(0), JoinHandle::join)
            .map_err(|_| anyhow!("their thread has panicked"))?;
        ensure!(closed == 0, "the router has closed {closed} of the others");
        Ok(())
    }
}

/// A histogram of times in nanoseconds.
pub fn histogram() -> Result<Histogram<u64>> {
    Ok(Histogram::new(3)?)
}

/// The figures of a histogram that are printed.
pub fn shown(times: &Histogram<u64>) -> Value {
    let at = |share| times.value_at_quantile(share);
    json!({ "n": times.len(), "p50": at(0.5), "p99": at(0.99), "p999": at(0.999) })
}

/// Round trips between the first and the last of `clients` clients.
pub fn trips(protocol: &dyn Protocol, at: SocketAddr, time: Duration, clients: u32) -> Result<Value> {
    let (mut times, mut trips) = (histogram()?, Trips::join(protocol, at, clients)?);
    trips.run(time, &mut times)?;
    trips.others.end()?;
    Ok(shown(&times))
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
    /// Its sender sends to `to` receivers, one after the other: to its own, or to those of all of so many pairs.
    fn join(protocol: &dyn Protocol, at: SocketAddr, pair: u32, to: u32) -> Result<Self> {
        let (from, own) = (2 * pair, 2 * pair + 1);
        let (sender, receiver) = (joined(protocol, at, from)?, joined(protocol, at, own)?);
        sender.set_nonblocking(true)?;
        receiver.set_nonblocking(true)?;
        let receiver_of = |package: u32| 2 * if to == 1 { pair } else { (pair + package) % to } + 1;
        let batch =
            (0..BATCH as u32).flat_map(|package| protocol.package(receiver_of(package), from)).collect();
        Ok(Self { sender, receiver, batch, left: 0, sent: 0, comes: protocol.comes(own), came: 0 })
    }

    /// Sends and reads what goes without waiting, of new batches up to `quota` packages; returns whether anything did.
    fn turn(&mut self, room: &mut [u8], quota: usize) -> Result<bool> {
        let (mut moved, before) = (false, self.sent);
        while self.left > 0 || self.sent - before + BATCH <= quota {
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

    /// Packages that have left and not come.
    fn on_the_way(&self) -> usize {
        self.sent - self.came / self.comes
    }
}

/// Senders, each with a receiver of its own, or all with all receivers in turn.
pub struct Pairs {
    all: Vec<Pair>,
    /// Each sender sends to all receivers.
    to_all: bool,
    room: Vec<u8>,
}

impl Pairs {
    pub fn join(protocol: &dyn Protocol, at: SocketAddr, pairs: u32, to_all: bool) -> Result<Self> {
        let to = if to_all { pairs } else { 1 };
        let all = (0..pairs).map(|pair| Pair::join(protocol, at, pair, to)).collect::<Result<Vec<_>>>()?;
        Ok(Self { all, to_all, room: vec![0; 256 << 10] })
    }

    /// Packages of all that have left and not come.
    fn on_the_way(&self) -> usize {
        self.all.iter().map(|pair| pair.sent).sum::<usize>() - self.came()
    }

    /// Packages that a pair may send now: of its own, or its share of those of all.
    fn quota(&self, pair: usize) -> usize {
        let on_the_way =
            if self.to_all { self.on_the_way() / self.all.len() } else { self.all[pair].on_the_way() };
        ON_THE_WAY.saturating_sub(on_the_way)
    }

    /// Sends for that time, and receives until each package has come: how many came, and in how many seconds.
    pub fn run(&mut self, time: Duration) -> Result<(usize, f64)> {
        let (begun, before) = (Instant::now(), self.came());
        let mut moved = begun;
        loop {
            let is_over = begun.elapsed() >= time;
            if is_over && self.on_the_way() == 0 && self.all.iter().all(|pair| pair.left == 0) {
                return Ok((self.came() - before, begun.elapsed().as_secs_f64()));
            }
            let mut any = false;
            for pair in 0..self.all.len() {
                let quota = if is_over { 0 } else { self.quota(pair) };
                any |= self.all[pair].turn(&mut self.room, quota)?;
            }
            if any {
                moved = Instant::now();
            } else {
                ensure!(moved.elapsed() < PATIENCE, "packages have been lost");
                std::thread::yield_now();
            }
        }
    }

    fn came(&self) -> usize {
        self.all.iter().map(|pair| pair.came / pair.comes).sum()
    }
}

/// Packages received per second by `pairs` receivers, each from its own sender, or from all.
pub fn rate(
    protocol: &dyn Protocol,
    at: SocketAddr,
    time: Duration,
    pairs: u32,
    to_all: bool,
) -> Result<Value> {
    let mut pairs = Pairs::join(protocol, at, pairs, to_all)?;
    pairs.run(time / 4)?;
    let (came, seconds) = pairs.run(time * 3 / 4)?;
    Ok(json!({ "rate": came as f64 / seconds, "n": came }))
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
