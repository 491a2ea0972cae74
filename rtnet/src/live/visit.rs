//! How another thread of the process gets at the sockets of a running station.

use std::any::Any;

use super::errands::Errands;
use crate::ip::{Exit, Stack};

/// Who looks at a station's sockets, or changes them, between two turns of its loop. It comes back with what it has found
/// or replaced. What it does is done in the real-time thread: it must not wait, allocate or free, so that it brings room
/// for all that it takes along.
pub trait Visitor: Send + Any {
    /// Carried out after a slot's send.
    fn visit(&mut self, stack: &mut Stack, exit: &mut dyn Exit);
}

/// The way of visitors: one at a time, as commands go.
pub type Visits = Errands<Box<dyn Visitor>, NoSockets>;

/// The station was started without sockets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("it has no sockets and no address: start it with one, as in `rtnet station --ip 10.0.0.1/24`")]
pub struct NoSockets;
