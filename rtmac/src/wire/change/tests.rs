use super::*;
use crate::wire::{self, Message, Rtmac};
use proptest::prelude::*;
use rtnet::buf::Pool;
use rtnet::time::GlobalTime;

const MASTER: Address = Address([2, 0, 0, 0, 0, 1]);
const SLAVE: Address = Address([2, 0, 0, 0, 0, 3]);

/// A Synchronisation of cycle 100 that says: schedule 2 is in use, 3 is committed to cycle 148.
const SYNC: &str = "ffffffffffff020000000001902100010200020100000000\
                    0064000000e8da9afdb2000000e8da9af100\
                    820101000002abcd00031234000000940294";
const PART: &str = "ffffffffffff02000000000190210001020082010101\
                    000300020001\
                    12340123456789abcdef00000000001e848000002710\
                    0200000000030200005c000000010000000200000000000aae60";
const ANSWER: &str = "020000000001020000000003902100010200820101100003\
                      12340123456789abcdef03030201";

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect()
}

fn status() -> Status {
    Status {
        oper: ScheduleId { number: 2, sum: 0xabcd },
        admin: ScheduleId { number: 3, sum: 0x1234 },
        activation: 148,
        state: State::Committed,
        is_sure: true,
    }
}

fn a_part() -> Part {
    Part {
        id: ScheduleId { number: 3, sum: 0x1234 },
        digest: 0x0123_4567_89ab_cdef,
        slots: 2,
        index: 1,
        cycle: Span::from_micros(2_000),
        station: SLAVE,
        slot: SlotConfig {
            id: 2,
            offset: Span::from_micros(700),
            phase: 1,
            period: 2,
            size: 92,
            joint: Some(0),
            latest: Span::from_micros(10),
        },
    }
}

fn an_answer() -> Answer {
    let id = ScheduleId { number: 3, sum: 0x1234 };
    let verdict = Verdict::Refused(Why::Phase, 2);
    Answer { id, digest: 0x0123_4567_89ab_cdef, verdict, gives_time: true }
}

fn sync(cycle: u32, said: &Status) -> Buf {
    let mut frame = Pool::new(1).take().unwrap();
    let global = GlobalTime::from_nanos;
    let sync = Message::Sync { cycle, xmit: global(1_000_100_003_250), sched: global(1_000_100_000_000) };
    sync.write(Address::BROADCAST, MASTER, &mut frame);
    said.write(&mut frame);
    frame
}

#[test]
fn a_status_and_its_bytes_are_the_same_thing_and_the_synchronisation_stays_what_it_is() {
    let frame = sync(100, &status());
    assert_eq!(hex(&frame), hex(&bytes(SYNC)));
    assert_eq!(Status::of_sync(&bytes(SYNC)), Some(status()));
    assert!(matches!(wire::parse(&frame), Ok(Rtmac::Tdma(Message::Sync { cycle: 100, .. }))));
}

#[test]
fn parts_and_answers_and_their_bytes_are_the_same_thing_in_both_directions() {
    let examples = [
        (PART, Extension::Part(a_part()), Address::BROADCAST, MASTER),
        (ANSWER, Extension::Answer(an_answer()), MASTER, SLAVE),
    ];
    for (text, extension, destination, source) in examples {
        let mut frame = Pool::new(1).take().unwrap();
        extension.write(destination, source, &mut frame);
        let mut padded = bytes(text);
        padded.resize(padded.len().max(ethernet::MIN_FRAME), 0);
        assert_eq!(hex(&frame), hex(&padded));
        assert_eq!(wire::parse(&frame), Ok(Rtmac::Extension(extension)));
        for len in 0..bytes(text).len() {
            assert!(wire::parse(&frame[..len]).is_err(), "{len} bytes of {text}");
        }
    }
}

#[test]
fn what_real_stations_have_behind_a_synchronisation_is_no_status() {
    let mut frame = sync(100, &status());
    let stale = frame.clone_bytes();
    // The same bytes as stale memory behind another cycle's.
    frame.room_mut()[BODY + 3] = 101;
    assert_eq!(Status::of_sync(&frame), None);
    for at in STATUS_AT..ethernet::MIN_FRAME {
        let mut changed = stale.clone();
        changed[at] ^= 0x10;
        assert_eq!(Status::of_sync(&changed), None, "byte {at}");
    }
    assert_eq!(Status::of_sync(&stale[..ethernet::MIN_FRAME - 1]), None);
}

#[test]
fn stamping_a_synchronisation_leaves_its_status_readable() {
    let mut frame = sync(100, &status());
    let stamp =
        Message::Sync { cycle: 0, xmit: GlobalTime::default(), sched: GlobalTime::default() }.stamp(7);
    stamp.write(&mut frame, rtnet::Instant::from_nanos(93));
    assert_eq!(Status::of_sync(&frame), Some(status()));
}

#[test]
fn contradictions_are_refused_by_name() {
    let mut part = bytes(PART);
    part[27] = 2;
    assert_eq!(wire::parse(&part), Err(Refusal::ScheduleFormat), "part 2 of 2, from 0");
    let mut answer = bytes(ANSWER);
    answer[34] = 9;
    assert_eq!(wire::parse(&answer), Err(Refusal::ScheduleFormat), "an unknown verdict");
    let mut answer = bytes(ANSWER);
    answer[35] = 99;
    assert_eq!(wire::parse(&answer), Err(Refusal::ScheduleFormat), "an unknown reason");
    let mut other = bytes(ANSWER);
    other[21] = 0x77;
    assert_eq!(wire::parse(&other), Err(Refusal::TdmaMessage));
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

trait CloneBytes {
    fn clone_bytes(&self) -> Vec<u8>;
}

impl CloneBytes for Buf {
    fn clone_bytes(&self) -> Vec<u8> {
        self.to_vec()
    }
}

fn any_id() -> impl Strategy<Value = ScheduleId> {
    any::<(u16, u16)>().prop_map(|(number, sum)| ScheduleId { number, sum })
}

proptest! {
    #[test]
    fn every_status_comes_back(
        oper in any_id(), admin in any_id(), activation: u32, state in 0usize..6, is_sure: bool, cycle: u32,
    ) {
        let said = Status { oper, admin, activation, state: State::ALL[state], is_sure };
        prop_assert_eq!(Status::of_sync(&sync(cycle, &said)), Some(said));
    }

    #[test]
    fn whatever_comes_is_read_without_panic_and_written_as_it_was_read(body: Vec<u8>, message in 0x0100u16..0x0112) {
        let mut frame = bytes(ANSWER);
        frame[20..22].copy_from_slice(&message.to_be_bytes());
        frame.truncate(22);
        frame.extend(body);
        let _ = Status::of_sync(&frame);
        if let Ok(Rtmac::Extension(extension)) = wire::parse(&frame) {
            let mut again = Pool::new(1).take().unwrap();
            extension.write(MASTER, SLAVE, &mut again);
            prop_assert_eq!(wire::parse(&again), Ok(Rtmac::Extension(extension)));
        }
    }
}
