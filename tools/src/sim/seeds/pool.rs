//! Independent runs on several threads.

use std::cell::RefCell;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Once};
use std::thread::{self, Builder};

/// Starts this many runs, in order, on `jobs` threads. Each result comes with the run's place as soon as it is there. A run
/// that panics is an `Err` with the place in the source and the message. No further run starts once the receiver is gone.
///
/// # Errors
/// No thread can be started.
pub fn start<T: Send + 'static>(
    count: usize,
    jobs: usize,
    run: impl Fn(usize) -> T + Send + Sync + 'static,
) -> io::Result<Receiver<(usize, Result<T, String>)>> {
    keep_panics();
    let (results, received) = channel();
    let (run, next) = (Arc::new(run), Arc::new(AtomicUsize::new(0)));
    for number in 0..jobs.clamp(1, count.max(1)) {
        let (results, run, next) = (results.clone(), run.clone(), next.clone());
        let work = move || {
            PANIC.set(Some(String::new()));
            loop {
                let place = next.fetch_add(1, Ordering::Relaxed);
                if place >= count {
                    return;
                }
                let result = catch_unwind(AssertUnwindSafe(|| run(place)))
                    .map_err(|_| PANIC.take().unwrap_or_default());
                PANIC.set(Some(String::new()));
                if results.send((place, result)).is_err() {
                    return;
                }
            }
        };
        // One thread is enough to go on with.
        match Builder::new().name(format!("run {number}")).spawn(work) {
            Err(error) if number == 0 => return Err(error),
            _ => {}
        }
    }
    Ok(received)
}

/// How many runs this process may have at once: one for each CPU that it may use.
pub fn usual_jobs() -> usize {
    thread::available_parallelism().map_or(1, usize::from)
}

thread_local! {
    /// The last panic of this thread, if it runs for [`start`].
    static PANIC: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// A panic in a run is a result: it is kept, not printed.
fn keep_panics() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let usual = take_hook();
        set_hook(Box::new(move |panic| {
            let kept = PANIC.with_borrow_mut(|kept| {
                kept.as_mut().map(|kept| *kept = panic.to_string().replace('\n', " "))
            });
            if kept.is_none() {
                usual(panic);
            }
        }));
    });
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::*;

    fn all(count: usize, jobs: usize) -> Vec<Result<usize, String>> {
        let run = |place| if place % 3 == 1 { panic!("{place} is bad") } else { place * 10 };
        let mut all: Vec<_> = start(count, jobs, run).unwrap().into_iter().collect();
        all.sort_by_key(|(place, _)| *place);
        assert!(all.iter().map(|(place, _)| *place).eq(0..count), "each once");
        all.into_iter().map(|(_, result)| result).collect()
    }

    #[test]
    fn any_number_of_jobs_gives_the_same_results() {
        let one = all(20, 1);
        assert_eq!((one[0].clone(), one[2].clone()), (Ok(0), Ok(20)));
        assert!([2, 7, 64].iter().all(|&jobs| all(20, jobs) == one));
        assert_eq!(all(0, 4), []);
    }

    #[test]
    fn a_panic_is_the_result_of_its_run_alone() {
        let why = all(5, 2)[4].clone().unwrap_err();
        assert!(why.contains("pool.rs:") && why.ends_with("4 is bad"), "{why}");
    }

    #[test]
    fn no_run_starts_once_nobody_listens() {
        let (count, dropped) = (Arc::new(AtomicUsize::new(0)), Arc::new(Barrier::new(2)));
        let (counted, gate) = (count.clone(), dropped.clone());
        // The second run lasts until nobody listens.
        let run = move |place| {
            if place == 1 {
                gate.wait();
            }
            counted.fetch_add(1, Ordering::Relaxed)
        };
        let results = start(1_000, 1, run).unwrap();
        results.recv().unwrap().1.unwrap();
        drop(results);
        dropped.wait();
        // The thread holds the only other count until it ends.
        while Arc::strong_count(&count) > 1 {
            thread::yield_now();
        }
        assert_eq!(count.load(Ordering::Relaxed), 2);
    }
}
