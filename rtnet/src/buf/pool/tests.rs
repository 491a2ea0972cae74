use std::sync::Barrier;
use std::sync::atomic::AtomicU32;
use std::thread;

use proptest::prelude::*;

use super::super::{Chain, ROOM, hand_over};
use super::*;

/// As many as there are, all at once.
fn take_all(pool: &Pool) -> Vec<Buf> {
    std::iter::from_fn(|| pool.take()).collect()
}

#[test]
fn a_pool_grows_as_far_as_it_has_places_and_shrinks_to_one_buffer() {
    let pool = Pool::with_room(2, 5);
    assert_eq!((pool.capacity(), pool.available()), (2, 2));
    assert_eq!(pool.extend(2), 2);
    assert_eq!(pool.extend(2), 1, "it has places for 5");
    assert_eq!(pool.extend(1), 0);
    assert_eq!((pool.capacity(), take_all(&pool).len()), (5, 5));
    assert_eq!(pool.shrink(3), 3);
    assert_eq!(pool.shrink(3), 1, "one stays");
    assert_eq!(pool.shrink(1), 0);
    assert_eq!((pool.capacity(), take_all(&pool).len()), (1, 1));
    assert_eq!(pool.extend(usize::MAX), 4);
    assert_eq!((pool.capacity(), take_all(&pool).len()), (5, 5));
}

#[test]
fn a_pool_that_was_made_for_so_many_grows_only_again() {
    let pool = Pool::new(3);
    assert_eq!((pool.extend(1), pool.shrink(1), pool.extend(2)), (0, 1, 1));
    assert_eq!((pool.capacity(), pool.available()), (3, 3));
}

#[test]
fn only_free_buffers_are_removed() {
    let pool = Pool::with_room(4, 8);
    let mut held = take_all(&pool);
    assert_eq!(pool.shrink(4), 0);
    held.truncate(2);
    assert_eq!(pool.shrink(4), 2);
    assert_eq!((pool.capacity(), pool.available()), (2, 0));
    // The places of those that are gone serve again, and those that are out keep theirs.
    assert_eq!(pool.extend(9), 6);
    drop(held);
    assert_eq!((pool.capacity(), take_all(&pool).len()), (8, 8));
}

#[test]
fn a_buffer_that_was_handed_over_counts_where_it_belongs_now() {
    let (nic, socket) = (Pool::with_room(1, 2), Pool::with_room(2, 4));
    let kept = hand_over(nic.take().unwrap(), &socket).unwrap();
    assert_eq!((nic.available(), socket.available()), (1, 1));
    assert_eq!(
        (nic.shrink(1), socket.shrink(2)),
        (0, 1),
        "the last one of the card, a free one of the socket"
    );
    assert_eq!((nic.extend(9), socket.extend(9)), (1, 3));
    drop(kept);
    assert_eq!((nic.available(), socket.available()), (2, 4));
}

#[test]
fn a_pool_tells_its_fewest_free_and_how_often_it_had_none() {
    let pool = Pool::with_room(4, 8);
    let told = |capacity, free, least, exhausted| PoolStatistics { capacity, free, least, exhausted };
    assert_eq!(pool.statistics(), told(4, 4, 4, 0));
    let held: Vec<_> = (0..3).map(|_| pool.take()).collect();
    assert_eq!(pool.statistics(), told(4, 1, 1, 0));
    drop(held);
    (0..10).for_each(|_| drop(pool.take()));
    assert_eq!(pool.statistics(), told(4, 4, 1, 0));
    let held = take_all(&pool);
    assert!(pool.take().is_none());
    assert_eq!(pool.statistics(), told(4, 0, 0, 2));

    // It starts over with every change of the capacity, and only then.
    assert_eq!(pool.shrink(1), 0);
    drop(held);
    assert_eq!(pool.statistics(), told(4, 4, 0, 2));
    assert_eq!(pool.extend(3), 3);
    assert_eq!(pool.statistics(), told(7, 7, 7, 2));
    let held = pool.take();
    assert_eq!(pool.shrink(5), 5);
    assert_eq!(pool.statistics(), told(2, 1, 1, 2));
    drop(held);
    assert_eq!(pool.statistics(), told(2, 2, 1, 2));
}

#[test]
fn the_buffers_in_use_are_the_same_few_all_the_time() {
    let pool = Pool::new(64);
    let mut waiting = std::collections::VecDeque::new();
    for _ in 0..1_000 {
        waiting.push_back(pool.take().unwrap());
        if waiting.len() == 3 {
            waiting.pop_front();
        }
    }
    let used = pool.home.places.iter().filter(|place| place.was_taken.load(Relaxed)).count();
    assert_eq!((used, pool.statistics().least), (3, 61));
}

/// One thread less is at work when it ends, also by a panic: nobody waits for it then.
struct AtWork<'a>(&'a AtomicU32);

impl Drop for AtWork<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Relaxed);
    }
}

#[test]
fn threads_take_hand_over_and_return_while_another_extends_and_shrinks() {
    let (nic, socket) = (Pool::with_room(4, 12), Pool::with_room(3, 9));
    let at_work = AtomicU32::new(3);
    thread::scope(|scope| {
        for byte in 1..=3u8 {
            let (nic, socket, at_work) = (&nic, &socket, &at_work);
            scope.spawn(move || {
                let _at_work = AtWork(at_work);
                for _ in 0..20_000 {
                    let Some(mut frame) = nic.take() else { continue };
                    frame.fill(&[byte; 64]);
                    frame.trim_front(14);
                    let mut chain = Chain::of(hand_over(frame, socket).unwrap_or_else(|refused| refused));
                    socket.take().into_iter().for_each(|empty| chain.push(empty));
                    let mine = chain.parts().flatten().all(|&filled| filled == byte);
                    assert!(mine && chain.len() == 50, "two owners of one buffer");
                }
            });
        }
        for pool in [&nic, &socket] {
            let at_work = &at_work;
            scope.spawn(move || {
                let mut capacity = pool.capacity();
                for n in (1..=5).cycle() {
                    capacity += pool.extend(n);
                    capacity -= pool.shrink(6 - n);
                    assert_eq!(pool.capacity(), capacity, "nobody else changes it");
                    let told = pool.statistics();
                    assert!(told.least <= told.free && told.free <= told.capacity, "{told:?}");
                    if at_work.load(Relaxed) == 0 {
                        break;
                    }
                }
            });
        }
    });
    for pool in [&nic, &socket] {
        assert_eq!(pool.available(), pool.capacity(), "every buffer is home");
        assert_eq!(take_all(pool).len(), pool.capacity());
    }
}

#[test]
fn threads_that_extend_and_shrink_at_once_keep_the_count_and_leave_a_buffer() {
    let pool = Pool::with_room(500, 1_000);
    let at_once = |resize: fn(&Pool) -> usize| -> usize {
        let together = Barrier::new(3);
        let resize = || {
            together.wait();
            resize(&pool)
        };
        thread::scope(|scope| [0; 3].map(|_| scope.spawn(resize)).map(|one| one.join().unwrap()).iter().sum())
    };
    let mut capacity = 500;
    for _ in 0..200 {
        assert_eq!((at_once(|pool| pool.shrink(1_000)), pool.capacity()), (capacity - 1, 1));
        assert_eq!((at_once(|pool| pool.extend(1_000)), pool.capacity()), (999, 1_000));
        capacity = 1_000;
    }
    assert_eq!(take_all(&pool).len(), 1_000);
}

#[test]
fn a_pool_with_room_may_be_dropped_while_its_buffers_are_out() {
    let pool = Pool::with_room(2, 4);
    let (early, late) = (pool.take(), pool.take());
    pool.extend(2);
    drop(early);
    drop(pool);
    drop(late);
}

#[test]
fn a_place_takes_16_bytes_and_a_buffer_30_beside_its_room() {
    assert_eq!((size_of::<Place>(), size_of::<Storage>(), size_of::<Home>()), (16, ROOM + 30, 128));
}

/// Counting them all for each of them would be a thousand million looks.
#[test]
fn the_first_takers_of_a_large_pool_do_not_count_it_each() {
    let pool = Pool::new(MOST / 2);
    let begun = crate::live::clock::thread_cpu_time();
    let held = take_all(&pool);
    let took = crate::live::clock::thread_cpu_time() - begun;
    assert_eq!((held.len(), pool.statistics().least), (MOST / 2, 0));
    assert!(took < 50_000_000, "{took} ns");
}

/// Counting them all each time would be 300 million looks.
#[test]
fn whether_a_large_pool_has_a_few_buffers_is_known_without_counting_all() {
    let pool = Pool::new(MOST / 2);
    let mut held: Vec<Buf> = (0..MOST / 4).filter_map(|_| pool.take()).collect();
    let begun = crate::live::clock::thread_cpu_time();
    let lacking = (0..10_000).filter(|n| pool.lacks(std::hint::black_box(1 + n % 45)).is_some());
    assert_eq!(lacking.count(), 0);
    let took = crate::live::clock::thread_cpu_time() - begun;
    assert!(took < 20_000_000, "{took} ns");
    held.extend(take_all(&pool));
    assert_eq!((pool.lacks(1), pool.lacks(0)), (Some(MOST / 2), None));
}

#[test]
fn taking_needs_no_lock() {
    assert!(AtomicCell::<Option<Box<Storage>>>::is_lock_free());
}

#[derive(Clone, Debug)]
enum Step {
    Take,
    Return(usize),
    Extend(usize),
    Shrink(usize),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        8 => Just(Step::Take),
        6 => (0..16usize).prop_map(Step::Return),
        1 => (0..6usize).prop_map(Step::Extend),
        1 => (0..6usize).prop_map(Step::Shrink),
    ]
}

proptest! {
    /// The fewest ever free are told exactly, though they are not counted with every buffer.
    #[test]
    fn a_pool_counts_as_one_that_counts_always(
        capacity in 1..8usize,
        more in 0..8usize,
        steps in proptest::collection::vec(step(), 0..200),
    ) {
        let pool = Pool::with_room(capacity, capacity + more);
        let mut held = Vec::new();
        let mut expected = PoolStatistics { capacity, free: capacity, least: capacity, exhausted: 0 };
        for step in steps {
            let before = expected.capacity;
            match step {
                Step::Take => match pool.take() {
                    Some(buf) => {
                        held.push(buf);
                        expected.free -= 1;
                    }
                    None => expected.exhausted += 1,
                },
                Step::Return(which) if !held.is_empty() => {
                    held.swap_remove(which % held.len());
                    expected.free += 1;
                }
                Step::Return(_) => {}
                Step::Extend(n) => {
                    let added = n.min(capacity + more - expected.capacity);
                    prop_assert_eq!(pool.extend(n), added);
                    (expected.capacity, expected.free) = (expected.capacity + added, expected.free + added);
                }
                Step::Shrink(n) => {
                    let removed = n.min(expected.free).min(expected.capacity - 1);
                    prop_assert_eq!(pool.shrink(n), removed);
                    (expected.capacity, expected.free) = (expected.capacity - removed, expected.free - removed);
                }
            }
            let least = if expected.capacity == before { expected.least } else { expected.free };
            expected.least = least.min(expected.free);
            prop_assert_eq!(pool.statistics(), expected);
            prop_assert_eq!((pool.capacity(), pool.available()), (expected.capacity, expected.free));
            for n in 0..=capacity + more {
                prop_assert_eq!(pool.lacks(n).is_some(), n > expected.free);
            }
        }
    }
}
