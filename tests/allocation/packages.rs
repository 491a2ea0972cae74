//! Mailboxes and senders: once they are there, nothing that is done with them allocates, on either side.

use std::sync::Arc;
use std::sync::Barrier;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use package_router::broker::Broker;
use package_router::component::{Component, Mailbox, ReceiveError, SendError, Sender};
use package_router::mailbox::{self, MOST_SENDERS, Shape, of_owner, of_sender};
use package_router::name::{Class, MailboxName};
use package_router::wire::Head;

use crate::calls;

const ARM: MailboxName = MailboxName::new(0, Class(0x80), 1, 0);
const CAMERA: MailboxName = MailboxName::new(0, Class(0x81), 1, 0);
const SOON: Option<Duration> = Some(Duration::ZERO);
const PATIENCE: Option<Duration> = Some(Duration::from_secs(20));
const ROUNDS: usize = 200;

/// A broker in a thread of its own, whose allocations are its own.
struct Station {
    is_over: Arc<AtomicBool>,
    serves: Option<JoinHandle<()>>,
    dir: tempfile::TempDir,
}

impl Station {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut broker = Broker::bind(&dir.path().join("station.packages")).unwrap();
        let is_over = Arc::new(AtomicBool::new(false));
        let over = is_over.clone();
        let serves = thread::spawn(move || {
            while !over.load(Ordering::Relaxed) {
                broker.serve(Duration::from_millis(20));
            }
        });
        Self { is_over, serves: Some(serves), dir }
    }

    fn mailbox(&self, name: MailboxName, shape: Shape) -> (Component, Mailbox) {
        let component = Component::attach(&self.dir.path().join("station.packages")).unwrap();
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

/// What it allocates, and what comes of it.
fn counted<T>(does: impl FnOnce() -> T) -> (u64, T) {
    let before = calls();
    let done = does();
    (calls() - before, done)
}

/// Everything that is done with a mailbox, so often that each of its slots and rings is gone around.
fn everything(mailbox: &mut Mailbox, sender: &mut Sender, slots: usize, largest: usize) -> [usize; 4] {
    let (bytes, mut room) = ([7; 300], [0; 300]);
    let (mut sent, mut full, mut received, mut cleaned) = (0, 0, 0, 0);
    for round in 0..ROUNDS {
        for more in 0..slots * 3 / 2 + 1 {
            sender.set_priority((round * 31 + more * 7) as u8);
            let told = if more % 2 == 0 {
                sender.send(1, &bytes[..(round + more) % (largest + 1)])
            } else {
                let head = Head { kind: -6, priority: more as u8, id: 3, ..Head::default() };
                sender.send_with(&head, &bytes[..largest]).map(|()| 3)
            };
            match told {
                Ok(_) => sent += 1,
                Err(SendError::Mailbox(mailbox::SendError::Full(_))) => full += 1,
                Err(error) => panic!("{error}"),
            }
        }
        assert!(sender.send(1, &bytes[..largest + 1]).is_err(), "it is too large");
        let depth = mailbox.depth().unwrap();
        mailbox.receive(SOON).unwrap().put_back();
        assert!(matches!(mailbox.receive_into(&mut [], SOON), Ok((_, 0)) | Err(ReceiveError::TooSmall(_))));
        // The last of them may have been empty, and so was received.
        received += depth - mailbox.depth().unwrap();
        for turn in 0..depth / 2 {
            match turn % 3 {
                0 => {
                    let Ok(package) = mailbox.receive(PATIENCE) else { continue };
                    assert!(package.body().copy_to(0, &mut room) == package.body().len());
                }
                1 => assert!(mailbox.try_receive().unwrap().is_some()),
                _ => assert!(mailbox.receive_into(&mut room, SOON).is_ok()),
            }
            received += 1;
        }
        if round % 2 == 0 {
            cleaned += mailbox.clean().unwrap();
        }
        while mailbox.try_receive().unwrap().is_some() {
            received += 1;
        }
        assert_eq!(mailbox.receive(SOON).err(), Some(ReceiveError::TimedOut));
        assert_eq!(mailbox.depth(), Ok(0));
    }
    [sent, full, received, cleaned]
}

fn check_everything(shape: Shape, expected_full: bool) -> (Sender, [usize; 4]) {
    let station = Station::new();
    let (_arm, mut arm) = station.mailbox(ARM, shape);
    let (_camera, camera) = station.mailbox(CAMERA, Shape::new(1, 1));
    let mut sender = camera.sender(ARM).unwrap();
    // It is bound: that it is there is seen by the owner when it looks first.
    let (allocations, told) = counted(|| everything(&mut arm, &mut sender, shape.slots, shape.largest_body));
    let [sent, full, received, cleaned] = told;
    assert_eq!(full > 0, expected_full, "{told:?}");
    let replaced = sender.counted(of_sender::REPLACED) as usize;
    assert_eq!(sent, received + cleaned + replaced, "{told:?}, {replaced} replaced");
    assert_eq!(arm.counted(of_owner::RECEIVED), received as u64);
    assert!(sent >= ROUNDS && received > 0 && cleaned > 0, "{told:?}");
    assert_eq!(allocations, 0);
    (sender, told)
}

#[test]
fn what_is_sent_received_put_back_and_cleaned_away_takes_no_memory_of_its_own() {
    for shape in
        [Shape::new(16, 240), Shape::new(1, 8), Shape::new(5, 0), Shape::new(64, 100).senders(MOST_SENDERS)]
    {
        check_everything(shape, true);
    }
}

#[test]
fn what_makes_way_for_what_is_newer_takes_none_either() {
    for shape in [Shape::new(16, 240), Shape::new(1, 8), Shape::new(33, 1)] {
        // The least urgent of those that come then find no room.
        let (sender, _) = check_everything(shape.replacing(), true);
        assert!(sender.counted(of_sender::REPLACED) > 0);
    }
}

#[test]
fn an_owner_that_was_overtaken_ten_times_over_sorts_without_memory() {
    let station = Station::new();
    let (_arm, mut arm) = station.mailbox(ARM, Shape::new(16, 8).replacing());
    let mut sender = arm.sender(ARM).unwrap();
    let (allocations, received) = counted(|| {
        let mut received = 0;
        for _ in 0..ROUNDS {
            (0..160u8).for_each(|count| assert!(sender.send(1, &[count]).is_ok()));
            for count in 144..160 {
                let mut room = [0; 1];
                assert!(arm.receive_into(&mut room, SOON).is_ok_and(|_| room == [count]));
                received += 1;
            }
        }
        received
    });
    assert_eq!((received, arm.depth()), (16 * ROUNDS, Ok(0)));
    assert_eq!(allocations, 0);
}

#[test]
fn a_sender_that_comes_and_goes_takes_no_memory_of_the_owners() {
    let station = Station::new();
    let (_arm, mut arm) = station.mailbox(ARM, Shape::new(4, 8).senders(2));
    let (_camera, camera) = station.mailbox(CAMERA, Shape::new(1, 1));
    let turn = Arc::new(Barrier::new(2));
    let theirs = turn.clone();
    let comes_and_goes = thread::spawn(move || {
        for count in 0..ROUNDS {
            let mut sender = camera.sender(ARM).unwrap();
            sender.send(1, &count.to_ne_bytes()).unwrap();
            if count % 2 == 0 {
                drop(sender);
                theirs.wait();
                theirs.wait();
            } else {
                theirs.wait();
                theirs.wait();
                drop(sender);
            }
        }
    });
    let mut allocations = 0;
    for count in 0..ROUNDS {
        turn.wait();
        let (more, came) = counted(|| {
            let mut room = [0; 8];
            let came = arm.receive_into(&mut room, PATIENCE).map(|_| usize::from_ne_bytes(room));
            // It looks, and says that all is read of who has gone.
            (came, arm.depth())
        });
        allocations += more;
        assert_eq!(came, (Ok(count), Ok(0)));
        turn.wait();
        // Whoever has gone meanwhile: their lane is another's next time.
        let (more, _) = counted(|| arm.depth());
        allocations += more;
    }
    comes_and_goes.join().unwrap();
    assert_eq!(arm.counted(of_owner::RECEIVED), ROUNDS as u64);
    assert_eq!(allocations, 0);
}

#[test]
fn who_sleeps_and_is_woken_takes_no_memory_and_neither_does_who_wakes() {
    // So often it must have slept: a busy host may keep it from doing so in time.
    const WAKES: u32 = 30;
    let station = Station::new();
    let (_arm, mut arm) = station.mailbox(ARM, Shape::new(4, 8));
    let (_camera, camera) = station.mailbox(CAMERA, Shape::new(1, 1));
    let mut sender = camera.sender(ARM).unwrap();
    let (turn, is_over) = (Arc::new(Barrier::new(2)), Arc::<AtomicBool>::default());
    let (theirs, over) = (turn.clone(), is_over.clone());
    let wakes = thread::spawn(move || {
        let mut allocations = 0;
        for count in 0u32.. {
            theirs.wait();
            if over.load(Ordering::Relaxed) {
                break;
            }
            thread::sleep(Duration::from_millis(2));
            allocations += counted(|| sender.send(1, &count.to_ne_bytes()).unwrap()).0;
        }
        allocations
    });
    let (mut allocations, mut slept, deadline) = (0, 0, Instant::now() + Duration::from_secs(60));
    for count in 0.. {
        is_over.store(slept == WAKES || Instant::now() > deadline, Ordering::Relaxed);
        turn.wait();
        if is_over.load(Ordering::Relaxed) {
            break;
        }
        let begun = Instant::now();
        let (more, came) = counted(|| {
            let mut room = [0; 4];
            arm.receive_into(&mut room, PATIENCE).map(|_| u32::from_ne_bytes(room))
        });
        allocations += more;
        assert_eq!(came, Ok(count));
        slept += u32::from(begun.elapsed() > Duration::from_millis(1));
        // And who waits in vain.
        let (more, told) = counted(|| arm.receive(Some(Duration::from_micros(300))).err());
        allocations += more;
        assert_eq!(told, Some(ReceiveError::TimedOut));
    }
    assert_eq!((wakes.join().unwrap(), allocations, slept), (0, 0, WAKES));
}
