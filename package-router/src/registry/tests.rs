use super::*;
use crate::name::Class;

const ARM: ComponentId = ComponentId(1);
const CAMERA: ComponentId = ComponentId(2);

fn name(instance: u8) -> MailboxName {
    MailboxName::new(0, Class(0x80), instance, 0)
}

/// The arm has mailbox 1, for two senders, the camera has mailbox 2.
fn two() -> Registry {
    let mut registry = Registry::new();
    assert_eq!(registry.create(ARM, name(1), Shape::new(4, 8).senders(2)), Ok(0));
    assert_eq!(registry.create(CAMERA, name(2), Shape::new(4, 8)), Ok(1));
    registry
}

fn never(_: usize, _: u32) -> bool {
    false
}

#[test]
fn a_name_is_one_mailbox_s_as_long_as_its_owner_lives() {
    let mut registry = two();
    let again = |registry: &mut Registry| registry.create(CAMERA, name(1), Shape::new(1, 1));
    assert_eq!(again(&mut registry), Err(Refused::Taken(name(1))));
    assert_eq!(registry.delete(CAMERA, name(1)), Err(Refused::NotOwn(name(1))));
    assert_eq!(registry.left(ARM), [0]);
    let before = two().get(0).unwrap().generation;
    assert_eq!(again(&mut registry), Ok(0));
    assert!(registry.get(0).unwrap().generation > before);
    assert_eq!(registry.delete(CAMERA, name(1)), Ok(0));
    assert_eq!(registry.delete(CAMERA, name(1)), Err(Refused::NoMailbox(name(1))));
}

#[test]
fn a_name_is_nobody_elses_as_long_as_somebody_can_send_in_it() {
    let mut registry = two();
    let lane = registry.bind(CAMERA, name(2), name(1), never).unwrap();
    let shape = Shape::new(1, 1);
    let others = |registry: &mut Registry| registry.create(ARM, name(2), shape);
    let taken = Err(Refused::Taken(name(2)));
    registry.delete(CAMERA, name(2)).unwrap();
    assert_eq!(others(&mut registry), taken, "of one that makes it ready");
    assert!(registry.ready(CAMERA, lane));
    assert_eq!(others(&mut registry), taken, "of one that sends");
    assert_eq!(registry.create(CAMERA, name(2), shape), Ok(1), "who sends so may have it anew");
    assert_eq!(registry.left(CAMERA), [1]);
    assert_eq!(others(&mut registry), taken, "of one that has hung up, and may send on");
    assert_eq!(registry.create(ARM, name(3), shape), Ok(1), "another name is another's");
    registry.delete(ARM, name(3)).unwrap();
    assert_eq!(registry.ended(CAMERA), [0]);
    assert_eq!(registry.get(0).unwrap().lanes[1].state, LaneState::Left(name(2)));
    assert_eq!(others(&mut registry), Ok(1), "what is still to be read keeps no name");

    // It leads nowhere any more.
    let mut registry = two();
    let lane = registry.bind(CAMERA, name(2), name(1), never).unwrap();
    assert!(registry.ready(CAMERA, lane));
    registry.delete(CAMERA, name(2)).unwrap();
    registry.delete(ARM, name(1)).unwrap();
    assert_eq!(others(&mut registry), Ok(0));
}

#[test]
fn what_cannot_be_is_refused_and_changes_nothing() {
    let mut registry = two();
    assert_eq!(
        registry.create(ARM, MailboxName::NOBODY, Shape::new(1, 1)),
        Err(Refused::NoName(MailboxName::NOBODY))
    );
    assert_eq!(registry.create(ARM, name(3), Shape::new(0, 1)), Err(Refused::Shape(ShapeError::Slots(0))));
    let answering = Shape::new(1, 1).answering();
    assert_eq!(registry.create(ARM, name(3), answering), Err(Refused::Shape(ShapeError::Answers)));
    assert!(two().create_tcp(ARM, answering).is_ok());
    assert_eq!(registry.bind(ARM, name(2), name(2), never), Err(Refused::NotOwn(name(2))));
    assert_eq!(registry.bind(ARM, name(9), name(2), never), Err(Refused::NotOwn(name(9))));
    assert_eq!(registry.bind(ARM, name(1), name(9), never), Err(Refused::NoMailbox(name(9))));
    for instance in 3..=255 {
        if let Err(refused) = registry.create(ARM, name(instance), Shape::new(1, 1)) {
            panic!("{refused}");
        }
    }
    let (mut more, is_free) = (0, |more: u8| MailboxName::new(1, Class(0x80), more, 0));
    while registry.create(ARM, is_free(more), Shape::new(1, 1)).is_ok() {
        more += 1;
    }
    assert_eq!(registry.all().count(), MOST_MAILBOXES);
    assert_eq!(registry.create(ARM, is_free(more), Shape::new(1, 1)), Err(Refused::TooMany));
}

#[test]
fn a_lane_is_free_again_once_its_sender_is_gone_and_all_of_it_is_read() {
    let mut registry = two();
    let first = registry.bind(CAMERA, name(2), name(1), never).unwrap();
    let second = registry.bind(CAMERA, name(2), name(1), never).unwrap();
    assert_eq!(((first.place, first.lane), (second.place, second.lane)), ((0, 1), (0, 2)));
    let full = Err(Refused::NoLane(name(1), 2));
    assert_eq!(registry.bind(CAMERA, name(2), name(1), never), full);
    assert!(registry.ready(CAMERA, first));
    let wrong = [(CAMERA, first), (ARM, second), (CAMERA, LaneId { lane: 9, ..second })];
    assert!(!wrong.into_iter().any(|(by, lane)| registry.ready(by, lane)));
    let of_router = LaneId { lane: ROUTER, ..first };
    assert!(!registry.unbind(ARM, first) && !registry.unbind(ROUTERS, of_router));
    // One was never ready, so nothing of it is there to be read.
    assert!(registry.has_lanes(CAMERA));
    assert_eq!(registry.ended(CAMERA), [0]);
    assert!(!registry.has_lanes(CAMERA));
    let lanes = &registry.get(0).unwrap().lanes;
    assert_eq!((lanes[1].state, lanes[2].state), (LaneState::Left(name(2)), LaneState::Free));
    registry.bind(CAMERA, name(2), name(1), never).unwrap();
    assert_eq!(registry.bind(CAMERA, name(2), name(1), never), full);
    let drained = |lane, generation| (lane, generation) == (1, 1);
    let again = registry.bind(CAMERA, name(2), name(1), drained).unwrap();
    assert_eq!(again, LaneId { generation: 2, ..first });
    // Who had it before gives up nothing of it any more.
    assert!(!registry.unbind(CAMERA, first) && registry.unbind(CAMERA, again));
    assert_eq!(registry.get(0).unwrap().lanes[1].generation, 2);
}

/// Of which nobody has had any.
const LANE: LaneId = LaneId { place: 0, lane: 1, mailbox: 1, generation: 0 };

/// Every state of a lane, and everything that can happen to it, by who has it and by others.
#[test]
fn every_state_of_a_lane_answers_every_event() {
    use LaneState::{Bound, Free, Left, Reserved};
    let from = name(2);
    let states = [Free, Reserved(CAMERA, from), Bound(CAMERA, from), Left(from)];
    type Event = fn(&mut Registry, ComponentId);
    let ready: Event = |registry, by| _ = registry.ready(by, LANE);
    let unbind: Event = |registry, by| _ = registry.unbind(by, LANE);
    let ended: Event = |registry, by| _ = registry.ended(by);
    for (event, expected) in [
        (ready, [Free, Bound(CAMERA, from), Bound(CAMERA, from), Left(from)]),
        (unbind, [Free, Free, Left(from), Left(from)]),
        (ended, [Free, Free, Left(from), Left(from)]),
    ] {
        for (state, expected) in states.into_iter().zip(expected) {
            for (by, expected) in [(CAMERA, expected), (ARM, state)] {
                let mut registry = two();
                *registry.lane(LANE).unwrap() = state;
                event(&mut registry, by);
                assert_eq!(*registry.lane(LANE).unwrap(), expected, "{state:?}");
            }
        }
    }
}

/// The TCP client has a name of nobody else, and a lane of its own into each mailbox.
#[test]
fn the_tcp_client_takes_no_lane_from_senders() {
    const TCP: ComponentId = ComponentId(7);
    let mut registry = two();
    let place = registry.create_tcp(TCP, Shape::new(1, 1).senders(1)).unwrap();
    assert_eq!(registry.find(MailboxName::NOBODY), Some(place));
    assert_eq!(registry.create_tcp(ARM, Shape::new(1, 1)), Err(Refused::Taken(MailboxName::NOBODY)));
    let nobody = MailboxName::NOBODY;
    assert_eq!(
        registry.bind(ARM, nobody, name(1), never),
        Err(Refused::NotOwn(nobody)),
        "it is not its name"
    );
    (0..2).for_each(|_| _ = registry.bind(CAMERA, name(2), name(1), never).unwrap());
    let lane = registry.bind(TCP, nobody, name(1), never).unwrap();
    assert_eq!(lane.lane, registry.get(lane.place).unwrap().shape.tcp_lane());
    assert_eq!(registry.bind(TCP, nobody, name(1), never), Err(Refused::NoLane(name(1), 2)), "it has one");
    assert!(registry.ready(TCP, lane));
    assert_eq!(registry.ended(TCP), [lane.place]);
    let again = registry.bind(TCP, nobody, name(1), |_, _| true).unwrap();
    assert_eq!((again.lane, again.generation), (lane.lane, 2));
}
