//! Once a second, on standard error: how far the measurement is.

use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rtnet::time::Span;

const EVERY: Duration = Duration::from_secs(1);

/// Shows progress as long as it lives, if it was started to.
pub struct Progress {
    stages: Option<Sender<&'static str>>,
    thread: Option<JoinHandle<()>>,
}

impl Progress {
    /// Starts, if `wanted`, for a measurement that takes so long.
    pub fn start(wanted: bool, duration: Span) -> Self {
        if !wanted {
            return Self { stages: None, thread: None };
        }
        let (stages, told) = channel();
        let (start, whole) = (Instant::now(), duration.nanos() as f64 / 1e9);
        let show = move || {
            let mut stage = "";
            let mut next = start + EVERY;
            loop {
                match told.recv_timeout(next.saturating_duration_since(Instant::now())) {
                    Ok(new) => stage = new,
                    Err(RecvTimeoutError::Timeout) => {
                        next += EVERY;
                        eprintln!("rtnet: {}s of {whole:.0}s: {stage}", start.elapsed().as_secs());
                    }
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
        };
        Self { stages: Some(stages), thread: Some(thread::spawn(show)) }
    }

    /// What is measured now.
    pub fn stage(&self, what: &'static str) {
        if let Some(stages) = &self.stages {
            // The other end listens until this one is dropped.
            let _ = stages.send(what);
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.stages = None;
        if let Some(thread) = self.thread.take() {
            // A thread that only prints cannot have panicked but for a closed standard error.
            let _ = thread.join();
        }
    }
}
