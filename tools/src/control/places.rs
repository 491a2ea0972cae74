//! Where the sockets of running stations and labs are, and who has which name.
//!
//! ```text
//! /run/rtnet/            or $XDG_RUNTIME_DIR/rtnet, or /tmp/rtnet-UID: who may not write to /run
//!   NAME.lock  NAME.sock          a station of its own
//!   LAB/.lock  LAB/.sock          a lab; no station's name begins with a dot
//!   LAB/STATION.sock              a station of it
//! ```
//!
//! A name belongs to whoever holds the lock on its file; the kernel gives it up with the process. Everything
//! is readable to its owner only.

use std::fs::{self, DirBuilder, File};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, Result, anyhow, bail, ensure};
use nix::fcntl::{Flock, FlockArg};

/// For root.
const SYSTEM: &str = "/run/rtnet";
/// A socket's path must fit `sun_path`, 108 bytes; two of these and the directory do.
const NAME_AT_MOST: usize = 32;
/// A lab's own files in its directory.
const LOCK: &str = ".lock";
const SOCKET: &str = ".sock";

/// `[LAB/]STATION`, as it stands behind `-S`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    /// The lab it belongs to, or none.
    pub lab: Option<String>,
    /// The station.
    pub station: String,
}

impl FromStr for Place {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (lab, station) = match text.split_once('/') {
            Some((lab, station)) => (Some(lab), station),
            None => (None, text),
        };
        lab.into_iter().chain([station]).try_for_each(|name| check_name(name).map_err(|e| e.to_string()))?;
        Ok(Self { lab: lab.map(str::to_owned), station: station.to_owned() })
    }
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match &self.lab {
            Some(lab) => write!(f, "{lab}/{}", self.station),
            None => f.write_str(&self.station),
        }
    }
}

/// Whether something can be called that.
pub fn check_name(name: &str) -> Result<()> {
    let known = |b: u8| b.is_ascii_alphanumeric() || b"-_.".contains(&b);
    if name.is_empty() || name.len() > NAME_AT_MOST || name.starts_with('.') || !name.bytes().all(known) {
        bail!(
            "'{name}' is no name: use letters, digits, '-', '_' and '.', not '.' at its begin, at most \
             {NAME_AT_MOST}"
        );
    }
    Ok(())
}

/// A name that is ours as long as this lives.
#[derive(Debug)]
pub struct Held {
    _lock: Flock<File>,
    remove: Option<PathBuf>,
}

impl Drop for Held {
    fn drop(&mut self) {
        if let Some(directory) = &self.remove {
            // What is left behind is found and taken over by the next of this name.
            let _ = fs::remove_dir_all(directory);
        }
    }
}

/// A lab's place: its name, and where its sockets are.
#[derive(Clone, Debug)]
pub struct Home {
    /// Where all labs of its user are.
    pub directory: Directory,
    /// The lab's name.
    pub lab: String,
}

impl Home {
    /// The socket of one of its stations.
    pub fn station(&self, name: &str) -> PathBuf {
        self.directory.station(&Place { lab: Some(self.lab.clone()), station: name.to_owned() })
    }
    /// Its own.
    pub fn socket(&self) -> PathBuf {
        self.directory.lab(&self.lab)
    }
}

/// Where this user's stations and labs are.
#[derive(Clone, Debug)]
pub struct Directory(PathBuf);

impl Directory {
    /// The directory of this user; it need not exist. To be asked before entering a user namespace.
    pub fn of_user() -> Self {
        let uid = nix::unistd::geteuid();
        if uid.is_root() {
            return Self(SYSTEM.into());
        }
        match std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from) {
            Some(runtime) if runtime.is_absolute() => Self(runtime.join("rtnet")),
            _ => Self(format!("/tmp/rtnet-{uid}").into()),
        }
    }

    /// This directory, and no other.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Whether nobody else can have put sockets there; a directory that does not exist has none.
    pub fn check(&self) -> Result<()> {
        if self.0.exists() { check_private(&self.0) } else { Ok(()) }
    }

    /// The socket of a station.
    pub fn station(&self, place: &Place) -> PathBuf {
        let file = format!("{}.sock", place.station);
        match &place.lab {
            Some(lab) => self.0.join(lab).join(file),
            None => self.0.join(file),
        }
    }

    /// The socket of a lab.
    pub fn lab(&self, lab: &str) -> PathBuf {
        self.0.join(lab).join(SOCKET)
    }

    /// Takes a station's name.
    pub fn take_station(&self, name: &str) -> Result<Held> {
        check_name(name)?;
        self.make()?;
        let lock = lock(&self.0.join(format!("{name}.lock")), name)?;
        Ok(Held { _lock: lock, remove: None })
    }

    /// Takes a lab's name; its directory is new and empty, and goes with what is returned.
    pub fn take_lab(&self, name: &str) -> Result<Held> {
        check_name(name)?;
        self.make()?;
        let own = self.0.join(name);
        make_private(&own)?;
        let lock = lock(&own.join(LOCK), name)?;
        for left in fs::read_dir(&own)?.flatten().filter(|entry| entry.file_name() != LOCK) {
            fs::remove_file(left.path()).with_context(|| {
                format!("{} is left from a dead lab and cannot go", left.path().display())
            })?;
        }
        Ok(Held { _lock: lock, remove: Some(own) })
    }

    /// Whether anything of this lab is here, be it alive or not.
    pub fn has(&self, lab: &str) -> bool {
        self.0.join(lab).exists()
    }

    /// The labs that have a socket here, running or dead.
    pub fn labs(&self) -> Vec<String> {
        let mut labs = names(&self.0, |path| path.join(SOCKET).exists().then(|| file_name(path)));
        labs.sort();
        labs
    }

    /// The stations that have a socket here, as they stand behind `-S`.
    pub fn stations(&self) -> Vec<String> {
        let sockets = |directory: &Path| {
            names(directory, |path| {
                let name = file_name(path);
                name.strip_suffix(".sock").filter(|name| !name.is_empty()).map(str::to_owned)
            })
        };
        let mut all = sockets(&self.0);
        for lab in self.labs() {
            all.extend(sockets(&self.0.join(&lab)).into_iter().map(|station| format!("{lab}/{station}")));
        }
        all.sort();
        all
    }

    fn make(&self) -> Result<()> {
        make_private(&self.0)
    }
}

fn names(directory: &Path, of: impl Fn(&Path) -> Option<String>) -> Vec<String> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    entries.filter_map(|entry| of(&entry.path())).collect()
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A directory that only its owner can enter. One that somebody else has made is not used.
fn make_private(path: &Path) -> Result<()> {
    let made = DirBuilder::new().recursive(true).mode(0o700).create(path);
    made.with_context(|| format!("{} cannot be made", path.display()))?;
    check_private(path)
}

fn check_private(path: &Path) -> Result<()> {
    let found = fs::symlink_metadata(path)?;
    ensure!(
        found.is_dir() && found.uid() == nix::unistd::geteuid().as_raw() && found.mode() & 0o022 == 0,
        "{} belongs to somebody else, or others can write to it: remove it, or set XDG_RUNTIME_DIR",
        path.display()
    );
    Ok(())
}

fn lock(path: &Path, name: &str) -> Result<Flock<File>> {
    loop {
        let lock = lock_once(path, name)?;
        // Its last holder may have removed it between our opening and locking it: then others lock another.
        let inode = lock.metadata()?.ino();
        if fs::metadata(path).is_ok_and(|found| found.ino() == inode) {
            return Ok(lock);
        }
        path.parent().map_or(Ok(()), make_private)?;
    }
}

fn lock_once(path: &Path, name: &str) -> Result<Flock<File>> {
    let file = File::options().read(true).write(true).create(true).truncate(false).open(path);
    let mut file = file.with_context(|| format!("{} cannot be opened", path.display()))?;
    let mut holder = String::new();
    // Only for the message below.
    let _ = file.read_to_string(&mut holder);
    let mut lock = Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|_| {
        let holder = holder.trim();
        anyhow!("the name '{name}' is taken by process {holder}: choose another --name, or stop that one")
    })?;
    lock.set_len(0)?;
    lock.rewind()?;
    writeln!(lock, "{}", std::process::id())?;
    Ok(lock)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_a_station_with_or_without_its_lab() {
        let place: Place = "cell/slave1".parse().unwrap();
        assert_eq!((place.lab.as_deref(), place.station.as_str()), (Some("cell"), "slave1"));
        assert_eq!(place.to_string(), "cell/slave1");
        assert_eq!("slave1".parse::<Place>().unwrap().lab, None);
        for bad in ["", "/", "a/", "/b", "a/b/c", "..", "../x", "a b", ".hidden", &"x".repeat(33)] {
            assert!(bad.parse::<Place>().is_err(), "{bad}");
        }
    }

    #[test]
    fn a_name_is_taken_once_and_free_again_afterwards() {
        let scratch = tempfile::tempdir().unwrap();
        let directory = Directory::at(scratch.path().join("rtnet"));
        let held = directory.take_lab("cell").unwrap();
        let error = directory.take_lab("cell").unwrap_err().to_string();
        assert!(
            error.contains("taken by process") && error.contains(&std::process::id().to_string()),
            "{error}"
        );
        drop(held);
        assert!(!directory.path().join("cell").exists(), "nothing is left");
        directory.take_lab("cell").unwrap();
        let station = directory.take_station("arm").unwrap();
        assert!(directory.take_station("arm").is_err());
        drop(station);
        directory.take_station("arm").unwrap();
    }

    #[test]
    fn a_lock_whose_file_was_removed_meanwhile_is_not_the_name_s() {
        let scratch = tempfile::tempdir().unwrap();
        let path = scratch.path().join("arm.lock");
        let stale = lock_once(&path, "arm").unwrap();
        fs::remove_file(&path).unwrap();
        let held = lock(&path, "arm").unwrap();
        assert_ne!(stale.metadata().unwrap().ino(), held.metadata().unwrap().ino());
        assert!(lock(&path, "arm").is_err(), "and that is held");
    }

    #[test]
    fn what_a_dead_lab_left_is_taken_over() {
        let scratch = tempfile::tempdir().unwrap();
        let directory = Directory::at(scratch.path());
        let own = directory.lab("cell");
        fs::create_dir(own.parent().unwrap()).unwrap();
        fs::write(&own, "").unwrap();
        fs::write(own.with_file_name("slave1.sock"), "").unwrap();
        assert_eq!(directory.labs(), ["cell"]);
        assert_eq!(directory.stations(), ["cell/slave1"]);
        let _held = directory.take_lab("cell").unwrap();
        assert!(directory.labs().is_empty() && directory.stations().is_empty());
    }

    #[test]
    fn a_directory_that_others_can_write_to_is_not_used() {
        use std::os::unix::fs::PermissionsExt;
        let scratch = tempfile::tempdir().unwrap();
        let open = scratch.path().join("open");
        fs::create_dir(&open).unwrap();
        fs::set_permissions(&open, fs::Permissions::from_mode(0o777)).unwrap();
        let directory = Directory::at(&open);
        for error in [directory.take_station("arm").unwrap_err(), directory.check().unwrap_err()] {
            assert!(error.to_string().contains("others can write"), "{error}");
        }
    }
}
