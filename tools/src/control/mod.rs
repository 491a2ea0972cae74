//! How a running station is looked at and changed: requests and replies over a Unix socket.
//!
//! ```text
//!  rtnet tdma, rtnet slot ──► SOCK_SEQPACKET ──► control thread ──► command queue ──► real-time thread
//!                        one packet, one reply        ▲                                    │
//!                                                     └──── snapshots, records, answers ◄──┘
//! ```
//!
//! A packet is one JSON object of a known version. The control thread serves every client without waiting
//! for any of them; the real-time thread knows of none of this. Whoever hangs up, or shuts down its sending side, takes
//! back what it has asked for and nobody has begun with.

mod client;
mod clock;
mod loads;
mod places;
mod programs;
mod protocol;
mod reply;
mod ring;
mod router;
mod schedule;
mod server;
mod sockets;
mod tcp;
mod vnic;

pub use client::{Question, ask, ask_lab, ask_stack, lab_status, put, router_status, station_status};
pub use clock::{CalibrationShown, ClockShown, Progress};
pub use loads::Load;
pub use places::{Directory, Held, Home, Place, check_name, parse_name};
pub use programs::Answers;
pub use protocol::{
    Envelope, LabReply, LabRequest, LabStatus, MemberStatus, Reply, Request, RoleRequest, SlotChange,
    SlotRequest, SlotShown, StationStatus, VERSION, read,
};
pub use ring::RingShown;
pub use router::{ClientShown, ClosedShown, LinkShown, RatesShown, RouterReply, RouterRequest, RouterShown};
pub use schedule::{ActivationSaid, ChangesTold, ScheduleRequest, ScheduleSaid, ScheduleShown, SlotOf};
pub use server::{REQUEST_AT_MOST, Server, Traffic, check_length};
pub use sockets::{
    ChannelShown, CountersShown, EchoFailed, EchoRequest, EchoShown, EchoesShown, HostShown, InterfaceShown,
    NetworkShown, PoolShown, RouteSaid, RoutesShown, StackReply, StackRequest, Way,
};
pub use tcp::TcpShown;
pub use vnic::{VnicChange, VnicCounted, VnicRequest, VnicShown};
