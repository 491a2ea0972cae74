//! The clients, all on one thread.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
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
    _others: Others,
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
        let mut trips = Self { pair, _others: others, there, back, room };
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
    thread: Option<JoinHandle<()>>,
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
            let (mut events, mut room) = ([EpollEvent::empty(); 64], [0; 1 << 10]);
            while !ends.load(Ordering::Relaxed) {
                let count = ready.wait(&mut events, 100u8).unwrap_or(0);
                for event in &events[..count] {
                    let mut client = &all[event.data() as usize];
                    let is_open =
                        matches!(client.read(&mut room), Ok(1..)) && client.write_all(&answer).is_ok();
                    if !is_open {
                        let _ = ready.delete(client);
                    }
                }
            }
        });
        Ok(Self { is_over, thread: Some(thread) })
    }
}

impl Drop for Others {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        // Their names are free once it has ended.
        let _ = self.thread.take().map(JoinHandle::join);
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
    let mut times = histogram()?;
    Trips::join(protocol, at, clients)?.run(time, &mut times)?;
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
    fn join(protocol: &dyn Protocol, at: SocketAddr, pair: u32) -> Result<Self> {
        let (from, to) = (2 * pair, 2 * pair + 1);
        let (sender, receiver) = (joined(protocol, at, from)?, joined(protocol, at, to)?);
        sender.set_nonblocking(true)?;
        receiver.set_nonblocking(true)?;
        let batch = protocol.package(to, from).repeat(BATCH);
        Ok(Self { sender, receiver, batch, left: 0, sent: 0, comes: protocol.comes(to), came: 0 })
    }

    /// Sends and reads what goes without waiting, no further batch after the end; returns whether anything did.
    fn turn(&mut self, room: &mut [u8], is_over: bool) -> Result<bool> {
        let mut moved = false;
        while self.left > 0 || !is_over && self.on_the_way() + BATCH <= ON_THE_WAY {
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

/// Senders, each with a receiver of its own.
pub struct Pairs {
    all: Vec<Pair>,
    room: Vec<u8>,
}

impl Pairs {
    pub fn join(protocol: &dyn Protocol, at: SocketAddr, pairs: u32) -> Result<Self> {
        let all = (0..pairs).map(|pair| Pair::join(protocol, at, pair)).collect::<Result<Vec<_>>>()?;
        Ok(Self { all, room: vec![0; 256 << 10] })
    }

    /// Sends for that time, and receives until each package has come: how many came, and in how many seconds.
    pub fn run(&mut self, time: Duration) -> Result<(usize, f64)> {
        let (begun, before) = (Instant::now(), self.came());
        let mut moved = begun;
        loop {
            let is_over = begun.elapsed() >= time;
            if is_over && self.all.iter().all(|pair| pair.left == 0 && pair.on_the_way() == 0) {
                return Ok((self.came() - before, begun.elapsed().as_secs_f64()));
            }
            let mut any = false;
            for pair in &mut self.all {
                any |= pair.turn(&mut self.room, is_over)?;
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

/// Packages received per second by `pairs` receivers.
pub fn rate(protocol: &dyn Protocol, at: SocketAddr, time: Duration, pairs: u32) -> Result<Value> {
    let mut pairs = Pairs::join(protocol, at, pairs)?;
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
