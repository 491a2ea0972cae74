//! The core of a software real-time Ethernet: time, buffers, the transmit queue, and the station
//! with its two worlds, virtual time and the kernel.
//!
//! Protocol code is pure. It is told the time and the frames, and is asked for the next frame and
//! for when to be woken; it has no clock, no socket, no thread and no source of randomness. So the
//! same station runs live and in virtual time.
//!
//! ```
//! use rtnet::{Pool, Priority, PriorityQueue, hand_over};
//!
//! let (nic, socket) = (Pool::new(4), Pool::new(2));
//! let mut frame = nic.take().expect("a new pool is full");
//! frame.fill(b"a frame");
//!
//! // Keeping somebody else's buffer costs an empty one of one's own.
//! let kept = hand_over(frame, &socket).expect("the socket has an empty buffer");
//! assert_eq!((nic.available(), socket.available()), (4, 1));
//!
//! let mut queue = PriorityQueue::new();
//! queue.push(Priority::new(15)?, kept);
//! let (priority, frame) = queue.pop().expect("one is queued");
//! assert_eq!((priority, &frame[..]), (Priority::DEFAULT, &b"a frame"[..]));
//! # Ok::<(), rtnet::PriorityOutOfRange>(())
//! ```

pub mod api;
pub mod at_once;
pub mod buf;
pub mod clock;
pub mod counters;
pub mod direct;
pub mod discipline;
pub mod ip;
pub mod live;
pub mod queue;
pub mod room;
pub mod sim;
pub mod socket;
pub mod station;
pub mod time;
pub mod wire;

pub use buf::{Buf, Chain, Pool, PoolStatistics, hand_over};
pub use counters::{Refusal, Refusals};
pub use direct::Direct;
pub use discipline::{Discipline, Service};
pub use queue::{Priority, PriorityOutOfRange, PriorityQueue};
pub use station::Station;
pub use time::{GlobalTime, Instant, Offset, Span};
