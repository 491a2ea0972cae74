use super::*;
use crate::control::client::Question;
use crate::control::protocol::{LabReply, Request, read};
use socket2::{Domain, SockAddr, Type};
use std::net::Shutdown;
use std::os::fd::AsRawFd;

const SOON: Duration = Duration::from_millis(5);

fn server() -> (tempfile::TempDir, Server) {
    let scratch = tempfile::tempdir().unwrap();
    let server = Server::bind(&scratch.path().join("arm.sock")).unwrap();
    (scratch, server)
}

/// A client that the server knows.
fn client(server: &mut Server) -> Socket {
    let client = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
    client.connect(&SockAddr::unix(server.path()).unwrap()).unwrap();
    client.set_read_timeout(Some(SOON)).unwrap();
    server.serve(Duration::ZERO, |_, _| Vec::new());
    client
}

fn heard(mut client: &Socket) -> Option<String> {
    let mut reply = [0; 256];
    let length = client.read(&mut reply).ok()?;
    Some(String::from_utf8_lossy(&reply[..length]).into_owned())
}

#[test]
fn requests_that_take_long_are_answered_one_a_call_and_nobody_starves() {
    let (_scratch, mut server) = server();
    let clients: Vec<Socket> = (0..5).map(|_| client(&mut server)).collect();
    let mut answered = Vec::new();
    for _ in 0..clients.len() {
        // Whoever had its turn asks at once again.
        for (number, client) in clients.iter().enumerate() {
            client.send(&[number as u8]).unwrap();
        }
        let before = answered.len();
        server.serve(SOON, |packet, _| {
            answered.push(packet[0]);
            std::thread::sleep(TURN);
            b"done".to_vec()
        });
        assert_eq!(answered.len(), before + 1, "whoever serves has other things to do, too");
    }
    answered.sort_unstable();
    assert_eq!(answered, [0, 1, 2, 3, 4]);
}

#[test]
fn programs_leave_descriptors_for_everything_else() {
    for (files, programs) in [(0, 0), (64, 6), (1_024, 179), (20_000, 3_974)] {
        assert_eq!(programs_with(files), programs, "of {files}");
    }
}

#[test]
#[allow(unsafe_code)]
fn who_cannot_be_let_in_does_not_keep_the_server_from_waiting() {
    let (_scratch, mut server) = server();
    let inside = client(&mut server);
    // Always readable, and what is accepted is refused each time: EINVAL.
    let (other, never_accepts) = Socket::pair(Domain::UNIX, Type::SEQPACKET, None).unwrap();
    other.send(b"!").unwrap();
    let [from, to] = [never_accepts.as_fd(), server.listener.as_fd()].map(|fd| fd.as_raw_fd());
    // SAFETY: both are open, and each stays its owner's.
    assert_eq!(unsafe { nix::libc::dup2(from, to) }, to);
    server.serve(SOON, |_, _| Vec::new());
    assert!(server.is_full);
    let begun = Instant::now();
    (0..4).for_each(|_| server.serve(SOON, |_, _| Vec::new()));
    assert!(begun.elapsed() >= 4 * SOON, "{:?}", begun.elapsed());
    assert_eq!(server.traffic().not_let_in, 5);
    inside.send(b"?").unwrap();
    server.serve(SOON, |_, _| b"done".to_vec());
    assert_eq!(heard(&inside).as_deref(), Some("done"), "who is there is served");
}

#[test]
fn requests_that_take_no_time_are_answered_in_one_call() {
    let (_scratch, mut server) = server();
    let clients: Vec<Socket> = (0..5).map(|_| client(&mut server)).collect();
    clients.iter().for_each(|client| assert_eq!(client.send(b"?").unwrap(), 1));
    server.serve(SOON, |_, _| b"done".to_vec());
    assert!(clients.iter().all(|client| heard(client).as_deref() == Some("done")));
}

#[test]
fn what_was_taken_back_is_not_done() {
    let (_scratch, mut server) = server();
    let (gone, silent, stays) = (client(&mut server), client(&mut server), client(&mut server));
    for client in [&gone, &silent, &stays] {
        client.send(b"?").unwrap();
    }
    drop(gone);
    silent.shutdown(Shutdown::Write).unwrap();
    let mut asked = 0;
    server.serve(SOON, |_, _| {
        asked += 1;
        b"done".to_vec()
    });
    assert_eq!((asked, server.traffic().taken_back), (1, 2));
    assert_eq!(heard(&stays).as_deref(), Some("done"));
    let said = heard(&silent).unwrap();
    assert!(said.contains("nothing is done: it was taken back"), "{said}");
    assert!(matches!(read(said.as_bytes()), Ok(LabReply::Refused(_))), "labs say it, too");
}

#[test]
fn a_request_that_is_too_long_is_refused_with_the_limit() {
    let (_scratch, mut server) = server();
    let client = client(&mut server);
    client.send(&[b' '; REQUEST_AT_MOST + 1]).unwrap();
    server.serve(SOON, |_, _| panic!("it is not looked at"));
    assert!(heard(&client).unwrap().contains(&format!("{REQUEST_AT_MOST} bytes at most")));
    assert_eq!(heard(&client).as_deref(), Some(""), "and hung up");
}

#[test]
fn a_question_that_was_taken_back_in_time_is_refused_and_one_that_was_not_is_answered() {
    let (_scratch, mut server) = server();
    let path = server.path().to_owned();
    let ask = || Question::put(&path, Request::Status, SOON).unwrap();
    let (mut kept, mut taken_back) = (ask(), ask());
    assert!(matches!(kept.answer::<Reply>(Duration::ZERO), Ok(None)), "not yet");
    taken_back.take_back();
    server.serve(SOON, |_, _| Vec::new());
    server.serve(SOON, |_, _| Envelope::pack(Reply::Applied(7)));
    kept.take_back();
    assert_eq!(kept.answer(SOON).unwrap(), Some(Reply::Applied(7)));
    assert!(matches!(taken_back.answer(SOON).unwrap(), Some(Reply::Refused(_))));
}
