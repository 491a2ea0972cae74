//! What the core costs beside what it could be instead: `cargo bench -p tests --bench core`.
//!
//! ```text
//! pool    16 x take + return of a buffer   beside   ArrayQueue of boxed frames, pop + push
//! queue   16 x push + pop, 16 waiting      beside   ArrayQueue of the same, push + pop
//! frame   build + stamp + send             beside   `send` of a frame that was built beforehand
//!         the same with a kernel guard     beside   the same without
//! ```
//!
//! `RTNET_COUNT=pool/rtnet:1000` does one of them 1000 times and measures nothing: for tools that
//! count instructions.

use std::error::Error;
use std::hint::black_box;
use std::io;

use criterion::Criterion;
use crossbeam::queue::ArrayQueue;
use rtmac::wire::Message;
use rtnet::clock::EmulatedClock;
use rtnet::discipline::{Sent, Transmission};
use rtnet::live::clock::monotonic;
use rtnet::live::interface::Interface;
use rtnet::live::{GuardMode, OpenError, Port};
use rtnet::time::{GlobalTime, Span};
use rtnet::wire::ethernet::{Address, EtherType};
use rtnet::{Instant, Pool, Priority, PriorityQueue, buf};
use tests::bare::Bare;
use tools::lab::namespace::{Namespace, Segment};

/// As many as a port has for received frames.
const BUFFERS: usize = 32;
/// How often a step of `pool` and `queue` does the thing, so that what is around it hardly counts; and how
/// many frames wait in a queue meanwhile.
const BATCH: usize = 16;
const HERE: Address = Address([2, 0, 0, 0, 0, 1]);
const GUARDED: Address = Address([2, 0, 0, 0, 0, 3]);
const THERE: Address = Address([2, 0, 0, 0, 0, 2]);

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

/// What to do with the subjects of the benchmark.
enum Mode {
    Time(Box<Criterion>),
    Count { subject: String, times: u64 },
}

impl Mode {
    fn from_environment() -> Self {
        let Ok(count) = std::env::var("RTNET_COUNT") else {
            return Mode::Time(Box::new(Criterion::default().configure_from_args()));
        };
        let parsed = count.split_once(':').and_then(|(subject, n)| Some((subject, n.parse().ok()?)));
        let (subject, times) = parsed.expect("RTNET_COUNT is SUBJECT:TIMES, as pool/rtnet:1000");
        Mode::Count { subject: subject.to_owned(), times }
    }

    /// Whether any subject of this group is wanted.
    fn wants(&self, group: &str) -> bool {
        match self {
            Mode::Time(_) => true,
            Mode::Count { subject, .. } => subject.starts_with(group),
        }
    }

    fn subject<R>(&mut self, name: &str, mut step: impl FnMut() -> R) {
        match self {
            Mode::Time(criterion) => {
                criterion.bench_function(name, |bencher| bencher.iter(&mut step));
            }
            Mode::Count { subject, times } if subject == name => {
                for _ in 0..*times {
                    black_box(step());
                }
            }
            Mode::Count { .. } => {}
        }
    }
}

fn pool(mode: &mut Mode) {
    let pool = Pool::new(BUFFERS);
    mode.subject("pool/rtnet", || {
        for _ in 0..BATCH {
            drop(black_box(pool.take()));
        }
    });

    let boxes = ArrayQueue::new(BUFFERS);
    while boxes.push(Box::new([0u8; buf::ROOM])).is_ok() {}
    mode.subject("pool/array_queue", || {
        for _ in 0..BATCH {
            let _ = black_box(boxes.pop()).map(|frame| boxes.push(frame));
        }
    });
}

/// What waits here are buffers, which are linked through themselves; beside it, references, which cost nothing to drop. The
/// levels take turns, so that both empty and occupied ones are met.
fn queue(mode: &mut Mode) {
    let frame = &[0u8; buf::ROOM];
    let levels: [_; BATCH] =
        std::array::from_fn(|turn| Priority::new((turn * 5 % 16) as u8).expect("below 32"));

    let pool = Pool::new(BATCH + 1);
    let mut queue = PriorityQueue::new();
    levels.iter().for_each(|&level| queue.push(level, pool.take().expect("one for each and one more")));
    let mut held = pool.take();
    mode.subject("queue/rtnet", || {
        for &level in black_box(&levels) {
            if let Some(frame) = held.take() {
                queue.push(level, black_box(frame));
            }
            held = black_box(queue.pop()).map(|(_, frame)| frame);
        }
    });

    let queue = ArrayQueue::new(BUFFERS);
    levels.iter().for_each(|_| queue.push(frame).expect("room for more"));
    mode.subject("queue/array_queue", || {
        for _level in black_box(&levels) {
            let _ = queue.push(black_box(frame));
            black_box(queue.pop());
        }
    });
}

/// Frames go from one station over a bridge to another, which does not listen.
fn frame(mode: &mut Mode) -> Result<()> {
    let mut segment = Segment::new()?;
    let [here, guarded, there] = [Namespace::new()?, Namespace::new()?, Namespace::new()?];
    segment.attach(&here, "port0", "rt0", HERE.0)?;
    segment.attach(&guarded, "port1", "rt0", GUARDED.0)?;
    segment.attach(&there, "port2", "rt0", THERE.0)?;
    let now = monotonic();
    let clock = EmulatedClock { anchor: now, offset: Span::from_millis(100), drift_ppb: 20_000 };
    let open = |guard| -> Result<_> {
        Ok(Port::open(&Interface::find("rt0")?, &[EtherType::EXPERIMENTAL], clock, 0, guard)?)
    };

    let at = clock.local(now);
    build_and_send(mode, "frame/rtnet", here.run(|| open(GuardMode::User))??, HERE, at);
    match guarded.run(|| open(GuardMode::Kernel))? {
        Ok(port) => build_and_send(mode, "frame/guarded", port, GUARDED, at),
        Err(error) if error.is::<OpenError>() => skip("frame/guarded", &*error),
        Err(error) => return Err(error),
    }

    let pool = Pool::new(1);
    let mut frame = pool.take().expect("nobody else has it");
    let sched = GlobalTime::from_nanos(0);
    Message::Sync { cycle: 1, xmit: sched, sched }.write(THERE, HERE, &mut frame);
    let bare = here.run(|| -> Result<_> { Ok(Bare::open(&Interface::find("rt0")?)?) })??;
    mode.subject("frame/bare_send", || assert!(bare.send(&frame), "{}", io::Error::last_os_error()));
    Ok(())
}

/// A sync each time, from scratch.
fn build_and_send(mode: &mut Mode, name: &str, mut port: Port, from: Address, at: Instant) {
    let pool = Pool::new(BUFFERS);
    let latest = at + Span::from_millis(3_600_000);
    let mut cycle = 0;
    let sched = GlobalTime::from_nanos(0);
    mode.subject(name, || {
        cycle += 1;
        let message = Message::Sync { cycle, xmit: sched, sched };
        let mut frame = pool.take().expect("every sent frame goes home");
        message.write(THERE, from, &mut frame);
        let sent = port.transmit(Transmission { frame, at, latest, stamp: Some(message.stamp(7)) });
        assert!(matches!(sent, Sent::At(_)), "{sent:?}");
    });
}

fn skip(what: &str, error: &(dyn Error + 'static)) {
    let causes = std::iter::successors(Some(error), |&cause| cause.source());
    eprintln!("SKIP {what}: {}", causes.map(ToString::to_string).collect::<Vec<_>>().join(": "));
}

fn main() {
    let mut mode = Mode::from_environment();
    pool(&mut mode);
    queue(&mut mode);
    if mode.wants("frame")
        && let Err(error) = frame(&mut mode)
    {
        skip("frame", &*error);
    }
    if let Mode::Time(criterion) = mode {
        criterion.final_summary();
    }
}
