//! Push and pop of 64 bytes in one thread, a given number of them waiting meanwhile.
//!
//! ```text
//! lane         the two ends of a lane of a mailbox, which are given the time, in memory of this process
//! clocks       the same, and a reading of the clock at each end, as a component does
//! mapped       the first, in memory of which each end has its own mapping, as between processes: one core sees it at two addresses
//! component    a component that sends to its own mailbox, and receives
//! array_queue  crossbeam's ArrayQueue
//! heap         a BinaryHeap in a Mutex: the most urgent first, then the oldest
//! ```

use core::cmp::Reverse;
use core::hint::black_box;
use core::sync::atomic::AtomicU64;
use std::collections::BinaryHeap;
use std::os::fd::AsFd;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use crossbeam::queue::ArrayQueue;
use package_router::component::{Mailbox, Sender};
use package_router::mailbox::{Inbox, LaneSender, Layout, Segment, Shape, Stamps};
use package_router::shared::{Room, View, lane_at, lanes_file};
use package_router::wire::Head;
use rtnet::live::clock::monotonic;
use rtnet::live::realtime::pin;
use rtnet::live::sealed::Sealed;
use serde_json::{Value, json};

use crate::exchange::{MESSAGE, Message};
use crate::station::{Station, mailbox, name};

const SLOTS: usize = 64;
const SHAPE: Shape = Shape::new(SLOTS, MESSAGE).senders(1);
const PRIORITY: u8 = 100;
/// Steps between two readings of the clock.
const BATCH: u32 = 1_000;
const WARM_UP: usize = 20;

/// What is pushed and popped.
trait Queue {
    fn push(&mut self, message: &Message) -> Result<()>;
    fn pop(&mut self, room: &mut Message) -> Result<()>;
}

/// Memory of one process.
type Words = Arc<[AtomicU64]>;

/// The two ends of a lane. With `HAS_CLOCK` they read it.
struct Ends<Own, Lane, Seen, View, const HAS_CLOCK: bool> {
    sender: LaneSender<Lane, Seen>,
    inbox: Inbox<Own, View>,
    now: u64,
}

type Plain<const HAS_CLOCK: bool> = Ends<Words, Words, Words, Words, HAS_CLOCK>;
type Mapped = Ends<Sealed, Room, Sealed, View, false>;

struct Own {
    sender: Sender,
    mailbox: Mailbox,
    _station: Station,
}

struct Heap {
    waits: Mutex<BinaryHeap<(u8, Reverse<u64>, Message)>>,
    number: u64,
}

impl<const HAS_CLOCK: bool> Plain<HAS_CLOCK> {
    fn new() -> Result<Self> {
        let layout = Layout::of(&SHAPE);
        let zeros = |words| -> Words { (0..words).map(|_| AtomicU64::new(0)).collect() };
        let (own, lane) = (zeros(layout.owner_words(SHAPE.senders)), zeros(layout.sender_words()));
        Ok(Self {
            sender: LaneSender::new(lane.clone(), own.clone(), layout, 0),
            inbox: inbox(own, lane)?,
            now: 1,
        })
    }
}

impl Mapped {
    fn new() -> Result<Self> {
        let layout = Layout::of(&SHAPE);
        let words = layout.owner_words(SHAPE.senders);
        let own = Sealed::new(c"bench", words)?;
        let lanes = lanes_file(&layout, SHAPE.senders + 1)?;
        let memory = Arc::new(Sealed::open(lanes.try_clone()?, lane_at(&layout, SHAPE.senders + 1))?);
        let seen = Sealed::open(own.as_fd().try_clone_to_owned()?, words)?;
        let sender = LaneSender::new(Room::open(&lanes, &layout, 1)?, seen, layout, 0);
        let view = View::of(memory, 0, layout.sender_words()).context("a lane")?;
        Ok(Self { sender, inbox: inbox(own, view)?, now: 1 })
    }
}

fn inbox<Own: Segment, View: Segment>(own: Own, lane: View) -> Result<Inbox<Own, View>> {
    let mut inbox = Inbox::new(own, &SHAPE);
    inbox.attach(0, name(0x80), lane)?;
    Ok(inbox)
}

impl<Own, Lane, Seen, View, const HAS_CLOCK: bool> Ends<Own, Lane, Seen, View, HAS_CLOCK> {
    #[inline]
    fn now(&mut self) -> u64 {
        self.now = if HAS_CLOCK { monotonic() } else { self.now + 1 };
        self.now
    }
}

impl<Own, Lane, Seen, View, const HAS_CLOCK: bool> Queue for Ends<Own, Lane, Seen, View, HAS_CLOCK>
where
    Own: Segment,
    Lane: Segment<Word = Own::Word>,
    Seen: Segment<Word = Own::Word>,
    View: Segment<Word = Own::Word>,
{
    fn push(&mut self, message: &Message) -> Result<()> {
        let head = Head { from: name(0x80), to: name(0x80), priority: PRIORITY, ..Head::default() };
        let stamps = Stamps { sent: self.now(), ..Stamps::default() };
        self.sender.send(&head, message, &stamps)?;
        Ok(())
    }

    fn pop(&mut self, room: &mut Message) -> Result<()> {
        let now = self.now();
        self.inbox.receive(now).context("it was sent")?.body().copy_to(0, room);
        Ok(())
    }
}

impl Own {
    fn new() -> Result<Self> {
        let station = Station::new()?;
        let mailbox = mailbox(station.path(), name(0x80), SHAPE)?;
        Ok(Self { sender: mailbox.sender(mailbox.name())?, mailbox, _station: station })
    }
}

impl Queue for Own {
    fn push(&mut self, message: &Message) -> Result<()> {
        self.sender.send(1, message)?;
        Ok(())
    }

    fn pop(&mut self, room: &mut Message) -> Result<()> {
        self.mailbox.try_receive()?.context("it was sent")?.body().copy_to(0, room);
        Ok(())
    }
}

impl Queue for ArrayQueue<Message> {
    fn push(&mut self, message: &Message) -> Result<()> {
        ArrayQueue::push(self, *message).ok().context("there is room")
    }

    fn pop(&mut self, room: &mut Message) -> Result<()> {
        *room = ArrayQueue::pop(self).context("it was pushed")?;
        Ok(())
    }
}

impl Queue for Heap {
    fn push(&mut self, message: &Message) -> Result<()> {
        self.number += 1;
        let mut waits = self.waits.lock().unwrap_or_else(PoisonError::into_inner);
        ensure!(waits.len() < SLOTS, "there is room");
        waits.push((PRIORITY, Reverse(self.number), *message));
        Ok(())
    }

    fn pop(&mut self, room: &mut Message) -> Result<()> {
        let mut waits = self.waits.lock().unwrap_or_else(PoisonError::into_inner);
        *room = waits.pop().context("it was pushed")?.2;
        Ok(())
    }
}

/// What is done with a queue of whatever kind.
trait Visit {
    fn visit(&mut self, queue: &mut impl Queue) -> Result<()>;
}

fn with(subject: &str, visit: &mut impl Visit) -> Result<()> {
    match subject {
        "lane" => visit.visit(&mut Plain::<false>::new()?),
        "clocks" => visit.visit(&mut Plain::<true>::new()?),
        "mapped" => visit.visit(&mut Mapped::new()?),
        "component" => visit.visit(&mut Own::new()?),
        "array_queue" => visit.visit(&mut ArrayQueue::new(SLOTS)),
        "heap" => {
            let waits = Mutex::new(BinaryHeap::with_capacity(SLOTS));
            visit.visit(&mut Heap { waits, number: 0 })
        }
        _ => bail!("'{subject}' is none of lane, clocks, mapped, component, array_queue, heap"),
    }
}

/// So many steps.
fn steps(queue: &mut impl Queue, times: u32) -> Result<()> {
    let (message, mut room) = ([0x5a; MESSAGE], [0; MESSAGE]);
    for _ in 0..times {
        queue.push(black_box(&message))?;
        queue.pop(&mut room)?;
        black_box(&room);
    }
    Ok(())
}

struct Timed {
    waiting: usize,
    time: Duration,
    batches: Vec<u64>,
}

impl Visit for Timed {
    fn visit(&mut self, queue: &mut impl Queue) -> Result<()> {
        for _ in 0..self.waiting {
            queue.push(&[0; MESSAGE])?;
        }
        let until = monotonic() + self.time.as_nanos() as u64;
        let mut begun = monotonic();
        while begun < until {
            steps(queue, BATCH)?;
            let now = monotonic();
            self.batches.push(now - begun);
            begun = now;
        }
        Ok(())
    }
}

/// What a step takes: the median of batches, in a thread of its own on that core.
pub fn measure(subject: &str, waiting: usize, core: usize, time: Duration) -> Result<Value> {
    let mut timed = Timed { waiting, time, batches: Vec::new() };
    std::thread::scope(|scope| {
        let run = || {
            pin(core)?;
            with(subject, &mut timed)
        };
        scope.spawn(run).join().map_err(|_| anyhow::anyhow!("it panicked"))?
    })?;
    let mut batches = timed.batches.split_off(WARM_UP.min(timed.batches.len()));
    batches.sort_unstable();
    let median = *batches.get(batches.len() / 2).context("it was too short")?;
    Ok(json!({ "n": batches.len(), "ns": median as f64 / f64::from(BATCH) }))
}

struct Counted(u32);

impl Visit for Counted {
    fn visit(&mut self, queue: &mut impl Queue) -> Result<()> {
        steps(queue, self.0)
    }
}

/// Does it so often.
pub fn count(subject: &str, times: u32) -> Result<()> {
    with(subject, &mut Counted(times))
}
