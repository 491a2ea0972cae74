//! What the real-time threads of labs take of cores, so that together they are not stopped by the kernel. A lab says it
//! in a file of its own, `.load-PID`, and means it as long as it holds the lock on that.

use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow};
use nix::fcntl::{Flock, FlockArg};

use super::places::{Directory, is_held, names, rewrite};
use crate::remedy::explained;

const PREFIX: &str = ".load-";

/// What one lab has said.
#[derive(Debug)]
pub struct Load {
    directory: Directory,
    path: PathBuf,
    file: Flock<File>,
    cpu: usize,
}

impl Load {
    /// This process's lab takes such a share of a core.
    pub fn declare(directory: &Directory, cpu: usize, share: f64) -> Result<Self> {
        directory.make()?;
        let path = directory.path().join(format!("{PREFIX}{}", std::process::id()));
        let file = loop {
            let file = File::options().read(true).write(true).create(true).truncate(false).open(&path);
            let file =
                file.map_err(explained).with_context(|| format!("{} cannot be opened", path.display()))?;
            let file = Flock::lock(file, FlockArg::LockExclusive)
                .map_err(|(_, errno)| anyhow!("{} cannot be locked: {errno}", path.display()))?;
            // Somebody may have taken it for a dead lab's before it was locked.
            let inode = file.metadata()?.ino();
            if fs::metadata(&path).is_ok_and(|found| found.ino() == inode) {
                break file;
            }
        };
        let mut load = Self { directory: directory.clone(), path, file, cpu };
        load.change(share)?;
        Ok(load)
    }

    /// It takes another share of it from now on.
    pub fn change(&mut self, share: f64) -> Result<()> {
        rewrite(&mut self.file, &self.path, &format!("{} {share}", self.cpu))
    }

    /// What all others take of the same core. Those that are dead are forgotten.
    pub fn of_others(&self) -> f64 {
        let share = |path: &Path| {
            let is_load = path.file_name()?.to_str()?.starts_with(PREFIX);
            if !is_load || path == self.path {
                return None;
            }
            if !is_held(path) {
                let _ = fs::remove_file(path);
                return None;
            }
            let said = fs::read_to_string(path).ok()?;
            let (cpu, share) = said.trim().split_once(' ')?;
            (cpu.parse() == Ok(self.cpu)).then(|| share.to_owned())
        };
        names(self.directory.path(), share).iter().filter_map(|share| share.parse::<f64>().ok()).sum()
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_others_take_of_a_core_counts_as_long_as_they_live() {
        let dir = tempfile::tempdir().unwrap();
        let directory = Directory::at(dir.path().join("rtnet"));
        let mut own = Load::declare(&directory, 1, 0.5).unwrap();
        assert_eq!(own.of_others(), 0.0, "its own is nobody else's");
        let say = |name: &str, text: &str| {
            let path = directory.path().join(name);
            fs::write(&path, text).unwrap();
            Flock::lock(File::open(path).unwrap(), FlockArg::LockExclusive).unwrap()
        };
        let same = say(".load-1", "1 0.25\n");
        let _other = say(".load-2", "0 0.125\n");
        let _nonsense = say(".load-3", "much\n");
        assert_eq!(own.of_others(), 0.25);
        drop(same);
        assert_eq!(own.of_others(), 0.0, "it is dead");
        assert!(!directory.path().join(".load-1").exists());
        own.change(0.75).unwrap();
        assert_eq!(fs::read_to_string(&own.path).unwrap(), "1 0.75\n");
        let path = own.path.clone();
        drop(own);
        assert!(!path.exists());
    }
}
