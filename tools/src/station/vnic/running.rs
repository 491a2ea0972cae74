//! A VNIC's thread, which ends with its station, whatever that ends by.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Builder, JoinHandle};

use nix::sys::eventfd::EventFd;

/// A VNIC's thread, until this is dropped: then it has put back what it changed of the host.
pub struct Running {
    /// Gone only when this is.
    thread: Option<JoinHandle<()>>,
    stop: Arc<AtomicBool>,
    bell: Arc<EventFd>,
}

impl Running {
    /// Starts a thread that does this until it is to stop, and sleeps on nothing that the bell does not end. Why not, in a
    /// line, where the host has no thread left.
    pub(super) fn start(
        builder: Builder,
        stop: Arc<AtomicBool>,
        bell: Arc<EventFd>,
        body: impl FnOnce() + Send + 'static,
    ) -> Result<Self, String> {
        let thread = builder.name("vnic".into()).spawn(body);
        let thread = thread.map_err(|error| format!("no VNIC: its thread does not start: {error}"))?;
        Ok(Self { thread: Some(thread), stop, bell })
    }
}

impl Drop for Running {
    /// A real-time thread that panicked has told nobody to stop, nor has a station that cannot go on.
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // It does not block: one that was not read is readable already.
        let _ = self.bell.write(1);
        // What it panicked with it has said itself.
        self.thread.take().into_iter().for_each(|thread| drop(thread.join()));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, channel};
    use std::time::{Duration, Instant};

    use super::*;
    use crate::station::ended;

    /// One that asks as a VNIC does, and says when it has ended.
    fn running() -> (Running, Receiver<()>) {
        let (stop, bell) = (Arc::new(AtomicBool::new(false)), Arc::new(EventFd::new().unwrap()));
        let ((told, has_ended), stopped, rung) = (channel(), stop.clone(), bell.clone());
        let body = move || {
            while !stopped.load(Ordering::Relaxed) {
                rung.read().unwrap();
            }
            told.send(()).unwrap();
        };
        (Running::start(Builder::new(), stop, bell, body).unwrap(), has_ended)
    }

    #[test]
    fn a_vnics_thread_ends_with_a_real_time_thread_that_panics_and_that_is_said() {
        let (vnic, has_ended) = running();
        let real_time = std::thread::spawn(|| panic!("as for a fault of the program"));
        let (told, said) = channel();
        // Who would wait for ever does so elsewhere.
        std::thread::spawn(move || told.send(ended(real_time, Some(vnic)).unwrap_err().to_string()));
        let patience = Duration::from_secs(10);
        assert_eq!(said.recv_timeout(patience).as_deref(), Ok("the real-time thread panicked"));
        assert_eq!(has_ended.try_recv(), Ok(()), "before that was said");
    }

    #[test]
    fn a_vnics_thread_has_ended_when_a_station_that_cannot_go_on_does_so() {
        let (vnic, has_ended) = running();
        let began = Instant::now();
        drop(vnic);
        assert_eq!(has_ended.try_recv(), Ok(()));
        assert!(began.elapsed() < Duration::from_secs(10), "{:?}", began.elapsed());
    }

    #[test]
    fn a_host_without_a_thread_for_a_vnic_is_told_of_in_a_line() {
        let (stop, bell) = (Arc::default(), Arc::new(EventFd::new().unwrap()));
        let too_much = Builder::new().stack_size(1 << 60);
        let why = Running::start(too_much, stop, bell, || ()).err().unwrap();
        assert!(why.starts_with("no VNIC: its thread does not start: "), "{why}");
    }
}
