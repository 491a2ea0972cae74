//! Echoes that `rtnet ping` asks for. A question goes the way of a program's datagram: it is handed over at any moment, and
//! the station's thread takes it right before it chooses a slot's frame. A visitor would come only after the slot's send,
//! and wait for a whole cycle whenever it was asked.
//!
//! ```text
//!  control thread ─── asked ───► the loop, before it chooses a frame ──► the slot's queue
//!      ▲    ▲  └── answered: it was taken, or why it cannot leave ─┤
//!      │    └───── came: answers ──────────────────────────────────┘
//!      └─ each round of questions has its own
//! ```

use std::collections::VecDeque;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering, fence};

use crossbeam::atomic::AtomicCell;
use crossbeam::queue::ArrayQueue;
use nix::sys::eventfd::{EfdFlags, EventFd};
use rtnet::ip::Pong;
use rtnet::live::Bells;
use rtnet::queue::Priority;
use rtnet::socket::{Access, Options, Program, SocketError};
use rtnet::time::Instant;
use rtnet::wire::ethernet::MTU;
use rtnet::wire::{icmpv4, ipv4};

use crate::control::{EchoFailed, EchoRequest, EchoShown, EchoesShown};

/// Questions that wait to be taken: one comes every few milliseconds, and a slot every few.
const WAITING: usize = 8;
/// Answers that wait for the control thread. Half of it is used: the station's thread never comes to a place out of which
/// another one, which may be held up in the middle of it, still reads.
const CAME: usize = 128;
/// Rounds of questions that are remembered, as many as the stack waits for answers of.
const ROUNDS: usize = 8;
/// Answers of a round that nobody has read; later ones are lost.
const UNREAD: usize = 256;
/// Why a question finds no buffer: nothing else takes those of echoes for longer than a slot is away.
const BEHIND: &str = "the echoes before it wait for a slot still, and no buffer is left";
/// Bytes before what an echo takes along.
pub const ECHO_HEADERS: usize = ipv4::HEADER_LEN + icmpv4::HEADER_LEN;
/// Bytes that an echo takes along at the most: what a frame has room for.
pub const ECHO_AT_MOST: usize = MTU - ECHO_HEADERS;

/// Between the two threads. Pointers are swapped: neither waits for the other, and the memory of a question goes back to
/// who brought it.
struct Way {
    places: [Place; WAITING],
    came: ArrayQueue<Pong>,
    /// Whether there may be a question to be taken.
    is_asked: AtomicBool,
    /// Whether the loop sleeps without a slot that would wake it.
    is_asleep: AtomicBool,
}

#[derive(Default)]
struct Place {
    asked: AtomicCell<Option<Box<Question>>>,
    answered: AtomicCell<Option<Box<Question>>>,
}

struct Question {
    echo: EchoRequest,
    options: Options,
    data: Vec<u8>,
    /// Why it cannot leave, once it was taken.
    refused: Option<SocketError>,
}

/// The end in the station's thread.
pub struct Asker(Arc<Way>);

impl Program for Asker {
    fn run(&mut self, sockets: &mut Access<'_>) {
        let Self(way) = self;
        if way.is_asked.load(Ordering::Relaxed) && way.is_asked.swap(false, Ordering::SeqCst) {
            for place in &way.places {
                let Some(mut question) = place.asked.take() else { continue };
                let Question { echo, options, data, .. } = &*question;
                let which = (echo.identifier, echo.sequence);
                question.refused = sockets.ask_echo(echo.to, which, data, *options).err();
                place.answered.store(Some(question));
            }
        }
        while way.came.len() < CAME / 2
            && let Some(pong) = sockets.next_pong()
        {
            // There is room.
            let _ = way.came.push(pong);
        }
    }

    fn sleeps(&mut self, is_asleep: bool) -> bool {
        self.0.is_asleep.store(is_asleep, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        is_asleep && self.0.is_asked.load(Ordering::SeqCst)
    }
}

/// The control thread's end.
pub struct Echoes {
    way: Arc<Way>,
    doorbell: EventFd,
    /// Which places have a question that has not come back.
    taken: [bool; WAITING],
    /// The newest last.
    rounds: VecDeque<(u16, EchoesShown)>,
}

impl Echoes {
    /// None is asked for; among these bells is then one that wakes a loop that sleeps without a slot.
    pub fn new(bells: &Bells) -> io::Result<Self> {
        let doorbell = EventFd::from_flags(EfdFlags::EFD_NONBLOCK | EfdFlags::EFD_CLOEXEC)?;
        bells.hang(&doorbell)?;
        let (is_asked, is_asleep) = (AtomicBool::new(false), AtomicBool::new(false));
        let way = Way { places: Default::default(), came: ArrayQueue::new(CAME), is_asked, is_asleep };
        Ok(Self { way: Arc::new(way), doorbell, taken: [false; WAITING], rounds: VecDeque::new() })
    }

    /// What is to run in the station's thread.
    pub fn asker(&self) -> Asker {
        Asker(self.way.clone())
    }

    /// Hands a question over: when that was, by the station's clock. Whether it could leave shows later.
    pub fn ask(&mut self, echo: EchoRequest, clock: impl Fn() -> Instant) -> Result<Instant, String> {
        let priority = Priority::new(echo.priority).map_err(|error| error.to_string())?;
        let options = Options { priority, channel: echo.channel, tos: 0 };
        if echo.size > ECHO_AT_MOST {
            return Err(format!("an echo of {} bytes is none: a frame takes {ECHO_AT_MOST}", echo.size));
        }
        self.collect();
        let Some(place) = self.taken.iter().position(|is_taken| !is_taken) else {
            return Err(
                "the questions before this one wait for a slot still: it has none, or is held up".into()
            );
        };
        if news_of(&mut self.rounds, echo.identifier).is_none() {
            if self.rounds.len() == ROUNDS {
                self.rounds.pop_front();
            }
            self.rounds.push_back((echo.identifier, EchoesShown::default()));
        }
        // RTnet's: when it was asked, then the pattern.
        let mut data: Vec<u8> = (0..echo.size).map(|n| n.saturating_sub(8) as u8).collect();
        let at = clock();
        if let Some(sent) = data.first_chunk_mut() {
            *sent = at.nanos().to_ne_bytes();
        }
        self.taken[place] = true;
        let question = Question { echo, options, data, refused: None };
        self.way.places[place].asked.store(Some(Box::new(question)));
        self.way.is_asked.store(true, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        if self.way.is_asleep.load(Ordering::SeqCst) {
            // It does not block, and counts for longer than anybody asks.
            let _ = self.doorbell.write(1);
        }
        Ok(at)
    }

    /// What has come of a round since it was last asked for.
    pub fn of(&mut self, round: u16) -> EchoesShown {
        self.collect();
        news_of(&mut self.rounds, round).map(std::mem::take).unwrap_or_default()
    }

    fn collect(&mut self) {
        let Self { way, taken, rounds, .. } = self;
        for (place, is_taken) in way.places.iter().zip(taken) {
            let Some(question) = place.answered.take() else { continue };
            *is_taken = false;
            let Question { echo: EchoRequest { identifier, sequence, .. }, refused, .. } = *question;
            if let Some(refused) = refused
                && let Some(news) = news_of(rounds, identifier)
                && news.failed.len() < UNREAD
            {
                let is_behind = matches!(refused, SocketError::NoBuffers { .. });
                let why = if is_behind { BEHIND.to_owned() } else { refused.to_string() };
                news.failed.push(EchoFailed { sequence, why, is_behind });
            }
        }
        while let Some(pong) = way.came.pop() {
            if let Some(news) = news_of(rounds, pong.identifier).filter(|news| news.came.len() < UNREAD) {
                news.came.push(shown(&pong));
            }
        }
    }
}

fn news_of(rounds: &mut VecDeque<(u16, EchoesShown)>, round: u16) -> Option<&mut EchoesShown> {
    rounds.iter_mut().find(|(identifier, _)| *identifier == round).map(|(_, news)| news)
}

fn shown(pong: &Pong) -> EchoShown {
    let Pong { from, sequence, len, rx, left, .. } = *pong;
    let nanos = |at: Option<Instant>| at.map(|at| at.nanos());
    EchoShown { from, sequence, size: len, came: nanos(rx), left: nanos(left) }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use nix::poll::PollTimeout;
    use rtnet::buf::Buf;
    use rtnet::discipline::{Channel, SendError, TimeView};
    use rtnet::ip::route::Interface;
    use rtnet::ip::{Exit, Stack, StackConfig};
    use rtnet::wire::ethernet::Address;

    use super::*;

    const OWN: Ipv4Addr = Ipv4Addr::new(10, 0, 0, 1);

    /// Nothing leaves: whoever asks itself is answered at once.
    struct Nowhere;

    impl Exit for Nowhere {
        fn send(&mut self, frame: Buf, _: Priority, channel: Channel) -> Result<(), (SendError, Buf)> {
            Err((SendError::NoSlot(channel), frame))
        }
        fn limit(&self, _: Channel) -> Result<usize, SendError> {
            Ok(MTU)
        }
        fn time(&self) -> TimeView {
            TimeView::default()
        }
    }

    /// Both ends, and the stack between them.
    struct Bench {
        echoes: Echoes,
        stack: Stack,
        bells: Bells,
    }

    impl Bench {
        fn new() -> Self {
            let bells = Bells::new().unwrap();
            let echoes = Echoes::new(&bells).unwrap();
            let interface = Interface { address: Address([2, 0, 0, 0, 0, 1]), ip: OWN, prefix: 24 };
            let stack = Stack::new(StackConfig::new(interface), vec![Box::new(echoes.asker())]);
            Self { echoes, stack, bells }
        }

        fn ask(&mut self, to: Ipv4Addr, identifier: u16, sequence: u16) -> Result<Instant, String> {
            let echo = EchoRequest { to, identifier, sequence, size: 56, priority: 30, channel: 1 };
            self.echoes.ask(echo, || Instant::from_nanos(7))
        }

        /// A slot is about to come.
        fn slot(&mut self) {
            self.stack.poll(Instant::from_nanos(9), &mut Nowhere);
        }

        fn rings(&self) -> bool {
            self.bells.wait(PollTimeout::ZERO) != 0
        }

        fn came(&mut self, round: u16) -> Vec<u16> {
            self.echoes.of(round).came.iter().map(|echo| echo.sequence).collect()
        }
    }

    #[test]
    fn a_question_is_taken_before_a_slot_and_each_round_has_its_own_answers() {
        let mut bench = Bench::new();
        assert_eq!(bench.ask(OWN, 1, 5), Ok(Instant::from_nanos(7)));
        bench.ask(OWN, 2, 6).unwrap();
        assert!(bench.came(1).is_empty(), "no slot has come");
        bench.slot();
        assert_eq!((bench.came(2), bench.came(1), bench.came(1)), (vec![6], vec![5], vec![]));
        assert!(bench.came(3).is_empty(), "nobody's");
    }

    #[test]
    fn what_cannot_leave_is_told_with_its_reason_and_the_round_goes_on() {
        let mut bench = Bench::new();
        bench.ask(Ipv4Addr::new(10, 0, 0, 9), 1, 1).unwrap();
        bench.ask(OWN, 1, 2).unwrap();
        bench.slot();
        let EchoesShown { came, failed, .. } = bench.echoes.of(1);
        assert_eq!((came.len(), failed.len(), failed[0].sequence), (1, 1, 1));
        assert!(failed[0].why.starts_with("no route to 10.0.0.9"), "{}", failed[0].why);
        let long = EchoRequest { to: OWN, identifier: 1, sequence: 3, size: 1_473, priority: 30, channel: 1 };
        assert!(bench.echoes.ask(long, Instant::default).unwrap_err().contains("a frame takes 1472"));
    }

    #[test]
    fn no_more_questions_and_answers_wait_than_there_is_room_for() {
        let mut bench = Bench::new();
        assert!((0..8).all(|n| bench.ask(OWN, 1, n).is_ok()));
        assert!(bench.ask(OWN, 1, 8).unwrap_err().contains("wait for a slot"));
        bench.slot();
        for n in 8..2_000 {
            bench.ask(OWN, 1, n).unwrap();
            bench.slot();
        }
        assert_eq!(bench.came(1).len(), UNREAD);
        for round in 2..=9 {
            bench.ask(OWN, round, 1).unwrap();
        }
        bench.slot();
        assert_eq!((bench.came(1), bench.came(2)), (vec![], vec![1]), "the oldest round is forgotten");
    }

    #[test]
    fn only_a_loop_that_sleeps_without_a_slot_is_rung_for() {
        let mut bench = Bench::new();
        bench.ask(OWN, 1, 1).unwrap();
        assert!(!bench.rings());
        assert!(bench.stack.sleeps(true), "it has come meanwhile: it does not sleep");
        bench.stack.sleeps(false);
        bench.slot();
        assert!(!bench.stack.sleeps(true));
        bench.ask(OWN, 1, 2).unwrap();
        assert!(bench.rings());
        bench.ask(OWN, 1, 3).unwrap();
        assert!(bench.rings(), "again");
    }
}
