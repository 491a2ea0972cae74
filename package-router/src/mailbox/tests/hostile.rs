//! Whatever one side writes into its own memory: it harms nobody else.

use proptest::collection::vec;
use proptest::prelude::*;

use super::*;

fn any_word() -> impl Strategy<Value = u64> {
    prop_oneof![
        any::<u64>(),
        0..100u64,
        (0..100u64).prop_map(u64::wrapping_neg),
        (0..4u64, 0..4u64).prop_map(|(n, slot)| n << 16 | slot)
    ]
}

fn any_policy() -> impl Strategy<Value = WhenFull> {
    prop_oneof![Just(WhenFull::Refuse), Just(WhenFull::Replace), Just(WhenFull::Answer)]
}

proptest! {
    /// One sender scribbles over its segment at any time, between packages that it may have sent in earnest.
    #[test]
    fn a_mad_sender_costs_the_other_not_one_package(
        when_full in any_policy(),
        writes in vec((0..96usize, any_word(), 0..4u8), 1..200),
    ) {
        let shape = Shape { when_full, ..Shape::new(4, 8).senders(2) };
        let (mut inbox, mut senders) = mailbox(shape);
        let (mut refused, mut kept) = (Vec::new(), 0);
        let mad = senders[1].segment().clone();
        let (mut expected, mut came) = (0u8, 0u8);
        for (now, (place, word, what)) in (100..).zip(writes) {
            mad[place % mad.len()].store(word, core::sync::atomic::Ordering::Relaxed);
            match what {
                0 => _ = senders[1].send(&head(1, 50, 0), &[1; 8], &at(now)),
                1 => {
                    if when_full == WhenFull::Answer && senders[0].waiting() == Ok(4) {
                        kept += usize::from(senders[0].send(&head(0, 50, 0), &[], &at(now)).is_ok());
                    } else if senders[0].waiting().unwrap() < 4 {
                        senders[0].send(&head(0, 50, expected), &[expected; 8], &at(now)).unwrap();
                        expected = expected.wrapping_add(1);
                    }
                }
                _ => {
                    let before = refused.len();
                    inbox.take_refused_commands(&mut refused);
                    prop_assert!(refused.len() - before <= 2 * MOST_KEPT);
                    if let Some(package) = inbox.receive(now) {
                        prop_assert!(package.body().len() <= 8);
                        if package.head().from == from(0) {
                            prop_assert_eq!(package.body().to_vec(), [came; 8]);
                            came = came.wrapping_add(1);
                        }
                    }
                }
            }
        }
        // However much it claims to have sent.
        for _ in 0..100 {
            let Some(package) = inbox.receive(1_000) else { break };
            if package.head().from == from(0) {
                prop_assert_eq!(package.body().to_vec(), [came; 8]);
                came = came.wrapping_add(1);
            }
        }
        prop_assert_eq!(came, expected);
        prop_assert_eq!(senders[0].waiting(), Ok(0));
        inbox.take_refused_commands(&mut refused);
        prop_assert_eq!(refused.iter().filter(|head| head.from == from(0)).count(), kept);
    }

    /// The owner scribbles over its own: its senders are refused, or think that something was read.
    #[test]
    fn a_mad_owner_makes_its_senders_neither_wait_nor_fall(
        when_full in any_policy(),
        writes in vec((0..400usize, any_word(), any::<u8>()), 1..200),
    ) {
        let shape = Shape { when_full, ..Shape::new(4, 8).senders(2) };
        let (mut inbox, mut senders) = mailbox(shape);
        let mad = inbox.segment().clone();
        for (now, (place, word, what)) in (100..).zip(writes) {
            mad[place % mad.len()].store(word, core::sync::atomic::Ordering::Relaxed);
            let lane = usize::from(what % 2);
            let _ = senders[lane].send(&head(lane, what, what), &[what; 8], &at(now));
            if what > 200 {
                drop(inbox.receive(now));
                inbox.take_refused_commands(&mut Vec::new());
            }
        }
    }
}
