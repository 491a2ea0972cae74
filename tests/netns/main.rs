//! Real networks in kernel namespaces: the same objects as in virtual time, on packet sockets over veth.

// Real stations need real time.
#![allow(clippy::disallowed_methods)]

mod data_between_slots;
mod kernel_guard;
mod last_look;
mod linux_peer;
mod live;
mod not_for_us;
mod peer_over_veth;
mod sync_loss;
mod token;
mod wait_on_cycle;
mod with_sockets;
mod without_slots;
