//! Frame layouts. A header is parsed once, checked, and then read without further checks.

pub mod arp;
pub mod checksum;
pub mod ethernet;
pub mod icmpv4;
pub mod ipv4;
pub mod offload;
pub mod udp;
pub mod udp_options;
