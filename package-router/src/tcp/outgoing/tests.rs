use super::*;
use crate::name::MailboxName;
use crate::wire::Endian;

const SOURCE: Source = Source { place: 3, number: 7 };

fn head(priority: u8, id: u8, body: usize) -> Head {
    Head { priority, id, ..Head::new(1, MailboxName(1), MailboxName(2)) }.with_body(body).unwrap()
}

/// Priority and id of each package that leaves, if each write takes `at_once` bytes.
fn leaves(queue: &mut Outgoing, at_once: usize) -> Vec<(u8, u8)> {
    let mut bytes = Vec::new();
    while !queue.is_empty() {
        queue.write(|slices| Ok(taken(&mut bytes, slices, at_once)), &mut Vec::new()).unwrap();
    }
    let mut seen = Vec::new();
    super::super::frames::Frames::default()
        .cut(&bytes, |head, _| seen.push((head.priority, head.id)))
        .unwrap();
    assert_eq!((queue.bytes(), queue.packages(), queue.oldest(9)), (0, 0, None));
    seen
}

fn taken(bytes: &mut Vec<u8>, slices: &[IoSlice<'_>], at_once: usize) -> usize {
    let all: Vec<u8> = slices.iter().flat_map(|slice| slice.iter().copied()).take(at_once).collect();
    bytes.extend(&all);
    all.len()
}

#[test]
fn the_most_urgent_leaves_first_and_of_equals_the_oldest() {
    for at_once in 1..200 {
        let mut queue = Outgoing::new(1 << 16);
        for (id, priority) in (0..).zip([5, 200, 5, 0, 255, 200]) {
            queue.push(&head(priority, id, 20), &[id; 20], (SOURCE, 7), |_, _| ()).unwrap();
        }
        assert_eq!((queue.oldest(9), queue.packages(), queue.bytes()), (Some(2), 6, 6 * 36));
        let own = Head { id: 99, ..Head::new(17, MailboxName::NOBODY, MailboxName::NOBODY) };
        queue.push_own(&own, &[], 8).unwrap();
        let order = [(0, 99), (255, 4), (200, 1), (200, 5), (5, 0), (5, 2), (0, 3)];
        assert_eq!(leaves(&mut queue, at_once), order, "{at_once} bytes at once");
    }
}

#[test]
fn a_package_that_has_begun_is_ended_before_what_is_more_urgent() {
    for begun in 1..40 {
        let mut queue = Outgoing::new(1 << 16);
        queue.push(&head(1, 0, 24), &[0; 24], (SOURCE, 0), |_, _| ()).unwrap();
        queue.push(&head(1, 1, 24), &[0; 24], (SOURCE, 0), |_, _| ()).unwrap();
        let (mut bytes, mut first) = (Vec::new(), true);
        let once = |slices: &[IoSlice<'_>]| match core::mem::take(&mut first) {
            true => Ok(taken(&mut bytes, slices, begun)),
            false => Err(io::ErrorKind::WouldBlock.into()),
        };
        assert!(!queue.write(once, &mut Vec::new()).unwrap());
        queue.push(&head(9, 2, 24), &[0; 24], (SOURCE, 0), |_, _| ()).unwrap();
        assert!(queue.write(|slices| Ok(taken(&mut bytes, slices, 7).max(1)), &mut Vec::new()).is_ok());
        while !queue.is_empty() {
            queue.write(|slices| Ok(taken(&mut bytes, slices, 7)), &mut Vec::new()).unwrap();
        }
        let mut seen = Vec::new();
        super::super::frames::Frames::default().cut(&bytes, |head, _| seen.push(head.id)).unwrap();
        assert_eq!(seen, [0, 2, 1], "{begun} bytes had left");
    }
}

#[test]
fn the_oldest_of_the_least_urgent_makes_room() {
    let mut queue = Outgoing::new(3 * 36);
    let mut push = |priority, id, body: usize| {
        let mut dropped = Vec::new();
        let pushed = queue
            .push(&head(priority, id, body), &vec![0; body], (SOURCE, 0), |head, _| dropped.push(head.id));
        pushed.map(|()| dropped)
    };
    assert_eq!(push(3, 0, 20), Ok(vec![]));
    assert_eq!(push(1, 1, 20), Ok(vec![]));
    assert_eq!(push(1, 2, 20), Ok(vec![]));
    assert_eq!(push(1, 3, 20), Err(Full), "none of its own priority makes room");
    assert_eq!(push(2, 4, 20), Ok(vec![1]));
    assert_eq!(push(3, 5, 56), Ok(vec![2, 4]));
    assert_eq!(push(9, 6, 200), Err(Full), "it is longer than the queue");
    assert_eq!(push(3, 7, 0), Err(Full));
    assert_eq!(leaves(&mut queue, 1_000), [(3, 0), (3, 5)], "what could not help was not dropped");
}

#[test]
fn what_has_begun_is_not_dropped() {
    let mut queue = Outgoing::new(3 * 36);
    for id in 0..3 {
        queue.push(&head(1, id, 20), &[id; 20], (SOURCE, 0), |_, _| ()).unwrap();
    }
    let (mut bytes, mut first) = (Vec::new(), true);
    let once = |slices: &[IoSlice<'_>]| match core::mem::take(&mut first) {
        true => Ok(taken(&mut bytes, slices, 10)),
        false => Err(io::ErrorKind::WouldBlock.into()),
    };
    assert!(!queue.write(once, &mut Vec::new()).unwrap());
    let mut dropped = Vec::new();
    queue.push(&head(2, 8, 20), &[8; 20], (SOURCE, 0), |head, _| dropped.push(head.id)).unwrap();
    queue.push(&head(2, 9, 20), &[9; 20], (SOURCE, 0), |head, _| dropped.push(head.id)).unwrap();
    assert_eq!(dropped, [1, 2]);
    assert_eq!(
        queue.push(&head(3, 10, 20), &[0; 20], (SOURCE, 0), |_, _| ()),
        Ok(()),
        "one of priority 2 goes"
    );
    while !queue.is_empty() {
        queue.write(|slices| Ok(taken(&mut bytes, slices, 1_000)), &mut Vec::new()).unwrap();
    }
    let mut seen = Vec::new();
    let frames = &mut super::super::frames::Frames::default();
    frames
        .cut(&bytes, |head, body| seen.push((head.id, body.iter().all(|byte| *byte == head.id % 10))))
        .unwrap();
    assert_eq!(seen, [(0, true), (10, true), (9, true)]);
    assert_eq!(head(1, 0, 0).head_order, Endian::Little);
}

#[test]
fn answers_to_a_peer_that_does_not_read_are_bounded() {
    let mut queue = Outgoing::new(100);
    let own = Head::new(0, MailboxName::NOBODY, MailboxName::NOBODY);
    let taken = (0..10_000).filter(|_| queue.push_own(&own, &[], 0).is_ok()).count();
    assert_eq!(taken, OWN_AT_MOST / HEAD_LEN);
    assert_eq!((queue.bytes(), queue.oldest(9)), (0, None), "they are not packages");
}

#[test]
fn memory_is_given_back() {
    let mut queue = Outgoing::new(1 << 20);
    for priority in 0..=255 {
        queue.push(&head(priority, 0, 2_000), &[0; 2_000], (SOURCE, 0), |_, _| ()).unwrap();
    }
    let held = |queue: &Outgoing| queue.levels.iter().map(|level| level.bytes.capacity()).sum::<usize>();
    leaves(&mut queue, 1 << 20);
    queue.shrink();
    assert!(held(&queue) <= LEVELS_KEPT * BYTES_KEPT, "{}", held(&queue));
}

/// One priority after the other fills the queue, and what waits is displaced or leaves.
#[test]
fn memory_of_many_priorities_is_bounded_at_all_times() {
    let most = 1 << 20;
    for is_read in [false, true] {
        let mut queue = Outgoing::new(most);
        for priority in 0..=255 {
            for id in 0..=255 {
                queue.push(&head(priority, id, 4_080), &[0; 4_080], (SOURCE, 0), |_, _| ()).unwrap();
            }
            let mut left = if is_read { queue.bytes() - 4_096 } else { 0 };
            let read = |slices: &[IoSlice<'_>]| {
                let all: usize = slices.iter().map(|slice| slice.len()).sum();
                let now = all.min(left);
                left -= now;
                if now == 0 { Err(io::ErrorKind::WouldBlock.into()) } else { Ok(now) }
            };
            queue.write(read, &mut Vec::new()).unwrap();
            let held: usize = queue.levels.iter().map(|level| level.bytes.capacity()).sum();
            assert!(held <= 4 * most + 256 * TRIMMED_AT[1], "{held} bytes at priority {priority}");
        }
    }
}
