//! Programs with sockets of a station that is another thread here: what they wait with, and how they send.

// Programs wait, and the station takes its turns, in real time.
#![allow(clippy::disallowed_methods)]
// Of tokio, which must be told that a descriptor stays what it is.
#![allow(unsafe_code)]

#[path = "programs/frames.rs"]
mod frames;

use std::io::{self, ErrorKind};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use nix::errno::Errno;
use nix::poll::PollTimeout;
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags};
use rtnet::api::door::{Attached, Descriptors, Door};
use rtnet::api::handshake::{Answer, Ask};
use rtnet::api::line::Lines;
use rtnet::api::{Station, UdpSocket};
use rtnet::buf::{Buf, Pool};
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Channel, SendError, SyncState, TimeView};
use rtnet::ip::route::NetworkRoute;
use rtnet::ip::{Exit, Stack};
use rtnet::live::clock::monotonic;
use rtnet::live::{Bells, TimeBoard, TimePublisher, Visitor};
use rtnet::queue::Priority;
use rtnet::socket::{Flags, LinkMode, LinkType, Options};
use rtnet::time::{GlobalTime, Instant, Offset, Span};
use rtnet::wire::ethernet::MTU;
use tests::stacks::{ip, stack};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tools::control::{Answers, Server, Traffic};

const PATIENCE: Duration = Duration::from_secs(30);
const PORT: u16 = 36_000;

/// Frames, the oldest first.
type Frames = Arc<Mutex<Vec<Vec<u8>>>>;

/// What leaves is kept; nobody hears it.
struct Medium(Frames);

impl Exit for Medium {
    fn send(&mut self, frame: Buf, _: Priority, _: Channel) -> Result<(), (SendError, Buf)> {
        self.0.lock().unwrap().push(frame.to_vec());
        Ok(())
    }
    fn limit(&self, _: Channel) -> Result<usize, SendError> {
        Ok(MTU)
    }
    fn time(&self) -> TimeView {
        TimeView::default()
    }
}

struct Desk {
    stack: Stack,
    medium: Medium,
    door: Door,
}

impl Answers for Desk {
    fn answer(&mut self, _packet: &[u8], _traffic: Traffic) -> Vec<u8> {
        Vec::new()
    }
    fn ask(&mut self, ask: Ask, of: Option<&Attached>) -> (Answer, Option<(Attached, Descriptors)>) {
        match self.door.prepare(ask, of) {
            Ok(mut visit) => {
                visit.visit(&mut self.stack, &mut self.medium);
                self.door.finish(visit)
            }
            Err(answer) => (answer, None),
        }
    }
    fn leave(&mut self, left: Attached) {
        let mut visit = self.door.leave(left);
        visit.visit(&mut self.stack, &mut self.medium);
        self.door.finish(visit);
    }
}

/// Station 0, whose thread lets programs in. It knows station 1, and a network behind that.
struct Site {
    station: Station,
    /// Frames that have left.
    left: Frames,
    /// Frames that are to come.
    coming: Frames,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    _scratch: tempfile::TempDir,
}

impl Site {
    fn new() -> Self {
        Self::that_tells(None)
    }

    /// One whose programs' datagrams say when they were sent, by this board.
    fn that_tells(times: Option<Arc<TimeBoard>>) -> Self {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("site.sock");
        let mut server = Server::bind(&path).unwrap();
        let mut lines = Box::new(Lines::new(64));
        times.into_iter().for_each(|times| lines.tell_times(times));
        let mut stack = stack(0, vec![lines]);
        let network = "10.1.0.0/16".parse().unwrap();
        stack.routes_mut().add_network(NetworkRoute { network, gateway: ip(1) }).unwrap();
        let (left, coming, stop) = (Frames::default(), Frames::default(), Arc::<AtomicBool>::default());
        let mut desk = Desk { stack, medium: Medium(left.clone()), door: Door::new(Bells::new().unwrap()) };
        let (stopped, arriving, card) = (stop.clone(), coming.clone(), Pool::new(1));
        let thread = std::thread::spawn(move || {
            for turn in 1.. {
                if stopped.load(Ordering::Relaxed) {
                    return;
                }
                server.serve_all(Duration::from_micros(100), &mut desk);
                for bytes in arriving.lock().unwrap().drain(..) {
                    let mut frame = card.take().expect("whoever keeps a frame pays for it");
                    frame.fill(&bytes);
                    // What nobody wants is refused.
                    let _ = desk.stack.on_frame(Some(Instant::from_nanos(turn)), frame, &mut desk.medium);
                }
                desk.stack.poll(Instant::from_nanos(turn), &mut desk.medium);
                desk.stack.rest();
            }
        });
        Self { station: Station::at(&path), left, coming, stop, thread: Some(thread), _scratch: scratch }
    }

    /// One that sends to the other, by the station's loopback.
    fn sockets(&self) -> [UdpSocket; 2] {
        let sockets = [(); 2].map(|()| self.station.udp().unwrap());
        sockets[1].bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT)).unwrap();
        sockets[0].connect(Some(SocketAddrV4::new(ip(0), PORT))).unwrap();
        sockets
    }

    /// The first frames to leave, as soon as there are so many.
    fn left(&self, expected: usize) -> Vec<Vec<u8>> {
        let begun = std::time::Instant::now();
        loop {
            let left = self.left.lock().unwrap().clone();
            if left.len() >= expected {
                return left;
            }
            assert!(begun.elapsed() < PATIENCE, "{expected} leave");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn end(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().into_iter().for_each(|thread| thread.join().unwrap());
    }
}

impl Drop for Site {
    fn drop(&mut self) {
        self.end();
    }
}

fn number<T>(result: io::Result<T>) -> Errno {
    Errno::from_raw(result.err().and_then(|error| error.raw_os_error()).expect("it fails"))
}

/// The next number that comes.
async fn next(socket: &AsyncFd<UdpSocket>) -> io::Result<u64> {
    let mut room = [0; 8];
    let taken = socket.async_io(Interest::READABLE, |socket| socket.try_receive(&mut room));
    assert_eq!(taken.await?.len, room.len());
    Ok(u64::from_ne_bytes(room))
}

#[test]
fn a_program_of_tokio_waits_for_datagrams_and_for_the_end_of_the_station() {
    let mut site = Site::new();
    let [sender, receiver] = site.sockets();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        // SAFETY: a socket's descriptor is open, and the same one, as long as it lives, and this owns it.
        let receiver = unsafe { AsyncFd::register_with_interest(receiver, Interest::READABLE) }.unwrap();
        let soon = |what| tokio::time::timeout(PATIENCE, what);
        for n in 0..300u64 {
            // One that is waited for, or some that are there already, or come meanwhile.
            let burst = n % 7;
            (0..=burst).for_each(|m| sender.send(&(n + m).to_ne_bytes()).unwrap());
            for m in 0..=burst {
                assert_eq!(soon(next(&receiver)).await.expect("it is woken").unwrap(), n + m);
            }
            let none = tokio::time::timeout(Duration::from_millis(1), next(&receiver));
            assert!(n % 30 > 0 || none.await.is_err(), "nothing else comes");
        }
        site.end();
        let gone = soon(next(&receiver)).await.expect("it is woken");
        assert_eq!(number(gone), Errno::ENODEV);
    });
}

#[test]
fn one_epoll_waits_for_several_sockets_at_their_levels_or_their_edges() {
    for edges in [EpollFlags::empty(), EpollFlags::EPOLLET] {
        let mut site = Site::new();
        let [sender, first] = site.sockets();
        let second = site.station.udp().unwrap();
        second.bind(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, PORT + 1)).unwrap();
        let both = [first, second];
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC).unwrap();
        for (socket, data) in both.iter().zip(0..) {
            epoll.add(socket.as_fd(), EpollEvent::new(EpollFlags::EPOLLIN | edges, data)).unwrap();
        }
        let ready = |patience: Duration| {
            let mut events = [EpollEvent::empty(); 2];
            let found = epoll.wait(&mut events, PollTimeout::try_from(patience).unwrap()).unwrap();
            events[..found].iter().map(|event| event.data() as usize).collect::<Vec<_>>()
        };
        for n in 0..100u64 {
            let to = (n % 3 > 0) as usize;
            sender.send_to(&n.to_ne_bytes(), SocketAddrV4::new(ip(0), PORT + to as u16)).unwrap();
            let mut room = [0; 8];
            loop {
                let which = ready(PATIENCE);
                assert!(!which.is_empty(), "it is woken for {n}");
                let came: Vec<usize> =
                    which.into_iter().filter(|&which| both[which].try_receive(&mut room).is_ok()).collect();
                if !came.is_empty() {
                    assert_eq!((came, u64::from_ne_bytes(room)), (vec![to], n));
                    break;
                }
            }
            // Whoever waits for edges takes all there is.
            let kind = both.each_ref().map(|socket| socket.try_receive(&mut room).err().unwrap().kind());
            assert_eq!(kind, [ErrorKind::WouldBlock; 2]);
        }
        assert!(ready(Duration::from_millis(5)).is_empty(), "nothing else comes");
        site.end();
        assert!(!ready(PATIENCE).is_empty(), "of a station that is gone");
        assert_eq!(both.each_ref().map(|socket| number(socket.try_receive(&mut []))), [Errno::ENODEV; 2]);
    }
}

#[test]
fn a_program_sends_past_no_gateway_if_it_says_so_and_with_no_flag_that_there_is_not() {
    let site = Site::new();
    let socket = site.station.udp().unwrap();
    let (here, beyond) = (SocketAddrV4::new(ip(1), 9), SocketAddrV4::new(Ipv4Addr::new(10, 1, 0, 1), 9));
    socket.send_to(b"by a gateway", beyond).unwrap();
    socket.send_to_with(b"straight", here, Flags::DONTROUTE | Flags::DONTWAIT).unwrap();
    assert_eq!(site.left(2).len(), 2);
    socket.connect(Some(beyond)).unwrap();
    socket.send_with(b"never", Flags::DONTROUTE).unwrap();
    // What is found out in the station's thread is told of at the next call that sends.
    let begun = std::time::Instant::now();
    let told = loop {
        match socket.send_with(b"", Flags::NONE) {
            Ok(()) => assert!(begun.elapsed() < PATIENCE, "it hears of it"),
            refused => break number(refused),
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    assert_eq!(told, Errno::EHOSTUNREACH);
    for wrong in [libc::MSG_PEEK, libc::MSG_MORE] {
        assert_eq!(number(socket.send_with(b"", Flags::from_bits(wrong))), Errno::EINVAL);
    }
    assert_eq!(number(socket.send_to_with(b"", here, Flags::from_bits(libc::MSG_OOB))), Errno::EOPNOTSUPP);
}

#[test]
fn a_program_is_told_what_it_has_set() {
    let site = Site::new();
    let socket = site.station.udp().unwrap();
    assert_eq!((socket.options(), socket.timeout()), (Options::default(), None));
    let options = Options { priority: Priority::new(3).unwrap(), channel: 1, tos: 0x10 };
    socket.set_priority(options.priority).unwrap();
    socket.set_channel(options.channel);
    socket.set_tos(options.tos);
    socket.set_timeout(Some(PATIENCE));
    assert_eq!((socket.options(), socket.timeout()), (options, Some(PATIENCE)));
    let packet = site.station.packet(LinkMode::Raw, LinkType::Nothing).unwrap();
    assert_eq!(number(packet.set_priority(Priority::NON_RT)), Errno::EINVAL);
    assert_eq!(packet.options(), Options::default(), "as before");
}

#[test]
fn what_a_program_sends_with_times_says_when_it_handed_it_over_and_all_else_nothing() {
    let ahead = 1_700_000_000_000_000_000;
    let offset = Offset::between(Instant::default(), GlobalTime::from_nanos(ahead));
    // It is not too old for as long as this takes.
    let (start, period) =
        (Instant::from_nanos(monotonic()) + Span::from_millis(60_000), Some(Span::from_millis(1)));
    let with_state = |state| {
        let mut publisher = TimePublisher::new(EmulatedClock::default());
        publisher.publish(&TimeView { state, offset, start, period, ..TimeView::default() });
        (Site::that_tells(Some(publisher.board())), publisher)
    };
    let sites = [SyncState::Locked, SyncState::Lost].map(with_state);
    let knows = sites.iter().zip([true, false]).map(|((site, _), knows)| (site, knows));
    for (site, is_told) in knows.chain([(&Site::new(), false)]) {
        let (from, to) = (site.station.udp().unwrap(), site.station.udp().unwrap());
        to.set_timeout(Some(PATIENCE));
        let port = to.local_addr().unwrap().port();
        for with_times in [false, true, false] {
            from.set_with_times(with_times);
            let before = monotonic();
            from.send_to(b"now", SocketAddrV4::new(ip(0), port)).unwrap();
            let after = monotonic();
            let received = to.receive(&mut [0; 8]).unwrap();
            let sent = received.times.map(|times| times.sent.nanos() - ahead);
            assert_eq!((received.len, sent.is_some()), (3, with_times && is_told));
            assert!(
                sent.is_none_or(|sent| (before..=after).contains(&sent)),
                "{sent:?} of {before} to {after}"
            );
            assert!(received.times.is_none_or(|times| times.left.is_none()), "it never left");
        }
    }
}
