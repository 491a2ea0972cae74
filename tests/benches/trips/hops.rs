//! What it costs to wake another process by an eventfd, and to be woken.

use std::os::fd::{AsFd, OwnedFd};
use std::process::{Command, Stdio};
use std::time::Duration;

use anyhow::{Context, Result};
use nix::sys::eventfd::{EfdFlags, EventFd};
use rtnet::live::clock::monotonic;
use rtnet::live::realtime::RealTime;
use serde_json::Value;

use crate::figures::Times;
use crate::{Cores, PROGRAM_PRIORITY, STATION_PRIORITY, WARM_UP};

const ONE: [u8; 8] = 1u64.to_ne_bytes();

/// Four hops: there and back twice, from where a program is to where its station is, at their priorities.
pub fn measure(cores: Cores, time: Duration) -> Result<Value> {
    let [there, back] =
        [EventFd::from_flags(EfdFlags::EFD_CLOEXEC)?, EventFd::from_flags(EfdFlags::EFD_CLOEXEC)?];
    let given = |eventfd: &EventFd| -> Result<OwnedFd> { Ok(eventfd.as_fd().try_clone_to_owned()?) };
    let mut other = Command::new(std::env::current_exe()?)
        .args(["hops", &cores[1].to_string()])
        .stdin(Stdio::from(given(&there)?))
        .stdout(Stdio::from(given(&back)?))
        .spawn()
        .context("the other process")?;
    let asks = std::thread::spawn(move || -> Result<Value> {
        let realtime = RealTime { priority: Some(PROGRAM_PRIORITY), cpu: Some(cores[0]) };
        realtime.apply().into_iter().for_each(|refused| eprintln!("{refused}"));
        let mut times = Times::new();
        for (is_counted, time) in [(false, WARM_UP), (true, time)] {
            let until = monotonic() + time.as_nanos() as u64;
            loop {
                let begun = monotonic();
                if begun > until {
                    break;
                }
                for _ in 0..2 {
                    there.write(1)?;
                    back.read()?;
                }
                if is_counted {
                    times.note(monotonic() - begun);
                }
            }
        }
        Ok(times.figures())
    });
    let figures = asks.join().map_err(|_| anyhow::anyhow!("it panicked"));
    let _ = other.kill();
    let _ = other.wait();
    figures?
}

/// In a process of its own: hands on what comes, until it is killed.
pub fn answer(core: usize) -> Result<()> {
    let realtime = RealTime { priority: Some(STATION_PRIORITY), cpu: Some(core) };
    realtime.apply().into_iter().for_each(|refused| eprintln!("{refused}"));
    let (input, output) = (std::io::stdin(), std::io::stdout());
    loop {
        nix::unistd::read(input.as_fd(), &mut [0; ONE.len()])?;
        nix::unistd::write(output.as_fd(), &ONE)?;
    }
}
