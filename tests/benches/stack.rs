//! What the stack costs a frame: `cargo bench -p tests --bench stack`.
//!
//! ```text
//! receive/64, /1472       a frame ─► the stack ─► a socket, and read from there
//! send/64, /1472          a socket ─► the stack ─► a discipline's queue, and out of there
//! fragments/60000         a datagram in 41 frames ─► a socket, and read from there: per datagram
//! ```
//!
//! `RTNET_COUNT=receive/64:1000` does one of them 1000 times and measures nothing: for tools that count instructions.
//! `RTNET_COUNT=mixed:10000000` has two stations exchange so many datagrams, of all kinds, and tells the memory of this
//! process in bytes after the first part of them, and after all.

use std::hint::black_box;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::ops::Range;
use std::sync::Arc;

use criterion::Criterion;
use rtnet::counters::Refusal;
use rtnet::discipline::{Channel, SendError, TimeView};
use rtnet::ip::route::{HostRoute, Interface, Origin};
use rtnet::ip::{Exit, Stack, StackConfig};
use rtnet::socket::{Flags, Socket, SocketId};
use rtnet::time::Instant;
use rtnet::wire::ethernet::{Address, MTU};
use rtnet::{Buf, Pool, Priority, PriorityQueue};

const IP: [Ipv4Addr; 2] = [Ipv4Addr::new(10, 0, 0, 1), Ipv4Addr::new(10, 0, 0, 2)];
const PORT: u16 = 36_000;
/// Time that passes between two datagrams, nanoseconds.
const BETWEEN: u64 = 10_000;

/// A discipline's queue, and nothing else of it.
struct Queue(PriorityQueue);

impl Exit for Queue {
    fn send(&mut self, frame: Buf, priority: Priority, _: Channel) -> Result<(), (SendError, Buf)> {
        self.0.push(priority, frame);
        Ok(())
    }
    fn limit(&self, _channel: Channel) -> Result<usize, SendError> {
        Ok(MTU)
    }
    fn time(&self) -> TimeView {
        TimeView::default()
    }
}

struct End {
    stack: Stack,
    queue: Queue,
    nic: Pool,
    socket: SocketId,
}

impl End {
    /// The station with this number, and a socket that hears on [`PORT`].
    fn new(number: usize) -> Self {
        Self::with(number, 64)
    }

    /// The same whose socket has so many buffers.
    fn with(number: usize, buffers: usize) -> Self {
        let address = |n: usize| Address([2, 0, 0, 0, 0, 1 + n as u8]);
        let config = StackConfig::new(Interface { address: address(number), ip: IP[number], prefix: 24 });
        let mut stack = Stack::new(config, Vec::new());
        let (ip, address) = (IP[1 - number], address(1 - number));
        stack
            .routes_mut()
            .add_host(HostRoute { ip, address, origin: Origin::Static })
            .expect("there is room");
        let pool = Arc::new(Pool::new(buffers));
        let socket = stack.open(Socket::udp(pool)).map_err(|(error, _)| error).expect("the first socket");
        stack.bind(socket, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT)).expect("a free port");
        Self { stack, queue: Queue(PriorityQueue::new()), nic: Pool::new(32), socket }
    }

    fn send(&mut self, data: &[u8]) {
        self.send_to(SocketAddrV4::new(IP[1], PORT), data);
    }

    fn send_to(&mut self, to: SocketAddrV4, data: &[u8]) {
        let sent = self.stack.send_to(self.socket, data, Some(to), Flags::NONE, &mut self.queue);
        sent.expect("there is a buffer and a route");
    }

    fn hear(&mut self, bytes: &[u8]) {
        self.offer(bytes, 1).expect("there is a socket for it");
    }

    fn offer(&mut self, bytes: &[u8], now: u64) -> Result<(), Refusal> {
        let mut frame = self.nic.take().expect("whoever keeps a frame pays for it");
        frame.fill(bytes);
        let heard = self.stack.on_frame(Some(Instant::from_nanos(now)), frame, &mut self.queue);
        heard.map_err(|refused| refused.why)
    }

    fn read(&mut self, into: &mut [u8]) -> usize {
        let received = self.stack.receive(self.socket, into, Flags::NONE, &TimeView::default());
        received.expect("something has come").len
    }
}

/// The frames of a datagram of so many bytes.
fn frames(len: usize) -> Vec<Vec<u8>> {
    let mut end = End::new(0);
    end.send(&vec![0x5a; len]);
    std::iter::from_fn(|| end.queue.0.pop()).map(|(_, frame)| frame.to_vec()).collect()
}

fn subject<R>(criterion: &mut Option<Criterion>, name: &str, mut step: impl FnMut() -> R) {
    if let Some(criterion) = criterion {
        criterion.bench_function(name, |bencher| bencher.iter(&mut step));
        return;
    }
    let count = std::env::var("RTNET_COUNT").unwrap_or_default();
    let parsed = count.split_once(':').and_then(|(subject, n)| Some((subject, n.parse::<u64>().ok()?)));
    let (wanted, times) = parsed.expect("RTNET_COUNT is SUBJECT:TIMES, as receive/64:1000");
    if wanted == name {
        (0..times).for_each(|_| drop(black_box(step())));
    }
}

/// Two stations exchange so many datagrams: short and long ones, some whose end is lost, some for nobody.
fn mixed(count: u64) {
    let mut ends = [End::with(0, 512), End::with(1, 512)];
    let (data, mut room) = (vec![0x5a; 60_000], vec![0; 65_536]);
    let mut come = 0u64;
    let mut exchange = |numbers: Range<u64>| {
        for n in numbers {
            let (from, to, now) = (n as usize % 2, 1 - n as usize % 2, n * BETWEEN);
            let (len, port, is_cut) = match n % 4_096 {
                0 | 1 => (60_000, PORT, false),
                n if n % 64 == 2 => (3_000, PORT, true),
                n if n % 64 == 3 => (64, PORT + 1, false),
                n if n % 8 == 4 => (1_472, PORT, false),
                _ => (64, PORT, false),
            };
            ends[from].send_to(SocketAddrV4::new(IP[to], port), &data[..len]);
            while let Some((_, frame)) = ends[from].queue.0.pop() {
                if is_cut && ends[from].queue.0.is_empty() {
                    break;
                }
                let heard = ends[to].offer(&frame, now);
                assert_eq!(heard.err(), (port != PORT).then_some(Refusal::NoSocket), "datagram {n}");
            }
            let End { stack, queue, socket, .. } = &mut ends[to];
            stack.poll(Instant::from_nanos(now), queue);
            while stack.receive(*socket, &mut room, Flags::NONE, &TimeView::default()).is_ok() {
                come += 1;
            }
        }
        resident()
    };
    let first = count / 100;
    let before = exchange(0..first);
    let after = exchange(first..count);
    println!("{{\"datagrams\": {count}, \"came\": {come}, \"resident\": [{before}, {after}]}}");
}

/// Of this process alone: not of its file, of which the kernel maps and takes back what it likes.
fn resident() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let mut pages = statm.split(' ').skip(1).flat_map(str::parse::<u64>);
    let (all, of_files) = (pages.next().unwrap_or(0), pages.next().unwrap_or(0));
    all.saturating_sub(of_files) * 4_096
}

fn main() {
    let of_mixed = std::env::var("RTNET_COUNT").ok();
    if let Some(count) = of_mixed.as_deref().and_then(|count| count.strip_prefix("mixed:")) {
        return mixed(count.parse().expect("RTNET_COUNT is mixed:TIMES, as mixed:1000"));
    }
    let mut criterion =
        std::env::var("RTNET_COUNT").is_err().then(|| Criterion::default().configure_from_args());
    let mut room = vec![0; 65_536];
    for len in [64, 1472] {
        let (mut end, frame) = (End::new(1), frames(len).remove(0));
        subject(&mut criterion, &format!("receive/{len}"), || {
            end.hear(black_box(&frame));
            end.read(&mut room)
        });
        let (mut end, data) = (End::new(0), vec![0x5a; len]);
        subject(&mut criterion, &format!("send/{len}"), || {
            end.send(black_box(&data));
            end.queue.0.pop()
        });
    }
    let (mut end, all) = (End::new(1), frames(60_000));
    subject(&mut criterion, "fragments/60000", || {
        all.iter().for_each(|frame| end.hear(frame));
        end.read(&mut room)
    });
}
