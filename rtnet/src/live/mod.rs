//! Real time: the same stations on AF_PACKET sockets of a stock kernel.
//!
//! ```text
//!   wake at slot - lead ─► drain control socket ─► choose ─► sleep, spin ─► stamp, check, send, look again
//!        ▲                                                                        │
//!        └────────────────────────── drain data sockets ◄─────────────────────────┘
//! ```
//!
//! Other threads of the process read the time from the driver's [`TimeBoard`], and wait for cycles there; so do other
//! processes, by [`rtnet::api::Station::time`](crate::api::Station::time).
//!
//! Nothing else in this crate opens a socket on a network, or reads a clock.

#![allow(unsafe_code)]
#![allow(clippy::disallowed_methods)]

mod alarm;
mod bells;
mod bpf;
pub mod clock;
mod clock_order;
mod driver;
mod errands;
mod filter;
pub mod guard;
mod impair;
pub mod interface;
mod packet;
mod port;
pub mod realtime;
pub mod rights;
pub mod ring;
pub mod sealed;
mod time_board;
mod time_page;
mod tunnelled;
mod visit;
pub(crate) mod wait;

pub use bells::Bells;
pub use clock_order::ClockOrder;
pub use driver::{Driver, DriverConfig, Record, Snapshot};
pub use errands::{Errand, Errands};
pub use guard::{Guard, GuardMode, GuardRefused};
pub use impair::{Chances, Impaired, Impairment, ImpairmentRefused, LOGGED};
pub use port::{Data, ETHER_TYPES_AT_MOST, OpenError, Port, PortCounters, RECEIVE_POOL};
pub use time_board::{TimeBoard, TimePublisher};
pub use tunnelled::{TUNNELLED_QUEUE, Tunnelled};
pub use visit::{NoSockets, Visitor, Visits};
pub use wait::{Cycle, WaitError, Waiter};
