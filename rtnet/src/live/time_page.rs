//! The page that a station shows its time on: its threads read it where it writes, other processes in a mapping that they
//! cannot write.
//!
//! It is a sealed file without a name. The station's own mapping is from before the seals, and there is no other that can
//! be written, ever, nor can the file be written, cut short or have a hole made in it, by whoever has a descriptor of it: one
//! page does for all programs.

use core::num::NonZeroUsize;
use core::ops::Deref;
use core::ptr::NonNull;
use core::sync::atomic::AtomicU64;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::mman::{MapFlags, ProtFlags, mmap, munmap};
use nix::sys::stat::fstat;
use nix::unistd::ftruncate;

/// Words of a page.
pub(super) const WORDS: usize = 512;
const BYTES: NonZeroUsize = NonZeroUsize::new(WORDS * size_of::<AtomicU64>()).expect("there are some");

/// A page of words, which it dereferences to.
pub(super) enum Page {
    /// For this process alone: the kernel has no such files, or no more of them.
    Own(Box<[AtomicU64; WORDS]>),
    /// For others, too.
    Shared(Mapping),
}

/// A page of a file. One that was opened is only to be loaded from, and `Relaxed`: that is what atomics promise of memory
/// that cannot be written.
pub(super) struct Mapping {
    base: NonNull<[AtomicU64; WORDS]>,
    file: OwnedFd,
}

// SAFETY: what it refers to is only reached as atomics, from whatever thread, and stays mapped as long as it lives.
unsafe impl Send for Mapping {}
// SAFETY: as above.
unsafe impl Sync for Mapping {}

impl Page {
    /// A new one, all zero and there: who touches it does not wait for the kernel.
    pub(super) fn new() -> Self {
        Mapping::new()
            .map_or_else(|_| Page::Own(Box::new([const { AtomicU64::new(0) }; WORDS])), Page::Shared)
    }

    /// One that another process has made, to be read.
    pub(super) fn open(file: OwnedFd) -> io::Result<Self> {
        let odd = |why| Err(io::Error::new(io::ErrorKind::InvalidData, why));
        // Whoever reads a file behind its end is killed.
        if !SealFlag::from_bits_retain(fcntl(&file, FcntlArg::F_GET_SEALS)?).contains(SealFlag::F_SEAL_SHRINK)
        {
            return odd("a station's time that could be cut short");
        }
        if fstat(&file)?.st_size != BYTES.get() as i64 {
            return odd("a station's time of an odd length");
        }
        Mapping::of(file, ProtFlags::PROT_READ).map(Page::Shared)
    }

    /// What other processes open; `None`: there is nothing for them.
    pub(super) fn file(&self) -> Option<BorrowedFd<'_>> {
        match self {
            Page::Own(_) => None,
            Page::Shared(mapping) => Some(mapping.file.as_fd()),
        }
    }
}

impl Deref for Page {
    type Target = [AtomicU64; WORDS];

    #[inline]
    fn deref(&self) -> &Self::Target {
        match self {
            Page::Own(words) => words,
            // SAFETY: the mapping has so many words, begins at a page, and lives as long as `self`. Zeros, and whatever its
            // writer writes there, are valid words; that it does so at any time is what atomics are for.
            Page::Shared(mapping) => unsafe { mapping.base.as_ref() },
        }
    }
}

impl Mapping {
    fn new() -> io::Result<Self> {
        let file = memfd_create(c"rtnet-time", MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING)?;
        ftruncate(&file, BYTES.get() as i64)?;
        let mapping = Self::of(file, ProtFlags::PROT_READ | ProtFlags::PROT_WRITE)?;
        let cut = SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW;
        // To open it for reading only would be no obstacle: its owner may open it once more.
        let seals = cut | SealFlag::F_SEAL_FUTURE_WRITE | SealFlag::F_SEAL_SEAL;
        fcntl(&mapping.file, FcntlArg::F_ADD_SEALS(seals))?;
        Ok(mapping)
    }

    fn of(file: OwnedFd, protection: ProtFlags) -> io::Result<Self> {
        let flags = MapFlags::MAP_SHARED | MapFlags::MAP_POPULATE;
        // SAFETY: a new mapping at a place of the kernel's choice touches nothing that exists; its file is as long, and stays
        // so: nobody else has it yet, or it is sealed.
        let base = unsafe { mmap(None, BYTES, protection, flags, &file, 0)? };
        Ok(Self { base: base.cast(), file })
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: the mapping was made with this length, and nobody can refer to it any more. It cannot fail then.
        let _ = unsafe { munmap(self.base.cast(), BYTES.get()) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::sync::atomic::Ordering;
    use nix::errno::Errno;
    use nix::fcntl::{FallocateFlags, OFlag, fallocate, open};
    use nix::sys::mman::{MmapAdvise, madvise, mprotect};
    use nix::sys::stat::Mode;
    use nix::unistd::write;
    use std::os::fd::AsRawFd;

    /// A station's page, and a descriptor as a program gets it.
    fn page() -> (Page, OwnedFd) {
        let page = Page::new();
        let file = page.file().expect("this kernel has memfd_create").try_clone_to_owned().unwrap();
        (page, file)
    }

    #[test]
    fn a_program_sees_what_the_station_writes() {
        let (ours, file) = page();
        let theirs = Page::open(file).unwrap();
        assert_eq!(theirs[WORDS - 1].load(Ordering::Relaxed), 0);
        ours[WORDS - 1].store(7, Ordering::Relaxed);
        assert_eq!(theirs[WORDS - 1].load(Ordering::Relaxed), 7);
        drop(ours);
        assert_eq!(
            theirs[WORDS - 1].load(Ordering::Relaxed),
            7,
            "the station is gone, and what it wrote is there"
        );
    }

    #[test]
    fn a_hostile_program_can_neither_write_the_page_nor_make_it_shorter_nor_take_it_away() {
        let (ours, file) = page();
        ours[0].store(7, Ordering::Relaxed);
        // As it came, and opened once more: it is this user's file.
        let once_more = format!("/proc/self/fd/{}", file.as_raw_fd());
        let again = open(once_more.as_str(), OFlag::O_RDWR, Mode::empty()).unwrap();
        for file in [file, again] {
            assert_eq!(write(&file, &[1; 8]), Err(Errno::EPERM));
            assert_eq!(ftruncate(&file, 0), Err(Errno::EPERM));
            assert_eq!(ftruncate(&file, 1 << 20), Err(Errno::EPERM));
            let hole = FallocateFlags::FALLOC_FL_PUNCH_HOLE | FallocateFlags::FALLOC_FL_KEEP_SIZE;
            assert_eq!(fallocate(&file, hole, 0, BYTES.get() as i64), Err(Errno::EPERM));
            assert_eq!(fcntl(&file, FcntlArg::F_ADD_SEALS(SealFlag::F_SEAL_WRITE)), Err(Errno::EPERM));
            let both = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
            assert_eq!(
                Mapping::of(file.try_clone().unwrap(), both).err().unwrap().raw_os_error(),
                Some(libc::EPERM)
            );
            let theirs = Mapping::of(file, ProtFlags::PROT_READ).unwrap();
            // SAFETY: a mapping that could be written, too, would be what it is now for who only reads it.
            let writable = unsafe { mprotect(theirs.base.cast(), BYTES.get(), both) };
            assert_eq!(writable, Err(Errno::EACCES));
            // SAFETY: if it were done, zeros would be there, which nobody relies on.
            let taken = unsafe { madvise(theirs.base.cast(), BYTES.get(), MmapAdvise::MADV_REMOVE) };
            assert_eq!(taken, Err(Errno::EACCES));
        }
        assert_eq!(ours[0].load(Ordering::Relaxed), 7);
    }

    #[test]
    fn a_file_that_could_be_cut_short_or_is_no_page_is_not_read() {
        let odd = |bytes, seals| {
            let file = memfd_create(c"odd", MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING).unwrap();
            ftruncate(&file, bytes).unwrap();
            fcntl(&file, FcntlArg::F_ADD_SEALS(seals)).unwrap();
            Page::open(file).err().map(|error| error.kind())
        };
        let page = BYTES.get() as i64;
        assert_eq!(odd(page, SealFlag::empty()), Some(io::ErrorKind::InvalidData));
        assert_eq!(odd(page - 1, SealFlag::F_SEAL_SHRINK), Some(io::ErrorKind::InvalidData));
        assert_eq!(odd(0, SealFlag::F_SEAL_SHRINK), Some(io::ErrorKind::InvalidData));
        assert_eq!(odd(page, SealFlag::F_SEAL_SHRINK), None);
        assert!(Page::open(std::fs::File::open("/dev/null").unwrap().into()).is_err());
    }
}
