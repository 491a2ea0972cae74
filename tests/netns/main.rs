//! Real networks in kernel namespaces: the same objects as in virtual time, on packet sockets over veth.

mod live;
mod peer_over_veth;
mod sync_loss;
