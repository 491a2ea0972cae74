//! Calls to a server of another station.

use std::thread::{self, JoinHandle};

use package_router::component::SendError;
use package_router::rpc::{CallError, Clients, Dropped, Proxy};
use package_router::wire::ERROR;

use super::*;

const SERVER: &str = "0.Camera.0";
/// Its station could have it.
const NOBODY: &str = "0.Camera.1";
const ECHO: i8 = 21;
const QUIT: i8 = 22;
const SILENCE: i8 = 23;
/// Of a call that nobody is to answer: many cycles.
const SHORT: Duration = Duration::from_millis(100);

/// Answers until it is told to end.
fn serves(mut mailbox: Mailbox) -> JoinHandle<()> {
    thread::spawn(move || {
        let (mut clients, mut room) = (Clients::new(), [0; 2_000]);
        loop {
            let (command, len) = mailbox.receive_into(&mut room, Some(PATIENCE)).unwrap();
            let kind = match command.kind {
                ECHO | QUIT => OK,
                SILENCE => continue,
                _ => ERROR,
            };
            clients.reply(&mailbox, &command, kind, &room[..len]).unwrap();
            if command.kind == QUIT {
                return;
            }
        }
    })
}

#[test]
fn a_server_of_another_station_answers_calls_and_whatever_goes_wrong_says_what() {
    shared("a_server_of_another_station_answers_calls_and_whatever_goes_wrong_says_what", || {
        let cell = lab("calls", ROUTES);
        let server = serves(component(&cell, "arm", SERVER));
        let pilot = Component::named(&cell.place("master")).unwrap();
        let proxy = |own, of| Proxy::new(&pilot, name(own), Shape::new(8, 2_000), name(of)).unwrap();
        let (mut camera, mut nobody) = (proxy("0.Pilot.0", SERVER), proxy("0.Pilot.1", NOBODY));
        for count in 0..20u8 {
            // Some in one frame, some in two.
            let body = vec![count; if count % 2 == 0 { 3 } else { 1_800 }];
            let reply = camera.call(ECHO, &body, PATIENCE).unwrap();
            assert_eq!((reply.kind(), reply.body()), (OK, &body[..]));
        }
        let calls: Vec<_> = (0..8u8).map(|count| camera.begin(ECHO, &[count]).unwrap()).collect();
        for (count, call) in calls.into_iter().enumerate().rev() {
            assert_eq!(camera.finish(call, PATIENCE).unwrap().body(), [count as u8]);
        }

        assert_eq!(camera.call(99, &[], PATIENCE).err(), Some(CallError::Failed(name(SERVER))));
        assert_eq!(nobody.call(ECHO, &[], PATIENCE).err(), Some(CallError::NotAvailable(name(NOBODY))));
        let begun = Instant::now();
        assert_eq!(camera.call(SILENCE, &[], SHORT).err(), Some(CallError::TimedOut(name(SERVER))));
        assert!(begun.elapsed() >= SHORT);
        assert_eq!((camera.dropped(), nobody.dropped()), (Dropped::default(), Dropped::default()));

        // A way that outlives its mailbox leads nowhere: the name may be another's.
        let late = name("0.Pilot.2");
        let mut way = pilot.mailbox(late, Shape::new(1, 8)).unwrap().sender(name(SERVER)).unwrap();
        assert_eq!(way.send(ECHO, b"late"), Err(SendError::Unbound(late)));

        // It ends: what its station does not know yet comes to nobody, and then that is said of it.
        camera.call(QUIT, &[], PATIENCE).unwrap();
        server.join().unwrap();
        let deadline = Instant::now() + PATIENCE;
        loop {
            match camera.call(ECHO, &[], SHORT).err() {
                Some(CallError::NotAvailable(of)) if of == name(SERVER) => break,
                told => assert!(
                    told == Some(CallError::TimedOut(name(SERVER))) && Instant::now() < deadline,
                    "{told:?}"
                ),
            }
        }
        let server = serves(component(&cell, "arm", SERVER));
        assert_eq!(camera.call(ECHO, b"again", PATIENCE).unwrap().body(), b"again");
        camera.call(QUIT, &[], PATIENCE).unwrap();
        server.join().unwrap();
        assert_eq!(cell.down()["unexplained"], 0);
    });
}
