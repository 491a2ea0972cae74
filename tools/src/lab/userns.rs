//! An ordinary user's way to network namespaces: a user namespace of one's own, in which one is root.
//!
//! What it does not give: SCHED_FIFO, a TUN device, more locked memory. Each is said in a line where it is missed.

use std::fs;

use anyhow::{Context, Result, anyhow};
use nix::errno::Errno;
use nix::sched::{CloneFlags, unshare};
use nix::unistd::{getegid, geteuid};

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
            forbidden().unwrap_or("run it as root")
        ))
    };
    unshare(CloneFlags::CLONE_NEWUSER).map_err(|errno: Errno| refused(anyhow!(errno)))?;
    // Without this the kernel lets nobody write a map of groups.
    write("setgroups", "deny").map_err(refused)?;
    write("uid_map", &format!("0 {user} 1")).map_err(refused)?;
    write("gid_map", &format!("0 {group} 1")).map_err(refused)
}

/// Which setting forbids user namespaces to ordinary users here, and what to set it to.
pub fn forbidden() -> Option<&'static str> {
    let setting = |path: &str| fs::read_to_string(path).ok().and_then(|text| text.trim().parse::<u64>().ok());
    forbidden_by(
        setting("/proc/sys/kernel/unprivileged_userns_clone"),
        setting("/proc/sys/kernel/apparmor_restrict_unprivileged_userns"),
        setting("/proc/sys/user/max_user_namespaces"),
    )
}

/// None of the settings exists everywhere.
fn forbidden_by(clone: Option<u64>, apparmor: Option<u64>, max: Option<u64>) -> Option<&'static str> {
    match (clone, apparmor, max) {
        (Some(0), ..) => Some("kernel.unprivileged_userns_clone is 0: set it to 1"),
        (.., Some(0)) => Some("user.max_user_namespaces is 0: raise it"),
        (_, Some(1..), _) => Some(
            "kernel.apparmor_restrict_unprivileged_userns is 1: set it to 0, or write an AppArmor profile for rtnet",
        ),
        _ => None,
    }
}

fn write(file: &str, text: &str) -> Result<()> {
    let path = format!("/proc/self/{file}");
    fs::write(&path, text).with_context(|| format!("{path} cannot be written"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_forbids_user_namespaces_is_named_with_the_remedy() {
        assert_eq!(forbidden_by(None, None, None), None);
        assert_eq!(forbidden_by(Some(1), Some(0), Some(63_000)), None);
        for (found, name) in [
            (forbidden_by(Some(0), None, Some(63_000)), "kernel.unprivileged_userns_clone"),
            (forbidden_by(None, Some(1), Some(63_000)), "kernel.apparmor_restrict_unprivileged_userns"),
            (forbidden_by(None, None, Some(0)), "user.max_user_namespaces"),
        ] {
            let line = found.unwrap();
            assert!(line.starts_with(name) && line.contains(": "), "{line}");
        }
    }
}
