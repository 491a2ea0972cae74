//! From its first turn on, a station allocates nothing (invariant 2): in virtual time and live.

#![allow(unsafe_code)]
// Live stations need real time.
#![allow(clippy::disallowed_methods)]

mod buffers;
mod live;
mod other_processes;
mod packages;
mod proxy;
mod sockets;
mod tunnels;
mod virtual_time;
mod without_slots;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// The system's allocator, counting what is asked of it.
struct Counting;

thread_local! {
    /// Of this thread, since tests run side by side.
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

fn count() {
    CALLS.with(|calls| calls.set(calls.get() + 1));
}

/// How often this thread has asked for memory or given it back.
fn calls() -> u64 {
    CALLS.with(Cell::get)
}

// SAFETY: every call goes unchanged to the system's allocator, which keeps the contract; counting
// neither allocates nor panics, since the counter has no destructor and is never gone.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(memory, layout) }
    }
    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(memory, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn the_counter_counts() {
    let on_a_thread = || {
        let before = calls();
        drop(std::hint::black_box(Box::new(7)));
        calls() - before
    };
    assert_eq!(on_a_thread(), 2);
    assert_eq!(std::thread::spawn(on_a_thread).join().unwrap(), 2, "on every thread");
}
