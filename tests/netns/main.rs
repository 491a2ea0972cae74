//! Real networks in kernel namespaces: the same objects as in virtual time, on packet sockets over veth.

// Real stations need real time.
#![allow(clippy::disallowed_methods)]

mod kernel_guard;
mod live;
mod not_for_us;
mod peer_over_veth;
mod sync_loss;
mod wait_on_cycle;
mod without_slots;
