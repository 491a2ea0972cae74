//! Components that make mistakes: what they do costs them packages, mailboxes or their connection, and nobody else anything.

// Components need real time.
#![allow(clippy::disallowed_methods)]

mod hosts;
mod hung;
mod memory;

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
use nix::sys::epoll::{Epoll, EpollCreateFlags};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use nix::sys::signal::{Signal, kill};
use nix::sys::socket::{ControlMessage, ControlMessageOwned, MsgFlags, recvmsg, sendmsg};
use nix::sys::stat::fstat;
use nix::unistd::{Pid, ftruncate};
use package_router::broker::{Broker, MOST_COMPONENTS};
use package_router::component::{Component, Error, Mailbox, ReceiveError, SendError, Sender};
use package_router::handshake::{ANSWER_LEN, Answer, Ask, FILES, Lane};
use package_router::mailbox::{
    self, LARGEST_BODY, LaneSender, Layout, MOST_SENDERS, MOST_SLOTS, Shape, Stamps, of_owner, of_sender,
};
use package_router::name::{Class, MailboxName};
use package_router::registry::{LaneState, MOST_MAILBOXES, Refused};
use package_router::shared::{Room, lane_at};
use package_router::wire::Head;
use rtnet::live::sealed::Sealed;
use socket2::{Domain, SockAddr, Socket, Type};

use hosts::*;
use tests::host::{this_thread, until_asleep};

/// As long as anything may take on a host that has other things to do.
const PATIENCE: Duration = Duration::from_secs(20);
/// What is rung for comes sooner, however busy the host: what is not, comes at the end of [`PATIENCE`] or never. A broker that
/// waits for one client fails others' asks: they give up after 2 s.
const AT_ONCE: Duration = Duration::from_secs(10);
/// Set for a process that is to make a mistake: which one, and at which station.
const MISTAKE: &str = "RTNET_MISTAKE";

const SINK: MailboxName = MailboxName::new(0, Class(0x80), 0, 0);
const HONEST: MailboxName = MailboxName::new(0, Class(0x40), 0, 0);
const MISTAKEN: MailboxName = MailboxName::new(0, Class(0xc0), 0, 0);
const HEIR: MailboxName = MailboxName::new(0, Class(0x41), 0, 0);

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
    let brought = files_called(called, &Shape::new(1, 1));
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
        let answer = mistaken.ask(Ask::Create(MISTAKEN, shape), &brought.each_ref());
        assert!(matches!(answer, Answer::Refused(Refused::Shape(_))), "{shape:?}: {answer:?}");
    }
    let nobody = mistaken.creates(MailboxName::NOBODY, Shape::new(1, 1));
    assert_eq!(nobody, Answer::Refused(Refused::NoName(MailboxName::NOBODY)));
    drop(brought);
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
