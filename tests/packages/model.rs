//! Processes that do with mailboxes whatever chance says, one behind the other, beside a model of lists: each answer is the
//! model's.
//!
//! ```text
//! the test ─ some commands ─► one of the processes ─ an answer each ─► compared with what the lists say
//! ```

use std::io::{BufReader, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::process::{Child, Command, Stdio};

use package_router::component::{Error, ReceiveError, SendError};
use package_router::mailbox::{self, TooSmall, WhenFull, of_owner, of_sender};
use package_router::registry::Refused;
use package_router::wire::Head;
use rtnet::sim::Random;

use super::*;

/// Set for a process that is to be a component: where its commands come from, at which station, and which one it is.
const MEMBER_OF: &str = "RTNET_MEMBER_OF";
const TEST: &str = "model::what_processes_do_with_mailboxes_is_what_simple_lists_would";
/// Unless RTNET_OPERATIONS says otherwise.
const OPERATIONS: u64 = 20_000;
const MEMBERS: usize = 5;
/// Senders that each of them has at the most.
const HANDLES: usize = 6;
/// Commands that a process gets at a time, at the most.
const AT_ONCE: u64 = 40;

/// What mailboxes there are: each process begins with one of these.
const SHAPES: [Shape; 6] = [
    Shape::new(1, 16).senders(8),
    Shape::new(6, 40).senders(6),
    Shape::new(4, 24).senders(8).replacing(),
    Shape::new(3, 0).senders(4),
    Shape::new(1, 32).senders(3).replacing(),
    Shape::new(9, 1).senders(2),
];

/// What a process is told to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Do {
    Send,
    Receive,
    TryReceive,
    /// The length is that of the room.
    ReceiveInto,
    PutBack,
    Clean,
    Depth,
    /// It sleeps until there is something.
    Wait,
    /// The new sender is there before the old one of that handle has gone.
    Bind,
    Unbind,
    Create,
    Delete,
    /// A mailbox of another's name.
    CreateOthers,
}

const ALL: [Do; 13] = [
    Do::Send,
    Do::Receive,
    Do::TryReceive,
    Do::ReceiveInto,
    Do::PutBack,
    Do::Clean,
    Do::Depth,
    Do::Wait,
    Do::Bind,
    Do::Unbind,
    Do::Create,
    Do::Delete,
    Do::CreateOthers,
];

#[derive(Clone, Copy, Debug)]
struct Order {
    what: Do,
    handle: u8,
    /// Which process' mailbox, or which shape.
    target: u8,
    priority: u8,
    len: u16,
    /// Of a package, which its body follows from.
    number: u32,
}

const ORDER_LEN: usize = 10;

impl Order {
    fn to_bytes(self) -> [u8; ORDER_LEN] {
        let mut bytes = [self.what as u8, self.handle, self.target, self.priority, 0, 0, 0, 0, 0, 0];
        bytes[4..6].copy_from_slice(&self.len.to_le_bytes());
        bytes[6..].copy_from_slice(&self.number.to_le_bytes());
        bytes
    }

    fn parse(bytes: &[u8; ORDER_LEN]) -> Self {
        let [what, handle, target, priority, len @ .., a, b, c, d] = *bytes;
        let what = ALL[usize::from(what)];
        let (len, number) = (u16::from_le_bytes(len), u32::from_le_bytes([a, b, c, d]));
        Self { what, handle, target, priority, len, number }
    }
}

/// What comes of it.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Told {
    Done,
    /// The number that a package was sent with.
    Sent(u8),
    Received(Came),
    Nothing,
    TooSmall(TooSmall),
    Count(usize),
    NotSent(SendError),
    Refused(Refused),
    /// A sender that goes, and what it has sent, and what of it not: full, too large, replaced.
    Gone([u64; 4]),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Came {
    from: MailboxName,
    to: MailboxName,
    kind: i8,
    priority: u8,
    id: u8,
    len: usize,
    sum: u64,
}

type Words = [u64; 6];
const TOLD_LEN: usize = size_of::<Words>();

impl Told {
    /// So that two of them are the same if their words are.
    fn words(&self) -> Words {
        let text = |text: String| sum(text.as_bytes());
        match self {
            Told::Done => [0; 6],
            Told::Sent(id) => [1, u64::from(*id), 0, 0, 0, 0],
            Told::Received(Came { from, to, kind, priority, id, len, sum }) => {
                let marks = u64::from_le_bytes([*kind as u8, *priority, *id, 0, 0, 0, 0, 0]);
                [2, from.0.into(), to.0.into(), marks, *len as u64, *sum]
            }
            Told::Nothing => [3, 0, 0, 0, 0, 0],
            Told::TooSmall(TooSmall { got, needed }) => [4, *got as u64, *needed as u64, 0, 0, 0],
            Told::Count(count) => [5, *count as u64, 0, 0, 0, 0],
            Told::NotSent(error) => [6, text(format!("{error:?}")), 0, 0, 0, 0],
            Told::Refused(refused) => [7, text(format!("{refused:?}")), 0, 0, 0, 0],
            Told::Gone([sent, full, too_large, replaced]) => [8, *sent, *full, *too_large, *replaced, 0],
        }
    }
}

fn sum(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .fold(0xcbf2_9ce4_8422_2325, |sum, byte| (sum ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

fn body(number: u32, len: usize) -> impl Iterator<Item = u8> {
    (0..len as u32)
        .map(move |at| (number.wrapping_mul(0x9e37_79b1).wrapping_add(at * 0x0101_6b01) >> 16) as u8)
}

fn kind(number: u32) -> i8 {
    (number % 251) as u8 as i8
}

fn member_name(member: usize) -> MailboxName {
    name(0x30 + member as u8, 7)
}

// ---- one of the processes ----

struct Member {
    number: usize,
    component: Component,
    mailbox: Option<Mailbox>,
    senders: [Option<Sender>; HANDLES],
    room: Vec<u8>,
}

impl Member {
    fn carry_out(&mut self, order: &Order) -> Told {
        let handle = usize::from(order.handle);
        let refused = |error| match error {
            Error::Refused(refused) => Told::Refused(refused),
            error => panic!("{order:?}: {error}"),
        };
        match order.what {
            Do::Send => {
                let sender = self.senders[handle].as_mut().expect("it is bound");
                sender.set_priority(order.priority);
                self.room.clear();
                self.room.extend(body(order.number, order.len.into()));
                sender.send(kind(order.number), &self.room).map_or_else(Told::NotSent, Told::Sent)
            }
            Do::Create => {
                match self.component.mailbox(member_name(self.number), SHAPES[usize::from(order.target)]) {
                    Ok(mailbox) => {
                        self.mailbox = Some(mailbox);
                        Told::Done
                    }
                    Err(error) => refused(error),
                }
            }
            Do::CreateOthers => {
                let others = member_name(order.target.into());
                self.component.mailbox(others, SHAPES[0]).map_or_else(refused, |_| Told::Done)
            }
            Do::Delete => {
                self.mailbox = None;
                Told::Done
            }
            Do::Unbind => {
                let sender = self.senders[handle].take().expect("it is bound");
                use of_sender::{FULL, REPLACED, SENT, TOO_LARGE};
                Told::Gone([SENT, FULL, TOO_LARGE, REPLACED].map(|what| sender.counted(what)))
            }
            Do::Bind => {
                let mailbox = self.mailbox.as_ref().expect("it is there");
                match mailbox.sender(member_name(order.target.into())) {
                    Ok(sender) => {
                        self.senders[handle] = Some(sender);
                        Told::Done
                    }
                    Err(error) => refused(error),
                }
            }
            _ => self.receives(order),
        }
    }

    fn receives(&mut self, order: &Order) -> Told {
        let mailbox = self.mailbox.as_mut().expect("it is there");
        let came = |head: &Head, body: &[u8]| {
            let Head { from, to, kind, priority, id, .. } = *head;
            Told::Received(Came { from, to, kind, priority, id, len: body.len(), sum: sum(body) })
        };
        let soon = Some(Duration::ZERO);
        let told = match order.what {
            Do::Clean => mailbox.clean().map(Told::Count),
            Do::Depth => mailbox.depth().map(Told::Count),
            Do::Receive => {
                mailbox.receive(soon).map(|package| came(package.head(), &package.body().to_vec()))
            }
            Do::Wait => {
                mailbox.receive(Some(PATIENCE)).map(|package| came(package.head(), &package.body().to_vec()))
            }
            Do::TryReceive => mailbox.try_receive().map(|package| {
                package.map_or(Told::Nothing, |package| came(package.head(), &package.body().to_vec()))
            }),
            Do::PutBack => mailbox.receive(soon).map(|package| {
                let told = came(package.head(), &package.body().to_vec());
                package.put_back();
                told
            }),
            _ => {
                self.room.resize(order.len.into(), 0);
                mailbox.receive_into(&mut self.room, soon).map(|(head, len)| came(&head, &self.room[..len]))
            }
        };
        told.unwrap_or_else(|error| match error {
            ReceiveError::TimedOut => Told::Nothing,
            ReceiveError::TooSmall(too_small) => Told::TooSmall(too_small),
            ReceiveError::Gone => panic!("{order:?}: {error}"),
        })
    }
}

fn be_a_member(of: &str) -> ! {
    let mut words = of.rsplitn(3, ' ');
    let [number, station, orders] = [(); 3].map(|()| words.next().unwrap());
    let number: usize = number.parse().unwrap();
    let component = Component::attach(Path::new(station)).unwrap();
    let mut member =
        Member { number, component, mailbox: None, senders: Default::default(), room: Vec::new() };
    let mut stream = UnixStream::connect(orders).unwrap();
    stream.write_all(&[number as u8]).unwrap();
    let mut from = BufReader::new(stream.try_clone().unwrap());
    let mut count = [0];
    while from.read_exact(&mut count).is_ok() {
        let mut told = Vec::new();
        for _ in 0..count[0] {
            let mut order = [0; ORDER_LEN];
            from.read_exact(&mut order).unwrap();
            let words = member.carry_out(&Order::parse(&order)).words();
            told.extend(words.map(u64::to_le_bytes).concat());
        }
        stream.write_all(&told).unwrap();
    }
    std::process::exit(0)
}

// ---- the model ----

/// A package that waits.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    lane: usize,
    /// Which of all that were ever sent.
    order: u64,
    came: Came,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lane {
    Free,
    Bound,
    /// Its sender has gone.
    Left,
    /// And its owner has said that all is read.
    Drained,
}

struct List {
    shape: Shape,
    /// Which of all mailboxes that there ever were.
    generation: u64,
    lanes: Vec<Lane>,
    waiting: Vec<Waiting>,
}

struct Handle {
    to: usize,
    generation: u64,
    lane: usize,
    id: u8,
    counted: [u64; 4],
}

#[derive(Default)]
struct Model {
    lists: [Option<List>; MEMBERS],
    handles: [[Option<Handle>; HANDLES]; MEMBERS],
    generations: u64,
    sent: u64,
}

impl List {
    /// The owner looks: lanes of who has gone, and of whom nothing waits, are others'.
    fn looks(&mut self) {
        for (at, lane) in self.lanes.iter_mut().enumerate() {
            if *lane == Lane::Left && self.waiting.iter().all(|waiting| waiting.lane != at) {
                *lane = Lane::Drained;
            }
        }
    }

    /// The oldest of the most urgent.
    fn first(&self) -> Option<usize> {
        let urgency = |at: &usize| (u8::MAX - self.waiting[*at].came.priority, self.waiting[*at].order);
        (0..self.waiting.len()).min_by_key(urgency)
    }

    /// A place for a package of a lane; whether another one has made way for it.
    fn make_room(&mut self, lane: usize, priority: u8) -> Result<bool, SendError> {
        let of_lane = || (0..self.waiting.len()).filter(|at| self.waiting[*at].lane == lane);
        if of_lane().count() < self.shape.slots {
            return Ok(false);
        }
        let least =
            of_lane().min_by_key(|at| (self.waiting[*at].came.priority, self.waiting[*at].order)).unwrap();
        if self.shape.when_full == WhenFull::Refuse || self.waiting[least].came.priority > priority {
            return Err(mailbox::SendError::Full(self.shape.slots).into());
        }
        self.waiting.remove(least);
        Ok(true)
    }
}

impl Model {
    fn is_bound(&self, member: usize, handle: u8) -> bool {
        self.handles[member][usize::from(handle)].is_some()
    }

    fn expects(&mut self, member: usize, order: &Order) -> Told {
        let to = usize::from(order.target);
        match order.what {
            Do::Send => self.sends(member, order).map_or_else(Told::NotSent, Told::Sent),
            Do::Create => {
                let shape = SHAPES[to];
                self.generations += 1;
                let (generation, lanes) = (self.generations, vec![Lane::Free; shape.senders]);
                self.lists[member] = Some(List { shape, generation, lanes, waiting: Vec::new() });
                Told::Done
            }
            Do::CreateOthers => {
                let is_taken = self.lists[to].is_some();
                if is_taken { Told::Refused(Refused::Taken(member_name(to))) } else { Told::Done }
            }
            Do::Delete => {
                self.lists[member] = None;
                Told::Done
            }
            Do::Unbind => Told::Gone(self.leaves(member, order).expect("it is bound")),
            Do::Bind => self.binds(member, order).map_or_else(Told::Refused, |()| Told::Done),
            _ => {
                let list = self.lists[member].as_mut().expect("it is there");
                list.looks();
                let Some(first) = list.first() else {
                    let is_count = matches!(order.what, Do::Clean | Do::Depth);
                    return if is_count { Told::Count(0) } else { Told::Nothing };
                };
                let (got, needed) = (usize::from(order.len), list.waiting[first].came.len);
                match order.what {
                    Do::Clean => Told::Count(std::mem::take(&mut list.waiting).len()),
                    Do::Depth => Told::Count(list.waiting.len()),
                    Do::PutBack => Told::Received(list.waiting[first].came),
                    Do::ReceiveInto if got < needed => Told::TooSmall(TooSmall { got, needed }),
                    _ => Told::Received(list.waiting.remove(first).came),
                }
            }
        }
    }

    fn sends(&mut self, member: usize, order: &Order) -> Result<u8, SendError> {
        let handle = self.handles[member][usize::from(order.handle)].as_mut().expect("it is bound");
        handle.id = handle.id.wrapping_add(1);
        let (from, to) = (member_name(member), member_name(handle.to));
        let list = self.lists[handle.to].as_mut().filter(|list| list.generation == handle.generation);
        let list = list.ok_or(SendError::NoMailbox(to))?;
        let (len, most) = (usize::from(order.len), list.shape.largest_body);
        let [sent, full, too_large, replaced] = &mut handle.counted;
        if len > most {
            *too_large += 1;
            return Err(mailbox::SendError::TooLarge { got: len, most }.into());
        }
        match list.make_room(handle.lane, order.priority) {
            Ok(is_replaced) => *replaced += u64::from(is_replaced),
            Err(error) => {
                *full += 1;
                return Err(error);
            }
        }
        *sent += 1;
        self.sent += 1;
        let bytes: Vec<u8> = body(order.number, len).collect();
        let (kind, priority, id, sum) = (kind(order.number), order.priority, handle.id, sum(&bytes));
        let came = Came { from, to, kind, priority, id, len, sum };
        list.waiting.push(Waiting { lane: handle.lane, order: self.sent, came });
        Ok(id)
    }

    fn binds(&mut self, member: usize, order: &Order) -> Result<(), Refused> {
        let to = usize::from(order.target);
        let list = self.lists[to].as_mut().ok_or(Refused::NoMailbox(member_name(to)))?;
        list.lanes.iter_mut().filter(|lane| **lane == Lane::Drained).for_each(|lane| *lane = Lane::Free);
        let free = list.lanes.iter().position(|lane| *lane == Lane::Free);
        let lane = free.ok_or(Refused::NoLane(member_name(to), list.shape.senders))?;
        list.lanes[lane] = Lane::Bound;
        let generation = list.generation;
        self.leaves(member, order);
        let handle = Handle { to, generation, lane, id: 0, counted: [0; 4] };
        self.handles[member][usize::from(order.handle)] = Some(handle);
        Ok(())
    }

    fn leaves(&mut self, member: usize, order: &Order) -> Option<[u64; 4]> {
        let Handle { to, generation, lane, counted, .. } =
            self.handles[member][usize::from(order.handle)].take()?;
        if let Some(list) = self.lists[to].as_mut().filter(|list| list.generation == generation) {
            list.lanes[lane] = Lane::Left;
        }
        Some(counted)
    }

    /// What a member could do now.
    fn next(&self, member: usize, dice: &mut Random, number: u32) -> Order {
        let mut below = |n: usize| dice.below(n as u64) as usize;
        let handle = below(HANDLES) as u8;
        let (target, priority) =
            (below(MEMBERS) as u8, [0, 1, 63, 64, 100, 100, 100, 200, 254, 255][below(10)]);
        let of = |what| Order { what, handle, target, priority, len: 0, number };
        let is_bound = self.is_bound(member, handle);
        let Some(list) = &self.lists[member] else {
            let shape = below(SHAPES.len()) as u8;
            return match below(4) {
                0..2 if is_bound => Order { len: below(42) as u16, ..of(Do::Send) },
                2 if is_bound => of(Do::Unbind),
                _ => Order { target: shape, ..of(Do::Create) },
            };
        };
        match below(1_000) {
            0..520 if is_bound => {
                // As much as fits, mostly, where it is known.
                let to = self.handles[member][usize::from(handle)].as_ref().map_or(0, |handle| handle.to);
                let most = self.lists[to].as_ref().map_or(8, |list| list.shape.largest_body);
                let len = if below(20) == 0 { most + 1 + below(9) } else { below(most + 1) };
                Order { len: len as u16, ..of(Do::Send) }
            }
            0..520 => of(Do::Bind),
            520..640 => of(Do::Receive),
            640..760 => of(Do::TryReceive),
            760..860 => Order { len: 64, ..of(Do::ReceiveInto) },
            860..890 => {
                let needed = list.first().map_or(1, |first| list.waiting[first].came.len);
                Order { len: needed.saturating_sub(1) as u16, ..of(Do::ReceiveInto) }
            }
            890..920 => of(Do::PutBack),
            920..950 => of(Do::Depth),
            950..954 => of(Do::Clean),
            954..964 => of(Do::Bind),
            964..990 if is_bound => of(Do::Unbind),
            990..991 => of(Do::Delete),
            991..993 if usize::from(target) != member => of(Do::CreateOthers),
            _ => of(Do::TryReceive),
        }
    }

    /// Somebody of whom nothing waits, and who has a way to it.
    fn who_could_wait(&self, member: usize) -> Option<(usize, Order)> {
        let list = self.lists[member].as_ref().filter(|list| list.waiting.is_empty())?;
        (0..MEMBERS).filter(|other| *other != member).find_map(|other| {
            let handles = self.handles[other].iter().zip(0u8..);
            let mut to_it = handles.filter_map(|(handle, at)| Some((handle.as_ref()?, at)));
            let (_, handle) =
                to_it.find(|(handle, _)| (handle.to, handle.generation) == (member, list.generation))?;
            Some((other, Order { what: Do::Send, handle, target: 0, priority: 9, len: 0, number: 7 }))
        })
    }
}

// ---- the test ----

struct Driven {
    process: Child,
    stream: UnixStream,
}

impl Drop for Driven {
    fn drop(&mut self) {
        let _ = self.stream.shutdown(std::net::Shutdown::Both);
        let _ = (self.process.kill(), self.process.wait());
    }
}

impl Driven {
    fn tell(&mut self, orders: &[Order]) {
        let mut packet = vec![orders.len() as u8];
        packet.extend(orders.iter().flat_map(|order| order.to_bytes()));
        self.stream.write_all(&packet).unwrap();
    }

    fn told(&mut self) -> Words {
        let mut bytes = [0; TOLD_LEN];
        self.stream.read_exact(&mut bytes).expect("it answers");
        core::array::from_fn(|at| u64::from_le_bytes(bytes[at * 8..][..8].try_into().unwrap()))
    }
}

fn driven(station: &Station) -> Vec<Driven> {
    let orders = station.path.with_extension("orders");
    let listener = UnixListener::bind(&orders).unwrap();
    let own = std::env::current_exe().unwrap();
    let member = |number: usize| {
        let of = format!("{} {} {number}", orders.display(), station.path.display());
        let mut command = Command::new(&own);
        command.args(["--exact", TEST, "--nocapture"]).env(MEMBER_OF, of);
        let process = command.stdout(Stdio::null()).spawn().unwrap();
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(PATIENCE * 2)).unwrap();
        let mut number_of = [0];
        stream.read_exact(&mut number_of).unwrap();
        assert_eq!(usize::from(number_of[0]), number);
        Driven { process, stream }
    };
    (0..MEMBERS).map(member).collect()
}

#[test]
fn what_processes_do_with_mailboxes_is_what_simple_lists_would() {
    if let Ok(of) = std::env::var(MEMBER_OF) {
        be_a_member(&of);
    }
    let number = |variable, default| std::env::var(variable).map_or(default, |n: String| n.parse().unwrap());
    let (operations, seed) = (number("RTNET_OPERATIONS", OPERATIONS), number("RTNET_SEED", 1));
    let station = Station::new();
    let mut members = driven(&station);
    let (mut model, mut dice) = (Model::default(), Random::new(seed));
    let mut done = [0u64; ALL.len()];
    let mut outcomes = [0u64; 9];
    let mut count = 0;
    let mut lately: Vec<(usize, Order)> = Vec::new();
    let mut note = |member: usize, order: &Order, expected: &Told, told: Words| {
        lately.push((member, *order));
        let words = expected.words();
        let behind = lately.len().saturating_sub(30);
        assert_eq!(told, words, "{member}, {order:?}: expected {expected:?}, behind {:?}", &lately[behind..]);
        lately.drain(..behind);
        done[order.what as usize] += 1;
        outcomes[words[0] as usize] += 1;
    };
    while count < operations {
        let member = dice.below(MEMBERS as u64) as usize;
        if dice.below(2) == 0
            && let Some((other, send)) = model.who_could_wait(member)
        {
            let wait = Order { what: Do::Wait, ..send };
            members[member].tell(&[wait]);
            if dice.below(2) == 0 {
                // Some look for themselves still, some sleep.
                thread::sleep(Duration::from_micros(dice.below(200)));
            }
            members[other].tell(&[send]);
            if let Some(list) = &mut model.lists[member] {
                list.looks();
            }
            let sent = model.expects(other, &send);
            note(other, &send, &sent, members[other].told());
            let received = model.expects(member, &wait);
            note(member, &wait, &received, members[member].told());
            count += 2;
            continue;
        }
        let mut orders = Vec::new();
        let mut expected = Vec::new();
        for _ in 0..=dice.below(AT_ONCE) {
            let order = model.next(member, &mut dice, (count + orders.len() as u64) as u32);
            expected.push(model.expects(member, &order));
            orders.push(order);
        }
        members[member].tell(&orders);
        for (order, expected) in orders.iter().zip(&expected) {
            note(member, order, expected, members[member].told());
        }
        count += orders.len() as u64;
    }
    let kinds: Vec<String> = ALL.iter().zip(done).map(|(what, n)| format!("{what:?} {n}")).collect();
    let [_, sent, received, nothing, too_small, _, not_sent, refused, _] = outcomes;
    println!(
        "FIGURE {}: {count} operations of {MEMBERS} processes by seed {seed}, each as the model says: {}; {sent} packages sent, \
         {received} seen or received, {nothing} times nothing, {too_small} times too little room, {not_sent} not sent, {refused} \
         refused",
        TEST.trim_start_matches("model::"),
        kinds.join(", ")
    );
    assert!(
        done.iter().all(|n| *n > 0)
            && [sent, received, nothing, too_small, not_sent, refused].iter().all(|n| *n > 0)
    );
    let _ = of_owner::RECEIVED;
}
