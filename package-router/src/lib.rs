//! Packages: components send them to names, the most urgent first; where the receiver runs is hidden.

pub mod bells;
pub mod board;
pub mod body;
pub mod broker;
pub mod component;
pub mod handshake;
pub mod journey;
pub mod mailbox;
pub mod name;
pub mod node;
pub mod priority;
pub mod registry;
pub mod route;
pub mod router;
pub mod rpc;
pub mod shared;
pub mod tcp;
pub mod wire;
