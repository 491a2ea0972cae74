//! Stations, honest components, and such as make mistakes.

use super::*;

pub fn broker() -> (Broker, PathBuf, tempfile::TempDir) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("station.packages");
    (Broker::bind(&path).unwrap(), path, dir)
}

/// A broker in a thread of its own.
pub struct Station {
    pub path: PathBuf,
    pub is_over: Arc<AtomicBool>,
    pub serves: Option<JoinHandle<()>>,
    pub _dir: tempfile::TempDir,
}

impl Station {
    pub fn new() -> Self {
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

    pub fn mailbox(&self, name: MailboxName, shape: Shape) -> (Component, Mailbox) {
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
pub fn eventually<T>(what: &str, mut is_so: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(so) = is_so() {
            return so;
        }
        assert!(Instant::now() < deadline, "{what}");
        thread::sleep(Duration::from_millis(1));
    }
}

pub fn refused<T>(told: Result<T, Error>) -> Option<Refused> {
    match told {
        Err(Error::Refused(refused)) => Some(refused),
        _ => None,
    }
}

/// It is asked, and takes packages, as if nobody made a mistake.
pub fn goes_on(station: &Station, sink: &mut Mailbox) {
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
pub struct Raw(pub Socket);

impl Raw {
    pub fn connect(path: &Path) -> Self {
        let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        socket.connect(&SockAddr::unix(path).unwrap()).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        socket.set_write_timeout(Some(PATIENCE)).unwrap();
        Self(socket)
    }

    pub fn send(&self, packet: &[u8], files: &[&OwnedFd]) -> Result<(), Errno> {
        let raw: Vec<i32> = files.iter().map(|file| file.as_raw_fd()).collect();
        let rights = [ControlMessage::ScmRights(&raw)];
        let rights = if raw.is_empty() { &rights[..0] } else { &rights[..] };
        let parts = [IoSlice::new(packet)];
        sendmsg::<()>(self.0.as_raw_fd(), &parts, rights, MsgFlags::MSG_NOSIGNAL, None).map(drop)
    }

    /// `None`: it has hung up.
    pub fn receive(&self) -> Option<(Answer, Vec<OwnedFd>)> {
        let (mut packet, mut room) = ([0; ANSWER_LEN + 1], cmsg_space!([i32; FILES]));
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

    pub fn ask(&self, ask: Ask, files: &[&OwnedFd]) -> Answer {
        self.send(&ask.to_bytes(), files).unwrap();
        self.receive().expect("it answers").0
    }

    pub fn creates(&self, name: MailboxName, shape: Shape) -> Answer {
        self.ask(Ask::Create(name, shape), &files(&shape).each_ref())
    }

    /// A lane that was made ready.
    pub fn binds(&self, from: MailboxName, to: MailboxName) -> (LaneSender<Room, Sealed>, Lane) {
        self.send(&Ask::Bind { from, to }.to_bytes(), &[]).unwrap();
        let (answer, files) = self.receive().expect("it answers");
        let (lane, sender) = lane_of(&answer, files);
        assert_eq!(self.ask(Ask::Ready(lane), &[]), Answer::Done);
        (sender, lane)
    }
}

pub fn lane_of(answer: &Answer, files: Vec<OwnedFd>) -> (Lane, LaneSender<Room, Sealed>) {
    let Answer::Reserved { lane, shape, .. } = *answer else { panic!("{answer:?}") };
    let [owner, lanes, _bell]: [OwnedFd; FILES] = files.try_into().expect("all files");
    let layout = Layout::of(&shape);
    let room = Room::open(&lanes, &layout, lane.lane).unwrap();
    let theirs = Sealed::open(owner, layout.owner_words(shape.lanes())).unwrap();
    (lane, LaneSender::new(room, theirs, layout, lane.lane))
}

/// A descriptor that has just been received.
#[allow(unsafe_code)]
pub fn own(fd: i32) -> OwnedFd {
    // SAFETY: the kernel has just made it for this process, and nobody else knows of it.
    unsafe { OwnedFd::from_raw_fd(fd) }
}

/// What a mailbox of this shape lies in, and the set that its bells hang in.
pub fn files(shape: &Shape) -> [OwnedFd; FILES] {
    files_called(c"mistaken", shape)
}

pub fn files_called(name: &CStr, shape: &Shape) -> [OwnedFd; FILES] {
    let (layout, lanes) = (Layout::of(shape), shape.lanes());
    let bytes = [layout.owner_words(lanes), lane_at(&layout, lanes)].map(|words| words * size_of::<u64>());
    let [owner, lanes] = bytes.map(|bytes| bytes.next_multiple_of(4096));
    [file(name, owner, final_seals()), file(name, lanes, SealFlag::F_SEAL_SHRINK), a_set()]
}

/// A set that bells can hang in.
pub fn a_set() -> OwnedFd {
    Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC).unwrap().0
}

/// Of a file that nobody can write any more, cut short or make holes in.
pub fn final_seals() -> SealFlag {
    SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_FUTURE_WRITE
}

/// A file of so many bytes, none of which takes memory yet.
pub fn file(name: &CStr, bytes: usize, seals: SealFlag) -> OwnedFd {
    let file = memfd_create(name, MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING).unwrap();
    ftruncate(&file, bytes as i64).unwrap();
    fcntl(&file, FcntlArg::F_ADD_SEALS(seals)).unwrap();
    file
}

pub fn let_there_be_descriptors() {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    setrlimit(Resource::RLIMIT_NOFILE, most, most).unwrap();
    assert!(most >= 4_096, "this test takes more descriptors than {most}: raise `ulimit -Hn`");
}

/// Descriptors that this process, and so the broker, has of files that are called so; other tests have others.
pub fn descriptors(name: &CStr) -> usize {
    let called = format!("/memfd:{} (deleted)", name.to_str().unwrap());
    let all = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
    all.filter(|file| std::fs::read_link(file.path()).is_ok_and(|to| to.as_os_str() == called.as_str()))
        .count()
}

/// A process of its own that makes a mistake.
pub struct Mistaken(pub Child);

impl Mistaken {
    pub fn begin(test: &str, station: &Station) -> Self {
        let own = std::env::current_exe().unwrap();
        let mut command = Command::new(own);
        command
            .args(["--exact", &format!("packages::hung::{test}"), "--nocapture"])
            .env(MISTAKE, &station.path);
        Self(command.stdout(Stdio::null()).spawn().unwrap())
    }

    /// Returns once it is stopped.
    pub fn stop(&self) {
        tests::host::stop(self.process());
    }

    pub fn go_on(&self) {
        kill(self.process(), Signal::SIGCONT).unwrap();
    }

    fn process(&self) -> Pid {
        Pid::from_raw(self.0.id() as i32)
    }
}

impl Drop for Mistaken {
    fn drop(&mut self) {
        let _ = (self.0.kill(), self.0.wait());
    }
}

/// Where this process is to make a mistake, if it is.
pub fn is_to_make_it() -> Option<PathBuf> {
    std::env::var_os(MISTAKE).map(PathBuf::from)
}

/// Reads what waits of the mistaken, whose packages are numbered and come in their order: how many.
pub fn read_in_order(sink: &mut Mailbox, last: &mut u64) -> u64 {
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
