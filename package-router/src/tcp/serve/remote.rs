//! Another thread's hold on a running server.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use mio::Waker;

use crate::tcp::router::Status;
use crate::tcp::rules::Rules;

/// Asks a running server, or ends it, from any thread.
#[derive(Clone)]
pub struct Remote {
    stop: Arc<AtomicBool>,
    waker: Arc<Waker>,
    orders: Sender<Order>,
}

/// A request of another thread.
pub(super) enum Order {
    Status(Sender<Status>),
    Rules(Result<Rules, String>),
}

impl Remote {
    /// One that wakes a server by this, and the orders for that server.
    pub(super) fn new(waker: Waker) -> (Self, Receiver<Order>) {
        let (orders, taken) = channel();
        (Self { stop: Arc::default(), waker: Arc::new(waker), orders }, taken)
    }

    /// Whether the server is to end.
    pub(super) fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Ends the server's loop.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
        // It looks at the next event, at the latest.
        let _ = self.waker.wake();
    }

    /// Replaces the rules; `None` if the server has ended.
    pub fn set_rules(&self, rules: Rules) -> Option<()> {
        self.order(Order::Rules(Ok(rules)))
    }

    /// Reports rules that cannot be, and why, for the router's status; `None` if the server has ended.
    pub fn refuse_rules(&self, why: String) -> Option<()> {
        self.order(Order::Rules(Err(why)))
    }

    /// The router as it is; `None` if the server has not answered in time.
    pub fn status(&self, patience: Duration) -> Option<Status> {
        let (answer, answered) = channel();
        self.order(Order::Status(answer))?;
        answered.recv_timeout(patience).ok()
    }

    fn order(&self, order: Order) -> Option<()> {
        self.orders.send(order).ok()?;
        self.waker.wake().ok()
    }
}
