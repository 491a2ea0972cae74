//! Which mailboxes a station has, whose they are, and who may send to them. Pure: the [broker](crate::broker) does what follows.
//!
//! ```text
//! a lane   Free ─ bind ─► Reserved ─ ready ─► Bound ─ unbind, or its component has ended ─► Left ─ all is read ─► Free
//!                            └──────────── unbind, or its component has ended ─────────────────────────────────► Free
//! ```
//!
//! The TCP client is a component, too. Its mailbox has the name of nobody: it takes packages that have no other way. Its lane into other
//! mailboxes takes packages of anybody.

use crate::mailbox::{Shape, ShapeError, WhenFull};
use crate::name::MailboxName;

/// Mailboxes of a station: as many as the board shows.
pub const MOST_MAILBOXES: usize = 256;

/// A program that has come to the broker; another one has another number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ComponentId(pub u64);

/// All mailboxes of a station.
pub struct Registry {
    places: Vec<Option<Registered>>,
    generations: u64,
}

/// A mailbox that is there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Registered {
    /// What it is called.
    pub name: MailboxName,
    /// Whose it is.
    pub owner: ComponentId,
    /// What it is.
    pub shape: Shape,
    /// Tells it from all that were called so before.
    pub generation: u64,
    /// Its lanes, in the order of [`Shape::lanes`].
    pub lanes: Vec<Lane>,
}

/// A way into a mailbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lane {
    /// How many have had it.
    pub generation: u32,
    /// Who has it.
    pub state: LaneState,
}

/// Who has a lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LaneState {
    /// Nobody.
    Free,
    /// Somebody who makes it ready.
    Reserved(ComponentId, MailboxName),
    /// The component, and the mailbox that it sends from; from nobody: a router, whose packages are from elsewhere.
    Bound(ComponentId, MailboxName),
    /// Nobody any more; the owner has not read all yet of who had it.
    Left(MailboxName),
}

/// A lane as one component has it: who had it before, or has what is in its place now, does not mean that one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LaneId {
    /// The place of its mailbox.
    pub place: usize,
    /// Which of that mailbox's.
    pub lane: usize,
    /// The mailbox's generation.
    pub mailbox: u64,
    /// The lane's.
    pub generation: u32,
}

/// The LAN router's lane.
pub const ROUTER: usize = 0;
/// Who has it.
pub const ROUTERS: ComponentId = ComponentId(0);

/// Why something is not done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// Another mailbox has that name, or another component still has a sender of it.
    #[error(
        "{0} is there already, or a sender of it is still there: a name is one component's until both are gone"
    )]
    Taken(MailboxName),
    /// Nobody's name.
    #[error("{0} is nobody's name: a mailbox has one of its own")]
    NoName(MailboxName),
    /// It cannot be.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// There are too many.
    #[error("the station has {MOST_MAILBOXES} mailboxes: delete some")]
    TooMany,
    /// There is none of that name here.
    #[error("{0} is no mailbox of this station, and no route of the station's system leads to it")]
    NoMailbox(MailboxName),
    /// It is somebody else's.
    #[error("{0} is not this component's: it sends from mailboxes that it has, and deletes those")]
    NotOwn(MailboxName),
    /// All of its lanes are taken.
    #[error("{}", no_lane(*.0, *.1))]
    NoLane(MailboxName, usize),
}

fn no_lane(to: MailboxName, senders: usize) -> String {
    match to {
        MailboxName::NOBODY => format!(
            "the way to the TCP router has all the senders that it takes, {senders}: unbind some, or let bodies be smaller (--router-body)"
        ),
        to => format!("{to} has all the senders that it takes, {senders}: its owner says how many"),
    }
}

impl Registry {
    /// None is there yet.
    pub fn new() -> Self {
        Self { places: vec![None; MOST_MAILBOXES], generations: 0 }
    }

    /// A mailbox of a component: its place. A name is nobody else's as long as a sender of it is there, which may outlive the mailbox:
    /// what it sends would come from somebody else.
    pub fn create(&mut self, owner: ComponentId, name: MailboxName, shape: Shape) -> Result<usize, Refused> {
        self.create_beside(owner, |_| false, name, shape)
    }

    /// The same for one whose own earlier connections `is_former` knows: what those still send is its own affair.
    pub fn create_beside(
        &mut self,
        owner: ComponentId,
        is_former: impl Fn(ComponentId) -> bool,
        name: MailboxName,
        shape: Shape,
    ) -> Result<usize, Refused> {
        if name == MailboxName::NOBODY {
            return Err(Refused::NoName(name));
        }
        if shape.when_full == WhenFull::Answer {
            return Err(Refused::Shape(ShapeError::Answers));
        }
        let is_anothers = self.users().any(|(by, from)| from == name && by != owner && !is_former(by));
        if is_anothers {
            return Err(Refused::Taken(name));
        }
        self.add(owner, name, shape)
    }

    /// The mailbox of the TCP client: its place. There is one.
    pub fn create_tcp(&mut self, owner: ComponentId, shape: Shape) -> Result<usize, Refused> {
        self.add(owner, MailboxName::NOBODY, shape)
    }

    fn add(&mut self, owner: ComponentId, name: MailboxName, shape: Shape) -> Result<usize, Refused> {
        shape.check()?;
        if self.find(name).is_some() {
            return Err(Refused::Taken(name));
        }
        let place = self.places.iter().position(Option::is_none).ok_or(Refused::TooMany)?;
        self.generations += 1;
        let free = Lane { generation: 0, state: LaneState::Free };
        let mut lanes = vec![free; shape.lanes()];
        lanes[ROUTER] = Lane { generation: 1, state: LaneState::Bound(ROUTERS, MailboxName::NOBODY) };
        self.places[place] = Some(Registered { name, owner, shape, generation: self.generations, lanes });
        Ok(place)
    }

    /// Deletes a mailbox of a component.
    pub fn delete(&mut self, owner: ComponentId, name: MailboxName) -> Result<usize, Refused> {
        let place = self.find(name).ok_or(Refused::NoMailbox(name))?;
        match &self.places[place] {
            Some(mailbox) if mailbox.owner == owner => self.places[place] = None,
            _ => return Err(Refused::NotOwn(name)),
        }
        Ok(place)
    }

    /// A lane for what a component sends from one of its mailboxes to another. `is_drained` tells of a lane whether its owner has
    /// read everything of who had it as such a one.
    pub fn bind(
        &mut self,
        component: ComponentId,
        from: MailboxName,
        to: MailboxName,
        is_drained: impl Fn(usize, u32) -> bool,
    ) -> Result<LaneId, Refused> {
        self.check_own(component, from)?;
        let place = self.find(to).ok_or(Refused::NoMailbox(to))?;
        let Some(mailbox) = &mut self.places[place] else { return Err(Refused::NoMailbox(to)) };
        let (senders, tcp) = (mailbox.shape.senders, mailbox.shape.tcp_lane());
        let mut lanes = match from {
            MailboxName::NOBODY => tcp..tcp + 1,
            _ => ROUTER + 1..tcp,
        };
        for at in lanes.clone() {
            let lane = &mut mailbox.lanes[at];
            if matches!(lane.state, LaneState::Left(_)) && is_drained(at, lane.generation) {
                lane.state = LaneState::Free;
            }
        }
        let free = lanes.find(|at| mailbox.lanes[*at].state == LaneState::Free);
        let lane = free.ok_or(Refused::NoLane(to, senders))?;
        let generation = mailbox.lanes[lane].generation + 1;
        mailbox.lanes[lane] = Lane { generation, state: LaneState::Reserved(component, from) };
        Ok(LaneId { place, lane, mailbox: mailbox.generation, generation })
    }

    /// Whoever sends does so from a mailbox of its own.
    pub fn check_own(&self, component: ComponentId, from: MailboxName) -> Result<(), Refused> {
        let own = self.find(from).and_then(|place| self.get(place));
        own.filter(|own| own.owner == component).map(drop).ok_or(Refused::NotOwn(from))
    }

    /// A component has made a lane ready that it has reserved; `false`: it has none there.
    pub fn ready(&mut self, component: ComponentId, lane: LaneId) -> bool {
        match self.lane(lane) {
            Some(state @ &mut LaneState::Reserved(by, from)) if by == component => {
                *state = LaneState::Bound(component, from);
                true
            }
            _ => false,
        }
    }

    /// A component does not use a lane any more; `false`: it has none there.
    pub fn unbind(&mut self, component: ComponentId, lane: LaneId) -> bool {
        match self.lane(lane) {
            Some(state) if lane.lane != ROUTER => state.leave(component),
            _ => false,
        }
    }

    /// A component has gone: its mailboxes are there no more. Whether it still writes to lanes is another question: see
    /// [`Registry::ended`]. Tells which places have changed.
    pub fn left(&mut self, component: ComponentId) -> Vec<usize> {
        let of_it =
            |place: &Option<Registered>| place.as_ref().is_some_and(|mailbox| mailbox.owner == component);
        let changed: Vec<usize> = (0..self.places.len()).filter(|&at| of_it(&self.places[at])).collect();
        changed.iter().for_each(|&at| self.places[at] = None);
        changed
    }

    /// Its process has ended: its lanes are not written any more. Tells which places have changed.
    pub fn ended(&mut self, component: ComponentId) -> Vec<usize> {
        let mut changed = Vec::new();
        for (at, mailbox) in self.places.iter_mut().enumerate() {
            let lanes = mailbox.iter_mut().flat_map(|mailbox| mailbox.lanes.iter_mut().skip(1));
            if lanes.fold(false, |any, lane| lane.state.leave(component) | any) {
                changed.push(at);
            }
        }
        changed
    }

    /// Whether a component has lanes anywhere.
    pub fn has_lanes(&self, component: ComponentId) -> bool {
        self.users().any(|(by, _)| by == component)
    }

    /// Where the mailbox of a name is.
    pub fn find(&self, name: MailboxName) -> Option<usize> {
        self.places.iter().position(|place| place.as_ref().is_some_and(|mailbox| mailbox.name == name))
    }
    /// What is in a place.
    pub fn get(&self, place: usize) -> Option<&Registered> {
        self.places.get(place)?.as_ref()
    }
    /// All that are there.
    pub fn all(&self) -> impl Iterator<Item = (usize, &Registered)> {
        self.places.iter().enumerate().filter_map(|(place, mailbox)| Some((place, mailbox.as_ref()?)))
    }

    /// Who has lanes, and in which name.
    fn users(&self) -> impl Iterator<Item = (ComponentId, MailboxName)> {
        let lanes = self.all().flat_map(|(_, mailbox)| &mailbox.lanes);
        lanes.filter_map(|lane| match lane.state {
            LaneState::Reserved(by, from) | LaneState::Bound(by, from) => Some((by, from)),
            LaneState::Free | LaneState::Left(_) => None,
        })
    }

    fn lane(&mut self, id: LaneId) -> Option<&mut LaneState> {
        let mailbox = self.places.get_mut(id.place)?.as_mut()?;
        let lane = mailbox.lanes.get_mut(id.lane)?;
        let is_that = mailbox.generation == id.mailbox && lane.generation == id.generation;
        is_that.then_some(&mut lane.state)
    }
}

impl Default for Registry {
    fn default() -> Self {
        Self::new()
    }
}

impl LaneState {
    /// Whether it was this component's.
    fn leave(&mut self, component: ComponentId) -> bool {
        *self = match *self {
            LaneState::Reserved(by, _) if by == component => LaneState::Free,
            LaneState::Bound(by, from) if by == component => LaneState::Left(from),
            _ => return false,
        };
        true
    }
}

#[cfg(test)]
mod tests;
