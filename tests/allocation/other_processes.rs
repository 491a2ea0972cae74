//! Sockets of other processes: what the station's thread does for them, from their opening to their closing, allocates nothing
//! and frees nothing. What is made ready and freed elsewhere may.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use rtnet::api::door::{Attached, Descriptors, Door};
use rtnet::api::handshake::{Answer, Ask};
use rtnet::api::line::{LineCounters, Lines};
use rtnet::api::memory::Memory;
use rtnet::api::ring::{Reader, Writer};
use rtnet::api::segment::{self, ASLEEP, Order};
use rtnet::buf::{Buf, Pool};
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Channel, SendError, SyncState, TimeView};
use rtnet::ip::{Exit, Stack};
use rtnet::live::clock::monotonic;
use rtnet::live::{Bells, TimePublisher, Visitor};
use rtnet::queue::Priority;
use rtnet::socket::Options;
use rtnet::time::{Instant, Span};
use rtnet::wire::ethernet::MTU;
use tests::stacks::{at, bytes, ip, stack};

use crate::calls;

const PORT: u16 = 36_000;
/// How often programs come and go, and how many datagrams they exchange each time.
const VISITS: u64 = 20;
const DATAGRAMS: u64 = 500;
/// Frames that may leave in a turn.
const MOST: usize = 256;

/// Frames that wait to leave.
struct Leaving(Vec<Buf>);

impl Exit for Leaving {
    fn send(&mut self, frame: Buf, _: Priority, channel: Channel) -> Result<(), (SendError, Buf)> {
        if self.0.len() == self.0.capacity() {
            return Err((SendError::QueueFull(channel), frame));
        }
        self.0.push(frame);
        Ok(())
    }
    fn limit(&self, _: Channel) -> Result<usize, SendError> {
        Ok(MTU)
    }
    fn time(&self) -> TimeView {
        TimeView::default()
    }
}

/// A station whose two threads are this one, in turns.
struct Site {
    stack: Stack,
    leaving: Leaving,
    door: Door,
    card: Pool,
    now: Instant,
    /// How often what its own thread does has asked for memory or given it back.
    allocations: u64,
    _time: TimePublisher,
}

/// A program with a socket.
struct Program {
    attached: Attached,
    memory: Arc<Memory>,
    writer: Writer,
    reader: Reader,
    /// What wakes it, and what it rings: open as long as it lives.
    _descriptors: [std::os::fd::OwnedFd; 2],
}

impl Site {
    fn new(id: usize) -> Self {
        let mut time = TimePublisher::new(EmulatedClock::default());
        // Not too old for as long as this takes.
        let start = Instant::from_nanos(monotonic()) + Span::from_millis(60_000);
        let (state, period) = (SyncState::Locked, Some(Span::from_millis(1)));
        time.publish(&TimeView { state, start, period, ..TimeView::default() });
        let mut lines = Box::new(Lines::new(4));
        lines.tell_times(time.board());
        Self {
            stack: stack(id, vec![lines]),
            _time: time,
            leaving: Leaving(Vec::with_capacity(MOST)),
            door: Door::new(Bells::new().expect("a host has descriptors")),
            card: Pool::new(1),
            now: Instant::from_nanos(1),
            allocations: 0,
        }
    }

    /// Something in the station's thread.
    fn does<T>(&mut self, what: impl FnOnce(&mut Stack, &mut Leaving) -> T) -> T {
        let before = calls();
        let done = what(&mut self.stack, &mut self.leaving);
        self.allocations += calls() - before;
        done
    }

    /// What a program asks: made ready and answered by the control thread, done in the station's.
    fn ask(&mut self, ask: Ask, of: Option<&Attached>) -> (Answer, Option<(Attached, Descriptors)>) {
        let Ok(mut visit) = self.door.prepare(ask, of) else { panic!("{ask:?} is for the station's thread") };
        self.does(|stack, leaving| visit.visit(stack, leaving));
        self.door.finish(visit)
    }

    fn open(&mut self, ask: Ask) -> Program {
        let (_, opened) = self.ask(ask, None);
        let (attached, [memory, gate, doorbell]) = opened.expect("there is room");
        let memory = Arc::new(Memory::open(memory).expect("the same memory"));
        let writer = Writer::new(memory.clone(), segment::sent());
        let reader = Reader::new(memory.clone(), segment::received());
        Program { attached, memory, writer, reader, _descriptors: [gate, doorbell] }
    }

    fn close(&mut self, program: Program) {
        let mut visit = self.door.leave(program.attached);
        self.does(|stack, leaving| visit.visit(stack, leaving));
        self.door.finish(visit);
    }

    /// Hears what the other has sent, takes a turn, and goes to sleep and wakes again.
    fn turn(&mut self, other: &mut Self) {
        for sent in other.leaving.0.drain(..) {
            let mut frame = self.card.take().expect("whoever keeps a frame pays for it");
            frame.fill(&sent);
            let now = self.now;
            let heard = self.does(|stack, leaving| stack.on_frame(Some(now), frame, leaving));
            heard.expect("it is for this station");
        }
        self.now = Instant::from_nanos(self.now.nanos() + 1);
        let now = self.now;
        self.does(|stack, leaving| {
            stack.poll(now, leaving);
            stack.rest();
            stack.sleeps(true);
            stack.sleeps(false);
        });
    }

    fn lines(&mut self) -> LineCounters {
        self.stack.program_mut::<Lines>().expect("they are there").counters()
    }
}

impl Program {
    fn send(&mut self, data: &[u8], to: SocketAddrV4) {
        // Each says when it was sent.
        let (to, at) = (Some(segment::pack_udp(to)), Some(1_000));
        let order = Order { to, options: Options::default(), flags: 0, at };
        let written = self.writer.write(segment::pack_order(&order), data.len(), [data].into_iter());
        assert_eq!(written, Ok(true));
    }

    /// The datagram that has come, and that it sleeps from now on.
    fn receive(&mut self, room: &mut [u8]) -> Option<usize> {
        let record = self.reader.peek(room).expect("a station writes no nonsense")?;
        self.reader.take(record);
        let times = segment::unpack_received(record.meta, record.len, record.copied).times;
        assert_eq!(times.map(|times| times.sent.nanos()), Some(1_000));
        self.memory[ASLEEP].store(1, Ordering::SeqCst);
        Some(record.len)
    }
}

/// Programs of two stations open sockets, exchange datagrams, and close them; one ends by writing nonsense.
fn visit([one, other]: &mut [Site; 2]) -> u64 {
    let [mut asks, mut answers] = [&mut *one, &mut *other].map(|site| site.open(Ask::OpenUdp(8)));
    let bind = Ask::Bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT));
    for (site, program) in [(&mut *one, &asks), (&mut *other, &answers)] {
        assert_eq!(site.ask(bind, Some(&program.attached)).0.errno, 0);
    }
    let connected = one.ask(Ask::Connect(Some(at(1, PORT))), Some(&asks.attached)).0;
    let known = one.ask(Ask::LocalAddress, Some(&asks.attached)).0;
    assert_eq!((connected.errno, known.address), (0, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT)));
    let (data, mut room, mut received) = (bytes(4_000), [0; 4_000], 0);
    for n in 0..DATAGRAMS {
        // Now and then in fragments.
        let len = if n.is_multiple_of(16) { 4_000 } else { 64 };
        asks.send(&data[..len], at(1, PORT));
        one.turn(other);
        other.turn(one);
        let came = answers.receive(&mut room).expect("it has come");
        assert_eq!(room[..came], data[..len]);
        answers.send(&room[..came], SocketAddrV4::new(ip(0), PORT));
        other.turn(one);
        one.turn(other);
        received += u64::from(asks.receive(&mut room) == Some(len));
    }
    let hostile = other.open(Ask::OpenUdp(0));
    hostile.memory[segment::sent().head].store(u64::MAX, Ordering::SeqCst);
    other.turn(one);
    other.close(hostile);
    one.close(asks);
    other.close(answers);
    received
}

#[test]
fn sockets_of_other_processes_allocate_nothing_in_the_stations_thread() {
    let mut sites = [0, 1].map(Site::new);
    let received: u64 = (0..VISITS).map(|_| visit(&mut sites)).sum();
    assert_eq!(received, VISITS * DATAGRAMS);
    let [one, other] = sites.each_mut().map(Site::lines);
    assert_eq!((one.nonsense, other.nonsense), (0, VISITS));
    assert!(one.wakes >= VISITS * DATAGRAMS && other.wakes >= VISITS * DATAGRAMS, "{one:?} {other:?}");
    assert_eq!(sites.each_ref().map(|site| site.allocations), [0, 0]);
}
