//! Joint slots of which one goes while another still has its turn in the same cycle.

use super::*;

fn change(slots: &mut Slots, slot: SlotConfig) {
    slots.set(slot, 1, &mut Events::new()).unwrap();
}

/// Slot 0, and slot 2, joined to it, with frames for their turns of cycle 1: both at once or, if so, in this order.
fn joint(frames: &Frames, marks: core::ops::RangeInclusive<u8>) -> Slots {
    let mut slots = with(&[config(0, 100, 0, 1), joined(2, 300, 0)]);
    marks.for_each(|mark| frames.queue(&mut slots, mark, mark % 2 * 2));
    slots
}

#[test]
fn what_a_joint_slot_could_not_send_in_its_last_turn_goes_back_to_the_queue_it_was_joined_to() {
    let frames = Frames::new();
    let mut slots = joint(&frames, 1..=2);
    slots.remove(2, 1).unwrap();
    let (priority, frame) = slots.dequeue(2).unwrap();
    slots.pass_until(2, 2);
    assert_eq!(slots.get(2), None);
    slots.put_back(Returned { frame, priority, channel: 2 }).unwrap();
    assert_eq!(sent_in(&mut slots, 0), [1, 2]);

    // The same of what waited in it before it was joined.
    let mut slots = with(&[config(0, 100, 0, 1), config(2, 300, 0, 1)]);
    frames.queue(&mut slots, 1, 2);
    set(&mut slots, joined(2, 300, 0)).unwrap();
    slots.remove(2, 1).unwrap();
    let (priority, frame) = slots.dequeue(2).unwrap();
    slots.pass_until(2, 2);
    slots.put_back(Returned { frame, priority, channel: 2 }).unwrap();
    assert_eq!(sent_in(&mut slots, 0), [1]);
}

#[test]
fn what_slot_1_could_not_send_in_its_last_turn_goes_back_to_where_it_came_from() {
    let frames = Frames::new();
    for (joint, left) in [(Some(2), [vec![], vec![1]]), (None, [vec![1], vec![]])] {
        let own = SlotConfig { joint, ..config(1, 500, 0, 1) };
        let mut slots = with(&[config(0, 100, 0, 1), config(2, 300, 0, 1), own]);
        frames.queue(&mut slots, 1, 1);
        slots.remove(1, 1).unwrap();
        let (priority, frame) = slots.dequeue(1).unwrap();
        slots.pass_until(1, 2);
        slots.put_back(Returned { frame, priority, channel: 1 }).unwrap();
        assert_eq!([0, 2].map(|id| sent_in(&mut slots, id)), left, "joint: {joint:?}");
    }
}

#[test]
fn who_parts_from_a_slot_that_goes_in_the_same_cycle_takes_its_queue_over() {
    let frames = Frames::new();
    let mut slots = joint(&frames, 1..=4);
    change(&mut slots, config(2, 300, 0, 1));
    slots.remove(0, 1).unwrap();
    let (priority, late) = slots.dequeue(0).unwrap();
    slots.pass_until(0, 2);
    assert_eq!(slots.get(0), None, "its turn of the cycle is over, that of slot 2 is not");
    slots.put_back(Returned { frame: late, priority, channel: 0 }).unwrap();
    slots.enqueue(frames.of(5, 46), Priority::DEFAULT, 2).expect("its channel is served all the while");
    assert_eq!(slots.dequeue(2).unwrap().1[20], 1);
    slots.pass_until(2, 2);
    assert_eq!((sent_in(&mut slots, 2), slots.dropped()), (vec![2, 3, 4, 5], 0));
}

#[test]
fn of_several_that_part_the_first_takes_the_queue_over_for_the_others_until_they_do() {
    let frames = Frames::new();
    let mut slots = with(&[config(0, 100, 0, 1), joined(2, 300, 0), joined(3, 500, 0)]);
    (1..=3).for_each(|mark| frames.queue(&mut slots, mark, 3));
    [2, 3].iter().for_each(|&id| change(&mut slots, config(id, i64::from(id) * 100, 0, 1)));
    slots.remove(0, 1).unwrap();
    slots.pass_until(0, 2);
    assert_eq!([2, 3].map(|id| slots.dequeue(id).unwrap().1[20]), [1, 2]);
    [2, 3].iter().for_each(|&id| slots.pass_until(id, 2));
    assert_eq!([2, 3].map(|id| sent_in(&mut slots, id)), [vec![3], vec![]]);
}

#[test]
fn where_all_that_share_a_queue_go_in_one_cycle_what_is_left_is_counted() {
    let frames = Frames::new();
    let mut slots = joint(&frames, 1..=3);
    slots.remove(2, 1).unwrap();
    slots.remove(0, 1).unwrap();
    slots.pass_until(0, 2);
    assert_eq!(slots.dequeue(2).unwrap().1[20], 1, "its last turn");
    slots.pass_until(2, 2);
    assert_eq!((slots.payload_limit(2), slots.dropped()), (Err(SendError::NoSlot(2)), 2));
}
