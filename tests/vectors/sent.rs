//! Frames 23 to 28 as stacks send them: addresses, identification, fragments and padding are theirs, not the test's.

use std::net::SocketAddrV4;

use rtnet::socket::Options;
use tests::ends::{A, B, End, pair};
use tests::vectors::vector;

use super::stack::{ascending, ping_data};

/// What the slots of frames 24 and 25 take behind the Ethernet header: 104 bytes of a datagram each.
const SLOT: usize = 128;

fn frames(numbers: &[usize]) -> Vec<Vec<u8>> {
    numbers.iter().map(|&number| vector(number).bytes).collect()
}

/// The only frame that waits to leave.
fn leaves(end: &mut End) -> Vec<u8> {
    let mut frames = end.leaves(usize::MAX);
    assert_eq!(frames.len(), 1);
    frames.remove(0)
}

#[test]
fn a_stack_sends_the_datagrams_of_the_example_frames_whole_and_in_fragments() {
    let (_, mut slave) = pair();
    slave.queue.limit = SLOT;
    let [short, long] = [1024, 1025].map(|port| slave.socket(port, 4));
    slave.send(short, &[0; 16], Some(SocketAddrV4::new(A.1, 36_000))).expect("there is a route");
    slave.send(long, &ascending(200), Some(SocketAddrV4::new(A.1, 37_000))).expect("there is a route");
    assert_eq!(slave.leaves(usize::MAX), frames(&[23, 24, 25]));
}

#[test]
fn a_stack_asks_for_an_address_and_another_answers_as_in_the_example_frames() {
    let (mut master, mut slave) = (End::new(A), End::new(B));
    master.stack.solicit(B.1, &mut master.queue).expect("there are buffers");
    let asked = leaves(&mut master);
    assert_eq!(asked, vector(26).bytes);
    slave.hears(&asked).expect("it is asked for");
    assert_eq!(leaves(&mut slave), vector(27).bytes);
}

#[test]
fn a_stack_asks_for_the_echo_of_the_example_frame_and_another_answers_it() {
    let (mut master, mut slave) = pair();
    // Its identification is that of the third.
    for sequence in [7, 8, 1] {
        master.leaves(usize::MAX);
        let (to, which) = (B.1, (0xbeef, sequence));
        let asked = master.stack.ask_echo(to, which, &ping_data(), Options::default(), &mut master.queue);
        asked.expect("there is a route");
    }
    let asked = leaves(&mut master);
    assert_eq!(asked, vector(28).bytes);

    slave.hears(&asked).expect("it is for this one");
    assert_eq!(leaves(&mut slave), answer_to_frame_28());
}

/// Frame 28 with its ends exchanged, which changes no sum; of type 0 instead of 8, and with identification 0 instead of 2,
/// by which the two checksums are more.
fn answer_to_frame_28() -> Vec<u8> {
    let asked = vector(28).bytes;
    let mut answer = asked.clone();
    answer[..6].copy_from_slice(&asked[6..12]);
    answer[6..12].copy_from_slice(&asked[..6]);
    answer[26..30].copy_from_slice(&asked[30..34]);
    answer[30..34].copy_from_slice(&asked[26..30]);
    let mut word = |at: usize, from: u16, to: u16| {
        assert_eq!(asked[at..at + 2], from.to_be_bytes());
        answer[at..at + 2].copy_from_slice(&to.to_be_bytes());
    };
    word(18, 2, 0);
    word(24, 0x67a3, 0x67a5);
    word(34, 0x0800, 0);
    word(36, 0x48d5, 0x50d5);
    answer
}
