//! Where the control sockets of running stations are.

use std::fs::{self, File};
use std::io::{Error, ErrorKind, Result};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg};
use socket2::{Domain, SockAddr, Socket, Type};

/// For root.
const SYSTEM: &str = "/run/rtnet";
/// The bits of a directory's mode that its owner has.
const WRITABLE_BY_OTHERS: u32 = 0o022;
/// Behind a station's name.
pub const SOCKET: &str = ".sock";
/// A lab's own file in its directory, held as long as it runs; behind a station's name its own.
pub const LOCK: &str = ".lock";

/// The directory of this user's stations: `/run/rtnet` for root, else `$XDG_RUNTIME_DIR/rtnet`, else `/tmp/rtnet-UID`.
/// To be asked before entering a user namespace.
pub fn directory() -> PathBuf {
    let uid = nix::unistd::geteuid();
    if uid.is_root() {
        return SYSTEM.into();
    }
    match std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from) {
        Some(runtime) if runtime.is_absolute() => runtime.join("rtnet"),
        _ => format!("/tmp/rtnet-{uid}").into(),
    }
}

/// The same, if nobody else can have put sockets there. See [`check_private`].
///
/// # Errors
/// It is not this user's alone.
pub fn private_directory() -> Result<PathBuf> {
    let path = directory();
    check_private(&path)?;
    Ok(path)
}

/// Whether a directory is this user's alone, so that nobody else can have put sockets there; one that does not exist has none.
///
/// # Errors
/// It is another user's, others can write to it, or it is no directory: why, and what to do.
pub fn check_private(path: &Path) -> Result<()> {
    let found = match fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        found => found.map_err(|error| Error::new(error.kind(), format!("{}: {error}", path.display())))?,
    };
    let (own, mode) = (nix::unistd::geteuid().as_raw(), found.mode());
    let why = if found.is_symlink() {
        "is a symbolic link, which is not followed: remove it".to_owned()
    } else if !found.is_dir() {
        "is no directory: remove it".to_owned()
    } else if found.uid() != own {
        format!("belongs to user {}, not to user {own}: remove it", found.uid())
    } else if mode & WRITABLE_BY_OTHERS != 0 {
        format!(
            "can be written by others, mode {:04o}: `chmod 700` it once only your own sockets are in it",
            mode & 0o7777
        )
    } else {
        return Ok(());
    };
    let why = format!("{} {why}, or set XDG_RUNTIME_DIR to a directory of your own", path.display());
    Err(Error::new(ErrorKind::PermissionDenied, why))
}

/// The control socket of the station that is called `[LAB/]STATION`: without its lab one of its own, or else one of the only
/// lab.
pub fn socket_of(name: &str) -> Result<PathBuf> {
    find(&private_directory()?, name)
}

/// Whether somebody holds this lock. For a moment it is ours, shared with others who look.
pub fn is_held(path: &Path) -> bool {
    let Ok(file) = File::open(path) else { return false };
    matches!(Flock::lock(file, FlockArg::LockSharedNonblock), Err((_, Errno::EWOULDBLOCK)))
}

/// Whether somebody listens at this socket: its file outlives a process that was killed.
pub fn is_served(path: &Path) -> bool {
    let connected = Socket::new(Domain::UNIX, Type::SEQPACKET, None).and_then(|socket| {
        socket.set_nonblocking(true)?;
        socket.connect(&SockAddr::unix(path)?)
    });
    // There may be too many who wait to be let in.
    connected.map_or_else(|error| error.kind() == ErrorKind::WouldBlock, |()| true)
}

fn find(home: &Path, name: &str) -> Result<PathBuf> {
    let (lab, station) = match name.split_once('/') {
        Some((lab, station)) => (Some(lab), station),
        None => (None, name),
    };
    let is_name = |part: &str| !part.is_empty() && !part.starts_with('.') && !part.contains(['/', '\0']);
    if !lab.into_iter().chain([station]).all(is_name) {
        let why = format!("'{name}' is no station: write STATION, or LAB/STATION");
        return Err(Error::new(ErrorKind::InvalidInput, why));
    }
    let file = format!("{station}{SOCKET}");
    let own = lab.map_or(home.to_owned(), |lab| home.join(lab)).join(&file);
    if lab.is_some() || is_served(&own) {
        return Ok(own);
    }
    match labs(home).as_slice() {
        [] => Ok(own),
        [only] => Ok(only.join(file)),
        labs => {
            let there = labs.iter().filter(|lab| is_served(&lab.join(&file)));
            let there: Vec<String> = there
                .map(|lab| format!("{}/{station}", lab.file_name().unwrap_or_default().to_string_lossy()))
                .collect();
            if there.is_empty() {
                return Ok(own);
            }
            let why = format!("which station '{station}' is meant: {}?", there.join(" or "));
            Err(Error::new(ErrorKind::InvalidInput, why))
        }
    }
}

/// The directories of the labs that run.
fn labs(home: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(home).into_iter().flatten().flatten();
    let mut labs: Vec<PathBuf> =
        entries.map(|entry| entry.path()).filter(|path| is_held(&path.join(LOCK))).collect();
    labs.sort();
    labs
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_name_leads_nowhere_but_to_a_socket_of_this_user() {
        let home = tempfile::tempdir().unwrap();
        let home = home.path();
        assert_eq!(find(home, "arm").unwrap(), home.join("arm.sock"));
        assert_eq!(find(home, "cell/arm").unwrap(), home.join("cell").join("arm.sock"));
        for bad in ["", "/", "cell/", "/arm", "../arm", "cell/../arm", "a/b/c", ".", "cell/.lock"] {
            let error = find(home, bad).unwrap_err();
            assert!(error.to_string().contains(&format!("'{bad}'")), "{error}");
        }
    }

    #[test]
    fn directory_of_others_is_refused_with_the_reason() {
        let home = tempfile::tempdir().unwrap();
        let (own, link) = (home.path().join("own"), home.path().join("link"));
        check_private(&own).unwrap();
        std::os::unix::fs::symlink(&own, &link).unwrap();
        let refused = |path: &Path| {
            let error = check_private(path).unwrap_err();
            assert_eq!(error.kind(), ErrorKind::PermissionDenied);
            error.to_string()
        };
        assert!(refused(&link).contains("symbolic link"), "it leads nowhere");
        fs::create_dir(&own).unwrap();
        assert!(refused(&link).contains("symbolic link"), "it leads to a directory of this user");
        for (mode, is_private) in
            [(0o700, true), (0o755, true), (0o770, false), (0o702, false), (0o1777, false)]
        {
            fs::set_permissions(&own, fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(check_private(&own).is_ok(), is_private, "{mode:o}");
        }
        assert!(refused(&own).contains("mode 1777"));
        let file = home.path().join("file");
        File::create(&file).unwrap();
        assert!(refused(&file).contains("is no directory"));
    }

    #[test]
    fn a_station_without_its_lab_is_one_of_its_own_or_one_of_the_only_lab() {
        let home = tempfile::tempdir().unwrap();
        let home = home.path();
        let lab = |name: &str| {
            fs::create_dir(home.join(name)).unwrap();
            let file = File::create(home.join(name).join(LOCK)).unwrap();
            Flock::lock(file, FlockArg::LockExclusiveNonblock).unwrap()
        };
        let serve = |path: &Path| {
            let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
            socket.bind(&SockAddr::unix(path).unwrap()).unwrap();
            socket.listen(1).unwrap();
            socket
        };
        // Of a lab that was killed its directory is left.
        drop(lab("dead"));
        assert_eq!(find(home, "arm").unwrap(), home.join("arm.sock"));
        let _cell = lab("cell");
        assert_eq!(find(home, "arm").unwrap(), home.join("cell/arm.sock"));
        let _other = lab("other");
        assert_eq!(find(home, "arm").unwrap(), home.join("arm.sock"), "none of them has it");
        let _arm = serve(&home.join("cell/arm.sock"));
        let _leg = serve(&home.join("other/arm.sock"));
        let error = find(home, "arm").unwrap_err().to_string();
        assert_eq!(error, "which station 'arm' is meant: cell/arm or other/arm?");
        let _own = serve(&home.join("arm.sock"));
        assert_eq!(find(home, "arm").unwrap(), home.join("arm.sock"));
    }
}
