use std::thread;

use proptest::prelude::*;

use super::super::{Pool, hand_over};
use super::*;

fn filled(pool: &Pool, bytes: &[u8]) -> Buf {
    let mut buf = pool.take().expect("the pool has one");
    buf.fill(bytes);
    buf
}

/// Buffers of three pools by turns, each with its number in it.
fn chain_of(pools: &[Pool; 3], count: usize) -> Chain {
    let mut chain = Chain::new();
    (0..count).for_each(|i| chain.push(filled(&pools[i % 3], &[i as u8; 7])));
    chain
}

fn pools() -> [Pool; 3] {
    [17, 18, 19].map(Pool::new)
}

fn at_home(pools: &[Pool; 3]) -> [usize; 3] {
    [0, 1, 2].map(|i| pools[i].available())
}

#[test]
fn a_chain_of_50_buffers_from_three_pools_goes_home_when_it_is_dropped() {
    let pools = pools();
    let chain = chain_of(&pools, 50);
    assert_eq!((chain.count(), chain.len()), (50, 350));
    assert_eq!(at_home(&pools), [0, 1, 3]);
    drop(chain);
    assert_eq!(at_home(&pools), [17, 18, 19]);
}

#[test]
fn a_chain_goes_home_from_another_thread_too() {
    let pools = pools();
    for _ in 0..100 {
        let chain = chain_of(&pools, 50);
        thread::scope(|scope| scope.spawn(move || drop(chain)).join()).unwrap();
        assert_eq!(at_home(&pools), [17, 18, 19]);
    }
}

#[test]
fn chains_are_made_on_one_thread_and_end_on_another_at_the_same_time() {
    let pools = pools();
    let (sender, receiver) = std::sync::mpsc::sync_channel(4);
    thread::scope(|scope| {
        scope.spawn(|| {
            for _ in 0..5_000 {
                let buffers = (0..10).filter_map(|i| pools[i % 3].take());
                let chain = buffers.fold(Chain::new(), |mut chain, buf| {
                    chain.push(buf);
                    chain
                });
                sender.send(chain).unwrap();
            }
            drop(sender);
        });
        scope.spawn(|| receiver.into_iter().for_each(drop));
    });
    assert_eq!(at_home(&pools), [17, 18, 19]);
}

#[test]
fn dropping_a_long_chain_needs_no_more_stack_than_a_short_one() {
    let pool = Pool::new(10_000);
    let little = thread::Builder::new().stack_size(64 * 1_024);
    let mut chain = Chain::new();
    iter::from_fn(|| pool.take()).for_each(|buf| chain.push(buf));
    assert_eq!(chain.count(), 10_000);
    little.spawn(move || drop(chain)).unwrap().join().unwrap();
    assert_eq!(pool.available(), 10_000);
}

#[test]
fn a_buffer_taken_out_of_a_chain_is_on_its_own() {
    let (nic, socket) = (Pool::new(3), Pool::new(1));
    let mut chain = Chain::of(filled(&nic, b"first"));
    chain.push(filled(&nic, b"second"));
    chain.push(filled(&nic, b"third"));
    let kept = hand_over(chain.pop_front().unwrap(), &socket).unwrap();
    assert_eq!((&kept[..], chain.count(), nic.available()), (&b"first"[..], 2, 1));
    drop(kept);
    assert_eq!((socket.available(), nic.available()), (1, 1), "nothing went with it");
    assert_eq!(chain.parts().collect::<Vec<_>>(), [&b"second"[..], b"third"]);
}

#[test]
fn a_datagram_without_a_byte_is_a_chain_all_the_same() {
    let pool = Pool::new(1);
    let mut chain = Chain::of(pool.take().unwrap());
    assert_eq!((chain.len(), chain.count(), chain.is_empty()), (0, 1, false));
    assert!(chain.pop_front().is_some() && chain.pop_front().is_none());
    assert_eq!((chain.count(), chain.is_empty()), (0, true));
}

#[test]
fn copying_begins_within_a_part_and_ends_where_the_room_does() {
    let pool = Pool::new(3);
    let mut chain = Chain::new();
    for part in [&b"real"[..], b"-", b"time"] {
        let mut buf = filled(&pool, b"header");
        buf.truncate(0);
        buf.fill(&[b"udp", part].concat());
        buf.trim_front(3);
        chain.push(buf);
    }
    let copied = |from, room| {
        let mut into = vec![0; room];
        let n = chain.copy_to(from, &mut into);
        into.truncate(n);
        String::from_utf8(into).unwrap()
    };
    assert_eq!(copied(0, 20), "real-time");
    assert_eq!(copied(2, 5), "al-ti");
    assert_eq!(copied(4, 1), "-");
    assert_eq!(copied(8, 20), "e");
    assert_eq!([copied(9, 20), copied(usize::MAX, 20), copied(3, 0)], ["", "", ""]);
}

#[test]
fn a_chain_knows_which_bytes_are_where() {
    let pool = Pool::new(3);
    let mut chain = Chain::new();
    for part in [&b"abc"[..], b"", b"defg"] {
        chain.push(filled(&pool, part));
    }
    for from in 0..=7 {
        for to in from..=7 {
            assert!(chain.is_at(from, &b"abcdefg"[from..to]), "{from} to {to}");
        }
    }
    assert!(
        !chain.is_at(2, b"cX") && !chain.is_at(0, b"abd") && !chain.is_at(6, b"gh") && !chain.is_at(9, b"a")
    );
}

#[test]
fn a_chain_is_as_small_as_a_buffer_and_goes_to_any_thread() {
    fn goes_anywhere<T: Send + Sync>() -> usize {
        size_of::<T>()
    }
    assert_eq!(goes_anywhere::<Chain>(), goes_anywhere::<Buf>());
}

#[derive(Clone, Debug)]
enum Step {
    Push(Vec<u8>, usize),
    PushFront(Vec<u8>),
    Pop,
    Copy(usize, usize),
}

fn step() -> impl Strategy<Value = Step> {
    let bytes = proptest::collection::vec(any::<u8>(), 0..40);
    prop_oneof![
        1 => bytes.clone().prop_map(Step::PushFront),
        3 => (bytes, 0..40usize).prop_map(|(bytes, trimmed)| Step::Push(bytes, trimmed)),
        2 => Just(Step::Pop),
        1 => (0..300usize, 0..300usize).prop_map(|(from, room)| Step::Copy(from, room)),
    ]
}

proptest! {
    #[test]
    fn a_chain_behaves_as_a_vector_of_its_parts(steps in proptest::collection::vec(step(), 0..60)) {
        let pools = [20, 20, 20].map(Pool::new);
        let (mut chain, mut parts) = (Chain::new(), Vec::<Vec<u8>>::new());
        for (i, step) in steps.into_iter().enumerate() {
            match step {
                Step::Push(bytes, trimmed) => {
                    let mut buf = filled(&pools[i % 3], &bytes);
                    let trimmed = trimmed.min(bytes.len());
                    buf.trim_front(trimmed);
                    chain.push(buf);
                    parts.push(bytes[trimmed..].to_vec());
                }
                Step::PushFront(bytes) => {
                    chain.push_front(filled(&pools[i % 3], &bytes));
                    parts.insert(0, bytes);
                }
                Step::Pop => {
                    let first = (!parts.is_empty()).then(|| parts.remove(0));
                    prop_assert_eq!(chain.pop_front().map(|buf| buf.to_vec()), first);
                }
                Step::Copy(from, room) => {
                    let expected: Vec<u8> = parts.concat().into_iter().skip(from).take(room).collect();
                    let mut into = vec![0; room];
                    let n = chain.copy_to(from, &mut into);
                    prop_assert_eq!(&into[..n], &expected[..]);
                    prop_assert!(into[n..].iter().all(|&untouched| untouched == 0));
                }
            }
            prop_assert_eq!(chain.parts().map(<[u8]>::to_vec).collect::<Vec<_>>(), &parts[..]);
            prop_assert_eq!(chain.len(), parts.concat().len());
            prop_assert_eq!((chain.count(), chain.is_empty()), (parts.len(), parts.is_empty()));
        }
        drop(chain);
        prop_assert_eq!(at_home(&pools), [20; 3]);
    }
}
