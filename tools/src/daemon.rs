//! A process that stays is independent of its caller; a station depends on its lab.

use std::fs;
use std::io;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::{Context, Result, bail};
use nix::fcntl::{OFlag, open};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::{SigSet, Signal};
use nix::sys::stat::{Mode, umask};
use nix::unistd::{close, dup2_stderr, dup2_stdout, setsid};
use signal_hook::consts::{SIGCHLD, SIGHUP};

/// The last of the standard descriptors.
const STANDARD_ERROR: i32 = 2;

/// Makes this process independent of its caller, but for its working directory, against which paths may still have to be
/// resolved, and its standard descriptors. To be called before any file is open and any thread started.
pub fn begin() -> Result<()> {
    close_inherited()?;
    setsid().context("this process cannot have a session of its own")?;
    SigSet::empty().thread_set_mask().context("blocked signals cannot be let in")?;
    // A handler that does nothing, in the place of whatever the caller has ignored. Children begin without it.
    [SIGHUP, SIGCHLD].into_iter().try_for_each(disregard)?;
    private_umask();
    Ok(())
}

/// Lets go of the working directory: the file system it is on can be unmounted.
pub fn leave_directory() -> Result<()> {
    std::env::set_current_dir("/").context("the directory / cannot be entered")
}

/// Standard output and error lead nowhere from now on.
pub fn leave_output() -> Result<()> {
    let null = open("/dev/null", OFlag::O_WRONLY, Mode::empty()).context("/dev/null cannot be opened")?;
    dup2_stdout(&null).context("standard output cannot be redirected")?;
    leave_errors()
}

/// The same of standard error.
pub fn leave_errors() -> Result<()> {
    let null = open("/dev/null", OFlag::O_WRONLY, Mode::empty()).context("/dev/null cannot be opened")?;
    dup2_stderr(&null).context("standard error cannot be redirected")
}

/// Files of this process are its owner's to read and write, and others' not to write. What the caller's umask keeps from
/// others stays so.
pub fn private_umask() {
    let of_caller = umask(Mode::S_IWGRP | Mode::S_IWOTH);
    umask((of_caller | Mode::S_IWGRP | Mode::S_IWOTH) & (Mode::S_IRWXG | Mode::S_IRWXO));
}

/// Binds this process, a station's, to its lab: the kernel kills it, even if it is stopped, when the lab's process ends. It
/// has no descriptors but the standard ones. To be called before any file is open and any thread started.
pub fn belong_to_lab() -> Result<()> {
    close_inherited()?;
    SigSet::empty().thread_set_mask().context("blocked signals cannot be let in")?;
    disregard(SIGHUP)?;
    set_pdeathsig(Signal::SIGKILL).context("the station cannot be bound to its lab's process")?;
    // A lab that ended before that has closed our input.
    let input = io::stdin();
    let mut fds = [PollFd::new(input.as_fd(), PollFlags::empty())];
    poll(&mut fds, PollTimeout::ZERO).context("standard input cannot be looked at")?;
    if fds[0].revents().is_some_and(|events| events.contains(PollFlags::POLLHUP)) {
        bail!("the lab has ended before its station began");
    }
    Ok(())
}

/// Closes all descriptors but the standard ones.
fn close_inherited() -> Result<()> {
    let open = fs::read_dir("/proc/self/fd").context("/proc/self/fd cannot be read: mount /proc")?;
    let numbers = open.flatten().filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    let inherited: Vec<i32> = numbers.filter(|&number| number > STANDARD_ERROR).collect();
    // One of them was that of the directory itself, and is closed.
    for number in inherited {
        let _ = close(number);
    }
    Ok(())
}

/// This signal neither ends this process nor is it ignored.
fn disregard(signal: i32) -> Result<()> {
    signal_hook::flag::register(signal, Arc::<AtomicBool>::default())
        .context("a signal cannot be handled")?;
    Ok(())
}
