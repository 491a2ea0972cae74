//! All ways in which the steps of a sender and the owner may come between each other, and in which words may be seen late, up
//! to so many changes from one to the other: loom tries each.

use loom::model::Builder;
use loom::sync::atomic::{self as watched, Ordering};
use loom::thread;

use super::super::layout::{HEAD, of_lane, of_slot};
use super::*;

/// A word that both sides deal with, or one that is only counted in.
enum Spot {
    Watched(watched::AtomicU64),
    Plain(AtomicU64),
}

impl Word for Spot {
    fn get(&self) -> u64 {
        match self {
            Spot::Watched(word) => word.load(Ordering::Relaxed),
            Spot::Plain(word) => Word::get(word),
        }
    }
    fn get_acquire(&self) -> u64 {
        match self {
            Spot::Watched(word) => word.load(Ordering::Acquire),
            Spot::Plain(word) => Word::get_acquire(word),
        }
    }
    fn set(&self, value: u64) {
        match self {
            Spot::Watched(word) => word.store(value, Ordering::Relaxed),
            Spot::Plain(word) => Word::set(word, value),
        }
    }
    fn set_release(&self, value: u64) {
        match self {
            Spot::Watched(word) => word.store(value, Ordering::Release),
            Spot::Plain(word) => Word::set_release(word, value),
        }
    }
    fn fence() {
        watched::fence(Ordering::SeqCst);
    }
}

type Spots = Arc<[Spot]>;

fn spots(count: usize, is_watched: impl Fn(usize) -> bool) -> Spots {
    let spot = |place| match is_watched(place) {
        true => Spot::Watched(watched::AtomicU64::new(0)),
        false => Spot::Plain(AtomicU64::new(0)),
    };
    (0..count).map(spot).collect()
}

/// A mailbox of one sender.
fn pair(shape: Shape) -> (Inbox<Spots, Spots>, LaneSender<Spots, Spots>) {
    let layout = Layout::of(&shape);
    let lane = layout.lane(0);
    let of_lane = [of_lane::RETURNED, of_lane::TAKING, of_lane::ANSWERED].map(|of| lane + of);
    let own = spots(layout.owner_words(1), |place| {
        place == of_owner::ASLEEP
            || of_lane.contains(&place)
            || (0..layout.ring as u64).any(|n| place == layout.returned(0, n))
    });
    let theirs = spots(layout.sender_words(), |place| {
        let in_slot = |slot| {
            [of_slot::NUMBER, of_slot::SENT, of_slot::HEAD, of_slot::BODY].map(|of| layout.slot(slot) + of)
        };
        [of_sender::PUBLISHED, of_sender::KEPT].contains(&place)
            || (0..HEAD).any(|word| place == layout.kept(0) + word)
            || (0..layout.ring as u64).any(|n| place == layout.announced(n))
            || (0..shape.slots).any(|slot| in_slot(slot).contains(&place))
    });
    let mut inbox = Inbox::new(own.clone(), &shape);
    inbox.attach(0, from(0), theirs.clone()).unwrap();
    (inbox, LaneSender::new(theirs, own, layout, 0))
}

fn receive(inbox: &mut Inbox<Spots, Spots>) -> Option<u64> {
    let package = inbox.receive(1_000)?;
    let mut bytes = [0; 8];
    package.body().copy_to(0, &mut bytes);
    let count = u64::from_ne_bytes(bytes);
    assert_eq!((package.stamps().sent, u64::from(package.head().id)), (count, count), "torn");
    Some(count)
}

fn try_all(changes: usize, course: impl Fn() + Sync + Send + 'static) {
    let mut builder = Builder::new();
    builder.preemption_bound = Some(changes);
    builder.check(course);
}

/// So many are sent while the owner looks twice, and whatever is left is read at the end.
fn sent_while_two_looks(sends: u64, shape: Shape) {
    let (mut inbox, mut sender) = pair(shape);
    let sending = thread::spawn(move || {
        let mut full = Vec::new();
        for count in 1..=sends {
            let told = sender.send(&head(0, 7, count as u8), &count.to_ne_bytes(), &at(count));
            if told == Err(SendError::Full(shape.slots)) {
                full.push(count);
            } else {
                told.unwrap();
            }
        }
        (sender, full)
    });
    let mut came: Vec<_> = (0..2).filter_map(|_| receive(&mut inbox)).collect();
    let (mut sender, full) = sending.join().unwrap();
    came.extend(std::iter::from_fn(|| receive(&mut inbox)));
    assert_eq!(sender.waiting(), Ok(0));
    let replaced = sender.segment().at(of_sender::REPLACED).get() as usize;
    assert_eq!(
        came.len() + replaced + full.len(),
        sends as usize,
        "came {came:?}, full {full:?}, replaced {replaced}"
    );
    assert!(came.is_sorted() && came.iter().all(|count| !full.contains(count)));
    assert!(replaced == 0 || shape.when_full == WhenFull::Replace);
}

#[test]
fn each_package_is_read_whole_or_its_sender_was_told() {
    for slots in [1, 2] {
        try_all(3, move || sent_while_two_looks(2, Shape::new(slots, 8).senders(1)));
    }
}

#[test]
fn each_package_is_read_whole_or_counted_as_replaced_or_its_sender_was_told() {
    let shape = Shape::new(1, 8).senders(1).replacing();
    try_all(3, move || sent_while_two_looks(2, shape));
    // A slot that is used again, and whose turn before may still be seen.
    try_all(2, move || sent_while_two_looks(3, shape));
}

#[test]
fn who_sleeps_is_woken_or_has_seen_what_came() {
    try_all(4, || {
        let (mut inbox, mut sender) = pair(Shape::new(1, 8).senders(1));
        let sending =
            thread::spawn(move || sender.send(&head(0, 7, 1), &1u64.to_ne_bytes(), &at(1)).unwrap());
        let sleeps = inbox.falls_asleep();
        let wakes = sending.join().unwrap();
        assert!(!sleeps || wakes, "it sleeps, and nobody wakes it");
        assert_eq!(receive(&mut inbox), Some(1));
    });
}

#[test]
fn a_refused_command_wakes_its_owner_or_is_seen() {
    try_all(4, || {
        let (mut inbox, mut sender) = pair(Shape::new(1, 8).senders(1).answering());
        sender.send(&head(0, 7, 1), &1u64.to_ne_bytes(), &at(1)).unwrap();
        let sending = thread::spawn(move || sender.send(&head(0, 7, 2), &[], &at(2)).unwrap());
        assert!(!inbox.falls_asleep(), "a package waits");
        let mut refused = Vec::new();
        inbox.take_refused_commands(&mut refused);
        assert!(sending.join().unwrap() || refused == [Head { len: 16, ..head(0, 7, 2) }]);
        inbox.wakes_up();
        inbox.take_refused_commands(&mut refused);
        assert_eq!(refused.len(), 1);
    });
}
