//! As many connections as a router takes.

use std::collections::BTreeSet;
use std::time::Instant;

use nix::sys::resource::{Resource, getrlimit, setrlimit};

use package_router::tcp::control::{LIFESIGN, UNWATCHED, WATCHED};

use super::*;
use crate::host::figure;

/// The router's limit.
const CONNECTIONS: u32 = 10_000;
const MORE: u32 = 10;
/// From one question for a sign of life to the next.
const ROUND: Duration = Duration::from_secs(5);
/// Descriptors of all else in this process.
const OTHERS: u64 = 1_000;

#[test]
fn a_router_takes_ten_thousand_connections() {
    let test = "a_router_takes_ten_thousand_connections";
    let needed = u64::from(CONNECTIONS + MORE) + OTHERS;
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    if hard < needed {
        return skip(test, &format!("needs {needed} descriptors, and may have {hard} (ulimit -Hn)"));
    }
    setrlimit(Resource::RLIMIT_NOFILE, soft.max(needed), hard).unwrap();
    let router = Router::start("crowd", &[]);
    let mut clients: Vec<TcpStream> = (1..=CONNECTIONS)
        .map(|name| {
            let mut client = router.connect();
            // It is not asked for a sign of life before all are there.
            client.write_all(&package(UNWATCHED, 0, 0, &[])).unwrap();
            register(&mut client, name);
            client
        })
        .collect();
    for _ in 0..MORE {
        // It is closed at once, or reset.
        assert_eq!(router.connect().read(&mut [0]).unwrap_or(0), 0);
    }
    clients.iter_mut().for_each(|client| client.write_all(&package(WATCHED, 0, 0, &[])).unwrap());
    let last = clients.pop().unwrap();
    let mut pair = [clients.swap_remove(0), last];
    let is_over = AtomicBool::new(false);
    let (trips, longest) = thread::scope(|scope| {
        let _ends = AtEnd(&is_over);
        let trips = scope.spawn(|| trips(&mut pair, &is_over));
        live(&mut clients, 2 * ROUND + ROUND / 5);
        is_over.store(true, Ordering::Relaxed);
        trips.join().unwrap()
    });
    // None answers any more.
    let all = clients.iter_mut().chain(&mut pair);
    all.for_each(|client| client.write_all(&package(UNWATCHED, 0, 0, &[])).unwrap());
    let status = router.status();
    shows_each(&router, &status);
    let [connections, names] = ["connections", "names"].map(|of| status[of].as_u64().unwrap());
    assert_eq!((connections, names), (CONNECTIONS.into(), CONNECTIONS.into()));
    assert_eq!(status["counters"]["connections_refused"], MORE);
    assert_eq!(status["endings"]["silent"], 0, "{}", status["endings"]);
    figure(
        test,
        &format!(
            "{connections} connections, each with a name, lived for two rounds; {MORE} more were refused, and counted; of {trips} trips \
             there and back meanwhile the longest took {:.1} ms",
            longest.as_secs_f64() * 1e3
        ),
    );
}

/// The status has each connection with its name; on the screen it is the first 100, or all.
fn shows_each(router: &Router, status: &Value) {
    let each = status["clients"].as_array().unwrap().iter();
    let names: BTreeSet<String> = each.map(|client| client["mailboxes"].to_string()).collect();
    assert_eq!(names.len(), CONNECTIONS as usize);
    let lines = |options: &[&str]| {
        let shown = rtnet().args(["router", "status", &router.name]).args(options).output().unwrap().stdout;
        text(&shown).lines().filter(|line| line.starts_with("127.0.0.1:")).count()
    };
    let closed = status["closed"].as_array().unwrap().len();
    assert_eq!((lines(&[]), lines(&["--all"])), (100 + closed, CONNECTIONS as usize + closed));
}

/// Answers each question for a sign of life for so long.
fn live(clients: &mut [TcpStream], time: Duration) {
    clients.iter().for_each(|client| client.set_nonblocking(true).unwrap());
    let begun = Instant::now();
    while begun.elapsed() < time {
        for client in &mut *clients {
            let mut head = [0; HEAD_LEN];
            while let Ok(HEAD_LEN) = client.read(&mut head) {
                assert_eq!(Head::parse(&head).unwrap().kind, LIFESIGN);
                client.write_all(&package(0, 0, 0, &[])).unwrap();
            }
        }
        thread::sleep(Duration::from_millis(100));
    }
}

/// Packages there and back between the first client and the last, a thousand a second: their number, and the longest time.
fn trips([first, last]: &mut [TcpStream; 2], is_over: &AtomicBool) -> (u64, Duration) {
    let (there, back) = (package(-6, CONNECTIONS, 1, b"there"), package(-6, 1, CONNECTIONS, b"back"));
    let (mut trips, mut longest) = (0, Duration::ZERO);
    while !is_over.load(Ordering::Relaxed) {
        let begun = Instant::now();
        first.write_all(&there).unwrap();
        comes(last, b"there");
        last.write_all(&back).unwrap();
        comes(first, b"back");
        (trips, longest) = (trips + 1, longest.max(begun.elapsed()));
        thread::sleep(Duration::from_millis(1));
    }
    (trips, longest)
}

/// Reads a package. A question for a sign of life may come before it: the packages that are sent answer it.
fn comes(client: &mut TcpStream, body: &[u8]) {
    let mut package = read(client);
    while package.0.kind == LIFESIGN {
        package = read(client);
    }
    assert_eq!(package.1, body);
}

/// A router that may open a few descriptors only, as where the host's limit is low.
#[test]
fn connections_without_a_descriptor_wait_and_are_counted() {
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -n 30; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_rtnet")]);
    let router = Router::start_by(command, "descriptors", &[]);
    let mut first = router.connect();
    register(&mut first, 1);
    // The kernel opens them, and they wait there.
    let mut others: Vec<TcpStream> = (0..40).map(|_| router.connect()).collect();
    first.write_all(&package(-6, 1, 1, b"to itself")).unwrap();
    assert_eq!(read(&mut first).1, b"to itself", "it goes on");
    let mut last = others.pop().unwrap();
    last.write_all(&package(13, 0, 0, &2u32.to_le_bytes())).unwrap();
    thread::sleep(Duration::from_millis(300));
    drop(others);
    assert_eq!(read(&mut last).0.kind, OK, "it has its turn");
    wait_until("it is counted", || router.status()["counters"]["accepts_failed"].as_u64() > Some(0));
}
