//! Components that make mistakes: what they do costs them packages, mailboxes or their connection, and nobody else anything.

// Components need real time.
#![allow(clippy::disallowed_methods)]

use std::ffi::CStr;
use std::io::{IoSlice, IoSliceMut};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use nix::cmsg_space;
use nix::errno::Errno;
use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::signal::{Signal, kill};
use nix::sys::socket::{ControlMessage, ControlMessageOwned, MsgFlags, recvmsg, sendmsg};
use nix::sys::stat::fstat;
use nix::unistd::{Pid, ftruncate};
use package_router::broker::{Broker, MOST_COMPONENTS};
use package_router::component::{Component, Error, Mailbox, SendError, Sender};
use package_router::handshake::{ANSWER_LEN, Answer, Ask, Lane};
use package_router::mailbox::{
    self, LARGEST_BODY, LaneSender, Layout, MOST_SENDERS, MOST_SLOTS, Shape, Stamps, of_owner, of_sender,
};
use package_router::name::{Class, MailboxName};
use package_router::registry::{LaneState, MOST_MAILBOXES, Refused};
use package_router::shared::{Room, lane_at};
use package_router::wire::Head;
use rtnet::live::sealed::Sealed;
use socket2::{Domain, SockAddr, Socket, Type};

/// As long as anything may take on a host that has other things to do.
const PATIENCE: Duration = Duration::from_secs(20);
/// What a broker that does not wait for anybody takes for some asks, with much to spare: its clients give up after 2 s.
const AT_ONCE: Duration = Duration::from_millis(1_500);
/// Set for a process that is to make a mistake: which one, and at which station.
const MISTAKE: &str = "RTNET_MISTAKE";

const SINK: MailboxName = MailboxName::new(0, Class(0x80), 0, 0);
const HONEST: MailboxName = MailboxName::new(0, Class(0x40), 0, 0);
const MISTAKEN: MailboxName = MailboxName::new(0, Class(0xc0), 0, 0);
const HEIR: MailboxName = MailboxName::new(0, Class(0x41), 0, 0);

fn broker() -> (Broker, PathBuf, tempfile::TempDir) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("station.packages");
    (Broker::bind(&path).unwrap(), path, dir)
}

/// A broker in a thread of its own.
struct Station {
    path: PathBuf,
    is_over: Arc<AtomicBool>,
    serves: Option<JoinHandle<()>>,
    _dir: tempfile::TempDir,
}

impl Station {
    fn new() -> Self {
        let (mut broker, path, dir) = broker();
        let is_over = Arc::new(AtomicBool::new(false));
        let over = is_over.clone();
        let serves = thread::spawn(move || {
            while !over.load(Ordering::Relaxed) {
                broker.serve(Duration::from_millis(20));
            }
        });
        Self { path, is_over, serves: Some(serves), _dir: dir }
    }

    fn mailbox(&self, name: MailboxName, shape: Shape) -> (Component, Mailbox) {
        let component = Component::attach(&self.path).unwrap();
        let mailbox = component.mailbox(name, shape).unwrap();
        (component, mailbox)
    }
}

impl Drop for Station {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.serves.take().into_iter().for_each(|serves| serves.join().unwrap());
    }
}

/// Until it is so.
fn eventually<T>(what: &str, mut is_so: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(so) = is_so() {
            return so;
        }
        assert!(Instant::now() < deadline, "{what}");
        thread::sleep(Duration::from_millis(1));
    }
}

fn refused<T>(told: Result<T, Error>) -> Option<Refused> {
    match told {
        Err(Error::Refused(refused)) => Some(refused),
        _ => None,
    }
}

/// It is asked, and takes packages, as if nobody made a mistake.
fn goes_on(station: &Station, sink: &mut Mailbox) {
    let begun = Instant::now();
    let (_component, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let mut sender = honest.sender(sink.name()).unwrap();
    sender.set_priority(255);
    sender.send(9, b"here").unwrap();
    let package = sink.receive(Some(PATIENCE)).unwrap();
    let head = package.head();
    assert_eq!((head.from, head.kind, package.body().to_vec()), (HONEST, 9, b"here".to_vec()));
    drop(package);
    drop(sender);
    sink.depth().unwrap();
    assert!(begun.elapsed() < AT_ONCE, "{:?}", begun.elapsed());
}

/// A component that asks what it likes.
struct Raw(Socket);

impl Raw {
    fn connect(path: &Path) -> Self {
        let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        socket.connect(&SockAddr::unix(path).unwrap()).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        socket.set_write_timeout(Some(PATIENCE)).unwrap();
        Self(socket)
    }

    fn send(&self, packet: &[u8], files: &[&OwnedFd]) -> Result<(), Errno> {
        let raw: Vec<i32> = files.iter().map(|file| file.as_raw_fd()).collect();
        let rights = [ControlMessage::ScmRights(&raw)];
        let rights = if raw.is_empty() { &rights[..0] } else { &rights[..] };
        let parts = [IoSlice::new(packet)];
        sendmsg::<()>(self.0.as_raw_fd(), &parts, rights, MsgFlags::MSG_NOSIGNAL, None).map(drop)
    }

    /// `None`: it has hung up.
    fn receive(&self) -> Option<(Answer, Vec<OwnedFd>)> {
        let (mut packet, mut room) = ([0; ANSWER_LEN + 1], cmsg_space!([i32; 2]));
        let mut parts = [IoSliceMut::new(&mut packet)];
        let flags = MsgFlags::MSG_CMSG_CLOEXEC;
        let message = match recvmsg::<()>(self.0.as_raw_fd(), &mut parts, Some(&mut room), flags) {
            Err(Errno::ECONNRESET) => return None,
            told => told.unwrap(),
        };
        let mut files = Vec::new();
        for part in message.cmsgs().unwrap() {
            if let ControlMessageOwned::ScmRights(fds) = part {
                files.extend(fds.into_iter().map(own));
            }
        }
        let len = message.bytes;
        (len > 0).then(|| (Answer::parse(&packet[..len]).expect("an answer"), files))
    }

    fn ask(&self, ask: Ask, files: &[&OwnedFd]) -> Answer {
        self.send(&ask.to_bytes(), files).unwrap();
        self.receive().expect("it answers").0
    }

    fn creates(&self, name: MailboxName, shape: Shape) -> Answer {
        let (owner, lanes) = files(&shape);
        self.ask(Ask::Create(name, shape), &[&owner, &lanes])
    }

    /// A lane that was made ready.
    fn binds(&self, from: MailboxName, to: MailboxName) -> (LaneSender<Room, Sealed>, Lane) {
        self.send(&Ask::Bind { from, to }.to_bytes(), &[]).unwrap();
        let (answer, files) = self.receive().expect("it answers");
        let (lane, sender) = lane_of(&answer, files);
        assert_eq!(self.ask(Ask::Ready(lane), &[]), Answer::Done);
        (sender, lane)
    }
}

fn lane_of(answer: &Answer, files: Vec<OwnedFd>) -> (Lane, LaneSender<Room, Sealed>) {
    let Answer::Reserved { lane, shape, .. } = *answer else { panic!("{answer:?}") };
    let [owner, lanes]: [OwnedFd; 2] = files.try_into().expect("two files");
    let layout = Layout::of(&shape);
    let room = Room::open(&lanes, &layout, lane.lane).unwrap();
    let theirs = Sealed::open(owner, layout.owner_words(shape.senders + 1)).unwrap();
    (lane, LaneSender::new(room, theirs, layout, lane.lane))
}

/// A descriptor that has just been received.
#[allow(unsafe_code)]
fn own(fd: i32) -> OwnedFd {
    // SAFETY: the kernel has just made it for this process, and nobody else knows of it.
    unsafe { OwnedFd::from_raw_fd(fd) }
}

/// What comes with a mailbox: the router has a lane, too.
fn files(shape: &Shape) -> (OwnedFd, OwnedFd) {
    files_called(c"mistaken", shape)
}

fn files_called(name: &CStr, shape: &Shape) -> (OwnedFd, OwnedFd) {
    let (layout, lanes) = (Layout::of(shape), shape.senders + 1);
    let bytes = [layout.owner_words(lanes), lane_at(&layout, lanes)].map(|words| words * size_of::<u64>());
    let [owner, lanes] = bytes.map(|bytes| bytes.next_multiple_of(4096));
    (file(name, owner, final_seals()), file(name, lanes, SealFlag::F_SEAL_SHRINK))
}

/// Of a file that nobody can write any more, cut short or make holes in.
fn final_seals() -> SealFlag {
    SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_FUTURE_WRITE
}

/// A file of so many bytes, none of which takes memory yet.
fn file(name: &CStr, bytes: usize, seals: SealFlag) -> OwnedFd {
    let file = memfd_create(name, MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING).unwrap();
    ftruncate(&file, bytes as i64).unwrap();
    fcntl(&file, FcntlArg::F_ADD_SEALS(seals)).unwrap();
    file
}

fn let_there_be_descriptors() {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, most, most).unwrap();
    assert!(most >= 4_096, "this test takes more descriptors than {most}: raise `ulimit -Hn`");
}

/// Descriptors that this process, and so the broker, has of files that are called so; other tests have others.
fn descriptors(name: &CStr) -> usize {
    let called = format!("/memfd:{} (deleted)", name.to_str().unwrap());
    let all = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
    all.filter(|file| std::fs::read_link(file.path()).is_ok_and(|to| to.as_os_str() == called.as_str()))
        .count()
}

/// A process of its own that makes a mistake.
struct Mistaken(Child);

impl Mistaken {
    fn begin(test: &str, station: &Station) -> Self {
        let own = std::env::current_exe().unwrap();
        let mut command = Command::new(own);
        command.args(["--exact", &format!("packages::{test}"), "--nocapture"]).env(MISTAKE, &station.path);
        Self(command.stdout(Stdio::null()).spawn().unwrap())
    }

    fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.0.id() as i32), signal).unwrap();
    }
}

impl Drop for Mistaken {
    fn drop(&mut self) {
        let _ = (self.0.kill(), self.0.wait());
    }
}

/// Where this process is to make a mistake, if it is.
fn is_to_make_it() -> Option<PathBuf> {
    std::env::var_os(MISTAKE).map(PathBuf::from)
}

/// Reads what waits of the mistaken, whose packages are numbered and come in their order: how many.
fn read_in_order(sink: &mut Mailbox, last: &mut u64) -> u64 {
    let mut count = 0;
    while let Some(package) = sink.try_receive().unwrap() {
        assert_eq!(package.head().from, MISTAKEN);
        let bytes = package.body().to_vec();
        let number = u64::from_ne_bytes(bytes[..8].try_into().unwrap());
        assert_eq!(bytes, [number.to_ne_bytes(); 3].concat(), "torn");
        assert!(number > *last, "{number} behind {last}");
        *last = number;
        count += 1;
    }
    count
}

// ---- what they send ----

#[test]
fn a_million_packages_to_a_full_mailbox_are_refused_and_counted_and_cost_another_none() {
    const PACKAGES: u64 = 1_000_000;
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(8, 16).senders(2));
    let (_mistaken, mistaken) = station.mailbox(MISTAKEN, Shape::new(1, 1));
    let (_honest, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let (mut floods, mut sends) = (mistaken.sender(SINK).unwrap(), honest.sender(SINK).unwrap());
    sends.set_priority(255);
    let (begun, mut longest) = (Instant::now(), Duration::ZERO);
    for count in 0..PACKAGES {
        let told = floods.send(1, &count.to_ne_bytes());
        assert_eq!(told.is_ok(), count < 8);
        if count % 1_000 == 999 {
            let before = Instant::now();
            sends.send(1, &count.to_ne_bytes()).unwrap();
            let package = sink.receive(Some(PATIENCE)).unwrap();
            assert_eq!(
                (package.head().from, package.body().to_vec()),
                (HONEST, count.to_ne_bytes().to_vec())
            );
            drop(package);
            longest = longest.max(before.elapsed());
        }
    }
    let took = begun.elapsed();
    assert!(took < PATIENCE, "{took:?}");
    assert_eq!((floods.counted(of_sender::SENT), floods.counted(of_sender::FULL)), (8, PACKAGES - 8));
    assert_eq!((sends.counted(of_sender::SENT), sends.counted(of_sender::FULL)), (1_000, 0));
    assert_eq!((sink.counted(of_owner::RECEIVED), sink.depth()), (1_000, Ok(8)));
    assert_eq!(sink.counted(of_owner::NONSENSE) + sink.counted(of_owner::FORGED), 0);
    for count in 0..8u64 {
        assert_eq!(sink.receive(Some(PATIENCE)).unwrap().body().to_vec(), count.to_ne_bytes());
    }
    println!(
        "FIGURE a_million_packages_to_a_full_mailbox_are_refused_and_counted_and_cost_another_none: {PACKAGES} packages in \
         {took:?}, of which 8 fit; another's 1000 all came, each within {longest:?}"
    );
}

#[test]
fn who_says_to_be_another_is_not_heard_and_is_counted() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16).senders(3));
    let mistaken = Raw::connect(&station.path);
    assert!(matches!(mistaken.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }));
    let (mut lane, _) = mistaken.binds(MISTAKEN, SINK);
    let (now, head) =
        (Stamps { sent: 1, ..Stamps::default() }, Head { to: SINK, priority: 255, ..Head::default() });
    // Another that is there, the receiver, nobody, and one that never was.
    for from in [HONEST, SINK, MailboxName::NOBODY, MailboxName(u32::MAX)] {
        lane.send(&Head { from, ..head }, b"lies", &now).unwrap();
    }
    goes_on(&station, &mut sink);
    assert_eq!((sink.depth(), sink.counted(of_owner::FORGED)), (Ok(0), 4));
    // What it says truly is heard still.
    lane.send(&Head { from: MISTAKEN, ..head }, b"true", &now).unwrap();
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().body().to_vec(), b"true");
    assert_eq!((sink.counted(of_owner::FORGED), sink.counted(of_owner::NONSENSE)), (4, 0));
}

// ---- what they ask ----

#[test]
fn a_mailbox_that_is_larger_than_any_is_refused_by_the_broker_too() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16).senders(3));
    let mistaken = Raw::connect(&station.path);
    let called = c"too-large";
    let (owner, lanes) = files_called(called, &Shape::new(1, 1));
    for shape in [
        Shape::new(0, 1),
        Shape::new(MOST_SLOTS + 1, 1),
        Shape::new(usize::MAX, 1),
        Shape::new(1, LARGEST_BODY + 1),
        Shape::new(1, usize::MAX),
        Shape::new(1, 1).senders(0),
        Shape::new(1, 1).senders(MOST_SENDERS + 1),
        Shape::new(1, 1).senders(usize::MAX),
        Shape::new(MOST_SLOTS, LARGEST_BODY).senders(MOST_SENDERS),
    ] {
        let answer = mistaken.ask(Ask::Create(MISTAKEN, shape), &[&owner, &lanes]);
        assert!(matches!(answer, Answer::Refused(Refused::Shape(_))), "{shape:?}: {answer:?}");
    }
    let nobody = mistaken.creates(MailboxName::NOBODY, Shape::new(1, 1));
    assert_eq!(nobody, Answer::Refused(Refused::NoName(MailboxName::NOBODY)));
    drop((owner, lanes));
    assert_eq!(descriptors(called), 0);
    assert!(
        matches!(mistaken.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }),
        "the name is free"
    );
    goes_on(&station, &mut sink);
}

#[test]
fn who_takes_all_mailboxes_that_a_station_has_leaves_those_of_others_as_they_are() {
    let_there_be_descriptors();
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16));
    let (honest_is, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let mut sender = honest.sender(SINK).unwrap();
    let mistaken = Component::attach(&station.path).unwrap();
    let mut taken = Vec::new();
    let told = loop {
        let name = MailboxName(0x0100_0000 + taken.len() as u32);
        match mistaken.mailbox(name, Shape::new(1, 1).senders(1)) {
            Ok(mailbox) => taken.push(mailbox),
            told => break refused(told),
        }
    };
    assert_eq!((told, taken.len()), (Some(Refused::TooMany), MOST_MAILBOXES - 2));
    let another = |local| honest_is.mailbox(HONEST.with_local(local), Shape::new(1, 1));
    assert_eq!(refused(another(1)), Some(Refused::TooMany));
    sender.send(1, b"goes on").unwrap();
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().body().to_vec(), b"goes on");
    taken.pop();
    another(1).unwrap();
    drop((taken, mistaken));
    another(2).unwrap();
    goes_on_beside(&honest, &mut sink);
}

fn goes_on_beside(honest: &Mailbox, sink: &mut Mailbox) {
    honest.sender(SINK).unwrap().send(2, &[]).unwrap();
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().head().kind, 2);
}

#[test]
fn who_takes_all_senders_of_a_mailbox_leaves_who_has_one_its_own() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16).senders(5));
    let (_honest, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let mut sender = honest.sender(SINK).unwrap();
    let (mistaken_is, mistaken) = station.mailbox(MISTAKEN, Shape::new(1, 1));
    let mut taken: Vec<Sender> = (0..4).map(|_| mistaken.sender(SINK).unwrap()).collect();
    for _ in 0..100 {
        assert_eq!(refused(mistaken.sender(SINK)), Some(Refused::NoLane(SINK, 5)));
    }
    taken.iter_mut().for_each(|sender| _ = sender.send(1, &[]).unwrap());
    sender.send(2, &[]).unwrap();
    assert_eq!(sink.depth(), Ok(5));
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().head().kind, 2);
    drop((taken, mistaken, mistaken_is));
    // Who has gone makes way as soon as it is read.
    assert_eq!(sink.clean(), Ok(4));
    sink.depth().unwrap();
    let all: Vec<Sender> = (0..4).map(|_| honest.sender(SINK).unwrap()).collect();
    assert_eq!(all.len(), 4);
}

#[test]
fn what_is_another_s_is_neither_taken_nor_deleted_nor_spoken_for() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16).senders(3));
    let (_honest, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let mut sender = honest.sender(SINK).unwrap();
    let mistaken = Raw::connect(&station.path);
    let answers = |answer: Answer, refused| assert_eq!(answer, Answer::Refused(refused));
    answers(mistaken.creates(SINK, Shape::new(1, 1)), Refused::Taken(SINK));
    answers(mistaken.ask(Ask::Delete(SINK), &[]), Refused::NotOwn(SINK));
    answers(mistaken.ask(Ask::Delete(HEIR), &[]), Refused::NoMailbox(HEIR));
    answers(mistaken.ask(Ask::Bind { from: HONEST, to: SINK }, &[]), Refused::NotOwn(HONEST));
    answers(mistaken.ask(Ask::Bind { from: MISTAKEN, to: SINK }, &[]), Refused::NotOwn(MISTAKEN));
    assert!(matches!(mistaken.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }));
    answers(mistaken.ask(Ask::Bind { from: MISTAKEN, to: HEIR }, &[]), Refused::NoMailbox(HEIR));
    // Every lane there is, of another, the router's, and such as there are not.
    let (_lane, own) = mistaken.binds(MISTAKEN, SINK);
    for place in (0..4).chain([MOST_MAILBOXES - 1, MOST_MAILBOXES, u32::MAX as usize]) {
        for lane in (0..5).chain([127, 128, u32::MAX as usize]) {
            let other = Lane { place, lane, ..own };
            if other != own {
                assert_eq!(mistaken.ask(Ask::Unbind(other), &[]), Answer::Failed(libc::EINVAL), "{other:?}");
                assert_eq!(mistaken.ask(Ask::Ready(other), &[]), Answer::Failed(libc::EINVAL), "{other:?}");
            }
        }
    }
    assert_eq!(mistaken.ask(Ask::Ready(own), &[]), Answer::Failed(libc::EINVAL), "it is ready");
    assert_eq!(mistaken.ask(Ask::Unbind(own), &[]), Answer::Done);
    assert_eq!(mistaken.ask(Ask::Unbind(own), &[]), Answer::Failed(libc::EINVAL), "once");
    sender.send(1, b"mine").unwrap();
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().body().to_vec(), b"mine");
}

#[test]
fn a_sender_of_a_mailbox_that_is_gone_takes_nothing_from_the_one_in_its_place_when_it_goes() {
    let station = Station::new();
    let (sink_is, sink) = station.mailbox(SINK, Shape::new(4, 16).senders(2));
    let (_mistaken, mistaken) = station.mailbox(MISTAKEN, Shape::new(1, 1));
    let (_heir, heir) = station.mailbox(HEIR, Shape::new(1, 1));
    let old = mistaken.sender(SINK).unwrap();
    drop(sink);
    let mut sink = sink_is.mailbox(SINK, Shape::new(4, 16).senders(2)).unwrap();
    let mut new = mistaken.sender(SINK).unwrap();
    sink.depth().unwrap();
    drop(old);
    sink.depth().unwrap();
    // Its lane is nobody else's, and what it sends comes.
    let mut others = heir.sender(SINK).unwrap();
    assert_eq!(refused(heir.sender(SINK)), Some(Refused::NoLane(SINK, 2)));
    new.send(1, b"new").unwrap();
    others.send(2, b"others").unwrap();
    let came: Vec<_> = std::iter::from_fn(|| {
        let package = sink.try_receive().unwrap()?;
        Some((package.head().from, package.body().to_vec()))
    })
    .collect();
    // By the class of who sends.
    assert_eq!(came, [(HEIR, b"others".to_vec()), (MISTAKEN, b"new".to_vec())]);
}

// ---- the files that they bring ----

#[test]
fn files_that_are_too_short_not_sealed_too_few_or_too_many_make_no_mailbox() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16).senders(3));
    let (called, shape) = (c"too-odd", Shape::new(4, 100).senders(2));
    let (owner, lanes) = files_called(called, &shape);
    let size = |file: &OwnedFd| fstat(file).unwrap().st_size as usize;
    let short = file(called, size(&owner) - 4096, final_seals());
    let unsealed = file(called, size(&owner), SealFlag::F_SEAL_FUTURE_WRITE);
    let with_holes = file(called, size(&owner), SealFlag::F_SEAL_SHRINK);
    let few = file(called, size(&lanes) - 1, SealFlag::F_SEAL_SHRINK);
    let null: OwnedFd = std::fs::File::open("/dev/null").unwrap().into();
    let (pipe, _writes) = nix::unistd::pipe().unwrap();
    for files in [
        &[][..],
        &[&owner],
        &[&lanes],
        &[&lanes, &owner],
        &[&short, &lanes],
        &[&unsealed, &lanes],
        &[&with_holes, &lanes],
        &[&null, &lanes],
        &[&pipe, &lanes],
        &[&owner, &few],
        &[&owner, &null],
        &[&owner, &pipe],
    ] {
        let mistaken = Raw::connect(&station.path);
        let answer = mistaken.ask(Ask::Create(MISTAKEN, shape), files);
        assert!(matches!(answer, Answer::Failed(_)), "{files:?}: {answer:?}");
    }
    // More than are taken: it may be hung up on, or refused.
    for files in [&[&owner, &lanes, &null][..], &[&owner; 10]] {
        let mistaken = Raw::connect(&station.path);
        for ask in [Ask::Attach, Ask::Create(MISTAKEN, shape)] {
            if mistaken.send(&ask.to_bytes(), files).is_err() {
                break;
            }
            match mistaken.receive() {
                None => break,
                Some((answer, _)) => assert!(!matches!(answer, Answer::Created { .. }), "{answer:?}"),
            }
        }
    }
    // The name is nobody's.
    let mistaken = Raw::connect(&station.path);
    let answer = mistaken.ask(Ask::Create(MISTAKEN, shape), &[&owner, &lanes]);
    assert!(matches!(answer, Answer::Created { .. }), "{answer:?}");
    goes_on(&station, &mut sink);
    drop((mistaken, owner, lanes, short, unsealed, with_holes, few));
    eventually("no file is left", || (descriptors(called) == 0).then_some(()));
}

#[test]
fn lanes_that_could_be_cut_short_are_written_by_nobody() {
    let station = Station::new();
    let (_honest, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let mistaken = Raw::connect(&station.path);
    let shape = Shape::new(4, 100).senders(2);
    let (owner, lanes) = files(&shape);
    let unsealed = file(c"mistaken", fstat(&lanes).unwrap().st_size as usize, SealFlag::empty());
    match mistaken.ask(Ask::Create(SINK, shape), &[&owner, &unsealed]) {
        Answer::Created { .. } => {
            // As often as there are lanes, and more.
            for _ in 0..5 {
                assert!(matches!(honest.sender(SINK), Err(Error::Io(_))));
            }
            ftruncate(&unsealed, 0).unwrap();
            assert!(matches!(honest.sender(SINK), Err(Error::Io(_))));
        }
        answer => assert!(matches!(answer, Answer::Failed(_)), "{answer:?}"),
    }
}

#[test]
fn a_file_that_is_longer_than_its_mailbox_takes_no_more_memory_than_that() {
    const BYTES: usize = 256 << 20;
    let station = Station::new();
    let mistaken = Raw::connect(&station.path);
    let shape = Shape::new(1, 8).senders(1);
    let (_, lanes) = files(&shape);
    let owner = file(c"mistaken", BYTES, final_seals());
    assert_eq!(fstat(&owner).unwrap().st_blocks, 0);
    let answer = mistaken.ask(Ask::Create(MISTAKEN, shape), &[&owner, &lanes]);
    let taken = fstat(&owner).unwrap().st_blocks * 512;
    assert!(taken <= 1 << 20, "{answer:?}: the broker took {taken} bytes for a mailbox of some thousand");
}

// ---- how they hang and go ----

/// Sends to the sink for ever, numbered packages.
fn sends_for_ever(mut send: impl FnMut(&[u8]) -> bool) -> ! {
    for number in 1u64.. {
        while !send(&[number.to_ne_bytes(); 3].concat()) {
            thread::yield_now();
        }
    }
    unreachable!()
}

#[test]
fn one_that_hangs_while_it_has_a_lane_holds_up_nobody() {
    if let Some(station) = is_to_make_it() {
        let component = Component::attach(&station).unwrap();
        let mailbox = component.mailbox(MISTAKEN, Shape::new(1, 1)).unwrap();
        let mut sender = mailbox.sender(SINK).unwrap();
        sends_for_ever(|body| sender.send(1, body).is_ok());
    }
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 24).senders(2));
    let mistaken = Mistaken::begin("one_that_hangs_while_it_has_a_lane_holds_up_nobody", &station);
    let mut last = 0;
    for round in 0..10 {
        let before = last;
        eventually("it sends", || {
            read_in_order(&mut sink, &mut last);
            (last > before + 100).then_some(())
        });
        // At some instruction of sending, mostly.
        thread::sleep(Duration::from_micros(round * 37));
        mistaken.signal(Signal::SIGSTOP);
        // What it had sent is there, and no more; others go on.
        thread::sleep(Duration::from_millis(5));
        read_in_order(&mut sink, &mut last);
        let stopped = last;
        for _ in 0..20 {
            goes_on(&station, &mut sink);
        }
        assert_eq!(read_in_order(&mut sink, &mut last) + last - stopped, 0);
        mistaken.signal(Signal::SIGCONT);
    }
    assert_eq!(sink.counted(of_owner::NONSENSE) + sink.counted(of_owner::FORGED), 0);
}

#[test]
fn one_that_hangs_while_it_has_a_mailbox_refuses_what_does_not_fit_and_holds_up_nobody() {
    if let Some(station) = is_to_make_it() {
        // An echo.
        let component = Component::attach(&station).unwrap();
        let mut mailbox = component.mailbox(MISTAKEN, Shape::new(4, 24)).unwrap();
        let mut sender = mailbox.sender(SINK).unwrap();
        loop {
            let body = mailbox.receive(None).unwrap().body().to_vec();
            sender.send(3, &body).unwrap();
        }
    }
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(8, 24).senders(2));
    let test = "one_that_hangs_while_it_has_a_mailbox_refuses_what_does_not_fit_and_holds_up_nobody";
    let mistaken = Mistaken::begin(test, &station);
    let (_heir, heir) = station.mailbox(HEIR, Shape::new(1, 1));
    let mut sender = eventually("it is there", || heir.sender(MISTAKEN).ok());
    let mut number = 0u64;
    let mut send = |sender: &mut Sender| {
        number += 1;
        sender.send(1, &[number.to_ne_bytes(); 3].concat())
    };
    // It is at work.
    send(&mut sender).unwrap();
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().head().kind, 3);
    mistaken.signal(Signal::SIGSTOP);
    thread::sleep(Duration::from_millis(5));
    (0..4).for_each(|_| assert!(send(&mut sender).is_ok()));
    let (begun, full) = (Instant::now(), Err(SendError::Mailbox(mailbox::SendError::Full(4))));
    (0..100_000).for_each(|_| assert_eq!(send(&mut sender), full));
    assert!(begun.elapsed() < PATIENCE, "nobody waits for it: {:?}", begun.elapsed());
    for _ in 0..20 {
        goes_on(&station, &mut sink);
        // It can be bound to, and left.
        drop(heir.sender(MISTAKEN).map_err(|error| error.to_string()));
    }
    mistaken.signal(Signal::SIGCONT);
    for expected in 2..6u64 {
        let package = sink.receive(Some(PATIENCE)).unwrap();
        assert_eq!(package.body().to_vec(), [expected.to_ne_bytes(); 3].concat());
    }
    send(&mut sender).unwrap();
    assert_eq!(sink.receive(Some(PATIENCE)).unwrap().head().kind, 3);
}

#[test]
fn the_lane_of_one_that_has_hung_up_and_writes_on_is_nobodys_until_its_process_has_ended() {
    if let Some(station) = is_to_make_it() {
        let raw = Raw::connect(&station);
        assert!(matches!(raw.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }));
        let (mut lane, _) = raw.binds(MISTAKEN, SINK);
        drop(raw);
        let head = Head { from: MISTAKEN, to: SINK, ..Head::default() };
        let now = Stamps { sent: 1, ..Stamps::default() };
        sends_for_ever(|body| lane.send(&head, body, &now).is_ok());
    }
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 24).senders(1));
    let test = "the_lane_of_one_that_has_hung_up_and_writes_on_is_nobodys_until_its_process_has_ended";
    let mistaken = Mistaken::begin(test, &station);
    let mut last = 0;
    eventually("it sends", || {
        read_in_order(&mut sink, &mut last);
        (last > 0).then_some(())
    });
    // Its mailbox has gone with its connection.
    let heir_is = Component::attach(&station.path).unwrap();
    let heir = heir_is.mailbox(HEIR, Shape::new(1, 1)).unwrap();
    eventually("its name is free", || heir_is.mailbox(MISTAKEN, Shape::new(1, 1)).ok());
    for _ in 0..200 {
        let before = last;
        eventually("it still sends", || {
            read_in_order(&mut sink, &mut last);
            (last > before).then_some(())
        });
        assert_eq!(refused(heir.sender(SINK)), Some(Refused::NoLane(SINK, 1)));
        // Some come and go meanwhile.
        drop(Raw::connect(&station.path));
    }
    drop(mistaken);
    let mut sender = eventually("its lane is free", || {
        read_in_order(&mut sink, &mut last);
        heir.sender(SINK).ok()
    });
    for count in 0..100u8 {
        sender.send(1, &[count]).unwrap();
        let package = sink.receive(Some(PATIENCE)).unwrap();
        assert_eq!((package.head().from, package.body().to_vec()), (HEIR, vec![count]));
    }
    assert_eq!(sink.counted(of_owner::NONSENSE) + sink.counted(of_owner::FORGED), 0);
}

#[test]
fn one_that_hangs_up_just_when_another_comes_keeps_its_lane_while_its_process_lives() {
    let (mut broker, path, _dir) = broker();
    let mut ask = |raw: &Raw, ask: Ask, files: &[&OwnedFd]| {
        raw.send(&ask.to_bytes(), files).unwrap();
        // It is let in, and answered in the next turn.
        (0..2).for_each(|_| broker.serve(Duration::from_millis(1)));
        raw.receive().expect("it answers")
    };
    let shape = Shape::new(4, 24).senders(1);
    let [(sink_owner, sink_lanes), (owner, lanes)] = [(); 2].map(|()| files(&shape));
    let [sink, mistaken] = [(); 2].map(|()| Raw::connect(&path));
    assert!(matches!(
        ask(&sink, Ask::Create(SINK, shape), &[&sink_owner, &sink_lanes]).0,
        Answer::Created { .. }
    ));
    assert!(matches!(
        ask(&mistaken, Ask::Create(MISTAKEN, shape), &[&owner, &lanes]).0,
        Answer::Created { .. }
    ));
    let (answer, files) = ask(&mistaken, Ask::Bind { from: MISTAKEN, to: SINK }, &[]);
    let (which, _lane) = lane_of(&answer, files);
    assert_eq!(ask(&mistaken, Ask::Ready(which), &[]).0, Answer::Done);
    // In the same turn one goes, whose process is this one, and another comes.
    drop(mistaken);
    let _another = Raw::connect(&path);
    for turn in 0..5 {
        broker.serve(Duration::from_millis(1));
        let registered = broker.registry().get(which.place).expect("the sink is there");
        let state = registered.lanes[which.lane].state;
        assert!(matches!(state, LaneState::Bound(_, MISTAKEN)), "turn {turn}: {state:?}, and it could write");
    }
    assert_eq!(broker.registry().find(MISTAKEN), None);
}

#[test]
fn who_hung_up_and_has_no_lane_any_more_takes_nobodys_seat() {
    let_there_be_descriptors();
    let (mut broker, path, _dir) = broker();
    let mut ask = |raw: &Raw, ask: Ask, files: &[&OwnedFd]| {
        raw.send(&ask.to_bytes(), files).unwrap();
        (0..2).for_each(|_| broker.serve(Duration::from_millis(1)));
        raw.receive().map(|(answer, _)| answer)
    };
    let shape = Shape::new(1, 1).senders(1);
    let (owner, lanes) = files(&shape);
    let sink = Raw::connect(&path);
    for count in 0..MOST_COMPONENTS + 10 {
        // It never says that it does not need its lane any more; but the mailbox is gone.
        let mistaken = Raw::connect(&path);
        for (raw, name) in [(&sink, SINK), (&mistaken, MISTAKEN)] {
            let told = ask(raw, Ask::Create(name, shape), &[&owner, &lanes]);
            assert!(matches!(told, Some(Answer::Created { .. })), "behind {count} of them: {told:?}");
        }
        let told = ask(&mistaken, Ask::Bind { from: MISTAKEN, to: SINK }, &[]);
        let Some(Answer::Reserved { lane, .. }) = told else { panic!("{told:?}") };
        assert_eq!(ask(&mistaken, Ask::Ready(lane), &[]), Some(Answer::Done));
        drop(mistaken);
        assert_eq!(ask(&sink, Ask::Attach, &[]), Some(Answer::Done));
        assert_eq!(ask(&sink, Ask::Delete(SINK), &[]), Some(Answer::Done));
    }
}

#[test]
fn more_connections_than_there_may_be_are_hung_up_on_and_those_that_are_there_go_on() {
    let_there_be_descriptors();
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16));
    let (honest_is, honest) = station.mailbox(HONEST, Shape::new(1, 1));
    let connections: Vec<Raw> = (0..MOST_COMPONENTS + 50).map(|_| Raw::connect(&station.path)).collect();
    let is_let_in = |raw: &Raw| raw.send(&Ask::Attach.to_bytes(), &[]).is_ok() && raw.receive().is_some();
    let let_in = connections.iter().filter(|raw| is_let_in(raw)).count();
    assert_eq!(let_in, MOST_COMPONENTS - 2);
    let begun = Instant::now();
    assert!(Component::attach(&station.path).is_err());
    goes_on_beside(&honest, &mut sink);
    drop(honest_is.mailbox(HONEST.with_local(1), Shape::new(1, 1)).unwrap());
    assert!(begun.elapsed() < AT_ONCE, "{:?}", begun.elapsed());
    drop(connections);
    eventually("there is room", || Component::attach(&station.path).ok());
    goes_on_beside(&honest, &mut sink);
}

#[test]
fn who_does_not_take_its_answers_is_hung_up_on_and_holds_up_nobody() {
    let station = Station::new();
    let (_sink, mut sink) = station.mailbox(SINK, Shape::new(4, 16).senders(2));
    let mistaken = Raw::connect(&station.path);
    assert!(matches!(mistaken.creates(MISTAKEN, Shape::new(1, 1)), Answer::Created { .. }));
    let mut asked = 0;
    let told = loop {
        match mistaken.send(&Ask::Delete(HEIR).to_bytes(), &[]) {
            Ok(()) => asked += 1,
            Err(error) => break error,
        }
        if asked % 64 == 0 {
            goes_on(&station, &mut sink);
        }
        assert!(asked < 100_000, "it still asks");
    };
    assert!(matches!(told, Errno::EPIPE | Errno::ECONNRESET), "{told}");
    goes_on(&station, &mut sink);
    let heir = Component::attach(&station.path).unwrap();
    eventually("its mailbox has gone", || heir.mailbox(MISTAKEN, Shape::new(1, 1)).ok());
}
