//! Where Linux has the station's own address it must not hear the station's interface: every packet would reach it twice,
//! those for real-time sockets, too, and it would answer echoes and questions for the address beside the station's slots.
//!
//! What is changed for that is noted in a file before, which is locked as long as the station runs. Who is killed puts
//! nothing back; the next station at the interface does.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use nix::fcntl::{Flock, FlockArg};
use rtnet::live::interface::Interface;

/// What the kernel asks before it takes something that came by an interface: whether the way back is the same (it never is:
/// Linux has no address there), and whether the address that is asked for is one of that interface's.
const ASKED: [&str; 2] = ["rp_filter", "arp_ignore"];
const NO: &str = "0";
const YES: &str = "1";

/// Linux takes no packet of IPv4 from an interface, and answers no question for an address there, until this is dropped.
#[derive(Debug)]
pub struct Aside {
    changed: Vec<PathBuf>,
    note: Option<Note>,
}

impl Aside {
    /// Stands aside at an interface of the calling thread's network namespace. What was set so by somebody stays. What is
    /// changed is noted in the directory `notes`, if there is one, for who comes after a station that is killed.
    pub fn at(interface: &Interface, notes: Option<&Path>) -> io::Result<Self> {
        let mut aside = Self { changed: Vec::new(), note: None };
        let mut to_change = Vec::new();
        for name in ASKED {
            let path = switch(interface, name);
            if fs::read_to_string(&path)?.trim() == NO {
                to_change.push((name, path));
            }
        }
        if !to_change.is_empty() {
            // Without a note it is as with a host that has no place for notes: only who is killed leaves it so.
            let names = to_change.iter().map(|(name, _)| *name);
            aside.note = notes.and_then(|notes| Note::write(interface, notes, names).ok());
        }
        for (_, path) in to_change {
            fs::write(&path, YES)?;
            aside.changed.push(path);
        }
        Ok(aside)
    }
}

impl Drop for Aside {
    fn drop(&mut self) {
        for path in &self.changed {
            // An interface that is gone has nothing to be set.
            let _ = fs::write(path, NO);
        }
        if let Some(note) = &self.note {
            let _ = fs::remove_file(&note.path);
        }
    }
}

/// Puts back what a killed station has left at an interface, by its note in this directory. One that runs keeps what it has.
pub fn put_back(interface: &Interface, notes: &Path) {
    let Ok(path) = note_of(interface, notes) else { return };
    let Ok(Ok(mut file)) = File::open(&path).map(|file| Flock::lock(file, FlockArg::LockExclusiveNonblock))
    else {
        return;
    };
    let mut text = String::new();
    let read = file.read_to_string(&mut text);
    let mut lines = text.lines();
    // Of another life of the host, or an interface that only has the number of the one that was meant.
    let is_its = read.is_ok() && lines.next() == Some(&whose(interface));
    let left = ASKED.into_iter().filter(|name| is_its && lines.clone().any(|line| line == *name));
    let put = left.map(|name| switch(interface, name)).try_for_each(|path| {
        // Somebody may have set it to something else since.
        if fs::read_to_string(&path)?.trim() == YES { fs::write(&path, NO) } else { Ok(()) }
    });
    if put.is_ok() {
        let _ = fs::remove_file(&path);
    }
}

/// What a station has changed; its own as long as the file is open.
#[derive(Debug)]
struct Note {
    path: PathBuf,
    _lock: Flock<File>,
}

impl Note {
    fn write<'a>(
        interface: &Interface,
        notes: &Path,
        names: impl Iterator<Item = &'a str>,
    ) -> io::Result<Self> {
        let path = note_of(interface, notes)?;
        let file = File::options().write(true).create(true).truncate(false).open(&path)?;
        let mut lock = Flock::lock(file, FlockArg::LockExclusiveNonblock)
            .map_err(|(_, error)| io::Error::from(error))?;
        let lines = std::iter::once(whose(interface)).chain(names.map(str::to_owned));
        let text: String = lines.map(|line| line + "\n").collect();
        lock.set_len(0)?;
        lock.write_all(text.as_bytes())?;
        Ok(Self { path, _lock: lock })
    }
}

/// What asks one of these questions of an interface.
fn switch(interface: &Interface, name: &str) -> PathBuf {
    format!("/proc/sys/net/ipv4/conf/{}/{name}", interface.name).into()
}

/// One for each interface of each network namespace; no station's name begins with a dot.
fn note_of(interface: &Interface, notes: &Path) -> io::Result<PathBuf> {
    let namespace = fs::metadata("/proc/thread-self/ns/net")?.ino();
    Ok(notes.join(format!(".aside-{namespace}-{}", interface.index)))
}

/// The numbers of namespaces and interfaces are given again, after a start of the host at the latest.
fn whose(interface: &Interface) -> String {
    let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    format!("{} {}", boot.trim(), interface.address)
}
