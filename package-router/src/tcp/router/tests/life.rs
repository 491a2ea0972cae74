//! Signs of life.

use super::*;

#[test]
fn asking_much_and_reading_nothing_ends_as_silence() {
    let mut net = Net::of(2);
    let questions: Vec<u8> = (1..=5_000u32).flat_map(|name| control(13, &name.to_le_bytes())).collect();
    net.send(0, &questions);
    net.send(1, &questions);
    assert!(net.counters(0).answers_lost > 0, "no room is left");
    let round = |net: &mut Net| {
        net.now = net.router.next_round();
        net.router.round(net.now);
        net.endings()
    };
    assert_eq!(round(&mut net), []);
    // One shows that it is alive; the other does not.
    net.send(1, &control(0, &[]));
    assert_eq!(round(&mut net), [(0, Ending::Silent)]);
    net.router.disconnect(Connection(0), Ending::Silent, net.now);
    // It reads, and is asked.
    net.flush();
    assert_eq!(round(&mut net), []);
    net.flush();
    assert_eq!(round(&mut net), [(1, Ending::Silent)]);
}

#[test]
fn silence_ends_a_connection_in_the_round_after_it_was_asked() {
    let mut net = Net::of(4);
    net.send(2, &control(19, &[]));
    let round = |net: &mut Net| {
        net.now = net.router.next_round();
        net.router.round(net.now);
        net.flush();
        net.endings()
    };
    assert_eq!(round(&mut net), []);
    // 0 answers; 1 does not, nor does 2, whose watchdog is off; 3 sends something else.
    net.send(0, &control(0, &[]));
    net.send(3, &package(-6, 1, 2, b"data"));
    assert_eq!(round(&mut net), [(1, Ending::Silent)]);
    net.router.disconnect(Connection(1), Ending::Silent, net.now);
    net.send(0, &control(0, &[]));
    net.send(2, &control(18, &[]));
    assert_eq!(round(&mut net), [(3, Ending::Silent)]);
    assert_eq!(round(&mut net), [(2, Ending::Silent), (0, Ending::Silent)], "3 is on its way out already");
}

#[test]
fn each_of_many_is_asked_once_in_a_round() {
    const MANY: usize = 1_000;
    let mut net = Net::of(MANY);
    let mut asked = vec![0; MANY];
    let mut most = 0;
    for now in 0..2 * LIFESIGN_EVERY {
        if now < net.router.next_round() {
            continue;
        }
        net.now = now;
        net.router.round(now);
        let mut at_once = 0;
        for (of, count) in asked.iter_mut().enumerate() {
            let read = net.reads(of);
            if !read.is_empty() {
                assert_eq!(Head::parse(&read).unwrap().kind, LIFESIGN);
                net.send(of, &control(0, &[]));
                (*count, at_once) = (*count + 1, at_once + 1);
            }
        }
        most = most.max(at_once);
    }
    assert!(asked.iter().all(|count| *count == 1), "the second round begins at 10 s");
    assert_eq!((most, net.endings()), (256, vec![]));
}

#[test]
fn a_router_that_stands_still_in_a_round_ends_none_alive() {
    const MANY: usize = 300;
    let mut net = Net::of(MANY);
    // The second part has its turn 6 s after the first.
    net.router.round(LIFESIGN_EVERY);
    net.now = LIFESIGN_EVERY + 6_000;
    net.router.round(net.now);
    assert_eq!(net.router.next_round(), net.now + LIFESIGN_EVERY - 10, "the first part goes first again");
    // They answer just in time.
    (0..MANY).for_each(|of| net.send(of, &control(0, &[])));
    for _ in 0..2 {
        net.now = net.router.next_round();
        net.router.round(net.now);
    }
    assert_eq!(net.endings(), []);
}
