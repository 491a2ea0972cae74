//! The remedy for an answer of the kernel that means the same wherever files, sockets, threads and processes are made.

use std::io;

use nix::errno::Errno;
use nix::sys::resource::{Resource, getrlimit, rlim_t, setrlimit};

/// A socket's path must fit `sun_path`, with its end.
pub const SOCKET_PATH_AT_MOST: usize = 107;

/// An error, and behind it what to do.
#[derive(Debug, thiserror::Error)]
#[error("{error}{}", remedy_of(error).map_or(String::new(), |remedy| format!(": {remedy}")))]
pub struct Explained {
    error: io::Error,
}

/// The same error, with what to do where that is known.
pub fn explained(error: impl Into<io::Error>) -> Explained {
    Explained { error: error.into() }
}

fn remedy_of(error: &io::Error) -> Option<String> {
    let text = match error.raw_os_error().map(Errno::from_raw)? {
        Errno::ENOSPC => "its file system is full: free room there (`df`; `df -i` for too many files)",
        Errno::EDQUOT => "this user's share of its file system is used up: remove files there (`quota`)",
        Errno::EROFS => "its file system is read-only: choose another place, or `mount -o remount,rw`",
        Errno::EACCES => "this user may not: choose another place, or change its rights (`ls -ld`)",
        Errno::ENAMETOOLONG => "choose a shorter one",
        Errno::ENFILE => "this host has no more descriptors: raise the sysctl fs.file-max",
        Errno::EAGAIN => {
            "no more threads or processes: raise `ulimit -u`, or pids.max of its cgroup (TasksMax= of a service)"
        }
        Errno::EMFILE => return Some(files_remedy()),
        _ => return None,
    };
    Some(text.into())
}

/// How many descriptors this process may have is a limit of its own.
fn files_remedy() -> String {
    let limit = getrlimit(Resource::RLIMIT_NOFILE).map_or("not known".into(), |(_, hard)| hard.to_string());
    format!(
        "the limit of descriptors (RLIMIT_NOFILE) is {limit}: raise it, `ulimit -n`, or LimitNOFILE= of a service"
    )
}

/// Raises the soft limit of descriptors to the hard one; what it was before. Where the kernel does not let us it stays.
pub fn raise_files() -> Option<rlim_t> {
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).ok()?;
    setrlimit(Resource::RLIMIT_NOFILE, hard, hard).ok()?;
    Some(soft)
}

/// Sets the soft limit of descriptors to what it was: programs that use select(2) break above 1024.
pub fn restore_files(soft: rlim_t) -> nix::Result<()> {
    let (_, hard) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, soft.min(hard), hard)
}

/// Whether there are descriptors for a lab of so many stations, each of which takes `each`, and all together `beside`.
pub fn check_files(stations: usize, each: usize, beside: usize) -> Result<(), String> {
    let Ok((_, hard)) = getrlimit(Resource::RLIMIT_NOFILE) else { return Ok(()) };
    enough_files(stations, each, beside, hard)
}

fn enough_files(stations: usize, each: usize, beside: usize, hard: rlim_t) -> Result<(), String> {
    let needed = (stations * each + beside) as rlim_t;
    if needed <= hard {
        return Ok(());
    }
    let holds = (hard as usize).saturating_sub(beside) / each;
    Err(format!(
        "{stations} stations take {each} descriptors each and {beside} besides, {needed} in all, and the limit (RLIMIT_NOFILE) is \
         {hard}, which holds {holds} stations: raise it, `ulimit -n {needed}`, or LimitNOFILE={needed} of a service"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_the_kernel_say_what_to_do() {
        let line = |errno: Errno| explained(errno).to_string();
        assert!(
            line(Errno::ENOSPC)
                .starts_with("No space left on device (os error 28): its file system is full: free")
        );
        for errno in
            [Errno::EDQUOT, Errno::EROFS, Errno::EACCES, Errno::ENAMETOOLONG, Errno::EMFILE, Errno::EAGAIN]
        {
            assert!(line(errno).matches(": ").count() >= 1, "{}", line(errno));
        }
        assert_eq!(line(Errno::EIO), "Input/output error (os error 5)");
    }

    #[test]
    fn limit_of_descriptors_names_what_it_holds() {
        assert_eq!(enough_files(10, 4, 64, 104), Ok(()));
        let why = enough_files(11, 4, 64, 104).unwrap_err();
        assert!(
            why.contains("108 in all, and the limit (RLIMIT_NOFILE) is 104, which holds 10 stations"),
            "{why}"
        );
        assert!(why.contains("`ulimit -n 108`") && why.contains("LimitNOFILE=108"), "{why}");
        assert!(enough_files(2, 4, 64, 16).unwrap_err().contains("which holds 0 stations"));
    }
}
