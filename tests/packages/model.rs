//! Processes that do with mailboxes whatever chance says, one behind the other, beside a model of lists: each answer is the
//! model's.
//!
//! ```text
//! the test ─ some commands ─► one of the processes ─ an answer each ─► compared with what the lists say
//! ```

mod lists;
mod orders;

use std::io::{BufReader, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::process::{Child, Command, Stdio};

use package_router::component::{Error, ReceiveError, SendError};
use package_router::mailbox::{self, TooSmall, WhenFull, of_sender};
use package_router::registry::Refused;
use package_router::wire::Head;
use rtnet::sim::Random;
use tests::host::figure;
use tests::seeds;

use super::*;
use lists::*;
use orders::*;

/// Set for a process that is to be a component: where its commands come from, at which station, and which one it is.
const MEMBER_OF: &str = "RTNET_MEMBER_OF";
const TEST: &str = "model::what_processes_do_with_mailboxes_is_what_simple_lists_would";
/// Unless RTNET_OPERATIONS says otherwise.
const OPERATIONS: u64 = 20_000;
/// Seeds that share them.
const SEEDS: usize = 5;
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
    let operations =
        std::env::var("RTNET_OPERATIONS").map_or(OPERATIONS, |operations| operations.parse().unwrap());
    let seeds = seeds::drawn(TEST, SEEDS);
    let mut counted = Counted::default();
    for seed in &seeds {
        course(*seed, operations / seeds.len() as u64, &mut counted);
    }
    let Counted { count, done, outcomes } = counted;
    let kinds: Vec<String> = ALL.iter().zip(done).map(|(what, n)| format!("{what:?} {n}")).collect();
    let [_, sent, received, nothing, too_small, _, not_sent, refused, _] = outcomes;
    figure(
        TEST.trim_start_matches("model::"),
        &format!(
            "{count} operations of {MEMBERS} processes by seeds {seeds:?}, each as the model says: {}; {sent} packages sent, \
             {received} seen or received, {nothing} times nothing, {too_small} times too little room, {not_sent} not sent, {refused} \
             refused",
            kinds.join(", ")
        ),
    );
    assert!(
        done.iter().all(|n| *n > 0)
            && [sent, received, nothing, too_small, not_sent, refused].iter().all(|n| *n > 0)
    );
}

/// Counts of the operations so far.
#[derive(Default)]
struct Counted {
    count: u64,
    /// Commands of each kind.
    done: [u64; ALL.len()],
    /// Answers, by their first word.
    outcomes: [u64; 9],
}

/// Does this many operations, or a few more, by this seed.
fn course(seed: u64, operations: u64, Counted { count: all, done, outcomes }: &mut Counted) {
    let station = Station::new();
    let mut members = driven(&station);
    let (mut model, mut dice) = (Model::default(), Random::new(seed));
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
    *all += count;
}
