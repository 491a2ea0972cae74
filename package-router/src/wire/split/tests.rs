use super::*;
use crate::wire::Endian;
use proptest::prelude::*;

/// The head of a package of so many bytes of body.
fn package(body_len: usize) -> Head {
    let (to, from) = (MailboxName(0x0012_0001), MailboxName(0x0018_0000));
    Head { priority: 231, id: 42, ..Head::new(21, to, from) }.with_body(body_len).unwrap()
}

fn pieces(body_len: usize, most_datagram: usize) -> Vec<Piece> {
    split(&package(body_len), most_datagram).unwrap().collect()
}

/// Puts pieces together as they come, up to the first that is wrong.
fn join(pieces: &[Piece]) -> Result<(Head, Vec<Range<usize>>, bool), JoinError> {
    let (mut joining, first) = Joining::begin(&pieces[0].head, pieces[0].body.len())?;
    let (mut places, mut is_complete) = (vec![first], false);
    for piece in &pieces[1..] {
        let placed = joining.next(&piece.head, piece.body.len())?;
        places.push(placed.at);
        is_complete = placed.is_complete;
    }
    Ok((*joining.head(), places, is_complete))
}

#[test]
fn up_to_the_longest_datagram_a_package_is_one() {
    for body_len in [0, 1, MOST_DATAGRAM - HEAD_LEN] {
        let expected = Piece { head: package(body_len), body: 0..body_len };
        assert_eq!(pieces(body_len, MOST_DATAGRAM), [expected], "{body_len}");
    }
    assert_eq!(pieces(MOST_DATAGRAM - HEAD_LEN + 1, MOST_DATAGRAM).len(), 2);
}

#[test]
fn the_first_part_says_the_whole_length_and_each_further_one_its_own() {
    let whole = package(250);
    let part = |part, id, len| Head { part, id, len, ..whole };
    assert_eq!(
        pieces(250, 116),
        [
            Piece { head: part(Part::First, 42, 266), body: 0..100 },
            Piece { head: part(Part::Middle, 1, 116), body: 100..200 },
            Piece { head: part(Part::Last, 2, 66), body: 200..250 },
        ]
    );
    let flags: Vec<u8> = pieces(250, 116).iter().map(|piece| piece.head.to_bytes()[0]).collect();
    assert_eq!(flags, [0x07, 0x0b, 0x0f]);
}

#[test]
fn parts_keep_the_orders_of_their_package() {
    let java = Head { head_order: Endian::Big, body_order: Endian::Big, ..package(30) };
    let flags: Vec<u8> = split(&java, 36).unwrap().map(|piece| piece.head.to_bytes()[0]).collect();
    assert_eq!(flags, [0x04, 0x0c]);
    assert_eq!(split(&java, 36).unwrap().len(), 2);
}

#[test]
fn the_longest_package_takes_five_of_the_longest_datagrams() {
    let largest = MAX_LEN - HEAD_LEN;
    let pieces = pieces(largest, usize::MAX);
    let lens: Vec<_> = pieces.iter().map(|piece| HEAD_LEN + piece.body.len()).collect();
    assert_eq!(lens, [65_507, 65_507, 65_507, 65_507, 180]);
    assert_eq!(join(&pieces).map(|(head, _, is_complete)| (head, is_complete)), Ok((package(largest), true)));
}

#[test]
fn more_parts_than_there_are_numbers_are_refused_with_what_would_do() {
    let head = package(MAX_LEN - HEAD_LEN);
    assert_eq!(split(&head, 1_040).unwrap().len(), MOST_PARTS, "numbered 1 to 255 behind the first");
    let error = split(&head, 1_039).unwrap_err();
    assert_eq!(error, SplitError::TooManyParts { len: 262_144, most_datagram: 1_039, least: 1_040 });
    assert!(error.to_string().ends_with("it takes datagrams of 1040 or more"), "{error}");
    assert_eq!(split(&package(256), 17).unwrap().len(), MOST_PARTS);
    assert!(split(&package(257), 17).is_err());
    assert_eq!(split(&package(0), 16).unwrap().len(), 1);
    for nothing in [0, 15, 16] {
        assert!(split(&package(1), nothing).is_err(), "{nothing}: no room behind the head");
    }
}

#[test]
fn a_head_that_nobody_checked_is_not_split() {
    for len in [0, 15, 262_145, u32::MAX] {
        assert_eq!(split(&Head { len, ..Head::default() }, 1_472).err(), Some(SplitError::Len(len)));
    }
}

#[test]
fn a_part_that_is_missing_doubled_or_early_ends_the_package() {
    let all = pieces(500, 116);
    let of = |order: &[usize]| order.iter().map(|&at| all[at].clone()).collect::<Vec<_>>();
    let wrong = |expected, got| Err(JoinError::WrongNumber { expected, got });
    assert_eq!(join(&of(&[0, 2, 3, 4])), wrong(1, 2), "the second is missing");
    assert_eq!(join(&of(&[0, 1, 2, 4])), wrong(3, 4), "the last but one is missing");
    assert_eq!(join(&of(&[0, 1, 1, 2, 3, 4])), wrong(2, 1), "one is doubled");
    assert_eq!(join(&of(&[0, 2, 1, 3, 4])), wrong(1, 2), "two are swapped");
    assert_eq!(join(&of(&[0, 4, 3, 2, 1])), wrong(1, 4), "all further ones are reversed");
    assert_eq!(join(&of(&[4, 3, 2, 1, 0])), Err(JoinError::NotFirst(4)), "all are reversed");
    assert_eq!(join(&of(&[0, 0, 1, 2, 3, 4])), Err(JoinError::FirstAgain));
    assert_eq!(
        join(&of(&[0, 1, 2, 3])).map(|(.., is_complete)| is_complete),
        Ok(false),
        "the last is missing"
    );
    assert_eq!(join(&of(&[0, 1, 2, 3, 4, 4])), wrong(5, 4), "nothing follows the last");
}

#[test]
fn a_whole_package_is_no_part() {
    let whole = package(100);
    let first = &pieces(100, 76)[0];
    assert_eq!(Joining::begin(&whole, 100).err(), Some(JoinError::IsWhole));
    let (mut joining, _) = Joining::begin(&first.head, 60).unwrap();
    assert_eq!(joining.next(&whole, 100), Err(JoinError::IsWhole));
}

#[test]
fn a_part_of_another_package_changes_nothing() {
    let pieces = pieces(100, 76);
    let (mut joining, _) = Joining::begin(&pieces[0].head, 60).unwrap();
    let theirs = MailboxName(0x0019_0000);
    for head in [Head { from: theirs, ..pieces[1].head }, Head { to: theirs, ..pieces[1].head }] {
        let Head { from, to, .. } = head;
        assert_eq!(joining.next(&head, 40), Err(JoinError::OtherPackage { from, to }));
    }
    assert_eq!(joining.next(&pieces[1].head, 40), Ok(Placed { at: 60..100, is_complete: true }));
    assert_eq!(joining.head(), &package(100));
}

#[test]
fn a_first_part_holds_something_and_leaves_something() {
    let first = Head { part: Part::First, ..package(100) };
    assert_eq!(Joining::begin(&first, 0).err(), Some(JoinError::Empty));
    assert!(Joining::begin(&first, 99).is_ok());
    for came in [100, 101, usize::MAX] {
        assert_eq!(Joining::begin(&first, came).err(), Some(JoinError::Overlong { len: 100, came }));
    }
}

#[test]
fn every_lie_about_a_further_parts_length_is_refused() {
    let first = Head { part: Part::First, ..package(100) };
    let further = |part, body_len: usize| Head { part, id: 1, ..package(body_len) };
    let next = |head: Head, got| Joining::begin(&first, 60).unwrap().0.next(&head, got);
    for (said, got) in [(40, 39), (40, 41), (40, 0), (0, 40), (39, 40), (41, 40)] {
        assert_eq!(next(further(Part::Last, said), got), Err(JoinError::WrongLen { said, got }));
    }
    assert_eq!(next(further(Part::Middle, 0), 0), Err(JoinError::Empty));
    assert_eq!(next(further(Part::Last, 0), 0), Err(JoinError::Empty));
    assert_eq!(next(further(Part::Last, 39), 39), Err(JoinError::Incomplete { len: 100, came: 99 }));
    assert_eq!(next(further(Part::Last, 41), 41), Err(JoinError::Overlong { len: 100, came: 101 }));
    assert_eq!(next(further(Part::Middle, 39), 39), Ok(Placed { at: 60..99, is_complete: false }));
    assert_eq!(next(further(Part::Middle, 40), 40), Err(JoinError::Overlong { len: 100, came: 100 }));
    assert_eq!(next(further(Part::Last, 40), 40), Ok(Placed { at: 60..100, is_complete: true }));
}

#[test]
fn behind_part_255_there_is_no_number_left() {
    let whole = package(1_000);
    let first = Head { part: Part::First, ..whole };
    let (mut joining, _) = Joining::begin(&first, 1).unwrap();
    let part = |id| Head { part: Part::Middle, id, len: 17, ..whole };
    for id in 1..=255 {
        assert!(joining.next(&part(id), 1).is_ok(), "{id}");
    }
    for got in [0, 1, 255] {
        assert_eq!(joining.next(&part(got), 1), Err(JoinError::WrongNumber { expected: 256, got }));
    }
}

proptest! {
    #[test]
    fn what_is_split_and_joined_is_what_it_was(
        body in prop::collection::vec(any::<u8>(), 0..4_000),
        room in 0usize..5_000,
        id in any::<u8>(),
    ) {
        let head = Head { id, ..package(body.len()) };
        let most_datagram = least_datagram(body.len()) + room;
        let pieces: Vec<_> = split(&head, most_datagram).unwrap().collect();
        prop_assert!(pieces.iter().all(|piece| HEAD_LEN + piece.body.len() <= most_datagram));
        if let [piece] = &pieces[..] {
            prop_assert_eq!(piece, &Piece { head, body: 0..body.len() });
            prop_assert!(HEAD_LEN + body.len() <= most_datagram);
            return Ok(());
        }
        let (joined, places, is_complete) = join(&pieces).unwrap();
        prop_assert_eq!((joined, is_complete), (head, true));
        let mut copy = vec![0; body.len()];
        for (piece, place) in pieces.into_iter().zip(places) {
            copy[place].copy_from_slice(&body[piece.body]);
        }
        prop_assert_eq!(copy, body);
    }

    #[test]
    fn no_parts_whatever_are_placed_outside_the_body_or_twice(
        body_len in 0usize..200,
        first_len in 0usize..220,
        parts in prop::collection::vec((0usize..4, 0u8..6, 0usize..80, 0usize..80), 0..8),
    ) {
        let first = Head { part: Part::First, ..package(body_len) };
        let Ok((mut joining, place)) = Joining::begin(&first, first_len) else { return Ok(()) };
        let mut end = place.end;
        prop_assert!(place.start == 0 && end < body_len);
        for (part, id, said, got) in parts {
            let part = [Part::Whole, Part::First, Part::Middle, Part::Last][part];
            // Half of them are right about their length.
            let said = if said % 2 == 0 { got } else { said };
            let head = Head { part, id, ..package(said) };
            if let Ok(Placed { at, is_complete }) = joining.next(&head, got) {
                prop_assert!(at.start == end && at.end <= body_len && at.len() == got);
                prop_assert_eq!(is_complete, at.end == body_len);
                end = at.end;
            }
        }
    }
}
