//! Into the namespaces of a lab, from another process of the same user.

use std::fs::{self, File};
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use anyhow::{Context, Result};
use nix::mount::{MsFlags, mount};
use nix::sched::{CloneFlags, setns, unshare};

use super::guests::source;

const SYS: &str = "/sys";

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

/// Gives this process, which has entered a network namespace, a `/sys` with the interfaces of that one, and a mark of its
/// lab. It has a mount namespace of its own then; what is mounted under `/sys` stays there.
pub fn own_sys(mark: &str) -> Result<()> {
    unshare(CloneFlags::CLONE_NEWNS).context("no mount namespace")?;
    // A file system that is unmounted outside is unmounted here.
    let propagation = MsFlags::MS_REC | MsFlags::MS_SLAVE;
    mount(None::<&str>, "/", None::<&str>, propagation, None::<&str>)
        .context("mounts cannot be kept apart")?;
    let below = below_sys(&fs::read_to_string("/proc/self/mountinfo").context("/proc/self/mountinfo")?);
    let opened = |point: &String| {
        let file = File::options().read(true).custom_flags(nix::libc::O_PATH).open(point).ok()?;
        Some((point.clone(), file))
    };
    let below: Vec<(String, File)> = below.iter().filter_map(opened).collect();
    let flags = MsFlags::MS_NOSUID | MsFlags::MS_NODEV | MsFlags::MS_NOEXEC;
    mount(Some(source(mark).as_str()), SYS, Some("sysfs"), flags, None::<&str>).context("mount of sysfs")?;
    for (point, file) in below {
        let from = format!("/proc/self/fd/{}", file.as_raw_fd());
        // One that is missing there is missed by few programs, and the interfaces by none.
        let bound = MsFlags::MS_BIND | MsFlags::MS_REC;
        let _ = mount(Some(from.as_str()), point.as_str(), None::<&str>, bound, None::<&str>);
    }
    Ok(())
}

/// Where something is mounted right under `/sys`, and not under another mount there.
fn below_sys(mountinfo: &str) -> Vec<String> {
    let points = mountinfo.lines().filter_map(|line| line.split(' ').nth(4));
    let mut found: Vec<String> =
        points.filter(|point| point.starts_with("/sys/")).map(str::to_owned).collect();
    found.sort();
    found.dedup();
    let is_below = |point: &str, other: &String| {
        point.strip_prefix(other.as_str()).is_some_and(|rest| rest.starts_with('/'))
    };
    let all = found.clone();
    found.retain(|point| !all.iter().any(|other| is_below(point, other)));
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mounts_below_sys_are_found_without_those_below_them() {
        let line = |point: &str| format!("24 23 0:22 / {point} rw,relatime shared:2 - sysfs sysfs rw\n");
        let points = [
            "/",
            "/sys",
            "/sys/fs/cgroup/unified",
            "/sys/fs/cgroup",
            "/sys/fs/cgroup2",
            "/system",
            "/sys/fs/bpf",
        ];
        let found = below_sys(&points.map(line).concat());
        assert_eq!(found, ["/sys/fs/bpf", "/sys/fs/cgroup", "/sys/fs/cgroup2"]);
    }
}
