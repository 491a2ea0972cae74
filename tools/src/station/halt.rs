//! For tests and scenarios: a station that is held up where it cannot notice it, between its last look at the clock and
//! `send`. A lab whose scenario has stalls tells it for how long.
//!
//! A lab that is started with `RTNET_STOP_BEFORE_SEND=SIGUSR1` has stations that, once they are sent that signal,
//! stop (SIGSTOP) before their next `send`. Whoever asked for it continues them.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use anyhow::Result;
use nix::sys::signal::{Signal, raise};
use rtnet::live::Port;

/// Set by the signal.
static ASKED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// For how long the next frame is to be held up, nanoseconds.
static STALL: AtomicU64 = AtomicU64::new(0);

/// Has the next frame held up for so long, if the port is armed for that.
pub fn stall_next(nanos: u64) {
    STALL.store(nanos, Ordering::Relaxed);
}

/// Has the port stop its process when the signal has come, if the environment asks for that, and hold its frames up when
/// the lab has said so, if it may.
pub fn arm(port: &mut Port, may_stall: bool) -> Result<()> {
    if may_stall {
        port.hold_before_send(hold);
    }
    if std::env::var("RTNET_STOP_BEFORE_SEND").as_deref() == Ok("SIGUSR1") {
        let asked = ASKED.get_or_init(Arc::default);
        signal_hook::flag::register(signal_hook::consts::SIGUSR1, asked.clone())?;
        port.hold_before_send(hold);
    }
    Ok(())
}

fn hold() {
    let stall = STALL.load(Ordering::Relaxed);
    if stall > 0 {
        STALL.store(0, Ordering::Relaxed);
        std::thread::sleep(Duration::from_nanos(stall));
    }
    if ASKED.get().is_some_and(|asked| asked.swap(false, Ordering::Relaxed)) {
        // Fails only for signals that do not exist.
        let _ = raise(Signal::SIGSTOP);
    }
}
