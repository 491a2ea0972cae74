//! What becomes of the interface that a station runs on. A thread looks: the kernel tells those who send and receive
//! there little or nothing. It is a thread of its own, as the kernel keeps who looks waiting, for 20 ms while another
//! station's process dies, and the control thread has to answer meanwhile.
//!
//! ```text
//!          cut            set down
//!  up ◄─────────► no carrier ◄─────────► down         gone
//!  ▲      back             set up          ▲          the station ends: its sockets
//!  └───────────────────────────────────────┘          never come back
//! ```
//!
//! In all states but the last the station goes on, and needs no restart: its sockets are bound to the interface's
//! number, whatever its name, and work again as soon as it does.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::Duration;
use std::{fmt, io};

use nix::sys::eventfd::EventFd;
use rtnet::clock::True;
use rtnet::live::clock::monotonic;
use rtnet::live::interface::{Interface, Link, Watch};

/// Whether frames can pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkState {
    /// They can.
    Up,
    /// The cable, or the other end, is missing.
    NoCarrier,
    /// It was set down.
    Down,
}

impl LinkState {
    fn of(link: &Link) -> Self {
        match link {
            Link { up: false, .. } => LinkState::Down,
            Link { carrier: false, .. } => LinkState::NoCarrier,
            _ => LinkState::Up,
        }
    }

    /// The state's name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            LinkState::Up => "up",
            LinkState::NoCarrier => "no carrier",
            LinkState::Down => "down",
        }
    }
}

/// What is otherwise than it was.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Change {
    /// It has another name.
    Renamed { from: String, to: String },
    /// Frames can pass, or cannot any more, or for another reason than before.
    State {
        interface: String,
        from: LinkState,
        to: LinkState,
        /// When it was still as before, CLOCK_MONOTONIC.
        before: True,
    },
    /// It does not exist any more, here at least.
    Gone {
        interface: String,
        /// When it was last seen to be there.
        before: True,
    },
}

/// Looks that wait for the control thread; of more the state shows at the next one.
const LOOKS: usize = 16;
/// A thread that looks has little to remember.
const STACK: usize = 128 * 1024;

/// An interface that is looked at from time to time.
pub struct Wire {
    /// Until somebody looks.
    watch: Option<Watch>,
    looks: Receiver<(True, Option<Link>)>,
    /// Where who looks leaves it.
    to: SyncSender<(True, Option<Link>)>,
    /// Whether the last look showed something else than the one before it.
    news: Arc<AtomicBool>,
    seen: Seen,
}

/// What there is to be seen of it.
struct Seen {
    before: Look,
    carrier_lost: u64,
    renamed: u64,
}

/// One look at it.
struct Look {
    at: True,
    link: Link,
}

impl Wire {
    /// It counts as up until the first look, so that who starts without a carrier is told of it, too.
    pub fn open(interface: &Interface) -> io::Result<Self> {
        let link = Link { name: interface.name.clone(), up: true, carrier: true };
        let before = Look { at: monotonic(), link };
        let (to, looks) = sync_channel(LOOKS);
        let seen = Seen { before, carrier_lost: 0, renamed: 0 };
        Ok(Self { watch: Some(Watch::open(interface)?), looks, to, news: Arc::default(), seen })
    }

    /// Has a thread look so often, as long as the process runs; `waker` is written to when it sees something else.
    pub fn look_every(&mut self, every: Duration, waker: Arc<EventFd>) -> io::Result<()> {
        let Some(watch) = self.watch.take() else { return Ok(()) };
        let (to, news) = (self.to.clone(), self.news.clone());
        let thread = std::thread::Builder::new().name("wire".into()).stack_size(STACK);
        thread.spawn(move || {
            let mut before = None;
            loop {
                // What changes after this is seen at the next look, so that `before` never lies behind a change.
                let at = monotonic();
                // Where the kernel does not tell now, the next look does.
                if let Ok(link) = watch.look() {
                    let (is_news, is_gone) = (before.as_ref() != Some(&link), link.is_none());
                    before = Some(link.clone());
                    let sent = if is_gone { to.send((at, link)).is_ok() } else { offer(&to, (at, link)) };
                    if is_news {
                        news.store(true, Ordering::Release);
                        // It does not block: one that was not read is readable already.
                        let _ = waker.write(1);
                    }
                    if is_gone || !sent {
                        return;
                    }
                }
                std::thread::sleep(every);
            }
        })?;
        Ok(())
    }

    /// Whether a look showed something else since somebody last asked.
    pub fn has_news(&self) -> bool {
        self.news.swap(false, Ordering::Acquire)
    }

    /// What the looks have shown that were made since the last time.
    pub fn look(&mut self) -> Vec<Change> {
        let Self { looks, seen, .. } = self;
        looks.try_iter().flat_map(|(at, link)| seen.take(at, link)).collect()
    }

    /// The interface's name by the last look.
    pub fn name(&self) -> &str {
        &self.seen.before.link.name
    }

    /// Whether frames could pass then.
    pub fn state(&self) -> LinkState {
        LinkState::of(&self.seen.before.link)
    }

    /// What was counted so far, by name. A carrier is lost when the interface is set down, too.
    pub fn counters(&self) -> [(&'static str, u64); 2] {
        [("carrier_lost", self.seen.carrier_lost), ("renamed", self.seen.renamed)]
    }
}

/// Leaves a look if there is room; whether there is anybody to take it.
fn offer(to: &SyncSender<(True, Option<Link>)>, look: (True, Option<Link>)) -> bool {
    !matches!(to.try_send(look), Err(TrySendError::Disconnected(_)))
}

impl Seen {
    /// Takes a look; what it tells.
    fn take(&mut self, at: True, link: Option<Link>) -> Vec<Change> {
        let changes = changes(&self.before, link.as_ref());
        for change in &changes {
            match change {
                Change::Renamed { .. } => self.renamed += 1,
                Change::State { from: LinkState::Up, .. } => self.carrier_lost += 1,
                Change::State { .. } | Change::Gone { .. } => {}
            }
        }
        if let Some(link) = link {
            self.before = Look { at, link };
        }
        changes
    }
}

/// What differs between two looks. Between them more may have happened, of which there is no sign any more.
fn changes(before: &Look, now: Option<&Link>) -> Vec<Change> {
    let was = &before.link;
    let Some(is) = now else { return vec![Change::Gone { interface: was.name.clone(), before: before.at }] };
    let mut changes = Vec::new();
    if was.name != is.name {
        changes.push(Change::Renamed { from: was.name.clone(), to: is.name.clone() });
    }
    let (from, to) = (LinkState::of(was), LinkState::of(is));
    if from != to {
        changes.push(Change::State { interface: is.name.clone(), from, to, before: before.at });
    }
    changes
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Change::Renamed { from, to } => write!(f, "the interface '{from}' is called '{to}' now"),
            Change::State { interface, to: LinkState::Up, .. } => {
                write!(f, "the interface '{interface}' has its carrier again")
            }
            Change::State { interface, to: LinkState::NoCarrier, .. } => write!(
                f,
                "the interface '{interface}' has no carrier: look at the cable and its other end; the station \
                 goes on trying"
            ),
            Change::State { interface, to: LinkState::Down, .. } => write!(
                f,
                "the interface '{interface}' is down: bring it up with `ip link set {interface} up`; the station \
                 goes on trying"
            ),
            Change::Gone { interface, .. } => write!(
                f,
                "the interface '{interface}' is gone: it was removed, or moved to another network namespace; \
                 start the station again once it is back"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEFORE: True = 1_000;

    fn link(name: &str, state: LinkState) -> Link {
        Link { name: name.into(), up: state != LinkState::Down, carrier: state == LinkState::Up }
    }

    fn seen(state: LinkState) -> Seen {
        Seen { before: Look { at: BEFORE, link: link("rt0", state) }, carrier_lost: 0, renamed: 0 }
    }

    #[test]
    fn every_state_follows_every_other_and_only_leaving_up_counts_as_a_loss() {
        use LinkState::{Down, NoCarrier, Up};
        for from in [Up, NoCarrier, Down] {
            for to in [Up, NoCarrier, Down] {
                let mut seen = seen(from);
                let changes = seen.take(2_000, Some(link("rt0", to)));
                let change = Change::State { interface: "rt0".into(), from, to, before: BEFORE };
                assert_eq!(changes, if from == to { vec![] } else { vec![change] });
                let lost = u64::from(from == Up && to != Up);
                assert_eq!((seen.carrier_lost, seen.renamed), (lost, 0), "{from:?} to {to:?}");
            }
        }
    }

    #[test]
    fn a_change_is_dated_by_the_last_look_at_which_there_was_none() {
        let mut seen = seen(LinkState::Up);
        assert_eq!(seen.take(2_000, Some(link("rt0", LinkState::Up))), []);
        let changes = seen.take(3_000, Some(link("rt0", LinkState::NoCarrier)));
        assert!(matches!(changes[..], [Change::State { before: 2_000, .. }]), "{changes:?}");
    }

    #[test]
    fn an_interface_that_was_renamed_is_called_by_its_new_name() {
        let mut seen = seen(LinkState::Up);
        // As older kernels want it: nothing is renamed while it is up.
        let changes = seen.take(2_000, Some(link("rt9", LinkState::Down)));
        let lines: Vec<String> = changes.iter().map(Change::to_string).collect();
        assert_eq!(lines[0], "the interface 'rt0' is called 'rt9' now");
        assert!(lines[1].starts_with("the interface 'rt9' is down: bring it up with `ip link set rt9 up`"));
        assert_eq!((seen.before.link.name, seen.renamed), ("rt9".into(), 1));
    }

    #[test]
    fn an_interface_that_is_gone_is_named_with_the_remedy() {
        let changes = seen(LinkState::NoCarrier).take(2_000, None);
        assert!(matches!(changes[..], [Change::Gone { before: 1_000, .. }]), "{changes:?}");
        let line = changes[0].to_string();
        assert!(line.contains("'rt0' is gone") && line.contains("start the station again"), "{line}");
        assert!(!line.contains('\n'), "{line}");
    }
}
