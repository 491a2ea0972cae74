//! Lines, turn by turn.

use core::net::SocketAddrV4;
use std::fs::File;
use std::io::Write;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use super::*;
use crate::buf::Pool;
use crate::ip::StackConfig;
use crate::ip::route::Interface;
use crate::ip::tests::{A, B, End, IP_A, IP_B};
use crate::socket::{Options, Socket};
use crate::time::Instant;

/// A station and what its programs write.
struct Site {
    end: End,
    programs: Vec<(SocketId, Writer)>,
    pools: Vec<Arc<Pool>>,
    memories: Vec<Arc<Memory>>,
    /// What programs wait at.
    gates: Vec<OwnedFd>,
}

impl Site {
    fn new(programs: usize, buffers: usize) -> Self {
        let config = StackConfig::new(Interface { address: A, ip: IP_A, prefix: 24 });
        let mut end = End::above(config, vec![Box::new(Lines::new(programs))]);
        end.knows(IP_B, B);
        let (pools, memories, gates) = (Vec::new(), Vec::new(), Vec::new());
        let mut site = Self { end, programs: Vec::new(), pools, memories, gates };
        for _ in 0..programs {
            let line = Line::new(Bells::new().unwrap()).unwrap();
            let writer = Writer::new(line.memory.clone(), segment::sent());
            let pool = Arc::new(Pool::new(buffers));
            let id = site.end.open(Socket::udp(pool.clone()));
            site.pools.push(pool);
            site.memories.push(line.memory.clone());
            let [_, gate, _] = line.descriptors().unwrap();
            site.gates.push(gate);
            let lines = site.end.stack.program_mut::<Lines>().unwrap();
            assert!(lines.add(id, line).is_ok());
            site.programs.push((id, writer));
        }
        site
    }

    /// A program hands over a datagram of so many bytes.
    fn order(&mut self, program: usize, len: usize) {
        let to = Some(segment::pack_udp(SocketAddrV4::new(IP_B, 9)));
        let order = segment::pack_order(&Order { to, options: Options::default(), flags: 0, at: None });
        let written = self.programs[program].1.write(order, len, [&vec![7; len][..]].into_iter());
        assert_eq!(written, Ok(true));
    }

    /// One turn: how many frames are waiting after it.
    fn turn(&mut self) -> usize {
        let waiting = self.look();
        self.end.stack.rest();
        waiting
    }

    /// One look at programs, of which a turn may have several.
    fn look(&mut self) -> usize {
        self.end.stack.poll(Instant::from_nanos(0), &mut self.end.queue);
        self.end.queue.waiting.len()
    }

    /// A datagram of so many bytes comes for a program.
    fn hears(&mut self, program: usize, len: usize) {
        let mut peer = End::new(B, IP_B);
        peer.knows(IP_A, A);
        let socket = peer.socket(0, 1);
        let port = self.end.stack.local_address(self.programs[program].0).unwrap().port();
        peer.send(socket, &vec![7; len], IP_A, port).unwrap();
        // One for which there is no room is refused.
        let _ = self.end.hears(&peer.sent()[0]);
    }

    fn is_woken(&self, program: usize) -> bool {
        let mut fds = [PollFd::new(self.gates[program].as_fd(), PollFlags::POLLIN)];
        poll(&mut fds, PollTimeout::ZERO).unwrap() == 1
    }

    fn sent(&self, program: usize) -> (u64, u64) {
        let counters = self.end.stack.socket_counters(self.programs[program].0).unwrap();
        (counters.sent, counters.no_buffers)
    }
}

#[test]
fn what_waits_for_buffers_is_sent_when_they_are_home_and_is_no_loss() {
    let mut site = Site::new(1, 4);
    (0..6).for_each(|_| site.order(0, 100));
    for _ in 0..10 {
        assert_eq!(site.turn(), 4);
    }
    assert_eq!(site.sent(0), (4, 0));
    site.end.queue.waiting.truncate(2);
    assert_eq!(site.turn(), 4);
    assert_eq!(site.sent(0), (6, 0));
}

#[test]
fn who_reads_nothing_is_refused_what_he_sends_and_told_why() {
    let mut site = Site::new(2, 4);
    for _ in 0..4 + segment::RING * 8 / 1_400 {
        site.hears(0, 1_400);
        site.end.stack.rest();
    }
    assert_eq!(site.pools[0].available(), 0);
    (0..2).for_each(|program| site.order(program, 100));
    assert_eq!(site.turn(), 1, "nobody else's");
    assert_eq!([site.sent(0), site.sent(1)], [(0, 1), (1, 0)]);
    assert_eq!(site.memories[0][ERROR].load(Ordering::Relaxed), 1 << 32 | libc::ENOBUFS as u64);
}

#[test]
fn to_refuse_who_reads_nothing_is_work_of_a_turn_as_well() {
    let (programs, buffers) = (30, 1_000);
    let mut site = Site::new(programs, buffers);
    for program in 0..programs {
        while site.pools[program].available() > 0 {
            site.hears(program, 1_400);
            site.end.stack.rest();
        }
    }
    (0..programs).for_each(|program| site.order(program, 100));
    site.turn();
    let refused = (0..programs).map(|program| site.sent(program).1).sum::<u64>();
    assert!((1..=WORK_AT_ONCE.div_ceil(buffers) as u64).contains(&refused), "{refused}");
}

#[test]
fn nobody_is_woken_before_the_turn_is_over() {
    let mut site = Site::new(4, 4);
    site.hears(0, 100);
    // No route, and nonsense.
    let to = Some(segment::pack_udp(SocketAddrV4::new([192, 168, 0, 1].into(), 9)));
    let order = segment::pack_order(&Order { to, options: Options::default(), flags: 0, at: None });
    assert_eq!(site.programs[1].1.write(order, 0, [].into_iter()), Ok(true));
    site.memories[2][segment::sent().head].store(u64::MAX, Ordering::Relaxed);
    let woken = |site: &Site| [0, 1, 2, 3].map(|program| site.is_woken(program));
    site.look();
    assert_eq!(woken(&site), [false; 4], "its slot's frame has not left");
    site.end.stack.rest();
    assert_eq!(woken(&site), [true, true, true, false]);
    let word = |program: usize, word: usize| site.memories[program][word].load(Ordering::Relaxed);
    assert_eq!((word(1, ERROR), word(2, STATE)), (1 << 32 | libc::EHOSTUNREACH as u64, ENDED));
}

#[test]
fn long_datagrams_of_one_program_leave_the_others_their_part_of_each_turn() {
    let mut site = Site::new(3, 100);
    (0..3).for_each(|_| site.order(0, 20_000));
    (1..3).for_each(|program| site.order(program, 10));
    let fragments = 14;
    assert_eq!(site.turn(), fragments, "one datagram is work for a turn");
    assert_eq!(site.turn(), 2 * fragments + 2, "then who had no part of it comes first");
    assert_eq!(site.turn(), 3 * fragments + 2);
}

#[test]
fn however_often_programs_are_looked_at_in_a_turn_it_is_work_of_one() {
    let mut site = Site::new(2, 100);
    (0..2).for_each(|program| site.order(program, 20_000));
    let fragments = 14;
    assert_eq!([site.look(), site.look(), site.look()], [fragments; 3], "as for each of its slots");
    site.end.stack.rest();
    assert_eq!(site.look(), 2 * fragments);
}

#[test]
fn a_flood_of_short_datagrams_ends_a_turn_as_well() {
    let mut site = Site::new(20, 100);
    for program in 0..20 {
        (0..20).for_each(|_| site.order(program, 10));
    }
    let most = WORK_AT_ONCE / EACH + 1;
    let mut before = 0;
    while before < 400 {
        let now = site.turn();
        assert!((before + 1..=before + most).contains(&now), "from {before} to {now} frames in a turn");
        before = now;
    }
}

#[test]
fn orders_that_wait_have_their_part_of_each_turn_and_no_more() {
    let (programs, buffers) = (40, 1_000);
    let mut site = Site::new(programs, buffers);
    let held: Vec<_> = site.pools[1..].iter().flat_map(|pool| core::iter::from_fn(|| pool.take())).collect();
    (1..programs).for_each(|program| site.order(program, 10));
    // The last place of all has nothing to wait for.
    site.end.stack.program_mut::<Lines>().unwrap().first = 1;
    site.order(0, 10);
    let in_a_turn = WORK_AT_ONCE.div_ceil(EACH + buffers);
    for _ in 0..(programs - 1) / in_a_turn {
        assert_eq!(site.turn(), 0, "those before it have taken all of this turn");
        assert!(site.end.stack.sleeps(true));
    }
    assert_eq!(site.turn(), 1);
    drop(held);
    assert_eq!(site.turn(), programs, "once none has to wait");
}

#[test]
fn a_station_does_not_sleep_on_buffers_that_came_home_while_others_had_the_turn() {
    let (programs, buffers) = (20, 1_000);
    let mut site = Site::new(programs, buffers);
    let hold = |pool: &Arc<Pool>| -> Vec<_> { core::iter::from_fn(|| pool.take()).collect() };
    let mut held: Vec<_> = site.pools.iter().map(hold).collect();
    (0..programs).for_each(|program| site.order(program, 10));
    assert_eq!([site.turn(), site.turn()], [0, 0]);
    assert!(!site.end.stack.sleeps(true), "all wait, and were looked at");
    drop(held.pop());
    site.end.stack.program_mut::<Lines>().unwrap().first = 0;
    assert_eq!(site.turn(), 0, "its turn is the next");
    assert!(site.end.stack.sleeps(true));
    assert_eq!(site.turn(), 1);
    assert!(!site.end.stack.sleeps(true), "the others still wait");
}

#[test]
fn a_station_does_not_sleep_on_what_it_can_send_but_on_what_waits() {
    let mut site = Site::new(1, 10);
    (0..12).for_each(|_| site.order(0, 10));
    assert_eq!(site.turn(), ORDERS_AT_ONCE);
    assert!(site.end.stack.sleeps(true), "more can be sent");
    assert!(!site.end.stack.sleeps(true), "but not without a turn");
    assert_eq!(site.turn(), 10);
    assert!(!site.end.stack.sleeps(true), "what is left waits for buffers");
}

#[test]
fn who_makes_a_bell_useless_silences_no_other_and_one_that_has_gone_rings_no_more() {
    let bells = Bells::new().unwrap();
    let lines = [(); 2].map(|()| Line::new(bells.clone()).unwrap());
    let [mut full, mut other] = lines.each_ref().map(|line| {
        let [_, _, doorbell] = line.descriptors().unwrap();
        File::from(doorbell)
    });
    let is_heard = || bells.wait(PollTimeout::ZERO) != 0;
    full.write_all(&(u64::MAX - 1).to_ne_bytes()).unwrap();
    assert!(is_heard());
    for _ in 0..3 {
        assert!(!is_heard());
        other.write_all(&1u64.to_ne_bytes()).unwrap();
        assert!(is_heard());
    }
    drop(lines);
    other.write_all(&1u64.to_ne_bytes()).unwrap();
    assert!(!is_heard());
}
