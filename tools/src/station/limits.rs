//! What a station may take of its host: raised as far as that goes, before it gives up its rights.

use std::fs;
use std::io;

use nix::errno::Errno;
use nix::sys::resource::{Resource, getrlimit, rlim_t, setrlimit};
use rtnet::api::segment;

/// Locked beside what is counted: stacks that grow, sockets that are closed while others are opened.
const LOCKED_BESIDE: u64 = 4 << 20;

/// Descriptors, of which each socket of a program's takes some: as many as the host gives.
pub fn raise_files() {
    if let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_NOFILE)
        && soft < hard
    {
        // With fewer it can have fewer sockets, and says so to whom it refuses one.
        let _ = setrlimit(Resource::RLIMIT_NOFILE, hard, hard);
    }
}

/// Locked memory for so many sockets of programs, beside all that is locked now: once it has given up its rights, it is
/// bound by this limit, and was not before.
pub fn raise_locked(sockets: usize) {
    let wanted =
        locked_now() + sockets as u64 * segment::bytes().next_multiple_of(4096) as u64 + LOCKED_BESIDE;
    if let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_MEMLOCK)
        && let Some(limits) = raised((soft, hard), wanted)
        && setrlimit(Resource::RLIMIT_MEMLOCK, limits.0, limits.1).is_err()
    {
        // The hard limit is root's. What is still missing is told once a socket finds it so.
        let _ = setrlimit(Resource::RLIMIT_MEMLOCK, wanted.min(hard), hard);
    }
}

/// Limits, soft and hard, with which there is as much; `None`: there is.
fn raised((soft, hard): (rlim_t, rlim_t), wanted: u64) -> Option<(rlim_t, rlim_t)> {
    (soft < wanted).then(|| (wanted, hard.max(wanted)))
}

/// Bytes that this process has locked.
fn locked_now() -> u64 {
    locked_in(&fs::read_to_string("/proc/self/status").unwrap_or_default())
}

fn locked_in(status: &str) -> u64 {
    let line = status.lines().find_map(|line| line.strip_prefix("VmLck:"));
    let kilobytes = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    kilobytes.unwrap_or(0) * 1024
}

/// What is told once sockets have memory in which programs can make holes: why, what it costs, the remedy.
pub fn holey_memory(why: &io::Error) -> String {
    let remedy = match why.raw_os_error().map(Errno::from_raw) {
        Some(Errno::EAGAIN | Errno::ENOMEM | Errno::EPERM) => {
            "raise RLIMIT_MEMLOCK, `ulimit -l`, which takes CAP_SYS_RESOURCE, or let it have fewer sockets"
        }
        Some(Errno::ENOSYS) => "boot a kernel that has it, with secretmem.enable=1",
        _ => "see that it may have more descriptors and memory",
    };
    format!(
        "memfd_secret: {why}: sockets share memory in which a hostile program can make holes, and so hold the station up \
         for milliseconds ({remedy})"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_locked_is_read_from_where_the_kernel_tells_it() {
        assert_eq!(locked_in("VmPeak:\t  9 kB\nVmLck:\t    8200 kB\nVmPin:\t 0 kB\n"), 8_200 * 1024);
        assert_eq!(locked_in("VmPeak:\t  9 kB\n"), 0);
        assert_eq!(locked_now() % 4096, 0);
    }

    #[test]
    fn a_limit_is_only_ever_raised() {
        assert_eq!(raised((8, 8), 20), Some((20, 20)));
        assert_eq!(raised((8, 64), 20), Some((20, 64)));
        assert_eq!(raised((20, 64), 20), None);
        assert_eq!(raised((nix::libc::RLIM_INFINITY, nix::libc::RLIM_INFINITY), 20), None);
    }

    #[test]
    fn what_is_told_of_memory_with_holes_has_a_reason_and_a_remedy() {
        for (errno, remedy) in
            [(Errno::EAGAIN, "raise RLIMIT_MEMLOCK"), (Errno::ENOSYS, "secretmem.enable=1")]
        {
            let told = holey_memory(&errno.into());
            assert!(
                told.starts_with("memfd_secret: ") && told.contains(remedy) && !told.contains('\n'),
                "{told}"
            );
        }
    }
}
