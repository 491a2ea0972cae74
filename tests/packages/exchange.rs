//! What components do with mailboxes.

use package_router::component::{Error, ReceiveError, SendError};
use package_router::mailbox::{self, of_owner, of_sender};
use package_router::registry::Refused;
use package_router::wire::{Head, OK};

use super::*;

const ARM: u8 = 0x80;
const CAMERA: u8 = 0x18;

#[test]
fn a_command_is_answered_with_its_number_and_its_priority_and_wakes_who_waits() {
    let station = Station::new();
    let (_arm, mut arm) = component(&station.path, name(ARM, 0), Shape::new(4, 64));
    let (_camera, mut camera) = component(&station.path, name(CAMERA, 0), Shape::new(4, 64));
    let mut asks = arm.sender(camera.name()).unwrap();
    let answering = thread::spawn(move || {
        let mut answers = bound(&camera, name(ARM, 0));
        for _ in 0..1_000 {
            let package = camera.receive(Some(PATIENCE)).unwrap();
            assert!(package.head().is_command());
            let (reply, body) = (package.head().answer(OK), package.body().to_vec());
            drop(package);
            answers.send_with(&reply, &body).unwrap();
        }
    });
    asks.set_priority(77);
    for count in 0..1_000u32 {
        let id = asks.send(21, &count.to_le_bytes()).unwrap();
        let package = arm.receive(Some(PATIENCE)).unwrap();
        let Head { kind, priority, from, to, .. } = *package.head();
        assert_eq!((kind, priority, package.head().id), (OK, 77, id));
        assert_eq!((from, to), (name(CAMERA, 0), name(ARM, 0)));
        assert_eq!(package.body().to_vec(), count.to_le_bytes());
        // Some are answered at once, before others somebody has to be woken.
        if count % 10 == 0 {
            drop(package);
            thread::sleep(Duration::from_micros(300));
        }
    }
    answering.join().unwrap();
    assert_eq!(arm.counted(of_owner::RECEIVED), 1_000);
    assert_eq!(asks.counted(of_sender::SENT), 1_000);
}

#[test]
fn an_urgent_package_overtakes_the_backlog_of_others_and_its_own() {
    let station = Station::new();
    let (_sink, mut sink) = component(&station.path, name(ARM, 0), Shape::new(64, 8));
    let (_slow, slow) = component(&station.path, name(0xf0, 1), Shape::new(1, 8));
    let (_quick, quick) = component(&station.path, name(0x10, 2), Shape::new(1, 8));
    let (mut slow, mut quick) = (slow.sender(sink.name()).unwrap(), quick.sender(sink.name()).unwrap());
    for count in 0..64 {
        slow.send(1, &[count]).unwrap();
    }
    assert_eq!(slow.send(1, &[64]), Err(SendError::Mailbox(mailbox::SendError::Full(64))));
    quick.send(2, &[]).unwrap();
    assert_eq!(sink.depth(), Ok(65));
    // The class of who sends says how urgent it is.
    assert_eq!(sink.receive(None).unwrap().head().kind, 2);
    for count in 0..64 {
        assert_eq!(sink.receive(None).unwrap().body().to_vec(), [count]);
        if count == 31 {
            quick.send(2, &[]).unwrap();
            assert_eq!(sink.receive(None).unwrap().head().kind, 2);
        }
    }
    assert_eq!(sink.receive(Some(Duration::ZERO)).err(), Some(ReceiveError::TimedOut));
}

#[test]
fn who_waits_is_told_when_it_has_waited_long_enough() {
    let station = Station::new();
    let (_arm, mut arm) = component(&station.path, name(ARM, 0), Shape::new(4, 64));
    for millis in [0, 1, 30] {
        let (begun, timeout) = (std::time::Instant::now(), Duration::from_millis(millis));
        assert_eq!(arm.receive(Some(timeout)).err(), Some(ReceiveError::TimedOut));
        assert!(begun.elapsed() >= timeout);
    }
    assert!(arm.try_receive().unwrap().is_none());
}

#[test]
fn too_little_room_leaves_the_package_and_a_cleaned_mailbox_is_empty() {
    let station = Station::new();
    let (_arm, mut arm) = component(&station.path, name(ARM, 0), Shape::new(4, 64));
    let mut own = arm.sender(arm.name()).unwrap();
    own.send(1, &[1, 2, 3]).unwrap();
    own.send(1, &[4]).unwrap();
    let too_small = Err(ReceiveError::TooSmall(mailbox::TooSmall { got: 2, needed: 3 }));
    assert_eq!(arm.receive_into(&mut [0; 2], None), too_small);
    let mut room = [0; 8];
    assert_eq!(arm.receive_into(&mut room, None).map(|(_, len)| len), Ok(3));
    assert_eq!(arm.clean(), Ok(1));
    assert_eq!(arm.depth(), Ok(0));
}

fn refused<T>(told: Result<T, Error>) -> Option<Refused> {
    match told {
        Err(Error::Refused(refused)) => Some(refused),
        _ => None,
    }
}

#[test]
fn what_cannot_be_is_refused_with_why() {
    let station = Station::new();
    let (arm_is, arm) = component(&station.path, name(ARM, 0), Shape::new(4, 64).senders(1));
    let other = station.attach();
    assert_eq!(refused(other.mailbox(name(ARM, 0), Shape::new(1, 1))), Some(Refused::Taken(name(ARM, 0))));
    assert!(
        refused(other.mailbox(name(ARM, 1), Shape::new(0, 1))).unwrap().to_string().contains("1 to 1024")
    );
    assert_eq!(refused(arm.sender(name(ARM, 9))), Some(Refused::NoMailbox(name(ARM, 9))));
    let first = arm.sender(name(ARM, 0)).unwrap();
    assert_eq!(refused(arm.sender(name(ARM, 0))), Some(Refused::NoLane(name(ARM, 0), 1)));
    drop(first);
    // Its owner says that all is read when it looks next.
    let mut arm = arm;
    arm.depth().unwrap();
    drop(arm.sender(name(ARM, 0)).unwrap());
    drop(arm);
    arm_is.mailbox(name(ARM, 0), Shape::new(1, 1)).unwrap();
}

#[test]
fn a_name_is_nobody_elses_while_a_sender_of_it_is_still_there() {
    let station = Station::new();
    let (_arm, mut arm) = component(&station.path, name(ARM, 0), Shape::new(4, 64));
    let (camera_is, camera) = component(&station.path, name(CAMERA, 0), Shape::new(4, 64));
    let mut sender = camera.sender(arm.name()).unwrap();
    drop(camera);
    let other = station.attach();
    let create = || other.mailbox(name(CAMERA, 0), Shape::new(1, 1));
    let taken = refused(create()).unwrap();
    assert_eq!(taken, Refused::Taken(name(CAMERA, 0)));
    assert!(taken.to_string().contains("a sender of it is still there"), "{taken}");
    sender.send(7, &[]).unwrap();
    let head = *arm.receive(None).unwrap().head();
    assert_eq!((head.from, head.kind), (name(CAMERA, 0), 7));
    drop(camera_is.mailbox(name(CAMERA, 0), Shape::new(1, 1)).unwrap());
    assert_eq!(refused(create()), Some(taken));
    drop(sender);
    let heir = create().unwrap();
    heir.sender(arm.name()).unwrap().send(8, &[]).unwrap();
    assert_eq!(arm.receive(None).unwrap().head().kind, 8);
}

#[test]
fn a_mailbox_that_is_gone_takes_nothing_and_its_name_can_be_used_again() {
    let station = Station::new();
    let (_arm, arm) = component(&station.path, name(ARM, 0), Shape::new(4, 64));
    let (camera_is, camera) = component(&station.path, name(CAMERA, 0), Shape::new(4, 64));
    let mut sender = arm.sender(camera.name()).unwrap();
    sender.send(1, &[]).unwrap();
    drop(camera);
    assert_eq!(sender.send(1, &[]), Err(SendError::NoMailbox(name(CAMERA, 0))));
    let mut again = camera_is.mailbox(name(CAMERA, 0), Shape::new(2, 8)).unwrap();
    assert_eq!(sender.send(1, &[]), Err(SendError::NoMailbox(name(CAMERA, 0))), "it is another one");
    assert_eq!(again.depth(), Ok(0));
    drop(sender);
    arm.sender(name(CAMERA, 0)).unwrap().send(5, &[]).unwrap();
    assert_eq!(again.receive(None).unwrap().head().kind, 5, "its sender has gone, what it sent has not");
}

#[test]
fn a_sender_to_a_mailbox_that_is_gone_takes_nothing_with_it_of_the_next_in_its_place() {
    let station = Station::new();
    let (_arm, arm) = component(&station.path, name(ARM, 0), Shape::new(4, 64));
    let (camera_is, camera) = component(&station.path, name(CAMERA, 0), Shape::new(4, 64));
    let old = arm.sender(camera.name()).unwrap();
    drop(camera);
    // The same place, and the same lane.
    let mut next = camera_is.mailbox(name(CAMERA, 1), Shape::new(4, 64)).unwrap();
    let mut sender = arm.sender(next.name()).unwrap();
    assert_eq!(next.depth(), Ok(0));
    drop(old);
    assert_eq!(next.depth(), Ok(0));
    for kind in 1..9 {
        sender.send(kind, &[]).unwrap();
        assert_eq!(next.receive(Some(PATIENCE)).unwrap().head().kind, kind);
    }
}

#[test]
fn whoever_waits_is_told_that_the_station_has_ended() {
    let mut station = Station::new();
    let (_arm, mut arm) = component(&station.path, name(ARM, 0), Shape::new(4, 64));
    let (_camera, camera) = component(&station.path, name(CAMERA, 0), Shape::new(4, 64));
    let mut sender = camera.sender(arm.name()).unwrap();
    let waits = thread::spawn(move || arm.receive(Some(PATIENCE)).err());
    thread::sleep(Duration::from_millis(20));
    station.end();
    assert_eq!(waits.join().unwrap(), Some(ReceiveError::Gone));
    assert!(matches!(sender.send(1, &[]), Err(SendError::NoMailbox(_))));
}

#[test]
fn senders_come_and_go_and_each_finds_a_lane_and_its_packages_come() {
    let station = Station::new();
    let (_sink, mut sink) = component(&station.path, name(ARM, 0), Shape::new(2, 8).senders(2));
    let (_from, from) = component(&station.path, name(CAMERA, 0), Shape::new(1, 1));
    for count in 0..200u8 {
        let mut sender = bound(&from, sink.name());
        sender.send(1, &[count, 0]).unwrap();
        sender.send(1, &[count, 1]).unwrap();
        assert!(sender.send(1, &[]).is_err());
        // Some have gone before anybody knew that they were there.
        if count % 2 == 0 {
            drop(sender);
        }
        for part in 0..2 {
            assert_eq!(sink.receive(Some(PATIENCE)).unwrap().body().to_vec(), [count, part]);
        }
        sink.depth().unwrap();
    }
    assert_eq!(sink.counted(of_owner::NONSENSE) + sink.counted(of_owner::FORGED), 0);
}
