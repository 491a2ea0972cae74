//! For tests: a station that stops itself where it cannot notice it, between its last look at the clock and `send`.
//!
//! A lab that is started with `RTNET_STOP_BEFORE_SEND=SIGUSR1` has stations that, once they are sent that signal,
//! stop (SIGSTOP) before their next `send`. Whoever asked for it continues them.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use anyhow::Result;
use nix::sys::signal::{Signal, raise};
use rtnet::live::Port;

/// Set by the signal.
static ASKED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Has the port stop its process when the signal has come, if the environment asks for that.
pub fn arm(port: &mut Port) -> Result<()> {
    if std::env::var("RTNET_STOP_BEFORE_SEND").as_deref() == Ok("SIGUSR1") {
        let asked = ASKED.get_or_init(Arc::default);
        signal_hook::flag::register(signal_hook::consts::SIGUSR1, asked.clone())?;
        port.hold_before_send(stop);
    }
    Ok(())
}

fn stop() {
    if ASKED.get().is_some_and(|asked| asked.swap(false, Ordering::Relaxed)) {
        // Fails only for signals that do not exist.
        let _ = raise(Signal::SIGSTOP);
    }
}
