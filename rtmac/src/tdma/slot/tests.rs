mod parted;
mod size;

use super::queues::{fits, payload_of};
use super::*;
use crate::tdma::line::Drift;
use proptest::prelude::*;
use rtnet::buf::{Buf, Pool};
use rtnet::discipline::{Returned, SendError};
use rtnet::queue::Priority;
use rtnet::time::{GlobalTime, Offset};

fn config(id: u8, offset: i64, phase: u32, period: u32) -> SlotConfig {
    let (offset, latest) = (Span::from_micros(offset), Span::from_micros(10));
    SlotConfig { id, offset, phase, period, size: 100, joint: None, latest }
}

fn set(slots: &mut Slots, slot: SlotConfig) -> Result<(), Refused> {
    slots.set(slot, 0, &mut Events::new())
}

fn line() -> TimeLine {
    TimeLine {
        cycle: 0,
        start: Instant::from_nanos(0),
        sched: GlobalTime::default(),
        period: Span::from_millis(1),
        offset: Offset::default(),
        drift: Drift::NONE,
    }
}

#[test]
fn slots_take_turns_by_time_and_phase() {
    let mut slots = Slots::new(7);
    for slot in [config(0, 300, 0, 1), config(2, 100, 1, 2), config(3, 300, 0, 2)] {
        set(&mut slots, slot).unwrap();
    }
    slots.align(&line(), Instant::from_nanos(1_000_000));
    let order: Vec<_> = (0..6)
        .map(|_| {
            let turn = slots.next_turn(&line(), None).unwrap();
            slots.pass(&turn);
            (turn.cycle, turn.id, turn.at.nanos() / 1000)
        })
        .collect();
    assert_eq!(order, [(1, 2, 1100), (1, 0, 1300), (2, 0, 2300), (2, 3, 2300), (3, 2, 3100), (3, 0, 3300)]);
}

#[test]
fn all_buffers_that_there_are_may_wait_in_one_slot_also_where_it_changes() {
    let pool = Pool::new(5_000);
    let mut slots = with(&[config(0, 100, 0, 1)]);
    let queue = |slots: &mut Slots, n: usize, payload: usize| {
        for _ in 0..n {
            let mut frame = pool.take().unwrap();
            frame.fill(&[0; 1514][..ethernet::HEADER_LEN + payload]);
            slots.enqueue(frame, Priority::DEFAULT, 0).unwrap();
        }
    };
    queue(&mut slots, 2_000, 60);
    queue(&mut slots, 3_000, 100);
    set(&mut slots, config(0, 150, 0, 1)).unwrap();
    assert_eq!((slots.statuses().next().unwrap().queued, pool.available()), (5_000, 0));
    set(&mut slots, SlotConfig { size: 60, ..config(0, 150, 0, 1) }).unwrap();
    assert_eq!((slots.dropped(), pool.available()), (3_000, 3_000), "what is too large by now");
    assert_eq!(core::iter::from_fn(|| slots.dequeue(0)).count(), 2_000);
}

#[test]
fn slot_1_is_slot_0_until_it_is_defined() {
    let pool = Pool::new(3);
    let frame = || {
        let mut frame = pool.take().unwrap();
        frame.fill(&[0; 60]);
        frame
    };
    let mut slots = Slots::new(7);
    assert!(matches!(slots.enqueue(frame(), Priority::NON_RT, 1), Err((SendError::NoSlot(1), _))));
    set(&mut slots, config(0, 100, 0, 1)).unwrap();
    slots.enqueue(frame(), Priority::NON_RT, 1).unwrap();
    slots.enqueue(frame(), Priority::FIRST, 0).unwrap();
    assert_eq!(slots.dequeue(0).unwrap().0, Priority::FIRST);
    assert_eq!(slots.dequeue(0).unwrap().0, Priority::NON_RT);
    set(&mut slots, config(1, 200, 0, 1)).unwrap();
    slots.enqueue(frame(), Priority::NON_RT, 1).unwrap();
    assert!(slots.dequeue(0).is_none() && slots.dequeue(1).is_some());
}

#[test]
fn what_is_no_slot_is_refused_by_name() {
    let mut slots = Slots::new(7);
    let refused = |slots: &mut Slots, slot| set(slots, slot).unwrap_err().to_string();
    assert!(refused(&mut slots, config(8, 0, 0, 1)).contains("ids go from 0 to 7"));
    assert!(refused(&mut slots, config(0, 0, 2, 2)).contains("phase 3 of 2"));
    assert!(refused(&mut slots, config(0, 0, 0, MAX_PERIOD + 1)).contains("that 1 to 65536 cycles"));
    assert_eq!(set(&mut slots, config(0, 0, MAX_PERIOD - 1, MAX_PERIOD)), Ok(()));
    assert!(refused(&mut slots, config(0, -1, 0, 1)).contains("before the cycle"));
    assert!(refused(&mut slots, SlotConfig { size: 1501, ..config(0, 0, 0, 1) }).contains("1501"));
    assert!(slots.remove(3, 0).unwrap_err().to_string().contains("slot 3 is not defined"));
}

#[test]
fn the_lethal_frame_never_gets_into_a_queue() {
    let pool = Pool::new(1);
    let mut slots = Slots::new(7);
    set(&mut slots, config(0, 100, 0, 1)).unwrap();
    let mut frame = pool.take().unwrap();
    frame.fill(&[0; 60]);
    frame[12..18].copy_from_slice(&[0x90, 0x21, 0x00, 0x42, 2, 0]);
    let (error, mut frame) = slots.enqueue(frame, Priority::DEFAULT, 0).unwrap_err();
    assert_eq!(error, SendError::Lethal);
    frame[17] = 1;
    slots.enqueue(frame, Priority::DEFAULT, 0).unwrap();
}

/// Frames with a mark, so that they can be told from one another.
struct Frames(Pool);

impl Frames {
    fn new() -> Self {
        Self(Pool::new(200))
    }

    fn of(&self, mark: u8, payload: usize) -> Buf {
        let mut frame = self.0.take().unwrap();
        frame.fill(&[0; 1514][..ethernet::HEADER_LEN + payload]);
        frame[20] = mark;
        frame
    }

    /// Queues one that fits every slot.
    fn queue(&self, slots: &mut Slots, mark: u8, channel: Channel) {
        slots.enqueue(self.of(mark, MIN_SIZE), Priority::DEFAULT, channel).unwrap();
    }
}

/// The marks of what a slot would send in its next turns.
fn sent_in(slots: &mut Slots, id: Channel) -> Vec<u8> {
    core::iter::from_fn(|| slots.dequeue(id)).map(|(_, frame)| frame[20]).collect()
}

fn joined(id: u8, offset: i64, to: Channel) -> SlotConfig {
    SlotConfig { joint: Some(to), ..config(id, offset, 0, 1) }
}

fn with(configs: &[SlotConfig]) -> Slots {
    let mut slots = Slots::new(7);
    configs.iter().for_each(|&config| set(&mut slots, config).unwrap());
    slots
}

#[test]
fn joint_slots_take_the_most_urgent_frame_of_one_queue() {
    let frames = Frames::new();
    let mut slots = with(&[config(0, 100, 0, 1), joined(2, 300, 0), joined(3, 500, 2)]);
    assert_eq!(slots.get(3).unwrap().joint, Some(0), "what slot 2 is joined to");
    for (mark, channel, priority) in [(1, 0, 9), (2, 2, 5), (3, 3, 7), (4, 1, 31)] {
        slots.enqueue(frames.of(mark, 46), Priority::new(priority).unwrap(), channel).unwrap();
    }
    let mut next = |id| slots.dequeue(id).map(|(_, frame)| frame[20]);
    assert_eq!([next(0), next(3), next(2), next(2), next(0)], [Some(2), Some(3), Some(1), Some(4), None]);
}

#[test]
fn the_slot_with_the_highest_id_can_be_joined_to() {
    let mut slots = Slots::new(2);
    set(&mut slots, config(2, 100, 0, 1)).unwrap();
    set(&mut slots, joined(0, 300, 2)).unwrap();
    Frames::new().queue(&mut slots, 1, 0);
    assert_eq!(sent_in(&mut slots, 2), [1], "RTnet refuses that");
}

#[test]
fn a_slot_that_others_are_joined_to_stays_until_they_go() {
    let frames = Frames::new();
    let mut slots = with(&[config(0, 100, 0, 1), joined(2, 300, 0), joined(3, 500, 2)]);
    frames.queue(&mut slots, 1, 2);
    assert_eq!(slots.remove(0, 0), Err(Refused::JoinedTo { id: 0, by: 2 }));
    slots.remove(2, 0).unwrap();
    assert_eq!(slots.remove(0, 0), Err(Refused::JoinedTo { id: 0, by: 3 }), "joined by way of slot 2");
    set(&mut slots, config(3, 500, 0, 1)).unwrap();
    assert_eq!(
        (sent_in(&mut slots, 3), sent_in(&mut slots, 0)),
        (vec![], vec![1]),
        "who unjoins takes nothing along"
    );
    slots.remove(0, 0).unwrap();
    assert_eq!(slots.dropped(), 0);
}

#[test]
fn nothing_is_lost_where_two_queues_are_joined_and_parted() {
    let frames = Frames::new();
    let mut slots = with(&[config(0, 100, 0, 1), config(2, 300, 0, 1)]);
    for (first, channel) in [(0, 0), (100, 2)] {
        (0..32).for_each(|n| frames.queue(&mut slots, first + n, channel));
    }
    set(&mut slots, joined(2, 300, 0)).unwrap();
    let two = |slots: &mut Slots| [2, 2].map(|id| slots.dequeue(id).unwrap().1[20]);
    assert_eq!(two(&mut slots), [100, 101], "what waited in it has waited longer");
    assert_eq!(slots.statuses().map(|slot| slot.queued).collect::<Vec<_>>(), [32, 62]);
    assert_eq!(slots.dequeue(0).unwrap().1[20], 0);
    slots.enqueue(frames.of(99, 46), Priority::FIRST, 0).unwrap();
    assert_eq!(two(&mut slots), [99, 102], "but what is more urgent comes first");
    set(&mut slots, config(2, 300, 0, 1)).unwrap();
    assert_eq!(sent_in(&mut slots, 2), (103..132).collect::<Vec<_>>());
    assert_eq!(sent_in(&mut slots, 0), (1..32).collect::<Vec<_>>());
    assert_eq!(slots.dropped(), 0);
}

#[test]
fn what_a_joint_slot_could_not_send_goes_back_to_where_it_was_taken_from() {
    let frames = Frames::new();
    let mut slots = with(&[config(0, 100, 0, 1), config(2, 300, 0, 1)]);
    (1..=2).for_each(|mark| frames.queue(&mut slots, mark, 2));
    set(&mut slots, joined(2, 300, 0)).unwrap();
    frames.queue(&mut slots, 3, 0);
    let late = |slots: &mut Slots, between: fn(&mut Slots)| {
        let (priority, frame) = slots.dequeue(2).unwrap();
        between(slots);
        slots.put_back(Returned { frame, priority, channel: 2 }).unwrap();
    };
    late(&mut slots, |_| ());
    assert_eq!(slots.dequeue(2).unwrap().1[20], 1);
    late(&mut slots, |slots| set(slots, config(2, 300, 0, 1)).unwrap());
    assert_eq!((sent_in(&mut slots, 2), sent_in(&mut slots, 0)), (vec![2], vec![3]));
    set(&mut slots, joined(2, 300, 0)).unwrap();
    frames.queue(&mut slots, 4, 2);
    late(&mut slots, |slots| set(slots, config(2, 300, 0, 1)).unwrap());
    assert_eq!(sent_in(&mut slots, 2), [4], "its channel has another queue by now");
}

#[test]
fn a_slot_that_shrinks_takes_those_joined_to_it_along() {
    let frames = Frames::new();
    let mut slots = with(&[config(0, 100, 0, 1), config(2, 300, 0, 1)]);
    slots.enqueue(frames.of(1, 100), Priority::DEFAULT, 2).unwrap();
    set(&mut slots, joined(2, 300, 0)).unwrap();
    slots.enqueue(frames.of(2, 100), Priority::DEFAULT, 0).unwrap();
    frames.queue(&mut slots, 3, 2);
    set(&mut slots, SlotConfig { size: 60, ..config(0, 150, 0, 1) }).unwrap();
    let after = slots.get(2).unwrap();
    assert_eq!((after.size, after.joint, after.offset), (60, Some(0), Span::from_micros(300)));
    let error = slots.enqueue(frames.of(0, 61), Priority::DEFAULT, 2).unwrap_err().0;
    assert_eq!(error, SendError::TooLong { channel: 2, got: 61, limit: 60 });
    assert_eq!((sent_in(&mut slots, 2), slots.dropped(), slots.detached()), (vec![3], 2, 0));
}

#[test]
fn a_slot_that_grows_leaves_those_joined_to_it_behind_and_says_so() {
    let frames = Frames::new();
    let mut slots = with(&[config(0, 100, 0, 1), joined(2, 300, 0), joined(3, 500, 0)]);
    (1..=2).for_each(|mark| frames.queue(&mut slots, mark, mark));
    let mut events = Events::new();
    slots.set(SlotConfig { size: 101, ..config(0, 100, 0, 1) }, 6, &mut events).unwrap();
    let told: Vec<_> = core::iter::from_fn(|| events.take()).map(|e| (e.cycle, e.kind, e.slot)).collect();
    assert_eq!(told, [2, 3].map(|id| (7, EventKind::JointDetached, Some(id))));
    // They still have their turn in cycle 6.
    assert_eq!([slots.payload_limit(0), slots.payload_limit(2)], [Ok(100); 2], "any of them may take it");
    slots.pass_until(0, 7);
    assert_eq!(slots.payload_limit(0), Ok(100), "slot 2 may still take it");
    [2, 3].iter().for_each(|&id| slots.pass_until(id, 7));
    assert_eq!([slots.payload_limit(0), slots.payload_limit(2)], [Ok(101), Ok(100)]);
    frames.queue(&mut slots, 3, 3);
    assert_eq!([2, 3, 0].map(|id| sent_in(&mut slots, id)), [vec![], vec![3], vec![1, 2]]);
    assert_eq!((slots.dropped(), slots.detached()), (0, 2));
}

#[test]
fn slot_1_parts_from_slot_0_and_comes_back_without_losing_a_frame() {
    let frames = Frames::new();
    let mut slots = with(&[config(0, 100, 0, 1)]);
    assert_eq!(slots.remove(1, 0), Err(Refused::Alias));
    frames.queue(&mut slots, 1, 1);
    set(&mut slots, SlotConfig { size: 200, ..config(1, 200, 0, 1) }).unwrap();
    frames.queue(&mut slots, 2, 1);
    assert_eq!(sent_in(&mut slots, 0), [1], "queued before there was a slot 1");
    slots.enqueue(frames.of(3, 101), Priority::DEFAULT, 1).unwrap();
    slots.remove(1, 0).unwrap();
    assert_eq!((sent_in(&mut slots, 0), slots.dropped()), (vec![2], 1), "one is too large for slot 0");
    assert_eq!(slots.payload_limit(1), Ok(100), "it is slot 0 again");
    assert_eq!(slots.remove(1, 0), Err(Refused::Alias));
    slots.remove(0, 0).unwrap();
    assert_eq!(slots.payload_limit(1), Err(SendError::NoSlot(1)));
    assert_eq!(slots.remove(1, 0), Err(Refused::NotDefined { id: 1 }));
}

#[test]
fn slot_1_is_what_slot_0_is_also_where_that_is_joined_and_where_ids_end_at_0() {
    let frames = Frames::new();
    let mut slots = with(&[config(2, 100, 0, 1), joined(0, 300, 2)]);
    frames.queue(&mut slots, 1, 1);
    assert_eq!(sent_in(&mut slots, 2), [1]);
    let mut only = Slots::new(0);
    set(&mut only, config(0, 100, 0, 1)).unwrap();
    frames.queue(&mut only, 1, 1);
    assert_eq!(sent_in(&mut only, 0), [1]);
    assert_eq!(set(&mut only, config(1, 200, 0, 1)), Err(Refused::SlotId { id: 1, max: 0 }));
}

#[test]
fn a_channel_that_cannot_be_is_another_error_than_one_that_may_come() {
    let mut slots = with(&[config(0, 100, 0, 1)]);
    assert_eq!(slots.payload_limit(7), Err(SendError::NoSlot(7)));
    let unknown = SendError::UnknownChannel { channel: 8, max: 7 };
    assert_eq!(slots.payload_limit(8), Err(unknown));
    let frame = Frames::new().of(0, 46);
    assert_eq!(slots.enqueue(frame, Priority::DEFAULT, 8).err().map(|(error, _)| error), Some(unknown));
    assert_eq!(unknown.to_string(), "channel 8 is unknown: they go from 0 to 7");
}

#[derive(Clone, Debug)]
enum Step {
    Set {
        id: Channel,
        size: usize,
        joint: Option<Channel>,
        phase: u32,
    },
    Remove(Channel),
    Enqueue {
        channel: Channel,
        level: u8,
        payload: usize,
    },
    /// The next turn, whose frame is sent or comes back.
    Turn {
        late: bool,
    },
}

fn step() -> impl Strategy<Value = Step> {
    // Few of each, so that they meet.
    let size = prop::sample::select(vec![60, 100]);
    let joint = prop::option::of(0u8..3);
    let set = (0u8..3, size.clone(), joint, 0u32..2);
    let enqueue = (0u8..4, 0u8..2, size);
    prop_oneof![
        3 => set.prop_map(|(id, size, joint, phase)| Step::Set { id, size, joint, phase }),
        1 => (0u8..3).prop_map(Step::Remove),
        3 => enqueue.prop_map(|(channel, level, payload)| Step::Enqueue { channel, level, payload }),
        3 => any::<bool>().prop_map(|late| Step::Turn { late }),
    ]
}

proptest! {
    /// However slots are joined, parted, resized and removed between and within cycles.
    #[test]
    fn every_frame_fits_its_slot_and_is_sent_or_waits_where_it_can_be_or_is_counted(
        steps in prop::collection::vec(step(), 0..150)
    ) {
        let (frames, line) = (Frames::new(), line());
        let (mut slots, mut events) = (Slots::new(2), Events::new());
        let (mut cycle, mut queued, mut sent, mut lost) = (0, 0, 0, 0);
        for step in steps {
            match step {
                Step::Set { id, size, joint, phase } => {
                    let slot = SlotConfig { size, joint, ..config(id, i64::from(id) * 100, phase % 2, 1 + phase) };
                    // What cannot be is refused, and changes nothing.
                    let _ = slots.set(slot, cycle, &mut events);
                }
                Step::Remove(id) => drop(slots.remove(id, cycle)),
                Step::Enqueue { channel, level, payload } => {
                    let priority = Priority::new(level).unwrap();
                    queued += u64::from(slots.enqueue(frames.of(0, payload), priority, channel).is_ok());
                }
                Step::Turn { late } => {
                    let Some(turn) = slots.next_turn(&line, None) else { continue };
                    cycle = turn.cycle;
                    let size = slots.get(turn.id).unwrap().size;
                    let taken = slots.dequeue(turn.id);
                    slots.pass(&turn);
                    let Some((priority, frame)) = taken else { continue };
                    prop_assert!(fits(&frame, size), "{} bytes in a slot of {size}", payload_of(&frame));
                    if late {
                        lost += u64::from(slots.put_back(Returned { frame, priority, channel: turn.id }).is_err());
                    } else {
                        sent += 1;
                    }
                }
            }
            let waiting: usize = slots.table.iter().map(|slot| slot.queue.len()).sum();
            prop_assert_eq!(queued, sent + lost + slots.dropped() + waiting as u64);
            for slot in &slots.table {
                prop_assert!(slot.config.is_some() || slot.queue.is_empty(), "frames that no slot sends");
            }
        }
        // Once all changes have come, joint slots are of one size, and joined to one that has its own queue.
        slots.align(&line, line.start_of(cycle + 1));
        for (config, _) in slots.defined() {
            let owner = slots.get(config.queue());
            prop_assert!(owner.is_some_and(|owner| owner.size == config.size && owner.joint.is_none()), "{config:?}");
        }
    }
}
