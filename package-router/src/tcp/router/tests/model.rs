//! Random clients against plain lists: owners of names, waiting packages, dropped packages, and the order in which they leave.

use std::collections::BTreeMap;

use proptest::collection::vec;
use proptest::prelude::*;

use super::*;

const CLIENTS: usize = 4;
const NAMES: u32 = 6;
/// The smallest queue of a client, in bytes.
const QUEUE: usize = MAX_LEN;

#[derive(Clone, Debug)]
enum Step {
    Register(usize, u32),
    Delete(usize, u32),
    Purge(usize),
    Send {
        client: usize,
        to: u32,
        from: u32,
        command: bool,
        priority: u8,
        body: usize,
    },
    Read(usize, usize),
    /// Its kernel has all that has left.
    Arrives(usize),
    /// Its kernel has all but so many bytes of that.
    ArrivesInPart(usize, u64),
    Leaves(usize),
}

fn step() -> impl Strategy<Value = Step> {
    let (client, name) = (0..CLIENTS, 0..=NAMES);
    // Some bodies fill a queue, so that packages are refused and make room for others.
    let body = prop_oneof![0..64usize, 0..64usize, Just(100_000usize), Just(MAX_LEN - HEAD_LEN)];
    let send = (client.clone(), name.clone(), name.clone(), any::<bool>(), 0..4u8, body).prop_map(
        |(client, to, from, command, priority, body)| Step::Send {
            client,
            to,
            from,
            command,
            priority,
            body,
        },
    );
    prop_oneof![
        3 => (client.clone(), name.clone()).prop_map(|(client, name)| Step::Register(client, name)),
        1 => (client.clone(), name).prop_map(|(client, name)| Step::Delete(client, name)),
        1 => client.clone().prop_map(Step::Purge),
        12 => send,
        4 => (client.clone(), prop_oneof![1..200usize, Just(1_000_000)]).prop_map(|(client, bytes)| Step::Read(client, bytes)),
        1 => client.clone().prop_map(Step::Arrives),
        2 => (client.clone(), 0..100u64).prop_map(|(client, less)| Step::ArrivesInPart(client, less)),
        1 => client.prop_map(Step::Leaves),
    ]
}

/// A package that waits: its priority, its number among all, its head, and the client that sent it, while that stays connected.
#[derive(Clone, Debug, PartialEq)]
struct Waiting {
    priority: u8,
    number: usize,
    head: Head,
    sender: Option<usize>,
}

#[derive(Default)]
struct Reader {
    own: Vec<i8>,
    waiting: Vec<Waiting>,
    /// Bytes of the last package in `read` that are still to come, and that package if it is not the router's.
    rest: usize,
    begun: Option<Waiting>,
    /// Bytes that have left, and how many of them its kernel has.
    left: u64,
    arrived: u64,
    /// Where packages ended that have left, and their senders, while those stay connected: until all has arrived.
    flight: Vec<(u64, Option<usize>)>,
    /// Its own packages whose receiver has gone, without those that had arrived there, and with those that may not be known to have.
    receiver_gone: [u64; 2],
    /// Heads of packages whose first byte has left.
    read: Vec<Head>,
    is_begun_own: bool,
}

#[derive(Default)]
struct Model {
    owners: BTreeMap<u32, usize>,
    readers: Vec<Reader>,
    number: usize,
}

impl Model {
    fn answer(&mut self, to: usize, kind: i8) {
        self.readers[to].own.push(kind);
    }

    fn registers(&mut self, client: usize, name: u32) {
        let is_new = name != 0 && !self.owners.contains_key(&name);
        if is_new {
            self.owners.insert(name, client);
        }
        self.answer(client, if is_new || name == 0 { wire::OK } else { wire::ERROR });
    }

    fn deletes(&mut self, client: usize, name: u32) {
        let owner = self.owners.get(&name).copied();
        if owner == Some(client) {
            self.owners.remove(&name);
        }
        self.answer(client, if owner.is_none_or(|owner| owner == client) { wire::OK } else { wire::ERROR });
    }

    fn sends(&mut self, client: usize, head: Head) {
        let is_foreign = self.owners.get(&head.from.0).is_some_and(|owner| *owner != client);
        let to = self.owners.get(&head.to.0).copied().filter(|_| !is_foreign);
        let Some(to) = to else { return self.unavailable(client, &head) };
        if !self.enqueues(to, head, Some(client)) {
            self.unavailable(client, &head);
        }
    }

    fn enqueues(&mut self, to: usize, head: Head, sender: Option<usize>) -> bool {
        let Some(dropped) = self.push(to, head, sender) else { return false };
        for dropped in dropped {
            if let Some(sender) = dropped.sender {
                self.unavailable(sender, &dropped.head);
            }
        }
        true
    }

    fn unavailable(&mut self, client: usize, head: &Head) {
        if head.is_command() {
            self.enqueues(client, head.answer(wire::NOT_AVAILABLE), None);
        }
    }

    /// Senders of what waited for a client are answered, from the most urgent on.
    fn leaves(&mut self, client: usize) {
        self.owners.retain(|_, owner| *owner != client);
        let waiting =
            self.readers.iter_mut().flat_map(|reader| reader.waiting.iter_mut().chain(&mut reader.begun));
        waiting.filter(|of| of.sender == Some(client)).for_each(|of| of.sender = None);
        let flights = self.readers.iter_mut().flat_map(|reader| &mut reader.flight);
        flights.filter(|(_, sender)| *sender == Some(client)).for_each(|(_, sender)| *sender = None);
        let Reader { waiting: mut waited, begun, rest, flight, arrived, .. } =
            core::mem::take(&mut self.readers[client]);
        waited.extend(begun.filter(|_| rest > 0));
        waited.sort_by_key(|of| (core::cmp::Reverse(of.priority), of.number));
        let waiting = waited.iter().map(|of| (u64::MAX, of.sender));
        for (end, sender) in waiting.chain(flight).filter_map(|(end, sender)| Some((end, sender?))) {
            let [surely, at_most] = &mut self.readers[sender].receiver_gone;
            *surely += u64::from(end > arrived);
            *at_most += 1;
        }
        for Waiting { head, sender, .. } in waited {
            sender.into_iter().for_each(|sender| self.unavailable(sender, &head));
        }
    }

    /// The packages of a client that wait, and those in flight: without those that have arrived, and with those that may not be known to
    /// have.
    fn waits(&self, client: usize) -> [u64; 2] {
        let mut sums = [0; 2];
        for reader in &self.readers {
            let begun = reader.begun.iter().filter(|_| reader.rest > 0);
            let waiting = reader.waiting.iter().chain(begun).map(|of| (u64::MAX, of.sender));
            let of_client =
                waiting.chain(reader.flight.iter().copied()).filter(|(_, sender)| *sender == Some(client));
            for (end, _) in of_client {
                sums[0] += u64::from(end > reader.arrived);
                sums[1] += 1;
            }
        }
        sums
    }

    /// The packages that made room; `None` if there is no room.
    fn push(&mut self, to: usize, head: Head, sender: Option<usize>) -> Option<Vec<Waiting>> {
        let reader = &mut self.readers[to];
        let begun = if reader.rest > 0 && !reader.is_begun_own { reader.read.last() } else { None };
        let of = |waiting: &[Waiting]| waiting.iter().map(|of| of.head.len as usize).sum::<usize>();
        let all = of(&reader.waiting) + begun.map_or(0, |head| head.len as usize);
        let excess = (all + head.len as usize).saturating_sub(QUEUE);
        let mut below: Vec<Waiting> =
            reader.waiting.iter().filter(|of| of.priority < head.priority).cloned().collect();
        if of(&below) < excess {
            return None;
        }
        below.sort_by_key(|of| (of.priority, of.number));
        let mut dropped = Vec::new();
        while of(&below[..dropped.len()]) < excess {
            dropped.push(below[dropped.len()].clone());
        }
        reader.waiting.retain(|of| !dropped.contains(of));
        self.number += 1;
        reader.waiting.push(Waiting { priority: head.priority, number: self.number, head, sender });
        Some(dropped)
    }

    fn reads(&mut self, client: usize, mut bytes: usize) {
        let reader = &mut self.readers[client];
        while bytes > 0 {
            if reader.rest == 0 {
                let (head, is_own) = if reader.own.is_empty() {
                    reader.waiting.sort_by_key(|of| (core::cmp::Reverse(of.priority), of.number));
                    if reader.waiting.is_empty() {
                        return;
                    }
                    let first = reader.waiting.remove(0);
                    reader.begun = Some(first.clone());
                    (first.head, false)
                } else {
                    reader.begun = None;
                    (Head::new(reader.own.remove(0), MailboxName::NOBODY, MailboxName::NOBODY), true)
                };
                (reader.rest, reader.is_begun_own) = (head.len as usize, is_own);
                reader.read.push(head);
            }
            let now = reader.rest.min(bytes);
            (reader.rest, bytes) = (reader.rest - now, bytes - now);
            reader.left += now as u64;
            if reader.rest == 0 && !reader.is_begun_own {
                reader.flight.extend(reader.begun.as_ref().map(|of| (reader.left, of.sender)));
            }
        }
    }
}

/// Has `bytes` read of what waits for a connection.
pub(super) fn read(net: &mut Net, of: usize, bytes: usize) {
    let (read, mut left) = (&mut net.read[of], bytes);
    let send = |slices: &[IoSlice<'_>]| {
        let now: Vec<u8> = slices.iter().flat_map(|slice| slice.iter().copied()).take(left).collect();
        left -= now.len();
        read.extend_from_slice(&now);
        if now.is_empty() { Err(io::ErrorKind::WouldBlock.into()) } else { Ok(now.len()) }
    };
    net.router.write(Connection(of as u32), send).unwrap();
}

/// All that has left for a connection arrives.
fn arrives(net: &mut Net, of: usize) {
    let to = Connection(of as u32);
    let end = net.read[of].len() as u64;
    // A mark, and what is behind it.
    for _ in 0..2 {
        net.router.written(to, end);
        net.router.arrived(to, end);
    }
    assert!(!net.router.has_in_flight(to));
}

fn runs(steps: Vec<Step>) {
    let limits = Limits { queue: QUEUE, ..Limits::default() };
    let mut net = Net { router: Router::new(limits, 0), read: vec![Vec::new(); CLIENTS], now: 0 };
    let mut model = Model::default();
    for _ in 0..CLIENTS {
        net.router.connect(PEER, 0).unwrap();
        model.readers.push(Reader::default());
    }
    for step in steps {
        match step {
            Step::Register(client, name) => {
                net.send(client, &control(13, &name.to_le_bytes()));
                model.registers(client, name);
            }
            Step::Delete(client, name) => {
                net.send(client, &control(14, &name.to_le_bytes()));
                model.deletes(client, name);
            }
            Step::Purge(client) => {
                net.send(client, &control(15, &[]));
                model.owners.retain(|_, owner| *owner != client);
            }
            Step::Send { client, to, from, command, priority, body } => {
                // To 0 from 0 is control, and of no known kind.
                let kind = if (to, from) == (0, 0) {
                    -100
                } else if command {
                    21
                } else {
                    -6
                };
                let head = Head { priority, ..Head::new(kind, MailboxName(to), MailboxName(from)) };
                let head = head.with_body(body).unwrap();
                net.send(client, &[&head.to_bytes()[..], &vec![priority; body]].concat());
                if (to, from) != (0, 0) {
                    model.sends(client, head);
                }
            }
            Step::Read(client, bytes) => {
                net.router.written(Connection(client as u32), net.read[client].len() as u64);
                read(&mut net, client, bytes);
                model.reads(client, bytes);
            }
            Step::Arrives(client) => {
                arrives(&mut net, client);
                model.readers[client].flight.clear();
            }
            Step::ArrivesInPart(client, less) => {
                let reader = &mut model.readers[client];
                reader.arrived = reader.arrived.max(reader.left.saturating_sub(less));
                net.router.arrived(Connection(client as u32), reader.arrived);
            }
            Step::Leaves(client) => {
                net.router.disconnect(Connection(client as u32), Ending::Left, 0);
                assert_eq!(net.router.connect(PEER, 0), Ok(Connection(client as u32)));
                net.read[client].clear();
                model.leaves(client);
            }
        }
    }
    for (client, reader) in model.readers.iter().enumerate() {
        let waits = net.router.clients[client].as_ref().unwrap().waits;
        let gone = net.counters(client).receiver_gone;
        for (count, [surely, at_most]) in [(waits, model.waits(client)), (gone, reader.receiver_gone)] {
            assert!((surely..=at_most).contains(&count), "client {client}: {count} of {surely} to {at_most}");
        }
    }
    for client in 0..CLIENTS {
        read(&mut net, client, usize::MAX);
        model.reads(client, usize::MAX);
        let mut seen = Vec::new();
        let cut = Frames::default().cut(&net.read[client], |head, body| {
            assert!(body.iter().all(|byte| *byte == head.priority));
            seen.push(head);
        });
        assert_eq!((cut, seen), (Ok(()), model.readers[client].read.clone()), "client {client}");
        assert_eq!(net.router.status(0).clients[client].waiting, 0);
    }
    let begun: usize = net.router.clients.iter().flatten().map(|client| client.frames.begun()).sum();
    assert_eq!((net.router.held, begun), (0, 0));
    (0..CLIENTS).for_each(|client| arrives(&mut net, client));
    assert!(net.router.clients.iter().flatten().all(|client| client.waits == 0));
    let owned: usize = net.router.status(0).clients.iter().map(|client| client.names.len()).sum();
    assert_eq!((owned, net.router.table.len()), (model.owners.len(), model.owners.len()));
    assert_eq!(net.endings(), []);
}

proptest! {
    #[test]
    fn a_router_is_a_table_and_lists_by_priority(steps in vec(step(), 0..120)) {
        runs(steps);
    }
}
