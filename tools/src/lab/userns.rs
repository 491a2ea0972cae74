//! An ordinary user's way to network namespaces: a user namespace of one's own, in which one is root.
//!
//! What it does not give: SCHED_FIFO, a TUN device, more locked memory. Each is said in a line where it is missed.

use std::fs;

use anyhow::{Context, Result, anyhow};
use nix::errno::Errno;
use nix::sched::{CloneFlags, unshare};
use nix::unistd::{getegid, geteuid};

/// Switches that forbid user namespaces, the value with which they do, and how to turn them.
const FORBIDDEN: [(&str, &str, &str); 3] = [
    (
        "/proc/sys/kernel/apparmor_restrict_unprivileged_userns",
        "1",
        "this distribution forbids it by AppArmor: sysctl kernel.apparmor_restrict_unprivileged_userns=0 allows it",
    ),
    (
        "/proc/sys/kernel/unprivileged_userns_clone",
        "0",
        "this distribution forbids it: sysctl kernel.unprivileged_userns_clone=1 allows it",
    ),
    (
        "/proc/sys/user/max_user_namespaces",
        "0",
        "this host forbids it: sysctl user.max_user_namespaces=1000 allows it",
    ),
];

/// Sees to it that this process may make network namespaces: root may, others become root of a user namespace.
/// To be called before there is a second thread.
pub fn gain_namespaces() -> Result<()> {
    let (user, group) = (geteuid(), getegid());
    if user.is_root() {
        return Ok(());
    }
    let refused = |error: anyhow::Error| {
        error.context(format!(
            "a lab makes network namespaces, which takes root or a user namespace of one's own; {}",
            remedy()
        ))
    };
    unshare(CloneFlags::CLONE_NEWUSER).map_err(|errno: Errno| refused(anyhow!(errno)))?;
    // Without this the kernel lets nobody write a map of groups.
    write("setgroups", "deny").map_err(refused)?;
    write("uid_map", &format!("0 {user} 1")).map_err(refused)?;
    write("gid_map", &format!("0 {group} 1")).map_err(refused)
}

/// Who or what stands in the way, and what to do.
pub fn remedy() -> &'static str {
    let forbids = |&&(file, value, _): &&(&str, &str, &str)| {
        fs::read_to_string(file).is_ok_and(|found| found.trim() == value)
    };
    FORBIDDEN.iter().find(forbids).map_or("run it as root", |(.., remedy)| remedy)
}

fn write(file: &str, text: &str) -> Result<()> {
    let path = format!("/proc/self/{file}");
    fs::write(&path, text).with_context(|| format!("{path} cannot be written"))
}
