//! What the package router reads: heads and parts of packages, what components ask its broker, files, names.

use std::collections::BTreeSet;
use std::ffi::CString;
use std::io::{IoSlice, IoSliceMut};
use std::net::Ipv4Addr;
use std::os::fd::{AsRawFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::Duration;

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::socket::{ControlMessage, ControlMessageOwned, MsgFlags, recvmsg, sendmsg};
use nix::unistd::ftruncate;
use package_router::broker::Broker;
use package_router::component::Component;
use package_router::handshake::{ANSWER_LEN, Answer, Ask, Lane};
use package_router::mailbox::{Layout, Shape};
use package_router::name::{Class, MailboxName, Pattern};
use package_router::priority::{Priorities, level_of};
use package_router::route::{MOST_ROUTES, Routes};
use package_router::shared::lane_at;
use package_router::wire::{
    Endian, HEAD_LEN, Head, HeadError, Joining, MAX_LEN, MOST_DATAGRAM, MOST_PARTS, Part, split,
};
use rtnet::sim::Random;
use socket2::{Domain, SockAddr, Socket, Type};

use super::engine::{Target, fuzz, in_turn, outcome};
use super::mutate;
use super::steps::{self, Step};

// ---- heads ----

/// What real peers have sent (section 5.3 of the reference).
const SEEN: [&str; 6] = [
    "000d000000000000000000000000001400100100",
    "00154d2a00100200001001000000001568656c6c6f",
    "01154d2a000210000001100015000000",
    "03fd052b000110000063100010000000",
    "0106000a00001100000702001800000000000000",
    "03840100000001000000110000000400",
];

fn unhex(text: &str) -> Vec<u8> {
    let digits = |at| u8::from_str_radix(&text[at..at + 2], 16).expect("digits");
    (0..text.len()).step_by(2).map(digits).collect()
}

#[test]
fn package_head_takes_any_bytes() {
    fuzz(&Target {
        name: "package_head",
        seeds: SEEN.map(unhex).into(),
        has_corpus: true,
        mutate: mutate::bytes,
        run: |bytes| vec![head(bytes)],
    });
}

/// A head in another's reading: the flags, the four bytes behind each other, and the three words.
fn read_by_another(bytes: &[u8]) -> Option<([u8; 4], [u32; 3])> {
    let bytes: [u8; HEAD_LEN] = *bytes.first_chunk()?;
    let is_little = bytes[0] % 2 == 1;
    let word = |at: usize| {
        let parts: Vec<u32> = bytes[at..at + 4].iter().map(|&byte| byte.into()).collect();
        let [a, b, c, d] = parts.try_into().expect("four");
        if is_little {
            a + b * 0x100 + c * 0x1_0000 + d * 0x100_0000
        } else {
            d + c * 0x100 + b * 0x1_0000 + a * 0x100_0000
        }
    };
    Some(([bytes[0], bytes[1], bytes[2], bytes[3]], [4, 8, 12].map(word)))
}

fn head(bytes: &[u8]) -> u64 {
    let (ours, theirs) = (Head::parse(bytes), read_by_another(bytes));
    let Some(([flags, kind, priority, id], [to, from, len])) = theirs else {
        assert_eq!(ours, Err(HeadError::TooShort { got: bytes.len() }));
        return 0;
    };
    let head = match ours {
        Err(error) => {
            let expected = match len {
                0..16 => HeadError::LenBelowHead { len },
                _ => HeadError::LenAboveMost { len },
            };
            assert!(error == expected && !(16..=262_144).contains(&len), "{error:?}: {len}");
            return 1 + u64::from(len < 16);
        }
        Ok(head) => head,
    };
    assert!((16..=262_144).contains(&len));
    assert_eq!((head.kind as u8, head.priority, head.id), (kind, priority, id));
    assert_eq!((head.to.0, head.from.0, head.len, head.body_len()), (to, from, len, len as usize - 16));
    assert_eq!(
        (head.head_order == Endian::Little, head.body_order == Endian::Little),
        (flags & 1 == 1, flags & 2 == 2)
    );
    let part = [Part::Whole, Part::First, Part::Middle, Part::Last][usize::from(flags / 4 % 4)];
    assert_eq!((head.part, head.other_flags, head.is_whole()), (part, flags & 0xf0, flags & 12 == 0));
    assert_eq!(head.is_command(), (1..128).contains(&kind));
    assert_eq!(head.to_bytes(), bytes[..HEAD_LEN], "written as it was read");
    let reply = read_by_another(&head.answer(-3).to_bytes()).expect("a head");
    assert_eq!(reply, ([3, 0xfd, priority, id], [from, to, 16]));
    outcome([9, u64::from(flags), head.is_command().into(), (to == 0).into(), (len == 16).into()])
}

// ---- parts ----

#[test]
fn package_parts_takes_any_bytes() {
    let seed = |len: u32, most: u16, happens: &[u8]| {
        [&len.to_be_bytes()[1..], &most.to_be_bytes(), happens].concat()
    };
    fuzz(&Target {
        name: "package_parts",
        seeds: vec![
            seed(0, 1_472, &[]),
            seed(2_000, 1_472, &[0]),
            seed(262_128, 65_507, &[]),
            seed(262_128, 1_456, &[]),
            seed(100, 17, &[0, 1, 0, 0, 2]),
            seed(70_000, 1_472, &[0, 0, 0, 0, 0, 0, 0, 3, 4, 5, 6, 7, 8, 9, 10, 11]),
            seed(262_129, 65_507, &[]),
        ],
        has_corpus: true,
        mutate: mutate::bytes,
        run: parts,
    });
}

/// A package in the making, as another would keep it: all that came so far, and how many parts.
struct Made {
    bytes: Vec<u8>,
    parts: usize,
}

/// Cuts a package, lets things happen to its parts, one byte each, and joins what comes.
fn parts(bytes: &[u8]) -> Vec<u64> {
    let Some((&[a, b, c, d, e], happens)) = bytes.split_first_chunk::<5>() else { return vec![0] };
    let (len, most) = (u32::from_be_bytes([0, a, b, c]) as usize, usize::from(u16::from_be_bytes([d, e])));
    let names = (MailboxName(0x0018_0100), MailboxName(0x0017_0000));
    let whole = Head { id: 42, priority: 99, other_flags: 0x50, ..Head::new(21, names.0, names.1) };
    let whole = Head { len: (len + HEAD_LEN) as u32, ..whole };
    // By another's arithmetic: so many parts, each as large as can be but for the last.
    let room = most.min(MOST_DATAGRAM).saturating_sub(HEAD_LEN);
    let count = if len == 0 { 1 } else { (len + room).saturating_sub(1) / room.max(1) };
    let can_be =
        len + HEAD_LEN <= MAX_LEN && most >= HEAD_LEN && count <= MOST_PARTS && (room > 0 || len == 0);
    let Ok(pieces) = split(&whole, most) else {
        assert!(!can_be, "{len} in {most}");
        return vec![1 + u64::from(len + HEAD_LEN > MAX_LEN)];
    };
    assert!(can_be && pieces.len() == count, "{len} in {most}: {} of {count}", pieces.len());
    let body: Vec<u8> = (0..len).map(|at| (at * 7 + at / 251) as u8).collect();
    // As datagrams.
    let mut datagrams = Vec::new();
    let mut end = 0;
    for (number, piece) in pieces.enumerate() {
        assert_eq!(piece.body.start, end);
        end = piece.body.end;
        let part = body[piece.body].to_vec();
        assert!(part.len() + HEAD_LEN <= most && (part.len() == room || number + 1 == count));
        let mark = match number {
            _ if count == 1 => 0x53,
            0 => 0x57,
            _ if number + 1 == count => 0x5f,
            _ => 0x5b,
        };
        let (id, said) = if number == 0 { (42, len) } else { (number as u8, part.len()) };
        let expected = ([mark, 21, 99, id], [names.0.0, names.1.0, (said + HEAD_LEN) as u32]);
        assert_eq!(read_by_another(&piece.head.to_bytes()), Some(expected), "part {number} of {count}");
        datagrams.push((piece.head, part));
    }
    assert_eq!(end, len);
    if count == 1 {
        return vec![3];
    }
    for (at, &happens) in happens.iter().take(40).enumerate() {
        let (at, other) = (at % datagrams.len().max(1), usize::from(happens / 16));
        let Some((head, part)) = datagrams.get_mut(at) else { break };
        match happens % 16 {
            1 => drop(datagrams.remove(at)),
            2 => {
                let again = datagrams[at].clone();
                datagrams.insert(at, again);
            }
            3 => {
                let with = other % datagrams.len();
                datagrams.swap(at, with);
            }
            4 => head.id = head.id.wrapping_add(happens / 16),
            5 => head.from = MailboxName(head.from.0 ^ u32::from(happens / 16)),
            6 => head.to = MailboxName(head.to.0 ^ u32::from(happens / 16)),
            7 => head.len += u32::from(happens / 16),
            8 => part.truncate(other),
            9 => part.extend(vec![7; other]),
            10 => head.part = [Part::Whole, Part::First, Part::Middle, Part::Last][other % 4],
            11 => (head.part, head.len) = (Part::First, (part.len() + HEAD_LEN + other) as u32),
            12 => head.head_order = Endian::Big,
            _ => {}
        }
    }
    let mut outcomes = Vec::new();
    let mut ours: Option<(Joining, Vec<u8>)> = None;
    let mut made: Option<(Head, Made)> = None;
    for (head, part) in &datagrams {
        // It is read as it is written.
        let Ok(head) = Head::parse(&head.to_bytes()) else { continue };
        let mut is_over = false;
        match (&mut ours, &mut made) {
            (Some((joining, joined)), Some((first, made))) => {
                let before = *joining.head();
                let len = first.body_len();
                let behind = made.bytes.len() + part.len();
                let is_next = (head.to, head.from) == (first.to, first.from)
                    && matches!(head.part, Part::Middle | Part::Last)
                    && usize::from(head.id) == made.parts
                    && head.body_len() == part.len()
                    && !part.is_empty()
                    && if head.part == Part::Last { behind == len } else { behind < len };
                let told = joining.next(&head, part.len());
                assert_eq!(told.is_ok(), is_next, "{told:?} of {head:?} behind {} parts", made.parts);
                assert_eq!(*joining.head(), before);
                let Ok(placed) = told else {
                    outcomes.push(outcome(format!("{told:?}").bytes().take(10).map(u64::from)));
                    continue;
                };
                assert_eq!(placed.at, made.bytes.len()..behind);
                joined[placed.at].copy_from_slice(part);
                made.bytes.extend(part);
                made.parts += 1;
                assert_eq!(placed.is_complete, behind == len);
                if placed.is_complete {
                    assert_eq!(*joined, made.bytes);
                    outcomes.push(4 + u64::from(made.bytes == body));
                    is_over = true;
                }
            }
            _ => {
                let is_first = head.part == Part::First && !part.is_empty() && part.len() < head.body_len();
                let told = Joining::begin(&head, part.len());
                assert_eq!(told.is_ok(), is_first, "{told:?} of {head:?}");
                if let Ok((joining, at)) = told {
                    assert_eq!((at, *joining.head()), (0..part.len(), Head { part: Part::Whole, ..head }));
                    let mut joined = vec![0; head.body_len()];
                    joined[..part.len()].copy_from_slice(part);
                    ours = Some((joining, joined));
                    made = Some((head, Made { bytes: part.clone(), parts: 1 }));
                }
            }
        }
        if is_over {
            (ours, made) = (None, None);
        }
    }
    if happens.is_empty() {
        assert_eq!(outcomes, [5], "undisturbed, it is what was sent");
    }
    outcomes
}

// ---- the broker ----

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
        let (mut answer, mut room) = ([0; ANSWER_LEN + 1], nix::cmsg_space!([i32; 2]));
        let mut parts = [IoSliceMut::new(&mut answer)];
        let told = recvmsg::<()>(fd, &mut parts, Some(&mut room), MsgFlags::MSG_CMSG_CLOEXEC);
        let len = match told {
            Err(Errno::EAGAIN | Errno::ECONNRESET) => 0,
            told => {
                let told = told.expect("an answer, or none");
                for part in told.cmsgs().expect("two files at the most") {
                    if let ControlMessageOwned::ScmRights(fds) = part {
                        fds.into_iter().for_each(|fd| _ = nix::unistd::close(fd));
                    }
                }
                told.bytes
            }
        };
        if len == 0 {
            // What is no packet at all, and what brings too much, may cost its connection, which no ask does.
            assert!(sent.is_err() || Ask::parse(packet).is_none() || files.len() > 2, "{packet:02x?}");
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
                let lanes = shape.senders + 1;
                let layout = Layout::of(&shape);
                let words = [layout.owner_words(lanes), lane_at(&layout, lanes)];
                // Some are too short, or not sealed.
                let cut = if byte(8) % 4 == 3 { 4_096 } else { 0 };
                let seals =
                    [SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_FUTURE_WRITE, SealFlag::F_SEAL_SHRINK];
                let seals = if byte(9) % 4 == 3 { [SealFlag::empty(); 2] } else { seals };
                let bytes = words.map(|words| (words * 8).next_multiple_of(4_096).saturating_sub(cut));
                let files = [0, 1].map(|at| self.file(bytes[at], seals[at]));
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
            assert_eq!((mailbox.shape.check(), mailbox.lanes.len()), (Ok(()), mailbox.shape.senders + 1));
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

fn said(error: &str) -> u64 {
    assert!(error.starts_with("a.toml:"), "{error}");
    assert!(error.chars().count() < 1_000 && !error.chars().any(char::is_control), "{error:?}");
    // Places and figures are no other kind of mistake.
    outcome(error.bytes().filter(u8::is_ascii_alphabetic).take(40).map(u64::from))
}

#[test]
fn package_priorities_takes_any_text() {
    let file =
        "[class.Pilot]   # its name\ntask = 70\npackage = 231\nchannel = 2\n\n[class.0x80]\nlevel = 3\n";
    fuzz(&Target {
        name: "package_priorities",
        seeds: [file, "", "[class]\n", "class.Gyro.level = 30\n[class.1]\ntask = 99\npackage = 0\n"]
            .map(|text| text.as_bytes().to_vec())
            .into(),
        has_corpus: true,
        mutate: mutate::text,
        run: |text| vec![priorities(text)],
    });
}

fn priorities(bytes: &[u8]) -> u64 {
    let text = String::from_utf8_lossy(bytes);
    let priorities = match Priorities::parse(&text, "a.toml") {
        Err(error) => return said(&error.to_string()),
        Ok(priorities) => priorities,
    };
    let mut told = vec![u64::MAX];
    for class in (0..=255).map(Class) {
        let (package, level) = (priorities.package(class), priorities.level(class));
        assert_eq!((level, level.level()), (level_of(package), ((255 - package) / 8).min(30)));
        assert!(priorities.task(class).is_none_or(|task| (1..=99).contains(&task)));
        let is_rule = (priorities.task(class), package, priorities.channel(class))
            == (None, 255 - 8 * (class.0 >> 4), 0);
        // Of what is not named in any form the rule holds.
        let names_it = class.name().is_some_and(|name| text.to_lowercase().contains(&name.to_lowercase()));
        assert!(is_rule || names_it || text.contains(|digit: char| digit.is_ascii_digit()), "{class}");
        told.extend((!is_rule).then_some(u64::from(class.0)));
    }
    told.truncate(4);
    outcome(told)
}

#[test]
fn package_routes_takes_any_text() {
    let file = "[[route]]\nto = \"0.Pilot.*\"\nstation = \"10.0.0.2\"\n\n[[route]]\nto = \"0.*.*\"\nstation = \"arm\"\n\n\
                [[route]]\nto = \"Gyro(0/1).3\"\nstation = \"10.0.0.4\"\n";
    fuzz(&Target {
        name: "package_routes",
        seeds: [file, "", "route = []\n", "route = [{ to = '*.*.*', station = '10.0.0.9' }]\n"]
            .map(|text| text.as_bytes().to_vec())
            .into(),
        has_corpus: true,
        mutate: mutate::text,
        run: |text| vec![routes(text)],
    });
}

fn routes(bytes: &[u8]) -> u64 {
    let text = String::from_utf8_lossy(bytes);
    let own = Ipv4Addr::new(10, 0, 0, 2);
    let stations = |name: &str| (name == "arm").then_some(Ipv4Addr::new(10, 0, 0, 3));
    let routes = match Routes::parse(&text, "a.toml", own, stations) {
        Err(error) => return said(&error.to_string()),
        Ok(routes) => routes,
    };
    assert!(routes.len() <= MOST_ROUTES);
    let all: Vec<_> = routes.iter().collect();
    for route in &all {
        assert_eq!(route.to.to_string().parse(), Ok(route.to), "read as it is shown");
        let is_station =
            !route.station.is_unspecified() && !route.station.is_multicast() && !route.station.is_broadcast();
        assert!(is_station, "{}", route.station);
    }
    for name in [0, 0x0018_0103, 0x0012_0000, 0x001e_0103, u32::MAX].map(MailboxName) {
        // Of all that match, as the text of the pattern says, that with most places, of those the further left.
        let places =
            |to: &Pattern| -> Vec<bool> { to.to_string().split('.').map(|place| place != "*").collect() };
        let matches = |to: &Pattern| {
            let exact = Pattern::exact(name).to_string();
            let (ours, theirs) = (to.to_string(), exact.split('.').collect::<Vec<_>>());
            ours.split('.').zip(theirs).all(|(ours, theirs)| ours == "*" || ours == theirs)
        };
        let best = all.iter().filter(|route| matches(&route.to)).max_by_key(|route| {
            let mut places = places(&route.to);
            places.resize(4, false);
            (places.iter().filter(|said| **said).count(), places)
        });
        let expected = best.map(|route| route.station).filter(|station| *station != own);
        assert_eq!(routes.find(name), expected, "{name}");
    }
    outcome([u64::MAX, routes.len() as u64, routes.to_itself() as u64])
}

#[test]
fn package_names_takes_any_text() {
    let texts = [
        "Odometry(0/1).3",
        "0.Odometry.1.3",
        "0.0x12.1.3",
        "0x00120103",
        "*.Pilot.*.3",
        "0xff(255/255).255",
        "*(*/*)",
        "255.255.255.255",
        "18(0x0/0X1).0",
        "PtzDrive",
        "0x80",
    ];
    let change = |random: &mut Random, input: &mut Vec<u8>, other: &[u8]| {
        const MARKS: &[u8] = b"0123456789abcdefxX.*()/+- ";
        let at = random.below(input.len() as u64 + 1) as usize;
        match random.below(4) {
            0 => input.insert(at, MARKS[random.below(MARKS.len() as u64) as usize]),
            1 if at < input.len() => input[at] = MARKS[random.below(MARKS.len() as u64) as usize],
            2 => mutate::text(random, input, other),
            _ => mutate::bytes(random, input, other),
        }
    };
    fuzz(&Target {
        name: "package_names",
        seeds: texts.map(|text| text.as_bytes().to_vec()).into(),
        has_corpus: true,
        mutate: change,
        run: |text| names(text).to_vec(),
    });
}

/// A place as another reads it: `Some(None)` is any.
fn place_by_another(text: &str, is_class: bool) -> Option<Option<u8>> {
    if text == "*" {
        return Some(None);
    }
    let named =
        Class::NAMED.iter().find(|(_, name)| is_class && name.to_lowercase() == text.to_ascii_lowercase());
    if let Some((class, _)) = named {
        return Some(Some(class.0));
    }
    let lower = text.to_ascii_lowercase();
    let (digits, base) = match lower.strip_prefix("0x") {
        Some(digits) => (digits, 16u32),
        None => (&*lower, 10),
    };
    let mut number = 0u32;
    for digit in digits.chars() {
        let digit = "0123456789abcdef".find(digit).filter(|&digit| digit < base as usize)?;
        number = (number * base + digit as u32).min(1_000);
    }
    (!digits.is_empty() && number < 256).then_some(Some(number as u8))
}

/// All four places; the last is `None` if it is not said.
fn places_by_another(text: &str) -> Option<[Option<Option<u8>>; 4]> {
    if let Some((class, rest)) = text.split_once('(') {
        let (system, rest) = rest.split_once('/')?;
        let (instance, local) = rest.split_once(')')?;
        let local =
            if local.is_empty() { None } else { Some(place_by_another(local.strip_prefix('.')?, false)?) };
        let [system, instance] = [system, instance].map(|text| place_by_another(text, false));
        return Some([Some(system?), Some(place_by_another(class, true)?), Some(instance?), local]);
    }
    let places: Vec<&str> = text.split('.').collect();
    match places[..] {
        [whole] => {
            let digits = whole.strip_prefix("0x").or_else(|| whole.strip_prefix("0X"))?;
            let is_number = !digits.is_empty() && digits.chars().all(|digit| digit.is_ascii_hexdigit());
            let number = u64::from_str_radix(digits.trim_start_matches('0'), 16);
            let number = if digits.trim_start_matches('0').is_empty() { Ok(0) } else { number };
            let number = u32::try_from(number.ok().filter(|_| is_number)?).ok()?;
            Some(number.to_be_bytes().map(|place| Some(Some(place))))
        }
        [system, class, instance] => Some([
            Some(place_by_another(system, false)?),
            Some(place_by_another(class, true)?),
            Some(place_by_another(instance, false)?),
            None,
        ]),
        [system, class, instance, local] => Some([
            Some(place_by_another(system, false)?),
            Some(place_by_another(class, true)?),
            Some(place_by_another(instance, false)?),
            Some(place_by_another(local, false)?),
        ]),
        _ => None,
    }
}

fn names(bytes: &[u8]) -> [u64; 3] {
    let text = String::from_utf8_lossy(bytes);
    let (name, pattern, class) =
        (text.parse::<MailboxName>(), text.parse::<Pattern>(), text.parse::<Class>());
    let theirs = places_by_another(&text);
    // A name has no '*', and where it says no local, it is 0; a pattern's is any then.
    let expected = theirs.and_then(|[system, class, instance, local]| {
        let local = local.unwrap_or(Some(0))?;
        Some(MailboxName(u32::from_be_bytes([system??, class??, instance??, local])))
    });
    assert_eq!(name.as_ref().ok().copied(), expected, "{text:?}");
    let expected = theirs.map(|[system, class, instance, local]| {
        let [system, class, instance, local] = [system, class, instance, local].map(Option::flatten);
        Pattern::new(system, class.map(Class), instance, local)
    });
    assert_eq!(pattern.as_ref().ok().copied(), expected, "{text:?}");
    let expected = place_by_another(&text, true).flatten().map(Class);
    assert_eq!(class.as_ref().ok().copied(), expected, "{text:?}");
    if let Ok(name) = &name {
        assert_eq!(name.to_string().parse(), Ok(*name));
        assert!(pattern.as_ref().is_ok_and(|pattern| pattern.matches(*name)));
    }
    if let Ok(pattern) = &pattern {
        assert_eq!(pattern.to_string().parse(), Ok(*pattern));
    }
    // What is wrong, without the text itself.
    let why = |error: &dyn std::fmt::Display| {
        let said = error.to_string();
        let why = said.rsplit_once(": expected").or(said.split_once("its ")).map_or("", |(_, why)| why);
        outcome(why.bytes().take(12).map(u64::from))
    };
    let known = |place: Option<Option<u8>>| place.map_or(2, |place| u64::from(place.is_none()));
    [
        name.as_ref().map_or_else(|error| why(error), |name| outcome([1, u64::from(name.local() == 0)])),
        pattern
            .as_ref()
            .map_or_else(|error| why(error), |_| outcome(theirs.into_iter().flatten().map(known))),
        class.as_ref().map_or_else(|error| why(error), |class| outcome([2, class.name().is_some().into()])),
    ]
}
