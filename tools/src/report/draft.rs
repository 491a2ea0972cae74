//! Files that are there once they are whole: written beside their place, and then put into it.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::document::{Document, Kind};
use crate::remedy::explained;
use anyhow::Context;

/// A file to be. Unless it is put into its place, what was there stays, and nothing of it remains.
#[derive(Debug)]
pub struct Draft {
    place: PathBuf,
    /// None: what is there is no file, as /dev/null is none, or stands where no other can; it is written to itself.
    beside: Option<PathBuf>,
}

impl Draft {
    /// Begins it; fails if it could not be written.
    pub fn begin(path: &Path) -> io::Result<(Self, File)> {
        // What a link leads to is replaced, not the link.
        let place = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
        let there = fs::metadata(&place).ok();
        if there.as_ref().is_some_and(|there| !there.is_file()) {
            let file = File::options().write(true).open(&place)?;
            return Ok((Self { place, beside: None }, file));
        }
        // It could be replaced even so, but is not to be.
        there.as_ref().map(|_| File::options().append(true).open(&place)).transpose()?;
        let mut name = std::ffi::OsString::from(".");
        name.push(place.file_name().ok_or(io::ErrorKind::IsADirectory)?);
        name.push(format!(".{}", std::process::id()));
        let beside = place.with_file_name(name);
        match File::create(&beside) {
            Ok(file) => {
                if let Some(there) = there {
                    file.set_permissions(there.permissions())?;
                }
                Ok((Self { place, beside: Some(beside) }, file))
            }
            Err(_) if there.is_some() => {
                let file = File::create(&place)?;
                Ok((Self { place, beside: None }, file))
            }
            Err(error) => Err(error),
        }
    }

    /// Puts it into its place.
    pub fn keep(mut self) -> io::Result<()> {
        let Some(beside) = self.beside.take() else { return Ok(()) };
        fs::rename(&beside, &self.place).inspect_err(|_| drop(fs::remove_file(&beside)))
    }
}

impl Drop for Draft {
    fn drop(&mut self) {
        if let Some(beside) = &self.beside {
            let _ = fs::remove_file(beside);
        }
    }
}

/// `-` is standard output, as everywhere.
pub fn is_standard_output(path: &Path) -> bool {
    path == Path::new("-")
}

/// See [`write_text`].
pub fn write_json(path: &Path, report: &impl Kind) -> anyhow::Result<()> {
    write_text(path, &(serde_json::to_string_pretty(&Document::of(report))? + "\n"))
}

/// Writes a file that is there once it is whole.
pub fn write_text(path: &Path, text: &str) -> anyhow::Result<()> {
    let write = || {
        let (draft, mut file) = Draft::begin(path)?;
        file.write_all(text.as_bytes())?;
        draft.keep()
    };
    write().map_err(explained).with_context(|| format!("{} cannot be written", path.display()))
}

/// Whether it can be written; nothing of it remains, and nothing of what is there is lost.
pub fn can_be_written(path: &Path) -> io::Result<()> {
    // Who reads from a pipe is not to find its end already.
    let is_there = fs::metadata(path);
    match is_there {
        Ok(there) if there.is_dir() => Err(io::ErrorKind::IsADirectory.into()),
        Ok(there) if there.is_file() => File::options().append(true).open(path).map(drop),
        Ok(_) => Ok(()),
        Err(_) => Draft::begin(path).map(drop),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(directory: &Path) -> Vec<String> {
        let entries = fs::read_dir(directory).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn what_was_there_stays_until_what_takes_its_place_is_whole() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.json");
        fs::write(&path, "old").unwrap();
        let (draft, mut file) = Draft::begin(&path).unwrap();
        file.write_all(b"half").unwrap();
        drop(draft);
        assert_eq!(
            (fs::read_to_string(&path).unwrap(), names(directory.path())),
            ("old".into(), vec!["a.json".into()])
        );
        let (draft, mut file) = Draft::begin(&path).unwrap();
        file.write_all(b"whole").unwrap();
        draft.keep().unwrap();
        assert_eq!(
            (fs::read_to_string(&path).unwrap(), names(directory.path())),
            ("whole".into(), vec!["a.json".into()])
        );
    }

    #[test]
    fn what_a_link_leads_to_is_replaced_and_what_is_no_file_is_written_to() {
        let directory = tempfile::tempdir().unwrap();
        let (path, link) = (directory.path().join("a.json"), directory.path().join("link"));
        fs::write(&path, "old").unwrap();
        std::os::unix::fs::symlink(&path, &link).unwrap();
        Draft::begin(&link).unwrap().0.keep().unwrap();
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(fs::read_to_string(&path).unwrap(), "");
        Draft::begin(Path::new("/dev/null")).unwrap().0.keep().unwrap();
        assert!(!fs::metadata("/dev/null").unwrap().is_file());
    }

    #[test]
    fn asking_whether_a_file_can_be_written_leaves_nothing() {
        let directory = tempfile::tempdir().unwrap();
        can_be_written(&directory.path().join("a.json")).unwrap();
        assert_eq!(names(directory.path()), Vec::<String>::new());
        assert!(
            can_be_written(Path::new("/nowhere/a.json")).is_err()
                && can_be_written(directory.path()).is_err()
        );
    }
}
