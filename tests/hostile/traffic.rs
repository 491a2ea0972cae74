//! The traffic of a lab's stations, and bytes that it has not sent.

use std::sync::Arc;

use proptest::prelude::*;
use rtnet::buf::{Buf, Pool};
use rtnet::counters::Refusal;
use rtnet::discipline::{Opportunity, Service};
use rtnet::time::{GlobalTime, Instant};
use rtnet::wire::ethernet::{Address, EtherType};
use tests::{traffic, vectors};
use tools::station::traffic::{Arrived, Traffic, TrafficCounts};

use super::{MASTER, SLAVE, cases, hostile_frame};

/// A receiver in whom no byte has any business but those of the sender's frames.
struct Receiver {
    traffic: Traffic,
    counts: Arc<TrafficCounts>,
    pool: Pool,
}

impl Receiver {
    fn new() -> Self {
        let counts = Arc::new(TrafficCounts::default());
        let traffic = traffic::of_a_lab((1, SLAVE), MASTER, 0, counts.clone());
        Self { traffic, counts, pool: Pool::new(1) }
    }

    fn hear(&mut self, bytes: &[u8]) -> Result<(), Refusal> {
        let mut frame: Buf = self.pool.take().expect("the last one came back");
        frame.fill(bytes);
        self.traffic.on_frame(Some(Instant::default()), frame)
    }

    /// It is refused by its reason, and leaves no trace in the counts.
    fn refuses(&mut self, bytes: &[u8]) {
        assert_eq!(self.hear(bytes), Err(Refusal::BadPayload), "{bytes:02x?}");
        assert_eq!(self.counts.arrived(None), Arrived::default(), "{bytes:02x?}");
    }
}

/// What the sender sends in its slot.
fn genuine() -> Vec<u8> {
    let mut sender = traffic::of_a_lab((0, MASTER), SLAVE, 1, Arc::default());
    let scheduled = GlobalTime::from_nanos(1_000_100_400_000);
    let slot = Opportunity { channel: 0, cycle: 100, begin: Instant::default(), scheduled, non_rt: None };
    let mut sent = Vec::new();
    sender.fill(&slot, None, &mut |frame, _, _| {
        sent = frame.to_vec();
        Ok(())
    });
    sent
}

/// The same bytes, as traffic from the sender to the receiver as far as there are so many.
fn as_traffic(mut bytes: Vec<u8>) -> Vec<u8> {
    let head = [&SLAVE.0[..], &MASTER.0[..], &EtherType::EXPERIMENTAL.0.to_be_bytes()[..]].concat();
    bytes.iter_mut().zip(head).for_each(|(byte, of_head)| *byte = of_head);
    bytes
}

#[test]
fn only_the_whole_frame_is_accepted() {
    let (mut receiver, genuine) = (Receiver::new(), genuine());
    (0..genuine.len()).for_each(|len| receiver.refuses(&genuine[..len]));
    receiver.refuses(&[&genuine[..], &[0]].concat());
    assert_eq!(receiver.hear(&genuine), Ok(()));
    assert_eq!(receiver.hear(&genuine), Err(Refusal::BadPayload), "and once");
}

#[test]
fn every_prefix_of_every_example_frame_and_every_byte_changed() {
    let mut receiver = Receiver::new();
    for vector in vectors::all() {
        (0..=vector.bytes.len()).for_each(|len| receiver.refuses(&vector.bytes[..len]));
        (0..=vector.bytes.len()).for_each(|len| receiver.refuses(&as_traffic(vector.bytes[..len].to_vec())));
        for (at, change) in (0..vector.bytes.len()).flat_map(|at| [(at, 0x01), (at, 0x80), (at, 0xff)]) {
            let mut bytes = as_traffic(vector.bytes.clone());
            bytes[at] ^= change;
            receiver.refuses(&bytes);
        }
    }
}

#[test]
fn it_is_addressed_to_the_receiver_alone() {
    let mut bytes = genuine();
    bytes[..6].copy_from_slice(&Address::BROADCAST.0);
    Receiver::new().refuses(&bytes);
}

proptest! {
    #![proptest_config(cases(8))]

    #[test]
    fn any_frame(bytes in hostile_frame()) {
        let mut receiver = Receiver::new();
        receiver.refuses(&bytes);
        receiver.refuses(&as_traffic(bytes));
    }

    #[test]
    fn any_bytes_in_a_genuine_frame(at in any::<prop::sample::Index>(), with in prop::collection::vec(any::<u8>(), 1..30)) {
        let genuine = genuine();
        let mut bytes = genuine.clone();
        let at = at.index(bytes.len());
        bytes.iter_mut().skip(at).zip(&with).for_each(|(byte, with)| *byte = *with);
        prop_assume!(bytes != genuine);
        Receiver::new().refuses(&bytes);
    }
}
