//! As many connections as a router takes.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

use package_router::tcp::control::UNWATCHED;

use super::*;
use crate::host::figure;

/// The router's limit.
const CONNECTIONS: u32 = 10_000;
const MORE: u32 = 10;
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
            // Nothing here answers questions for a sign of life.
            client.write_all(&package(UNWATCHED, 0, 0, &[])).unwrap();
            register(&mut client, name);
            client
        })
        .collect();
    for _ in 0..MORE {
        // It is closed at once, or reset.
        assert_eq!(router.connect().read(&mut [0]).unwrap_or(0), 0);
    }
    clients[0].write_all(&package(-6, CONNECTIONS, 1, b"to the last")).unwrap();
    assert_eq!(read(clients.last_mut().unwrap()).1, b"to the last");
    let status = router.status();
    let [connections, names] = ["connections", "names"].map(|of| status[of].as_u64().unwrap());
    assert_eq!((connections, names), (CONNECTIONS.into(), CONNECTIONS.into()));
    assert_eq!(status["counters"]["connections_refused"], MORE);
    figure(
        test,
        &format!("{connections} connections, each with a name; {MORE} more were refused, and counted"),
    );
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
