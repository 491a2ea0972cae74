//! What becomes of the interface that a station runs on. A thread looks: the kernel tells those who send and receive
//! there little or nothing. It is a thread of its own, as the kernel keeps who looks waiting, for 20 ms while another
//! station's process dies, and the control thread has to answer meanwhile.
//!
//! ```text
//!          cut            set down
//!  up ◄─────────► no carrier ◄─────────► down         gone
//!  ▲      back             set up          ▲          the station ends: its sockets
//!  ├───────────────────────────────────────┘          never come back
//!  ├─────────► bridge port
//!  └─────────► other address, until it is set back
//! ```
//!
//! In all states but the last the station goes on, and needs no restart: its sockets are bound to the interface's
//! number, whatever its name, and work again as soon as it does.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::Duration;
use std::{fmt, io};

use anyhow::{Context, Result, bail};
use nix::sys::eventfd::EventFd;
use rtnet::clock::True;
use rtnet::live::clock::monotonic;
use rtnet::live::interface::{Interface, Watch};
use rtnet::wire::ethernet::{Address, MTU};
use vnic::netlink::Links;

/// Whether frames can pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkState {
    /// They can.
    Up,
    /// The cable, or the other end, is missing.
    NoCarrier,
    /// It was set down.
    Down,
    /// It is a port of a bridge, which takes all frames that come.
    BridgePort,
    /// It has another address than the station, which hears only what is for all.
    OtherAddress,
}

impl LinkState {
    /// The state's name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            LinkState::Up => "up",
            LinkState::NoCarrier => "no carrier",
            LinkState::Down => "down",
            LinkState::BridgePort => "bridge port",
            LinkState::OtherAddress => "other address",
        }
    }
}

/// An interface as it was at one look.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Link {
    name: String,
    is_up: bool,
    has_carrier: bool,
    mtu: usize,
    address: Option<Address>,
    /// The bridge that it is a port of.
    bridge: Option<String>,
}

impl Link {
    /// The state of an interface that a station with this address runs on.
    fn state(&self, own: Address) -> LinkState {
        match self {
            Link { is_up: false, .. } => LinkState::Down,
            Link { bridge: Some(_), .. } => LinkState::BridgePort,
            Link { address: Some(address), .. } if *address != own => LinkState::OtherAddress,
            Link { has_carrier: false, .. } => LinkState::NoCarrier,
            _ => LinkState::Up,
        }
    }
}

/// An open eye on an interface: whether it is the one that the station's sockets are bound to, and what it is like.
struct Eye {
    watch: Watch,
    links: Links,
    index: u32,
}

impl Eye {
    fn open(interface: &Interface) -> Result<Self> {
        Ok(Self { watch: Watch::open(interface)?, links: Links::open()?, index: interface.index })
    }

    /// `None`: the interface is gone. An error: the kernel did not answer, and the next look shows what this one would have.
    fn look(&mut self) -> Result<Option<Link>> {
        if !self.watch.is_there()? {
            return Ok(None);
        }
        let Some(found) = self.links.get(self.index)? else { bail!("it is not listed") };
        let bridge = match found.bridge {
            Some(index) => {
                Some(self.links.get(index)?.map_or_else(|| format!("#{index}"), |bridge| bridge.name))
            }
            None => None,
        };
        Ok(Some(Link {
            name: found.name,
            is_up: found.is_up,
            has_carrier: found.has_carrier,
            mtu: found.mtu,
            address: found.address.map(Address),
            bridge,
        }))
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
        /// Other names in the line: the bridge, or both addresses, its own first.
        why: Vec<String>,
        /// When it was still as before, CLOCK_MONOTONIC.
        before: True,
    },
    /// Its frames may be longer or shorter than before.
    Mtu { interface: String, to: usize },
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
    /// Until a thread looks.
    eye: Option<Eye>,
    mtu: Arc<AtomicUsize>,
    looks: Receiver<(True, Option<Link>)>,
    /// Where the looks are left.
    to: SyncSender<(True, Option<Link>)>,
    /// Whether the last look showed something else than the one before it.
    news: Arc<AtomicBool>,
    seen: Seen,
}

/// What there is to be seen of it.
struct Seen {
    /// The station's address.
    own: Address,
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
    /// It counts as up and with the usual MTU until the first look, so that other things are reported at the start, too.
    /// `mtu` has its MTU from now on, as each look shows it.
    ///
    /// # Errors
    /// The kernel does not say what the interface is; or it is a port of a bridge, and nothing would ever come.
    pub fn open(interface: &Interface, mtu: Arc<AtomicUsize>) -> Result<Self> {
        let unseen = || format!("the interface '{}' cannot be looked at", interface.name);
        let mut eye = Eye::open(interface).with_context(unseen)?;
        if let Some(found) = eye.look().with_context(unseen)? {
            mtu.store(found.mtu, Ordering::Relaxed);
            if let Some(bridge) = found.bridge {
                bail!("{}", of_a_bridge(&interface.name, &bridge));
            }
        }
        let link = Link {
            name: interface.name.clone(),
            is_up: true,
            has_carrier: true,
            mtu: MTU,
            address: Some(interface.address),
            bridge: None,
        };
        let before = Look { at: monotonic(), link };
        let (to, looks) = sync_channel(LOOKS);
        let seen = Seen { own: interface.address, before, carrier_lost: 0, renamed: 0 };
        Ok(Self { eye: Some(eye), mtu, looks, to, news: Arc::default(), seen })
    }

    /// Has a thread look so often, as long as the process runs; `waker` is written to when it sees something else.
    pub fn look_every(&mut self, every: Duration, waker: Arc<EventFd>) -> io::Result<()> {
        let Some(mut eye) = self.eye.take() else { return Ok(()) };
        let (to, news, mtu) = (self.to.clone(), self.news.clone(), self.mtu.clone());
        let thread = std::thread::Builder::new().name("wire".into()).stack_size(STACK);
        thread.spawn(move || {
            let mut before = None;
            loop {
                // What changes after this is seen at the next look, so that `before` never lies behind a change.
                let at = monotonic();
                // Where the kernel does not answer now, the next look shows it.
                if let Ok(link) = eye.look() {
                    let (is_news, is_gone) = (before.as_ref() != Some(&link), link.is_none());
                    link.iter().for_each(|link| mtu.store(link.mtu, Ordering::Relaxed));
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

    /// Its MTU then.
    pub fn mtu(&self) -> usize {
        self.seen.before.link.mtu
    }

    /// Whether frames could pass then.
    pub fn state(&self) -> LinkState {
        self.seen.before.link.state(self.seen.own)
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
    /// Takes a look, and returns what it shows.
    fn take(&mut self, at: True, link: Option<Link>) -> Vec<Change> {
        let changes = changes(self.own, &self.before, link.as_ref());
        for change in &changes {
            match change {
                Change::Renamed { .. } => self.renamed += 1,
                Change::State { from: LinkState::Up, .. } => self.carrier_lost += 1,
                Change::State { .. } | Change::Mtu { .. } | Change::Gone { .. } => {}
            }
        }
        if let Some(link) = link {
            self.before = Look { at, link };
        }
        changes
    }
}

/// What differs between two looks. Between them more may have happened, of which there is no sign any more.
fn changes(own: Address, before: &Look, now: Option<&Link>) -> Vec<Change> {
    let was = &before.link;
    let Some(is) = now else { return vec![Change::Gone { interface: was.name.clone(), before: before.at }] };
    let mut changes = Vec::new();
    if was.name != is.name {
        changes.push(Change::Renamed { from: was.name.clone(), to: is.name.clone() });
    }
    let (from, to) = (was.state(own), is.state(own));
    if from != to {
        let why = match to {
            LinkState::BridgePort => is.bridge.iter().cloned().collect(),
            LinkState::OtherAddress => {
                [Some(own), is.address].iter().flatten().map(Address::to_string).collect()
            }
            LinkState::Up | LinkState::NoCarrier | LinkState::Down => Vec::new(),
        };
        changes.push(Change::State { interface: is.name.clone(), from, to, why, before: before.at });
    }
    if was.mtu != is.mtu {
        changes.push(Change::Mtu { interface: is.name.clone(), to: is.mtu });
    }
    changes
}

fn of_a_bridge(interface: &str, bridge: &str) -> String {
    format!(
        "the interface '{interface}' is a port of the bridge '{bridge}', which takes all frames that come: use \
         '{bridge}', or take it out with `ip link set {interface} nomaster`"
    )
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Change::Renamed { from, to } => write!(f, "the interface '{from}' is called '{to}' now"),
            Change::State {
                interface,
                from: LinkState::BridgePort | LinkState::OtherAddress,
                to: LinkState::Up,
                ..
            } => {
                write!(f, "the interface '{interface}' is the station's again: frames pass")
            }
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
            Change::State { interface, to: LinkState::BridgePort, why, .. } => {
                write!(f, "{}; the station goes on trying", of_a_bridge(interface, &why.join(" ")))
            }
            Change::State { interface, to: LinkState::OtherAddress, why, .. } => {
                let own = why.first().map_or("", String::as_str);
                let other = why.last().map_or("", String::as_str);
                write!(
                    f,
                    "the interface '{interface}' has the address {other} now, and the station has {own}: nothing that is for \
                     this station alone comes in; set it back with `ip link set {interface} address {own}`, or start the \
                     station again"
                )
            }
            Change::Mtu { interface, to } if *to < MTU => write!(
                f,
                "the interface '{interface}' has an MTU of {to}: no frame is longer; datagrams go in fragments, and what \
                 cannot is refused (EMSGSIZE)"
            ),
            Change::Mtu { interface, to } => write!(
                f,
                "the interface '{interface}' has an MTU of {to}: this station sends up to {MTU} bytes in a \
                 frame, and takes longer IPv4 packets"
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
mod tests;
