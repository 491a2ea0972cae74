//! What mailboxes are to be: lists.

use super::*;

/// A package that waits.
#[derive(Clone, Copy, Debug)]
pub struct Waiting {
    pub lane: usize,
    /// Which of all that were ever sent.
    pub order: u64,
    pub came: Came,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lane {
    Free,
    Bound,
    /// Its sender has gone.
    Left,
    /// And its owner has said that all is read.
    Drained,
}

pub struct List {
    pub shape: Shape,
    /// Which of all mailboxes that there ever were.
    pub generation: u64,
    pub lanes: Vec<Lane>,
    pub waiting: Vec<Waiting>,
}

pub struct Handle {
    pub to: usize,
    pub generation: u64,
    pub lane: usize,
    pub id: u8,
    pub counted: [u64; 4],
}

#[derive(Default)]
pub struct Model {
    pub lists: [Option<List>; MEMBERS],
    pub handles: [[Option<Handle>; HANDLES]; MEMBERS],
    pub generations: u64,
    pub sent: u64,
}

impl List {
    /// The owner looks: lanes of who has gone, and of whom nothing waits, are others'.
    pub fn looks(&mut self) {
        for (at, lane) in self.lanes.iter_mut().enumerate() {
            if *lane == Lane::Left && self.waiting.iter().all(|waiting| waiting.lane != at) {
                *lane = Lane::Drained;
            }
        }
    }

    /// The oldest of the most urgent.
    pub fn first(&self) -> Option<usize> {
        let urgency = |at: &usize| (u8::MAX - self.waiting[*at].came.priority, self.waiting[*at].order);
        (0..self.waiting.len()).min_by_key(urgency)
    }

    /// A place for a package of a lane; whether another one has made way for it.
    pub fn make_room(&mut self, lane: usize, priority: u8) -> Result<bool, SendError> {
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
    pub fn is_bound(&self, member: usize, handle: u8) -> bool {
        self.handles[member][usize::from(handle)].is_some()
    }

    pub fn expects(&mut self, member: usize, order: &Order) -> Told {
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
                let is_taken = self.lists[to].is_some() || self.has_senders(to);
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

    /// Whether a member can still send, in its name.
    fn has_senders(&self, member: usize) -> bool {
        self.handles[member].iter().flatten().any(|handle| {
            self.lists[handle.to].as_ref().is_some_and(|list| list.generation == handle.generation)
        })
    }

    pub fn sends(&mut self, member: usize, order: &Order) -> Result<u8, SendError> {
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

    pub fn binds(&mut self, member: usize, order: &Order) -> Result<(), Refused> {
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

    pub fn leaves(&mut self, member: usize, order: &Order) -> Option<[u64; 4]> {
        let Handle { to, generation, lane, counted, .. } =
            self.handles[member][usize::from(order.handle)].take()?;
        if let Some(list) = self.lists[to].as_mut().filter(|list| list.generation == generation) {
            list.lanes[lane] = Lane::Left;
        }
        Some(counted)
    }

    /// What a member could do now.
    pub fn next(&self, member: usize, dice: &mut Random, number: u32) -> Order {
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
    pub fn who_could_wait(&self, member: usize) -> Option<(usize, Order)> {
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
