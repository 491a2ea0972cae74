//! What went through a tunnel, and what was lost at its ends, by reason.

use std::sync::atomic::{AtomicU64, Ordering};

macro_rules! losses {
    ($($(#[doc = $doc:literal])+ $name:ident = $text:literal,)+) => {
        /// Why a frame did not get through.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Loss { $($(#[doc = $doc])+ $name,)+ }

        impl Loss {
            /// Every reason, in the order of declaration.
            pub const ALL: &[Loss] = &[$(Loss::$name,)+];

            /// The reason's name in reports.
            pub const fn name(self) -> &'static str {
                match self { $(Loss::$name => $text,)+ }
            }
        }
    };
}

losses! {
    /// From Linux: shorter than an Ethernet header.
    Short = "short",
    /// From Linux: longer than the slot takes.
    TooLong = "too_long",
    /// From Linux: the station took it for no slot.
    NotQueued = "not_queued",
    /// From Linux: the kernel refused it on the station's interface, and without slots there is no next turn.
    KernelRefused = "kernel_refused",
    /// Neither IPv4 nor IPv6, where only packets go through, or not IPv4, where only that does.
    NotIp = "not_ip",
    /// From Linux: a packet to an address that no station is known to have (yet: a neighbour is asked for), or that no route
    /// leads to.
    NoStation = "no_station",
    /// For Linux: too short to have a frame inside.
    Truncated = "truncated",
    /// For Linux: what needed a buffer while none was free, a packet for a proxy or the question of a neighbour.
    NoBuffer = "no_buffer",
    /// For Linux: the kernel's queue in front of the tunnel was full.
    QueueFull = "queue_full",
    /// For Linux, while the device was down or gone.
    DeviceDown = "device_down",
    /// For Linux, which refused it.
    DeviceRefused = "device_refused",
}

/// What both ends count.
#[derive(Debug, Default)]
pub(crate) struct Counters {
    chosen: AtomicU64,
    put_off: AtomicU64,
    received: AtomicU64,
    losses: [AtomicU64; Loss::ALL.len()],
}

/// What went through, and what did not.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Counts {
    /// Frames that left in a turn.
    pub sent: u64,
    /// Times that one missed its turn, and waited for the next.
    pub put_off: u64,
    /// Frames that came for Linux, whether it took them or not.
    pub received: u64,
    losses: [u64; Loss::ALL.len()],
}

impl Counters {
    pub(crate) fn chose(&self, n: usize) {
        self.chosen.fetch_add(n as u64, Ordering::Relaxed);
    }
    pub(crate) fn put_off(&self) {
        self.put_off.fetch_add(1, Ordering::Relaxed);
    }
    pub(crate) fn received(&self) {
        self.received.fetch_add(1, Ordering::Relaxed);
    }
    pub(crate) fn lose(&self, why: Loss, n: u64) {
        self.losses[why as usize].fetch_add(n, Ordering::Relaxed);
    }

    pub(crate) fn now(&self) -> Counts {
        let of = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let put_off = of(&self.put_off);
        // Those are chosen again, or never left.
        let not_sent = put_off + of(&self.losses[Loss::KernelRefused as usize]);
        let sent = of(&self.chosen).saturating_sub(not_sent);
        Counts { sent, put_off, received: of(&self.received), losses: self.losses.each_ref().map(of) }
    }
}

impl Counts {
    /// How many were lost for this reason.
    pub fn lost(&self, why: Loss) -> u64 {
        self.losses[why as usize]
    }

    /// Every reason for which some were, with their number.
    pub fn losses(&self) -> impl Iterator<Item = (Loss, u64)> + '_ {
        Loss::ALL.iter().map(|&why| (why, self.lost(why))).filter(|(_, n)| *n > 0)
    }
}
