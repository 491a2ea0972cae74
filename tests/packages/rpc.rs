//! Proxies and servers of a station.

#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use package_router::component::{Error, SendError};
use package_router::mailbox;
use package_router::record;
use package_router::registry::Refused;
use package_router::rpc::{CallError, Clients, Dropped, MOST_CALLS, Proxy, ReplyError};
use package_router::wire::{ERROR, Head, NOT_AVAILABLE, OK, TIMEOUT};

use super::*;

const SERVER: MailboxName = MailboxName(0x0012_0000);
const PROXY: MailboxName = MailboxName(0x0018_0001);
const STRANGER: MailboxName = MailboxName(0x0010_0000);
/// Commands of the servers here.
const ECHO: i8 = 21;
const QUIT: i8 = 22;
const SAY: i8 = 23;
const SILENCE: i8 = 24;
const SHAPE: Shape = Shape::new(8, 64);
/// Of a call that nobody is to answer.
const SHORT: Duration = Duration::from_millis(20);

/// The system's allocator, counting for each thread what is asked of it.
struct Counting;

thread_local! {
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call goes unchanged to the system's allocator, which keeps the contract; counting neither allocates nor panics,
// since the counter has no destructor and is never gone.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        CALLS.with(|calls| calls.set(calls.get() + 1));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        CALLS.with(|calls| calls.set(calls.get() + 1));
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn allocations() -> u64 {
    CALLS.with(Cell::get)
}

/// Answers until it is told to end: how often it has asked for memory, but for the first answer to each.
fn serve(mailbox: &mut Mailbox) -> u64 {
    let (mut clients, mut room) = (Clients::new(), [0; 64]);
    let mut allocated = 0;
    loop {
        let (command, len) = mailbox.receive_into(&mut room, Some(PATIENCE)).unwrap();
        let kind = match command.kind {
            // It says what it is told to say.
            SAY => room[0] as i8,
            ECHO | QUIT => OK,
            SILENCE => continue,
            _ => ERROR,
        };
        let (known, before) = (clients.known(), allocations());
        clients.reply(mailbox, &command, kind, &room[..len]).unwrap();
        allocated += if clients.known() == known { allocations() - before } else { 0 };
        if command.kind == QUIT {
            return allocated;
        }
    }
}

/// A server in a thread of its own, which ends when it is told.
fn server(station: &Station) -> JoinHandle<u64> {
    let (_component, mut mailbox) = component(&station.path, SERVER, SHAPE);
    thread::spawn(move || {
        let _component = _component;
        serve(&mut mailbox)
    })
}

fn proxy(component: &Component, own: MailboxName) -> Proxy {
    Proxy::new(component, own, SHAPE, SERVER).unwrap()
}

record! {
    #[derive(Clone, Copy, Debug, PartialEq)]
    struct Pose {
        t: u32,
        x: i32,
        rho: f32,
    }
}

#[test]
fn a_call_is_answered_typed_or_not_and_takes_no_memory() {
    let station = Station::new();
    let serves = server(&station);
    let component = station.attach();
    let mut proxy = proxy(&component, PROXY);
    assert_eq!(proxy.call(ECHO, b"first", PATIENCE).unwrap().body(), b"first");
    let before = allocations();
    for count in 0..1_000u32 {
        let pose = Pose { t: count, x: -7, rho: 0.5 };
        assert_eq!(proxy.call_typed(ECHO, &pose, PATIENCE), Ok(pose));
        let bytes = count.to_le_bytes();
        let reply = proxy.call(ECHO, &bytes, PATIENCE).unwrap();
        assert_eq!((reply.kind(), reply.body()), (OK, &bytes[..]));
    }
    assert_eq!(proxy.call(ECHO, &[0; 65], PATIENCE).err(), Some(too_large()));
    assert_eq!(proxy.call(SILENCE, &[], SHORT).err(), Some(CallError::TimedOut(SERVER)));
    assert_eq!(allocations() - before, 0, "in 2002 calls");
    assert!(proxy.call_typed::<_, u64>(ECHO, &1u32, PATIENCE).is_err_and(|error| {
        error.to_string() == "the reply: a body of 4 bytes: this record has exactly 8"
    }));
    assert_eq!(proxy.call_typed::<_, ()>(QUIT, &(), PATIENCE), Ok(()));
    assert_eq!(serves.join().unwrap(), 0, "in its answers but the first");
    assert_eq!((proxy.in_flight(), proxy.dropped()), (0, Dropped::default()));
}

fn too_large() -> CallError {
    CallError::Send(SendError::Mailbox(mailbox::SendError::TooLarge { got: 65, most: 64 }))
}

#[test]
fn calls_in_flight_are_answered_in_any_order_and_each_has_its_own_reply() {
    let station = Station::new();
    let (_server, mut server) = component(&station.path, SERVER, SHAPE);
    let component = station.attach();
    let mut proxy = proxy(&component, PROXY);
    proxy.set_priority(99);
    let mut answers = server.sender(PROXY).unwrap();
    let calls: Vec<_> = (0..8u8).map(|count| proxy.begin(ECHO, &[count; 3]).unwrap()).collect();
    assert_eq!(proxy.begin(ECHO, &[]).err(), Some(CallError::TooMany(8)), "as many as there are slots");
    let mut commands: Vec<(Head, Vec<u8>)> = Vec::new();
    for _ in 0..8 {
        let package = server.receive(Some(PATIENCE)).unwrap();
        assert_eq!((package.head().priority, package.head().from), (99, PROXY));
        commands.push((*package.head(), package.body().to_vec()));
    }
    assert_eq!(proxy.is_answered(&calls[7]), Ok(false));
    for (command, body) in commands.iter().rev() {
        answers.send_with(&command.answer(-6), body).unwrap();
    }
    for call in &calls {
        assert_eq!(proxy.is_answered(call), Ok(true));
    }
    for (count, call) in calls.into_iter().enumerate() {
        let reply = proxy.finish(call, Duration::ZERO).unwrap();
        assert_eq!((reply.kind(), reply.body()), (-6, &[count as u8; 3][..]));
    }
    // Whose reply does not come is given up, and its place is another's.
    let call = proxy.begin(ECHO, &[]).unwrap();
    proxy.give_up(call);
    assert_eq!((proxy.in_flight(), proxy.dropped()), (0, Dropped::default()));
    let many = Proxy::new(&component, name(0x19, 0), Shape::new(64, 1), PROXY).unwrap();
    assert_eq!(many.in_flight(), 0);
    const { assert!(MOST_CALLS < 64) };
}

#[test]
fn whatever_goes_wrong_says_what() {
    let mut station = Station::new();
    let component = station.attach();
    let missing = Proxy::new(&component, PROXY, SHAPE, SERVER).err();
    assert!(matches!(missing, Some(Error::Refused(Refused::NoMailbox(SERVER)))));
    let serves = server(&station);
    let mut proxy = proxy(&component, PROXY);
    let mut told = |command, body: &[u8], timeout| proxy.call(command, body, timeout).err();
    assert_eq!(told(99, &[], PATIENCE), Some(CallError::Failed(SERVER)));
    for (kind, error) in [
        (ERROR, CallError::Failed(SERVER)),
        (TIMEOUT, CallError::NotInTime(SERVER)),
        (NOT_AVAILABLE, CallError::NotAvailable(SERVER)),
    ] {
        assert_eq!(told(SAY, &[kind as u8], PATIENCE), Some(error));
    }
    assert_eq!(told(SAY, &[-4i8 as u8], PATIENCE), None, "a status is an answer");
    let begun = Instant::now();
    assert_eq!(told(SILENCE, &[], SHORT), Some(CallError::TimedOut(SERVER)));
    assert!(begun.elapsed() >= SHORT);
    assert_eq!(told(ECHO, &[0; 65], PATIENCE), Some(too_large()));
    assert_eq!(told(QUIT, &[], PATIENCE), None);
    serves.join().unwrap();
    let no_mailbox = CallError::Send(SendError::NoMailbox(SERVER));
    assert_eq!(told(ECHO, &[], PATIENCE), Some(no_mailbox));
    // Nobody reads there: its slots are full some time.
    let (_deaf, _mailbox) = super::component(&station.path, SERVER, Shape::new(1, 64));
    proxy.rebind().unwrap();
    assert_eq!(proxy.call(ECHO, &[], SHORT).err(), Some(CallError::TimedOut(SERVER)));
    let full = CallError::Send(SendError::Mailbox(mailbox::SendError::Full(1)));
    assert_eq!(proxy.call(ECHO, &[], SHORT).err(), Some(full));
    assert_eq!(proxy.in_flight(), 0);
    station.end();
    assert!(proxy.rebind().is_err());
    assert_eq!(proxy.call(ECHO, &[], SHORT).err(), Some(no_mailbox));
}

#[test]
fn who_waits_for_a_reply_is_told_that_the_station_has_ended() {
    let mut station = Station::new();
    let (_server, _mailbox) = component(&station.path, SERVER, SHAPE);
    let component = station.attach();
    let mut proxy = proxy(&component, PROXY);
    let waits = thread::spawn(move || {
        let _component = component;
        proxy.call(ECHO, &[], PATIENCE).err()
    });
    thread::sleep(SHORT);
    let begun = Instant::now();
    station.end();
    assert_eq!(waits.join().unwrap(), Some(CallError::Gone));
    assert!(begun.elapsed() < PATIENCE / 2, "it did not wait until its time was over");
}

#[test]
fn a_reply_that_is_late_or_comes_twice_is_no_later_calls() {
    let station = Station::new();
    let (_server, mut server) = component(&station.path, SERVER, SHAPE);
    let component = station.attach();
    let mut proxy = proxy(&component, PROXY);
    let mut answers = server.sender(PROXY).unwrap();
    let command = |server: &mut Mailbox| *server.receive(Some(PATIENCE)).unwrap().head();
    for _ in 0..300 {
        assert_eq!(proxy.call(ECHO, &[], Duration::ZERO).err(), Some(CallError::TimedOut(SERVER)));
        let late = command(&mut server);
        let call = proxy.begin(ECHO, &[]).unwrap();
        let in_time = command(&mut server);
        for (head, body) in [(late, b"late"), (in_time, b"good"), (in_time, b"more")] {
            answers.send_with(&head.answer(OK), body).unwrap();
        }
        assert_eq!(proxy.finish(call, PATIENCE).unwrap().body(), b"good");
    }
    // The last one's second reply waits to be looked at.
    let call = proxy.begin(ECHO, &[]).unwrap();
    assert_eq!(proxy.is_answered(&call), Ok(false));
    assert_eq!(proxy.dropped(), Dropped { late: 300, doubled: 300, unasked: 0 });
}

/// Somebody sends to the proxy what is more urgent than any reply, as fast as it is read.
#[test]
fn who_floods_a_proxy_neither_answers_its_calls_nor_keeps_them_from_being_over() {
    let station = Station::new();
    let serves = server(&station);
    let component = station.attach();
    let mut proxy = proxy(&component, PROXY);
    let (_stranger, stranger) = super::component(&station.path, STRANGER, SHAPE);
    let is_over = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut floods = stranger.sender(PROXY).unwrap();
            while !is_over.load(Ordering::Relaxed) {
                for id in 0..=u8::MAX {
                    let _ = floods.send_with(&Head { id, priority: 255, ..Head::default() }, b"flood");
                }
            }
        });
        let until = Instant::now() + PATIENCE;
        while proxy.dropped().unasked < 10_000 {
            assert!(Instant::now() < until, "{:?}", proxy.dropped());
            let begun = Instant::now();
            assert_eq!(proxy.call(SILENCE, &[], SHORT).err(), Some(CallError::TimedOut(SERVER)));
            assert!((SHORT..PATIENCE).contains(&begun.elapsed()));
        }
        is_over.store(true, Ordering::Relaxed);
    });
    assert_eq!(proxy.call(ECHO, b"ours", PATIENCE).unwrap().body(), b"ours");
    assert_eq!((proxy.dropped().late, proxy.dropped().doubled), (0, 0));
    proxy.call(QUIT, &[], PATIENCE).unwrap();
    serves.join().unwrap();
}

#[test]
fn a_client_that_comes_again_under_its_name_is_answered() {
    let station = Station::new();
    let serves = server(&station);
    for count in 0..20u8 {
        let component = station.attach();
        let deadline = Instant::now() + PATIENCE;
        // The server has as many places as it says; the broker sees a moment later that the last one has gone.
        let mut proxy = loop {
            match Proxy::new(&component, PROXY, SHAPE, SERVER) {
                Ok(proxy) => break proxy,
                Err(error) if Instant::now() > deadline => panic!("{error}"),
                Err(_) => thread::sleep(Duration::from_millis(1)),
            }
        };
        assert_eq!(proxy.call(ECHO, &[count], PATIENCE).unwrap().body(), [count]);
        if count == 19 {
            proxy.call(QUIT, &[], PATIENCE).unwrap();
        }
    }
    serves.join().unwrap();
}

#[test]
fn what_asks_for_nothing_is_not_answered() {
    let station = Station::new();
    let (_server, mut server) = component(&station.path, SERVER, SHAPE);
    let (_arm, arm) = component(&station.path, PROXY, SHAPE);
    arm.sender(SERVER).unwrap().send(-6, &[]).unwrap();
    let data = *server.receive(Some(PATIENCE)).unwrap().head();
    let mut clients = Clients::new();
    assert!(matches!(clients.reply(&server, &data, OK, &[]), Err(ReplyError::NoCommand(-6))));
    let gone = Head { from: name(0x90, 9), ..Head::new(1, SERVER, SERVER) };
    assert!(matches!(clients.reply(&server, &gone, OK, &[]), Err(ReplyError::Bind(_))));
    assert_eq!(clients.known(), 0);
}

/// Set for a process that is to be a server: of which station.
const SERVER_OF: &str = "RTNET_SERVER_OF";
const KILLED: &str = "rpc::a_server_that_is_killed_is_called_again_once_it_is_there_again";

fn server_process(station: &Station) -> Child {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", KILLED, "--nocapture"]).env(SERVER_OF, &station.path);
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

#[test]
fn a_server_that_is_killed_is_called_again_once_it_is_there_again() {
    if let Ok(station) = std::env::var(SERVER_OF) {
        let (_component, mut mailbox) = component(Path::new(&station), SERVER, SHAPE);
        serve(&mut mailbox);
        return;
    }
    let station = Station::new();
    let mut process = server_process(&station);
    let component = station.attach();
    let deadline = Instant::now() + PATIENCE;
    let mut proxy = loop {
        match Proxy::new(&component, PROXY, SHAPE, SERVER) {
            Ok(proxy) => break proxy,
            Err(error) => assert!(Instant::now() < deadline, "{error}"),
        }
        thread::sleep(Duration::from_millis(1));
    };
    for count in 0..3u8 {
        assert_eq!(proxy.call(ECHO, &[count], PATIENCE).unwrap().body(), [count]);
        // It dies with a command that it has not answered.
        let call = proxy.begin(SILENCE, &[]).unwrap();
        process.kill().unwrap();
        process.wait().unwrap();
        assert_eq!(proxy.finish(call, SHORT).err(), Some(CallError::TimedOut(SERVER)));
        let deadline = Instant::now() + PATIENCE;
        loop {
            match proxy.call(ECHO, &[], SHORT).err() {
                Some(CallError::Send(SendError::NoMailbox(SERVER))) => break,
                told => assert!(Instant::now() < deadline, "{told:?}"),
            }
        }
        process = server_process(&station);
        while let Err(error) = proxy.rebind() {
            assert!(Instant::now() < deadline, "{error}");
            thread::sleep(Duration::from_millis(1));
        }
    }
    proxy.call(QUIT, &[], PATIENCE).unwrap();
    assert!(process.wait().unwrap().success());
}
