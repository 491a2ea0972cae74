//! A mailbox of this component.

use core::time::Duration;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;

use rtnet::live::clock::{later, monotonic};
use rtnet::live::sealed::Sealed;

use super::{Error, Link, Sender, odd, short};
use crate::bells::{Bells, Woken};
use crate::board::{LaneShown, MOST_LANES};
use crate::handshake::{Answer, Ask};
use crate::mailbox::{self, Inbox, Layout, Segment, Shape, TooSmall, Word};
use crate::name::MailboxName;
use crate::registry::{ROUTER, Refused};
use crate::shared::{View, lane_at, lanes_file};
use crate::wire::Head;

/// How long who waits looks for himself before he sleeps: as long as it takes to be woken by another core.
const SPIN: u64 = 20_000;
/// After that was in vain, how often he sleeps at once: twice as often each time, until it is seen by less than one package of 1000.
const SLEEPS: core::ops::RangeInclusive<u32> = 32..=4096;

/// A mailbox of this component. It is there as long as this is.
pub struct Mailbox {
    link: Arc<Link>,
    name: MailboxName,
    place: usize,
    generation: u64,
    inbox: Inbox<Sealed, View>,
    lanes: Arc<Sealed>,
    /// Of each lane, who has it, as it was last seen.
    attached: Box<[u32]>,
    /// What of the board was seen.
    changes: u64,
    /// Lanes whose senders have gone, and that are not all read.
    leaving: usize,
    bells: Bells,
    patience: Patience,
}

/// A package that was received, as it lies in its slot.
pub type Package<'a> = mailbox::Package<'a, Sealed, View>;

/// Why nothing was received.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ReceiveError {
    /// Nothing came in time.
    #[error("nothing came in time")]
    TimedOut,
    /// The station has ended, or deleted the mailbox.
    #[error("the mailbox is there no more: its station has ended")]
    Gone,
    /// There is too little room for it.
    #[error(transparent)]
    TooSmall(#[from] TooSmall),
}

impl Mailbox {
    pub(super) fn create(link: &Arc<Link>, name: MailboxName, shape: Shape) -> Result<Self, Error> {
        shape.check().map_err(Refused::Shape)?;
        let layout = Layout::of(&shape);
        let all = shape.lanes();
        let own = Sealed::new(c"rtnet-mailbox", layout.owner_words(all))?;
        let lanes = lanes_file(&layout, all)?;
        let memory = Arc::new(Sealed::open(lanes.try_clone()?, lane_at(&layout, all))?);
        let bells = Bells::new(&*link.socket())?;
        let files = [own.as_fd(), lanes.as_fd(), bells.as_fd()];
        let (answer, files) = link.ask(Ask::Create(name, shape), &files)?;
        let Answer::Created { place, generation } = answer else { return Err(odd(&answer).into()) };
        let mut mailbox = Self {
            link: link.clone(),
            name,
            place,
            generation,
            inbox: Inbox::new(own, &shape.senders(all)),
            lanes: memory,
            attached: vec![0; all].into_boxed_slice(),
            changes: 0,
            leaving: 0,
            bells,
            patience: Patience::default(),
        };
        for file in files {
            mailbox.let_router_in(file)?;
        }
        Ok(mailbox)
    }

    /// What comes from elsewhere says whose it is.
    fn let_router_in(&mut self, file: OwnedFd) -> Result<(), Error> {
        let words = self.inbox.layout().sender_words();
        let memory = Arc::new(Sealed::open(file, words)?);
        let view = View::of(memory, 0, words).ok_or_else(short)?;
        self.inbox.attach(ROUTER, MailboxName::NOBODY, view).map_err(|_| short())?;
        Ok(())
    }

    /// What it is called.
    pub fn name(&self) -> MailboxName {
        self.name
    }

    /// A way from here to another mailbox of the station: what is sent by it is from this one.
    pub fn sender(&self, to: MailboxName) -> Result<Sender, Error> {
        Sender::bind(&self.link, self.name, (self.place, self.generation), to)
    }

    /// Waits for the most urgent package, at most so long; `None`: for ever. It stays where it is while it is lent.
    pub fn receive(&mut self, timeout: Option<Duration>) -> Result<Package<'_>, ReceiveError> {
        let until = timeout.map(|timeout| later(monotonic(), timeout));
        loop {
            self.follow()?;
            // Who finds nothing need not know the time.
            if self.inbox.has_some() && self.inbox.find(monotonic()) {
                return Ok(self.inbox.lend());
            }
            if until.is_some_and(|until| until <= monotonic()) {
                return Err(ReceiveError::TimedOut);
            }
            if !self.spin(until) {
                self.sleep(until)?;
            }
        }
    }

    /// The most urgent package, if there is one. For who spins: it asks the kernel for nothing but the time.
    #[inline]
    pub fn try_receive(&mut self) -> Result<Option<Package<'_>>, ReceiveError> {
        self.follow()?;
        let is_found = self.inbox.has_some() && self.inbox.find(monotonic());
        Ok(is_found.then(|| self.inbox.lend()))
    }

    /// Waits, and copies the body: the head, and how long the body is. One that is too long stays.
    pub fn receive_into(
        &mut self,
        into: &mut [u8],
        timeout: Option<Duration>,
    ) -> Result<(Head, usize), ReceiveError> {
        let package = self.receive(timeout)?;
        let (head, needed) = (*package.head(), package.body().len());
        if needed > into.len() {
            package.put_back();
            return Err(TooSmall { got: into.len(), needed }.into());
        }
        package.body().copy_to(0, into);
        Ok((head, needed))
    }

    /// Throws away what waits: how many.
    pub fn clean(&mut self) -> Result<usize, ReceiveError> {
        self.follow()?;
        Ok(self.inbox.clean(monotonic()))
    }

    /// How many wait.
    pub fn depth(&mut self) -> Result<usize, ReceiveError> {
        self.follow()?;
        Ok(self.inbox.depth())
    }

    /// Takes the heads of commands that found it full, if it [answers](mailbox::WhenFull::Answer) them.
    pub(crate) fn take_refused_commands(&mut self, heads: &mut Vec<Head>) -> Result<(), ReceiveError> {
        self.follow()?;
        self.inbox.take_refused_commands(heads);
        // A lane may be free now.
        self.follow()
    }

    /// Packages that found it full, of all senders so far.
    pub(crate) fn refused(&self) -> u64 {
        self.inbox.refused()
    }

    /// Its own memory, where it counts: see [`mailbox::of_owner`].
    pub fn counted(&self, what: usize) -> u64 {
        Word::get(self.inbox.segment().at(what))
    }

    /// Prepares a wait in the caller's own set of descriptors, in which this is readable once something comes. `false`: something is here
    /// already. [`Self::end_wait`] follows in both cases.
    pub fn prepare_wait(&mut self) -> Result<bool, ReceiveError> {
        self.follow()?;
        Ok(self.inbox.falls_asleep())
    }

    /// Ends that wait.
    pub fn end_wait(&mut self) -> Result<(), ReceiveError> {
        self.inbox.wakes_up();
        // A bell that rings after that ends the next wait at once.
        for _ in 0..MOST_LANES {
            match self.bells.wait(Some(0)) {
                Woken::Rung => {}
                Woken::TooLate => break,
                Woken::StationGone => return Err(ReceiveError::Gone),
            }
        }
        Ok(())
    }

    /// Follows who comes and goes.
    #[inline]
    fn follow(&mut self) -> Result<(), ReceiveError> {
        if self.link.board.changes(self.place).get_acquire() != self.changes {
            self.follow_changes()?;
        }
        if self.leaving > 0 {
            self.let_leave();
        }
        Ok(())
    }

    #[cold]
    fn follow_changes(&mut self) -> Result<(), ReceiveError> {
        let changes = self.link.board.changes(self.place).get_acquire();
        if !self.link.board.has(self.place, self.generation) {
            return Err(ReceiveError::Gone);
        }
        self.changes = changes;
        for lane in 0..self.attached.len() {
            match self.link.board.lane(self.place, lane) {
                LaneShown::Bound { generation, from } => self.let_in(lane, generation, from),
                LaneShown::Left { generation, from } => {
                    // It may have come and gone unseen; nobody else has the lane before it is said that it is read.
                    self.let_in(lane, generation, from);
                    self.leaving += usize::from(self.inbox.leave(lane));
                }
                LaneShown::Free => {}
            }
        }
        Ok(())
    }

    /// Lets in who has a lane now, if that is not known yet.
    fn let_in(&mut self, lane: usize, generation: u32, from: MailboxName) {
        // The lane of the LAN router is not in this file.
        if self.attached[lane] == generation || lane == ROUTER {
            return;
        }
        self.attached[lane] = generation;
        let layout = self.inbox.layout();
        let view = View::of(self.lanes.clone(), lane_at(layout, lane), layout.sender_words());
        // It is free: the broker has seen that all was read of who had it before.
        let is_in = view.is_some_and(|view| self.inbox.attach(lane, from, view).is_ok());
        debug_assert!(is_in);
    }

    /// Lanes that are read to their end are others'.
    fn let_leave(&mut self) {
        while let Some((lane, _)) = self.inbox.next_left() {
            self.leaving = self.leaving.saturating_sub(1);
            let drained = self.inbox.layout().drained(lane);
            self.inbox.segment().at(drained).set_release(self.attached[lane].into());
        }
    }

    /// Looks for itself for a while; `false`: that was in vain, or is not worth it.
    fn spin(&mut self, until: Option<u64>) -> bool {
        if !self.patience.has_some() {
            return false;
        }
        let end = until.unwrap_or(u64::MAX).min(monotonic() + SPIN);
        let mut found = false;
        while !found && monotonic() < end {
            core::hint::spin_loop();
            found = self.inbox.has_news();
        }
        self.patience.note(found);
        found
    }

    fn sleep(&mut self, until: Option<u64>) -> Result<(), ReceiveError> {
        if !self.inbox.falls_asleep() {
            return Ok(());
        }
        let woken = self.bells.wait(until);
        self.inbox.wakes_up();
        if woken == Woken::StationGone { Err(ReceiveError::Gone) } else { Ok(()) }
    }
}

/// The set of its bells, for [`Mailbox::prepare_wait`].
impl AsFd for Mailbox {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.bells.as_fd()
    }
}

impl Drop for Mailbox {
    fn drop(&mut self) {
        // A station that has ended has deleted it.
        let _ = self.link.ask(Ask::Delete(self.name), &[]);
    }
}

/// Whether it is worth looking for oneself: where the sender has another core, and answers soon.
#[derive(Default)]
struct Patience {
    /// Times to sleep at once, and how many there were the last time.
    sleeps: u32,
    last: u32,
}

impl Patience {
    fn has_some(&mut self) -> bool {
        self.sleeps = self.sleeps.saturating_sub(1);
        self.sleeps == 0
    }

    fn note(&mut self, found: bool) {
        self.last = if found { 0 } else { (2 * self.last).clamp(*SLEEPS.start(), *SLEEPS.end()) };
        self.sleeps = self.last;
    }
}
