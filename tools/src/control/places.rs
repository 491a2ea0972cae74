//! Where the sockets of running stations and labs are, and who has which name.
//!
//! ```text
//! /run/rtnet/            or $XDG_RUNTIME_DIR/rtnet, or /tmp/rtnet-UID: who may not write to /run
//!   NAME.lock  NAME.sock          a station of its own
//!   LAB/.lock  LAB/.sock          a lab; no station's name begins with a dot
//!   LAB/.namespaces               by what its namespaces are known, see `lab::guests`
//!   LAB/STATION.sock              a station of it
//!   .router-NAME  .router-NAME.lock   a router of packages
//!   .load-PID                     what a lab takes of a core, see `loads.rs`
//!   .aside-NAMESPACE-INTERFACE    what a proxy has changed of Linux's there, see `vnic::tun`
//! ```
//!
//! A name belongs to whoever holds the lock on its file; the kernel gives it up with the process. Everything
//! is readable to its owner only.

use std::fs::{self, DirBuilder, File};
use std::io::{Read, Seek, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::{Duration, Instant};

use crate::remedy::explained;
use anyhow::{Context, Result, anyhow, bail};
use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg};
pub(super) use rtnet::api::place::is_held;
use rtnet::api::place::{self, LOCK, SOCKET, is_served};

/// Rights of a directory that is its owner's only.
const OWNERS: u32 = 0o700;
/// A socket's path must fit `sun_path`, 108 bytes; two of these and the directory do.
const NAME_AT_MOST: usize = 32;
/// In a lab's directory: by what its namespaces are known.
const NOTE: &str = ".namespaces";
/// The begin of the file names of a router of packages: no station's name begins with a dot.
const ROUTER: &str = ".router-";
/// How long a lock is waited for. Its holder may only look at it, or die: the kernel takes 50 to 100 ms to close what a lab had open, on a
/// busy host longer.
const LOCKED_WITHIN: Duration = Duration::from_secs(1);

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

/// Whether a station or a lab can be called that: the same in files, in labs and on command lines. A name becomes a file's,
/// and stands behind options.
pub fn check_name(name: &str) -> Result<()> {
    let known = |b: u8| b.is_ascii_alphanumeric() || b"-_.".contains(&b);
    let is_file = [LOCK, SOCKET].iter().any(|end| name.ends_with(end)) || name.starts_with('.');
    let is_option = name.starts_with('-');
    if name.is_empty() || name.len() > NAME_AT_MOST || is_file || is_option || !name.bytes().all(known) {
        let shown: String = name.chars().map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect();
        bail!(
            "'{shown}' is no name: use letters A to Z, digits, '-', '_' and '.', not '-' or '.' at its begin nor '{LOCK}' or \
             '{SOCKET}' at its end, at most {NAME_AT_MOST} in all",
        );
    }
    Ok(())
}

/// A name on the command line.
pub fn parse_name(text: &str) -> Result<String, String> {
    check_name(text).map(|()| text.to_owned()).map_err(|error| error.to_string())
}

/// A name that is ours as long as this lives.
#[derive(Debug)]
pub struct Held {
    lock: Flock<File>,
    path: PathBuf,
    /// A lab's, with all that is in it.
    directory: Option<PathBuf>,
    /// The note of a dead lab of this name.
    pub left: Option<String>,
}

impl Held {
    /// Notes something of a lab, that is read as [`Held::left`] if the lab dies.
    pub fn note(&self, text: &str) -> Result<()> {
        let Some(directory) = &self.directory else { return Ok(()) };
        let path = directory.join(NOTE);
        fs::write(&path, text).with_context(|| format!("{} cannot be written", path.display()))
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        // Somebody may have removed it, and the next of this name have made it anew. What is left behind is found and taken
        // over by that one.
        if is_at(&self.lock, &self.path) {
            let _ = match &self.directory {
                Some(directory) => fs::remove_dir_all(directory),
                None => fs::remove_file(&self.path),
            };
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
    /// The directory of this user, in which nobody else can have put sockets; it need not exist. To be asked before entering a
    /// user namespace.
    pub fn of_user() -> Result<Self> {
        Ok(Self(place::private_directory()?))
    }

    /// This directory, and no other.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// The socket of a station.
    pub fn station(&self, place: &Place) -> PathBuf {
        let file = format!("{}{SOCKET}", place.station);
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
        let path = self.0.join(format!("{name}{LOCK}"));
        Ok(Held { lock: lock(&path, name)?, path, directory: None, left: None })
    }

    /// The socket of a router of packages.
    pub fn router(&self, name: &str) -> PathBuf {
        self.0.join(format!("{ROUTER}{name}"))
    }

    /// Takes a router's name.
    pub fn take_router(&self, name: &str) -> Result<Held> {
        check_name(name)?;
        self.make()?;
        let path = self.0.join(format!("{ROUTER}{name}{LOCK}"));
        Ok(Held { lock: lock(&path, name)?, path, directory: None, left: None })
    }

    /// Takes a lab's name; its directory is new and empty, and goes with what is returned.
    pub fn take_lab(&self, name: &str) -> Result<Held> {
        check_name(name)?;
        self.make()?;
        let own = self.0.join(name);
        make_private(&own)?;
        let path = own.join(LOCK);
        let lock = lock(&path, name)?;
        let noted = fs::read_to_string(own.join(NOTE)).ok();
        let all = fs::read_dir(&own).map_err(explained);
        let all = all.with_context(|| format!("{} cannot be read", own.display()))?;
        for left in all.flatten().filter(|entry| entry.file_name() != LOCK) {
            fs::remove_file(left.path()).map_err(explained).with_context(|| {
                format!("{} is left from a dead lab and cannot go", left.path().display())
            })?;
        }
        Ok(Held { lock, path, directory: Some(own), left: noted })
    }

    /// Whether anything of this lab is here, be it alive or not.
    pub fn has(&self, lab: &str) -> bool {
        self.0.join(lab).exists()
    }

    /// The note of a lab, alive or not.
    pub fn noted(&self, lab: &str) -> Option<String> {
        fs::read_to_string(self.0.join(lab).join(NOTE)).ok()
    }

    /// The labs that run, or are coming up: those whose name is held.
    pub fn labs(&self) -> Vec<String> {
        names(&self.0, |path| is_held(&path.join(LOCK)).then(|| file_name(path)))
    }

    /// The same, and those that are dead and have left something.
    pub fn labs_dead_or_alive(&self) -> Vec<String> {
        names(&self.0, |path| path.join(LOCK).exists().then(|| file_name(path)))
    }

    /// The process that has a lab's name, whether the lab can be asked or is still coming up.
    pub fn keeper(&self, lab: &str) -> Option<String> {
        let path = self.0.join(lab).join(LOCK);
        is_held(&path).then(|| fs::read_to_string(path).unwrap_or_default().trim().to_owned())
    }

    /// The station that is meant: without its lab one of its own, or else one of the only lab.
    pub fn find(&self, place: &Place) -> Result<Place> {
        let station = &place.station;
        if place.lab.is_some() || is_served(&self.station(place)) {
            return Ok(place.clone());
        }
        let in_lab = |lab: &String| Place { lab: Some(lab.clone()), station: station.clone() };
        match self.labs().as_slice() {
            [] => Ok(place.clone()),
            [only] => Ok(in_lab(only)),
            labs => {
                let there = labs.iter().map(in_lab).filter(|place| is_served(&self.station(place)));
                match there.map(|place| place.to_string()).collect::<Vec<_>>().as_slice() {
                    [] => Ok(place.clone()),
                    some => bail!("which station '{station}' is meant: {}?", some.join(" or ")),
                }
            }
        }
    }

    /// The only lab that runs, if it is only one.
    pub fn only_lab(&self) -> Option<String> {
        let mut labs = self.labs();
        labs.pop().filter(|_| labs.is_empty())
    }

    /// The stations that run, as they stand behind `-S`.
    pub fn stations(&self) -> Vec<String> {
        let sockets = |directory: &Path| {
            names(directory, |path| {
                let name = file_name(path);
                let name = name.strip_suffix(SOCKET).filter(|name| !name.is_empty())?;
                is_served(path).then(|| name.to_owned())
            })
        };
        let mut all = sockets(&self.0);
        for lab in self.labs() {
            all.extend(sockets(&self.0.join(&lab)).into_iter().map(|station| format!("{lab}/{station}")));
        }
        all.sort();
        all
    }

    pub(super) fn make(&self) -> Result<()> {
        make_private(&self.0)
    }
}

pub(super) fn names(directory: &Path, of: impl Fn(&Path) -> Option<String>) -> Vec<String> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries.filter_map(|entry| of(&entry.path())).collect();
    names.sort();
    names
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// A directory that only its owner can enter. One that somebody else has made is not used.
fn make_private(path: &Path) -> Result<()> {
    let made = DirBuilder::new().recursive(true).mode(OWNERS).create(path);
    made.map_err(explained).with_context(|| format!("{} cannot be made", path.display()))?;
    place::check_private(path)?;
    // A umask may have kept it even from its owner.
    if fs::metadata(path)?.mode() & OWNERS != OWNERS {
        let private = fs::Permissions::from_mode(OWNERS);
        fs::set_permissions(path, private).with_context(|| format!("{} is closed", path.display()))?;
    }
    Ok(())
}

fn lock(path: &Path, name: &str) -> Result<Flock<File>> {
    loop {
        let lock = lock_once(path, name)?;
        // Its last holder may have removed it between our opening and locking it: then others lock another.
        if is_at(&lock, path) {
            return Ok(lock);
        }
        path.parent().map_or(Ok(()), make_private)?;
    }
}

/// Whether this file is the one that is found by that path.
fn is_at(file: &File, path: &Path) -> bool {
    let inodes = (file.metadata().map(|of| of.ino()), fs::metadata(path).map(|of| of.ino()));
    matches!(inodes, (Ok(own), Ok(found)) if own == found)
}

fn lock_once(path: &Path, name: &str) -> Result<Flock<File>> {
    let file = File::options().read(true).write(true).create(true).truncate(false).open(path);
    let mut file = file.map_err(explained).with_context(|| format!("{} cannot be opened", path.display()))?;
    let mut holder = String::new();
    // Only for the message below.
    let _ = file.read_to_string(&mut holder);
    let mut lock = lock_within(file, LOCKED_WITHIN).map_err(|_| {
        let holder = holder.trim();
        anyhow!("the name '{name}' is taken by process {holder}: choose another --name, or stop that one")
    })?;
    rewrite(&mut lock, path, &std::process::id().to_string())?;
    Ok(lock)
}

/// This line is all that a file of this path holds from now on.
pub(super) fn rewrite(file: &mut File, path: &Path, line: &str) -> Result<()> {
    let mut write = || {
        file.set_len(0)?;
        file.rewind()?;
        writeln!(file, "{line}")
    };
    write().map_err(explained).with_context(|| format!("{} cannot be written", path.display()))
}

/// Who looks whether a lock is held holds it for a moment.
fn lock_within(mut file: File, within: Duration) -> Result<Flock<File>, Errno> {
    let deadline = Instant::now() + within;
    loop {
        match Flock::lock(file, FlockArg::LockExclusiveNonblock) {
            Err((same, Errno::EWOULDBLOCK)) if Instant::now() < deadline => file = same,
            locked => return locked.map_err(|(_, error)| error),
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[cfg(test)]
mod tests;
