//! Into the namespaces of a lab, from another process of the same user.

use std::fs::File;
use std::path::Path;

use anyhow::{Context, Result};
use nix::sched::{CloneFlags, setns};

/// Moves the calling thread into a network namespace of a lab. An ordinary user goes through the user namespace
/// of the process `pid`, in which one is root: that takes a process of one thread.
pub fn enter(pid: u32, net: &Path) -> Result<()> {
    let open = |path: &Path| {
        File::open(path).with_context(|| format!("{} cannot be opened: has it ended?", path.display()))
    };
    let (user, net) = (open(Path::new(&format!("/proc/{pid}/ns/user")))?, open(net)?);
    if !nix::unistd::geteuid().is_root() {
        setns(&user, CloneFlags::CLONE_NEWUSER).context("its user namespace cannot be entered")?;
    }
    setns(&net, CloneFlags::CLONE_NEWNET).context("its network namespace cannot be entered")
}
