//! Whatever comes to a broker.

use super::*;

/// Connections at a time.
const MOST: usize = 4;

#[test]
fn package_broker_takes_any_packet() {
    fuzz(&Target {
        name: "package_broker",
        seeds: broker_seeds(),
        has_corpus: true,
        mutate: steps::change,
        run: broker,
    });
}

fn broker_seeds() -> Vec<Vec<u8>> {
    let (arm, camera) = (MailboxName(0x0080_0000), MailboxName(0x0015_0000));
    let lane = |place, n| -> Vec<u8> { vec![place, n] };
    let step = |kind, argument, bytes: Vec<u8>| Step { kind, argument, bytes };
    let create =
        |who, name: MailboxName, shape: [u8; 4]| step(3, who, [&name.0.to_be_bytes()[..], &shape].concat());
    let bind = |who, from: MailboxName, to: MailboxName| {
        step(4, who, [from.0.to_be_bytes(), to.0.to_be_bytes()].concat())
    };
    // Any packet, with and without files.
    let shape = Shape::new(4, 16).senders(2);
    let packets =
        [Ask::Attach, Ask::Create(arm, shape), Ask::Delete(arm), Ask::Bind { from: arm, to: camera }]
            .map(|ask| ask.to_bytes().to_vec());
    let of_packets = |files: u8| packets.clone().map(|packet| step(2, files << 4, packet)).to_vec();
    let honest = vec![
        create(0, arm, [4, 16, 2, 0]),
        step(0, 0, vec![]),
        create(1, camera, [1, 0, 1, 1]),
        bind(1, camera, arm),
        step(5, 1, lane(0, 1)),
        step(6, 1, lane(0, 1)),
        step(7, 0, arm.0.to_be_bytes().to_vec()),
        step(1, 1, vec![]),
    ];
    let again = vec![
        create(0, arm, [4, 16, 2, 0]),
        create(1, arm, [4, 16, 2, 0]),
        bind(0, arm, arm),
        bind(0, arm, arm),
        bind(0, arm, arm),
        step(5, 0, lane(0, 1)),
        step(1, 0, vec![]),
        step(0, 0, vec![]),
    ];
    (0..=4).map(of_packets).chain([honest, again]).map(|steps| steps::write(&steps)).collect()
}

/// Files that are called so in this process, the broker's among them.
fn descriptors(called: &CString) -> usize {
    let called = format!("/memfd:{} (deleted)", called.to_str().expect("ASCII"));
    let all = std::fs::read_dir("/proc/self/fd").expect("a directory").flatten();
    all.filter(|file| std::fs::read_link(file.path()).is_ok_and(|to| to.as_os_str() == called.as_str()))
        .count()
}

struct Fuzzed {
    broker: Broker,
    connections: Vec<Socket>,
    called: CString,
    /// Lanes that were reserved: of whom, and which.
    lanes: Vec<Lane>,
}

impl Fuzzed {
    fn connect(&mut self, path: &Path) {
        if self.connections.len() < MOST {
            let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None).expect("a host has sockets");
            socket.connect(&SockAddr::unix(path).expect("a short path")).expect("it listens");
            socket.set_nonblocking(true).expect("a socket can be so");
            self.connections.push(socket);
        }
    }

    fn file(&self, bytes: usize, seals: SealFlag) -> OwnedFd {
        let flags = MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING;
        let file = memfd_create(self.called.as_c_str(), flags).expect("this kernel has memfd_create");
        ftruncate(&file, bytes as i64).expect("an empty file can grow");
        fcntl(&file, FcntlArg::F_ADD_SEALS(seals)).expect("it is not sealed yet");
        file
    }

    /// What came of a packet: roughly what is answered.
    fn ask(&mut self, who: u8, packet: &[u8], files: &[OwnedFd]) -> u64 {
        if self.connections.is_empty() {
            return 0;
        }
        let who = usize::from(who) % self.connections.len();
        let raw: Vec<i32> = files.iter().map(AsRawFd::as_raw_fd).collect();
        let rights = [ControlMessage::ScmRights(&raw)];
        let rights = if raw.is_empty() { &rights[..0] } else { &rights[..] };
        let fd = self.connections[who].as_raw_fd();
        let sent = sendmsg::<()>(fd, &[IoSlice::new(packet)], rights, MsgFlags::MSG_NOSIGNAL, None);
        // It is let in, and answered in the next turn.
        (0..2).for_each(|_| self.broker.serve(Duration::ZERO));
        let (mut answer, mut room) = ([0; ANSWER_LEN + 1], nix::cmsg_space!([i32; FILES]));
        let mut parts = [IoSliceMut::new(&mut answer)];
        let told = recvmsg::<()>(fd, &mut parts, Some(&mut room), MsgFlags::MSG_CMSG_CLOEXEC);
        let len = match told {
            Err(Errno::EAGAIN | Errno::ECONNRESET) => 0,
            told => {
                let told = told.expect("an answer, or none");
                for part in told.cmsgs().expect("no more files than there is room for") {
                    if let ControlMessageOwned::ScmRights(fds) = part {
                        fds.into_iter().for_each(|fd| _ = nix::unistd::close(fd));
                    }
                }
                told.bytes
            }
        };
        if len == 0 {
            // What is no packet at all, and what brings too much, may cost its connection, which no ask does.
            assert!(sent.is_err() || Ask::parse(packet).is_none() || files.len() > FILES, "{packet:02x?}");
            drop(self.connections.remove(who));
            return 1;
        }
        let answer = Answer::parse(&answer[..len]).expect("an answer");
        assert_eq!(
            matches!(answer, Answer::Failed(libc::EPROTO)),
            Ask::parse(packet).is_none(),
            "{packet:02x?}"
        );
        if let Answer::Reserved { lane, .. } = answer {
            self.lanes.push(lane);
        }
        outcome(format!("{answer:?}").bytes().filter(u8::is_ascii_alphabetic).take(14).map(u64::from))
    }

    fn step(&mut self, step: &Step, path: &Path) -> u64 {
        let Step { kind, argument, bytes } = step;
        let number = |at: usize| -> u32 {
            u32::from_be_bytes(core::array::from_fn(|more| bytes.get(at + more).copied().unwrap_or(0)))
        };
        let byte = |at: usize| usize::from(bytes.get(at).copied().unwrap_or(0));
        let (who, name) = (*argument, MailboxName(number(0)));
        match kind % 8 {
            0 => {
                self.connect(path);
                2
            }
            1 => {
                if !self.connections.is_empty() {
                    drop(self.connections.remove(usize::from(*argument) % self.connections.len()));
                }
                self.broker.serve(Duration::ZERO);
                3
            }
            2 => {
                let files: Vec<OwnedFd> =
                    (0..argument / 16 % 6).map(|_| self.file(8_192, SealFlag::F_SEAL_SHRINK)).collect();
                self.ask(who % 16, bytes, &files)
            }
            3 => {
                let shape = Shape::new(byte(4), byte(5) * byte(5)).senders(byte(6));
                let shape = if byte(7) % 2 == 1 { shape.replacing() } else { shape };
                let lanes = shape.lanes();
                let layout = Layout::of(&shape);
                let words = [layout.owner_words(lanes), lane_at(&layout, lanes)];
                // Some are too short, or not sealed.
                let cut = if byte(8) % 4 == 3 { 4_096 } else { 0 };
                let seals =
                    [SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_FUTURE_WRITE, SealFlag::F_SEAL_SHRINK];
                let seals = if byte(9) % 4 == 3 { [SealFlag::empty(); 2] } else { seals };
                let bytes = words.map(|words| (words * 8).next_multiple_of(4_096).saturating_sub(cut));
                let [owner, lanes] = [0, 1].map(|at| self.file(bytes[at], seals[at]));
                // Bells hang in a set, and in nothing else.
                let set = match byte(10) % 4 {
                    3 => self.file(8, SealFlag::empty()),
                    _ => Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC).expect("a set").0,
                };
                let files = [owner, lanes, set];
                self.ask(who, &Ask::Create(name, shape).to_bytes(), &files)
            }
            4 => self.ask(who, &Ask::Bind { from: name, to: MailboxName(number(4)) }.to_bytes(), &[]),
            5 | 6 => {
                // One that there is, or that there was, or any.
                let any = self.lanes.get(byte(2) % self.lanes.len().max(1)).copied();
                let Some(any) = any else { return 4 };
                let lane = if byte(0) < 8 { Lane { place: byte(0), lane: byte(1), ..any } } else { any };
                let ask = if kind % 8 == 5 { Ask::Ready(lane) } else { Ask::Unbind(lane) };
                self.ask(who, &ask.to_bytes(), &[])
            }
            _ => self.ask(who, &Ask::Delete(name).to_bytes(), &[]),
        }
    }

    /// No name is there twice, and no lane has two.
    fn check(&self) {
        let mut names = BTreeSet::new();
        for (_, mailbox) in self.broker.registry().all() {
            assert!(names.insert(mailbox.name) && mailbox.name != MailboxName::NOBODY);
            assert_eq!((mailbox.shape.check(), mailbox.lanes.len()), (Ok(()), mailbox.shape.lanes()));
        }
    }

    /// Somebody who makes no mistakes comes, sends, receives and goes.
    fn honest(&mut self, path: &Path) {
        let names = (0..).map(|local| MailboxName::new(9, Class(0x99), 9, local));
        let name = { names }.find(|&name| self.broker.registry().find(name).is_none()).expect("one is free");
        thread::scope(|scope| {
            let honest = scope.spawn(move || {
                let component = Component::attach(path).expect("it is let in");
                let mut mailbox = component.mailbox(name, Shape::new(2, 8)).expect("its name is free");
                let mut sender = mailbox.sender(name).expect("a lane is free");
                sender.send(7, b"honest").expect("a slot is free");
                let package = mailbox.receive(Some(Duration::from_secs(20))).expect("it came");
                assert_eq!((package.head().kind, package.body().to_vec()), (7, b"honest".to_vec()));
            });
            while !honest.is_finished() {
                self.broker.serve(Duration::from_millis(1));
            }
            honest.join().expect("it goes on");
        });
    }
}

fn broker(input: &[u8]) -> Vec<u64> {
    static RUNS: AtomicU64 = AtomicU64::new(0);
    let called =
        CString::new(format!("package-fuzz-{}", RUNS.fetch_add(1, Ordering::Relaxed))).expect("no zero");
    let dir = tempfile::tempdir().expect("a host has room");
    let path = dir.path().join("packages");
    let broker = Broker::bind(&path).expect("the path is free");
    let mut fuzzed = Fuzzed { broker, connections: Vec::new(), called, lanes: Vec::new() };
    fuzzed.connect(&path);
    let mut outcomes = Vec::new();
    for step in steps::read(input) {
        outcomes.push(outcome([u64::from(step.kind % 8), fuzzed.step(&step, &path)]));
        fuzzed.check();
    }
    fuzzed.honest(&path);
    fuzzed.connections.clear();
    (0..3).for_each(|_| fuzzed.broker.serve(Duration::ZERO));
    assert_eq!((fuzzed.broker.components(), fuzzed.broker.registry().all().count()), (0, 0), "all have gone");
    assert_eq!(descriptors(&fuzzed.called), 0, "and nothing of theirs is left");
    in_turn(&outcomes)
}

// ---- files and names ----
