//! The way of commands between the control thread and the loop.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crossbeam::atomic::AtomicCell;
use nix::sys::eventfd::EventFd;

/// A command on its way to the loop and back.
pub struct Errand<C, R> {
    /// What is asked for; on the way back with what it replaced.
    pub command: C,
    /// From which cycle on it holds, or why not; `None` on the way there.
    pub result: Option<Result<u32, R>>,
}

/// The two ends of the way of commands: one errand at a time, handed over by swapping a pointer, so that the loop
/// never waits for somebody who was preempted while handing it over.
pub struct Errands<C, R> {
    asked: AtomicCell<Option<Box<Errand<C, R>>>>,
    answered: AtomicCell<Option<Box<Errand<C, R>>>>,
    /// Whether one is under way.
    under_way: AtomicBool,
    /// What wakes the loop if it waits for anything but a slot.
    bell: Arc<EventFd>,
}

impl<C, R> Errands<C, R> {
    pub(super) fn new(bell: Arc<EventFd>) -> Self {
        Self {
            asked: AtomicCell::new(None),
            answered: AtomicCell::new(None),
            under_way: AtomicBool::new(false),
            bell,
        }
    }

    /// Sends a command; gives it back while another is under way. For one thread.
    pub fn send(&self, command: C) -> Result<(), C> {
        if self.under_way.swap(true, Ordering::Relaxed) {
            return Err(command);
        }
        self.asked.store(Some(Box::new(Errand { command, result: None })));
        // It does not block, and counts for longer than anybody asks.
        let _ = self.bell.write(1);
        Ok(())
    }

    /// The command that has come back, if it has.
    pub fn take(&self) -> Option<Errand<C, R>> {
        let errand = self.answered.take()?;
        self.under_way.store(false, Ordering::Relaxed);
        Some(*errand)
    }

    /// Takes a command back that the loop has not begun with: then it will not be carried out. `None`: it has begun,
    /// and answers as soon as it runs. For the thread that sends.
    pub fn take_back(&self) -> Option<C> {
        let errand = self.asked.take()?;
        self.under_way.store(false, Ordering::Relaxed);
        Some(errand.command)
    }

    /// The command to be carried out, if there is one. For the loop, which answers it.
    pub(super) fn next(&self) -> Option<Box<Errand<C, R>>> {
        self.asked.take()
    }

    /// Sends it back. There is only this one, so that the place is free.
    pub(super) fn answer(&self, errand: Box<Errand<C, R>>) {
        self.answered.store(Some(errand));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Numbers = Errands<u32, ()>;

    fn numbers() -> Numbers {
        Numbers::new(Arc::new(EventFd::new().unwrap()))
    }

    /// What the loop does with a command.
    fn obey(errands: &Numbers) -> bool {
        let Some(mut errand) = errands.next() else { return false };
        errand.result = Some(Ok(errand.command));
        errands.answer(errand);
        true
    }

    #[test]
    fn what_is_taken_back_in_time_is_never_carried_out() {
        let errands = numbers();
        errands.send(7).unwrap();
        assert_eq!(errands.send(8), Err(8), "one at a time");
        assert_eq!(errands.take_back(), Some(7));
        assert!(!obey(&errands) && errands.take().is_none());
        errands.send(9).unwrap();
        assert!(obey(&errands));
        assert_eq!(errands.take().and_then(|errand| errand.result), Some(Ok(9)));
    }

    #[test]
    fn what_was_begun_cannot_be_taken_back_and_is_answered() {
        let errands = numbers();
        errands.send(7).unwrap();
        let begun = errands.next().unwrap();
        assert_eq!(errands.take_back(), None);
        assert_eq!(errands.send(8), Err(8), "it is still under way");
        errands.answer(begun);
        assert_eq!(errands.take_back(), None);
        assert_eq!(errands.take().map(|errand| errand.command), Some(7));
    }

    #[test]
    fn between_two_threads_each_command_is_either_taken_back_or_answered() {
        let errands = Arc::new(numbers());
        let over = Arc::new(AtomicBool::new(false));
        let (of_loop, until) = (errands.clone(), over.clone());
        let begun = std::thread::spawn(move || {
            let mut begun = 0;
            while !until.load(Ordering::Relaxed) {
                begun += u32::from(obey(&of_loop));
                std::hint::spin_loop();
            }
            begun
        });
        let (mut answered, mut taken_back) = (0, 0);
        for command in 0..20_000 {
            errands.send(command).unwrap();
            match errands.take_back() {
                Some(same) => {
                    assert_eq!(same, command);
                    taken_back += 1;
                }
                None => {
                    let errand = loop {
                        if let Some(errand) = errands.take() {
                            break errand;
                        }
                        std::thread::yield_now();
                    };
                    assert_eq!(errand.result, Some(Ok(command)));
                    answered += 1;
                }
            }
        }
        over.store(true, Ordering::Relaxed);
        assert_eq!((begun.join().unwrap(), taken_back + answered), (answered, 20_000));
    }
}
