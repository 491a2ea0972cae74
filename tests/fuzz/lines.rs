//! A station that serves a program which writes anything anywhere into the memory that they share, and an honest one beside it;
//! and what both sides say to each other first.

use std::net::SocketAddrV4;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use rtnet::api::handshake::{Answer, Ask, is_ask};
use rtnet::api::line::{Line, Lines};
use rtnet::api::memory::Memory;
use rtnet::api::ring::Writer;
use rtnet::api::segment::{self, ASLEEP, Order, STATION_ASLEEP};
use rtnet::buf::Pool;
use rtnet::ip::StackConfig;
use rtnet::ip::route::Interface;
use rtnet::live::Bells;
use rtnet::socket::{Options, Socket, SocketId};
use tests::ends::{A, B, End};

use super::engine::{Target, fuzz, in_turn, outcome};
use super::mutate;
use super::rings::{seeds, whims, wish};

const PORT: u16 = 36_000;

/// A program: its socket, the memory, and what writes there as it should be.
struct Program {
    id: SocketId,
    pool: Arc<Pool>,
    memory: Arc<Memory>,
    writer: Writer,
    ordered: u64,
}

impl Program {
    fn new(end: &mut End, bells: &Bells, buffers: usize) -> Self {
        let line = Line::new(bells.clone()).expect("memory");
        let [memory, _, _] = line.descriptors().expect("descriptors");
        let memory = Arc::new(Memory::open(memory).expect("the same memory"));
        let pool = Arc::new(Pool::new(buffers));
        let id = end.open(Socket::udp(pool.clone())).expect("room");
        let lines = end.stack.program_mut::<Lines>().expect("they are there");
        assert!(lines.add(id, line).is_ok(), "room");
        let writer = Writer::new(memory.clone(), segment::sent());
        Self { id, pool, memory, writer, ordered: 0 }
    }

    /// Orders a datagram of so many bytes, if its ring is one still.
    fn order(&mut self, len: usize) {
        let to = Some(segment::pack_udp(SocketAddrV4::new(B.1, 9)));
        let order = Order { to, options: Options::default(), flags: 0, at: None };
        let written = self.writer.write(segment::pack_order(&order), len, [&[7; 4_096][..len]].into_iter());
        self.ordered += u64::from(written == Ok(true));
    }
}

#[test]
fn lines_take_any_words() {
    fuzz(&Target { name: "lines", seeds: seeds(), has_corpus: true, mutate: mutate::bytes, run: serve });
}

fn serve(input: &[u8]) -> Vec<u64> {
    let bells = Bells::new().expect("an epoll");
    let config = StackConfig::new(Interface { address: A.0, ip: A.1, prefix: 24 });
    let mut end = End::above(config, vec![Box::new(Lines::new(2))]);
    end.knows(B);
    let [mut hostile, mut honest] = [8, 64].map(|buffers| Program::new(&mut end, &bells, buffers));
    end.stack.bind(hostile.id, SocketAddrV4::new(A.1, PORT)).expect("a free port");
    let mut peer = End::new(B);
    peer.knows(A);
    let peers = peer.socket(9, 8);
    let mut outcomes = Vec::new();
    for whim in whims(input) {
        match whim.what % 8 {
            0 => hostile.order(whim.at * 16),
            1 => {
                let sent = peer.send(peers, &[5; 4_096][..whim.at * 16], Some(SocketAddrV4::new(A.1, PORT)));
                assert_eq!(sent, Ok(()));
                for frame in peer.leaves(8) {
                    let _ = end.hears(&frame);
                }
            }
            _ => {
                let at = place(&hostile, whim.what / 8 % 8, whim.at);
                hostile.memory[at].store(wish(&whim, hostile.memory[at].load(Relaxed)), Relaxed);
            }
        }
        honest.order(whim.at);
        // In one of two turns each has its part.
        for _ in 0..2 {
            end.stack.poll(end.now, &mut end.queue);
            end.stack.rest();
        }
        let [of_hostile, of_honest] =
            [&hostile, &honest].map(|program| end.stack.socket_counters(program.id).expect("it is open"));
        assert_eq!((of_honest.sent, of_honest.refused), (honest.ordered, 0), "whatever the other one does");
        let is_ended = end.stack.program_mut::<Lines>().map_or(0, |lines| lines.counters().nonsense);
        outcomes.push(outcome([of_hostile.sent.min(9), of_hostile.refused.min(9), is_ended]));
        if whim.what & 0x40 == 0 || end.queue.waiting.len() > 40 {
            end.queue.waiting.clear();
        }
    }
    end.queue.waiting.clear();
    for Program { id, pool, .. } in [hostile, honest] {
        drop(end.stack.program_mut::<Lines>().and_then(|lines| lines.remove(id)));
        drop(end.stack.close(id));
        assert_eq!(pool.available(), pool.capacity(), "everything comes home");
    }
    in_turn(&outcomes)
}

/// Where it writes: what the station believes if it can be, or anything else.
fn place(hostile: &Program, which: u8, at: usize) -> usize {
    let (sent, received) = (segment::sent(), segment::received());
    let tail = hostile.memory[sent.tail].load(Relaxed) as usize;
    match which {
        0 | 1 => sent.head,
        2 => received.tail,
        3 => [ASLEEP, STATION_ASLEEP][at % 2],
        // The record that is looked at next.
        4..7 => sent.records.start + (tail + at % 8) % sent.records.len(),
        _ => at * 131 % hostile.memory.len(),
    }
}

#[test]
fn handshake_takes_any_packet() {
    let to = SocketAddrV4::new(A.1, PORT);
    let asks = [
        Ask::OpenUdp(16),
        Ask::Bind(to),
        Ask::Connect(Some(to)),
        Ask::Extend(3),
        Ask::LocalAddress,
        Ask::Time,
    ];
    let mut seeds: Vec<_> = asks.map(|ask| ask.to_bytes().to_vec()).to_vec();
    seeds.push(Answer { address: to, ..Answer::refused(19) }.to_bytes().to_vec());
    fuzz(&Target {
        name: "handshake",
        seeds,
        has_corpus: true,
        mutate: mutate::bytes,
        run: |packet| vec![handshake(packet)],
    });
}

/// What is read is what would be written.
fn handshake(packet: &[u8]) -> u64 {
    let (ask, answer) = (Ask::parse(packet), Answer::parse(packet));
    if let Some(ask) = ask {
        assert!(is_ask(packet) && Ask::parse(&ask.to_bytes()) == Some(ask));
    }
    if let Some(answer) = answer {
        assert_eq!(Answer::parse(&answer.to_bytes()), Some(answer));
    }
    let which = ask.map_or(0, |_| 1 + u64::from(packet[4]) + u64::from(packet[5] % 8) * 16);
    outcome([which, answer.map_or(0, |answer| 1 + u64::from(answer.errno != 0))])
}
