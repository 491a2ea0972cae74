mod hostile;
mod interleaved;
mod model;
mod threads;

use core::sync::atomic::AtomicU64;
use std::sync::Arc;

use rtnet::time::GlobalTime;

use super::layout::MOST_KEPT;
use super::*;
use crate::name::{Class, MailboxName};
use crate::wire::Head;

type Words = Arc<[AtomicU64]>;
type Owner = Inbox<Words, Words>;
type Sender = LaneSender<Words, Words>;

fn words(count: usize) -> Words {
    (0..count).map(|_| AtomicU64::new(0)).collect()
}

/// The mailbox from which the sender in a lane sends.
fn from(lane: usize) -> MailboxName {
    MailboxName::new(0, Class(0x80), lane as u8, 0)
}

fn own(inbox: &Owner, place: usize) -> u64 {
    inbox.segment().at(place).get()
}

fn sent(sender: &Sender, place: usize) -> u64 {
    sender.segment().at(place).get()
}

/// A sender in a free lane of a mailbox.
fn bound(inbox: &mut Owner, lane: usize) -> Sender {
    let segment = words(inbox.layout().sender_words());
    inbox.attach(lane, from(lane), segment.clone()).unwrap();
    LaneSender::new(segment, inbox.segment().clone(), *inbox.layout(), lane)
}

fn mailbox(shape: Shape) -> (Owner, Vec<Sender>) {
    shape.check().unwrap();
    let own = words(Layout::of(&shape).owner_words(shape.senders));
    let mut inbox = Inbox::new(own, &shape);
    let senders = (0..shape.senders).map(|lane| bound(&mut inbox, lane)).collect();
    (inbox, senders)
}

/// A head of a package of the sender in a lane.
fn head(lane: usize, priority: u8, id: u8) -> Head {
    Head { priority, id, kind: 1, from: from(lane), ..Head::default() }
}

fn at(sent: u64) -> Stamps {
    Stamps { sent, ..Stamps::default() }
}

/// All that waits: lane and id of each.
fn all(inbox: &mut Owner) -> Vec<(u8, u8)> {
    let mut all = Vec::new();
    while let Some(package) = inbox.receive(1_000_000) {
        all.push((package.head().from.instance(), package.head().id));
    }
    all
}

#[test]
fn the_most_urgent_comes_first_and_of_equals_who_was_sent_first() {
    let (mut inbox, mut senders) = mailbox(Shape::new(4, 8).senders(2));
    for (lane, priority, id, when) in
        [(0, 7, 1, 10), (1, 9, 2, 8), (1, 7, 3, 9), (0, 200, 4, 12), (1, 7, 5, 13)]
    {
        senders[lane].send(&head(lane, priority, id), &[], &at(when)).unwrap();
    }
    assert_eq!(inbox.depth(), 5);
    assert_eq!(all(&mut inbox), [(0, 4), (1, 2), (1, 3), (0, 1), (1, 5)]);
}

#[test]
fn a_package_comes_as_it_was_sent_of_whatever_length() {
    let (mut inbox, mut senders) = mailbox(Shape::new(2, 37).senders(1));
    let body: Vec<u8> = (1..=37).collect();
    for len in 0..=body.len() {
        let at = GlobalTime::from_nanos;
        let (left, came) = ((len % 2 == 0).then_some(at(6)), Some(at(7)));
        let stamps = match len % 3 {
            0 => Stamps { sent: 5, ..Stamps::default() },
            1 => Stamps { sent: 5, origin: Origin::Elsewhere(None), left, came },
            _ => Stamps { sent: 5, origin: Origin::Elsewhere(Some(at(u64::MAX))), left, came },
        };
        let sent = Head { kind: -6, ..head(0, 3, len as u8) };
        // In parts, as it lies in the buffers of a datagram.
        let mut slot = senders[0].reserve(3, len).unwrap();
        for part in body[..len].chunks(len % 7 + 1) {
            assert_eq!(slot.write(part), part.len());
        }
        assert_eq!(slot.write(&[0xee]), 0, "there is no room for more than was said");
        slot.publish(&sent, &stamps);
        let package = inbox.receive(9).unwrap();
        assert_eq!(*package.head(), Head { len: 16 + len as u32, ..sent });
        assert_eq!((package.stamps(), package.waited()), (stamps, 4));
        assert_eq!((package.body().len(), package.body().to_vec()), (len, body[..len].to_vec()));
        for skip in 0..=len + 1 {
            let mut room = [0xee; 20];
            let copied = package.body().copy_to(skip, &mut room);
            let expected = &body[skip.min(len)..len.min(skip + 20)];
            assert_eq!((&room[..copied], copied), (expected, expected.len()));
            assert!(room[copied..].iter().all(|&byte| byte == 0xee));
        }
    }
    assert!(inbox.receive(9).is_none());
}

#[test]
fn who_fills_its_slots_is_refused_at_once_and_nobody_else() {
    let (mut inbox, mut senders) = mailbox(Shape::new(3, 8).senders(2));
    for id in 0..3 {
        senders[0].send(&head(0, 200, id), &[id], &at(1)).unwrap();
    }
    for _ in 0..1_000_000 {
        assert_eq!(senders[0].send(&head(0, 255, 9), &[9], &at(2)), Err(SendError::Full(3)));
    }
    assert_eq!(sent(&senders[0], of_sender::FULL), 1_000_000);
    assert_eq!(senders[0].waiting(), Ok(3));
    senders[1].send(&head(1, 0, 7), &[], &at(3)).unwrap();
    assert_eq!(inbox.receive(4).map(|package| package.head().id), Some(0));
    assert_eq!(senders[0].waiting(), Ok(2));
    senders[0].send(&head(0, 1, 3), &[], &at(5)).unwrap();
    assert!(senders[0].send(&head(0, 1, 4), &[], &at(6)).is_err());
    assert_eq!(all(&mut inbox), [(0, 1), (0, 2), (0, 3), (1, 7)]);
}

#[test]
fn a_body_that_no_slot_holds_is_refused_and_what_is_not_published_takes_no_slot() {
    let (mut inbox, mut senders) = mailbox(Shape::new(1, 8).senders(1));
    let refused = Err(SendError::TooLarge { got: 9, most: 8 });
    assert_eq!(senders[0].send(&head(0, 1, 1), &[0; 9], &at(1)), refused);
    drop(senders[0].reserve(1, 8).unwrap());
    senders[0].send(&head(0, 1, 2), &[0; 8], &at(1)).unwrap();
    assert_eq!((sent(&senders[0], of_sender::TOO_LARGE), sent(&senders[0], of_sender::SENT)), (1, 1));
    assert_eq!(all(&mut inbox), [(0, 2)]);
}

#[test]
fn a_package_stays_where_there_is_too_little_room_for_it_and_where_it_is_put_back() {
    let (mut inbox, mut senders) = mailbox(Shape::new(4, 8).senders(1));
    senders[0].send(&head(0, 1, 1), &[1, 2, 3], &at(1)).unwrap();
    senders[0].send(&head(0, 1, 2), &[4], &at(2)).unwrap();
    let mut room = [0; 4];
    assert_eq!(inbox.receive_into(3, &mut room[..2]), Err(TooSmall { got: 2, needed: 3 }));
    inbox.receive(3).unwrap().put_back();
    senders[0].send(&head(0, 2, 3), &[], &at(3)).unwrap();
    let mut next = |room: &mut [u8]| inbox.receive_into(4, room).unwrap().map(|(head, len)| (head.id, len));
    assert_eq!(next(&mut room), Some((3, 0)));
    assert_eq!((next(&mut room), room), (Some((1, 3)), [1, 2, 3, 0]));
    assert_eq!(next(&mut room), Some((2, 1)));
    assert_eq!(next(&mut room), None);
    assert_eq!(own(&inbox, of_owner::RECEIVED), 3);
}

#[test]
fn who_says_to_be_somebody_else_is_not_heard_but_for_a_router() {
    let (mut inbox, mut senders) = mailbox(Shape::new(4, 8).senders(1));
    senders[0].send(&head(5, 1, 1), &[], &at(1)).unwrap();
    senders[0].send(&head(0, 1, 2), &[], &at(2)).unwrap();
    assert_eq!(all(&mut inbox), [(0, 2)]);
    assert_eq!(own(&inbox, of_owner::FORGED), 1);
    assert_eq!(senders[0].waiting(), Ok(0));
    inbox.leave(0);
    inbox.next_left().unwrap();
    let segment = words(inbox.layout().sender_words());
    inbox.attach(0, MailboxName::NOBODY, segment.clone()).unwrap();
    let mut router = LaneSender::new(segment, inbox.segment().clone(), *inbox.layout(), 0);
    router.send(&head(5, 1, 3), &[], &at(3)).unwrap();
    assert_eq!(all(&mut inbox), [(5, 3)]);
}

#[test]
fn where_the_new_replaces_the_old_the_oldest_of_the_least_urgent_makes_way_and_nothing_more_urgent() {
    let (mut inbox, mut senders) = mailbox(Shape::new(3, 8).senders(1).replacing());
    for (id, priority) in [(1, 5), (2, 9), (3, 5)] {
        senders[0].send(&head(0, priority, id), &[id], &at(id.into())).unwrap();
    }
    assert_eq!(inbox.depth(), 3);
    senders[0].send(&head(0, 5, 4), &[4], &at(4)).unwrap();
    assert_eq!(senders[0].send(&head(0, 4, 5), &[5], &at(5)), Err(SendError::Full(3)));
    senders[0].send(&head(0, 255, 6), &[6], &at(6)).unwrap();
    assert_eq!((sent(&senders[0], of_sender::REPLACED), sent(&senders[0], of_sender::FULL)), (2, 1));
    let bodies: Vec<_> =
        std::iter::from_fn(|| inbox.receive(7).map(|package| package.body().to_vec())).collect();
    assert_eq!(bodies, [[6], [2], [4]]);
    assert_eq!(senders[0].waiting(), Ok(0));
}

#[test]
fn a_sender_that_overtakes_who_does_not_look_leaves_the_newest_in_their_order() {
    let (mut inbox, mut senders) = mailbox(Shape::new(5, 8).senders(2).replacing());
    senders[1].send(&head(1, 9, 1), &[], &at(1)).unwrap();
    for id in 0..=200 {
        senders[0].send(&head(0, 9, id), &[id], &at(10 + u64::from(id))).unwrap();
    }
    assert_eq!(all(&mut inbox), [(1, 1), (0, 196), (0, 197), (0, 198), (0, 199), (0, 200)]);
    assert_eq!(sent(&senders[0], of_sender::REPLACED), 196);
    assert_eq!(own(&inbox, of_owner::NONSENSE), 0);
}

#[test]
fn a_package_that_is_being_read_does_not_make_way() {
    let (mut inbox, mut senders) = mailbox(Shape::new(1, 8).senders(1).replacing());
    senders[0].send(&head(0, 5, 1), &[1], &at(1)).unwrap();
    let package = inbox.receive(2).unwrap();
    assert_eq!(senders[0].send(&head(0, 5, 2), &[2], &at(2)), Err(SendError::Full(1)));
    assert_eq!(package.body().to_vec(), [1]);
    drop(package);
    senders[0].send(&head(0, 5, 3), &[3], &at(3)).unwrap();
    assert_eq!(sent(&senders[0], of_sender::REPLACED), 0, "it was read");
    // One that was put back meanwhile has made way after all.
    let package = inbox.receive(4).unwrap();
    assert_eq!(senders[0].send(&head(0, 5, 4), &[4], &at(4)), Err(SendError::Full(1)));
    package.put_back();
    senders[0].send(&head(0, 5, 5), &[5], &at(5)).unwrap();
    assert_eq!(all(&mut inbox), [(0, 5)]);
    assert_eq!(sent(&senders[0], of_sender::REPLACED), 1);
}

#[test]
fn what_a_sender_that_is_gone_has_sent_is_read_and_then_its_lane_is_another_s() {
    let (mut inbox, mut senders) = mailbox(Shape::new(2, 8).senders(2));
    senders[0].send(&head(0, 1, 1), &[], &at(1)).unwrap();
    inbox.leave(0);
    assert!(inbox.next_left().is_none(), "a package of it waits");
    assert_eq!(inbox.attach(0, from(0), words(1000)), Err(Taken));
    drop(senders.remove(0));
    assert_eq!(all(&mut inbox), [(0, 1)]);
    assert_eq!(inbox.next_left().map(|(lane, _)| lane), Some(0));
    assert!(inbox.next_left().is_none());
    let mut next = bound(&mut inbox, 0);
    for id in 5..7 {
        next.send(&head(0, 1, id), &[], &at(4)).unwrap();
    }
    assert_eq!(next.send(&head(0, 1, 7), &[], &at(4)), Err(SendError::Full(2)));
    assert_eq!(inbox.refused(), 1);
    assert_eq!(all(&mut inbox), [(0, 5), (0, 6)]);
    assert_eq!(next.waiting(), Ok(0));
    inbox.leave(0);
    assert_eq!(
        (inbox.next_left().is_some(), inbox.refused()),
        (true, 1),
        "a sender that has gone counts, too"
    );
}

#[test]
fn only_who_sleeps_is_woken_and_nobody_sleeps_while_something_waits() {
    let (mut inbox, mut senders) = mailbox(Shape::new(2, 8).senders(1));
    assert_eq!(senders[0].send(&head(0, 1, 1), &[], &at(1)), Ok(false));
    assert!(!inbox.falls_asleep());
    assert_eq!(senders[0].send(&head(0, 1, 2), &[], &at(2)), Ok(false));
    assert_eq!(all(&mut inbox).len(), 2);
    assert!(inbox.falls_asleep());
    let awaited = |inbox: &Owner| inbox.awaited().map(|(word, seen)| (word.get(), seen)).collect::<Vec<_>>();
    assert_eq!(awaited(&inbox), [(2, 2)]);
    assert_eq!(senders[0].send(&head(0, 1, 3), &[], &at(4)), Ok(true));
    assert_eq!(awaited(&inbox), [(3, 2)]);
    inbox.wakes_up();
    assert_eq!(all(&mut inbox), [(0, 3)]);
}

/// The ids of the refused commands of each sender that it takes to answer.
fn refused(inbox: &mut Owner) -> Vec<(u8, u8)> {
    let mut heads = Vec::new();
    inbox.take_refused_commands(&mut heads);
    heads.iter().map(|head| (head.from.instance(), head.id)).collect()
}

#[test]
fn refused_commands_are_kept_for_the_owner_to_answer() {
    let (mut inbox, mut senders) = mailbox(Shape::new(1, 8).senders(2).answering());
    for (lane, sender) in senders.iter_mut().enumerate() {
        assert_eq!(sender.send(&head(lane, 9, 0), &[], &at(1)), Ok(false));
        let data = Head { kind: 0, ..head(lane, 9, 1) };
        assert_eq!(sender.send(&data, &[], &at(1)), Err(SendError::Full(1)), "no answer is awaited");
    }
    // Five times as many as are kept at once.
    for turn in 0..5 {
        let ids = (0..MOST_KEPT).map(|count| (count + turn) as u8);
        for id in ids.clone() {
            assert_eq!(senders[1].send(&head(1, 9, id), &[0; 8], &at(2)), Ok(turn > 0));
        }
        let (one_more, full) = (head(1, 9, turn as u8), Err(SendError::Full(1)));
        assert_eq!(senders[1].send(&one_more, &[], &at(2)), full, "as many as there are ids are kept");
        let kept: Vec<_> = ids.map(|id| (1, id)).collect();
        assert_eq!((refused(&mut inbox), refused(&mut inbox)), (kept, vec![]));
        assert!(!inbox.falls_asleep(), "two packages wait, but a refused command wakes it");
    }
    assert_eq!(inbox.refused(), 2 + 5 * (MOST_KEPT as u64 + 1));
    assert_eq!(all(&mut inbox), [(0, 0), (1, 0)]);
    assert_eq!(senders[0].send(&head(0, 9, 2), &[], &at(3)), Ok(false), "a package does not wake it");
}

#[test]
fn a_lane_is_free_once_its_refused_commands_are_taken() {
    let (mut inbox, mut senders) = mailbox(Shape::new(1, 8).senders(1).answering());
    for id in 0..3 {
        senders[0].send(&head(0, 9, id), &[], &at(1)).unwrap();
    }
    inbox.leave(0);
    assert_eq!(all(&mut inbox), [(0, 0)]);
    assert!(inbox.next_left().is_none(), "two commands are not answered");
    assert_eq!(refused(&mut inbox), [(0, 1), (0, 2)]);
    assert_eq!(inbox.next_left().map(|(lane, _)| lane), Some(0));
    let mut next = bound(&mut inbox, 0);
    for id in 3..6 {
        next.send(&head(0, 9, id), &[], &at(2)).unwrap();
    }
    assert_eq!(refused(&mut inbox), [(0, 4), (0, 5)], "the next sender goes on where it was");
}

#[test]
fn a_mailbox_that_is_cleaned_is_empty_and_counts_what_it_threw_away() {
    let (mut inbox, mut senders) = mailbox(Shape::new(4, 8).senders(2));
    for id in 0..4 {
        senders[usize::from(id) % 2].send(&head(usize::from(id) % 2, id, id), &[], &at(1)).unwrap();
    }
    assert_eq!(inbox.clean(2), 4);
    assert_eq!((inbox.depth(), inbox.clean(3)), (0, 0));
    assert_eq!((own(&inbox, of_owner::CLEANED), own(&inbox, of_owner::RECEIVED)), (4, 0));
    assert_eq!(own(&inbox, of_owner::MOST), 4);
    assert_eq!(senders[0].waiting(), Ok(0));
}

#[test]
fn how_long_packages_took_is_counted_when_they_are_read() {
    let (mut inbox, mut senders) = mailbox(Shape::new(4, 8).senders(1));
    for when in [100, 200, 900] {
        senders[0].send(&head(0, 1, 1), &[], &at(when)).unwrap();
    }
    while inbox.receive(1_000).is_some() {}
    let latencies = Latencies::read(inbox.segment(), of_owner::LATENCIES);
    assert_eq!(latencies.count(), 3);
    assert!((900..=1125).contains(&latencies.quantile(1.0).unwrap()));
    assert!((100..=125).contains(&latencies.quantile(0.1).unwrap()));
}
