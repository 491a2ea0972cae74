//! Memory that a station shares with a program: an anonymous file that neither can cut short, nor, where the kernel has
//! such, take pages out of.

#![allow(unsafe_code)]

use core::num::NonZeroUsize;
use core::ops::Deref;
use core::ptr::NonNull;
use core::sync::atomic::{AtomicU64, Ordering};
use std::io;
use std::os::fd::{AsFd, BorrowedFd, FromRawFd, OwnedFd};

use nix::errno::Errno;
use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::mman::{MapFlags, ProtFlags, mmap, munmap};
use nix::sys::statfs::{FsType, fstatfs};
use nix::unistd::ftruncate;

/// A mapping of whole words, which dereferences to them.
pub struct Memory {
    base: NonNull<AtomicU64>,
    words: usize,
    file: OwnedFd,
}

// SAFETY: what it refers to is only reached as atomics, from whatever thread, and stays mapped as long as it lives.
unsafe impl Send for Memory {}
// SAFETY: as above.
unsafe impl Sync for Memory {}

impl Memory {
    /// New memory of at least so many bytes, all zero and there: nobody who touches it waits for the kernel.
    pub fn new(bytes: usize) -> io::Result<Self> {
        let bytes = bytes.next_multiple_of(PAGE);
        Self::new_secret(bytes).or_else(|_| Self::map(sealed(bytes)?, bytes))
    }

    fn new_secret(bytes: usize) -> io::Result<Self> {
        secret(bytes).and_then(|file| Self::map(file, bytes))
    }

    /// Memory that somebody else has made and sealed, of its own length.
    pub fn open(file: OwnedFd) -> io::Result<Self> {
        let is_sealed = || {
            let seals = SealFlag::from_bits_retain(fcntl(&file, FcntlArg::F_GET_SEALS)?);
            Ok::<_, io::Error>(seals.contains(SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW))
        };
        let is_locked = is_secret(&file)?;
        if !is_locked && !is_sealed()? {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "shared memory that could be cut short"));
        }
        let bytes = usize::try_from(nix::sys::stat::fstat(&file)?.st_size).unwrap_or(0);
        Self::map(file, bytes).map_err(|error| match error.raw_os_error() {
            Some(libc::EAGAIN) if is_locked => {
                io::Error::new(io::ErrorKind::OutOfMemory, LockLimit { bytes })
            }
            _ => error,
        })
    }

    fn map(file: OwnedFd, bytes: usize) -> io::Result<Self> {
        let length = NonZeroUsize::new(bytes)
            .filter(|bytes| bytes.get() % PAGE == 0)
            .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "shared memory of an odd length"))?;
        let (protection, flags) =
            (ProtFlags::PROT_READ | ProtFlags::PROT_WRITE, MapFlags::MAP_SHARED | MapFlags::MAP_POPULATE);
        // SAFETY: a new mapping at a place of the kernel's choice touches nothing that exists; its file is as long, and
        // sealed, so that all of it stays valid.
        let base = unsafe { mmap(None, length, protection, flags, &file, 0)? };
        let memory = Self { base: base.cast(), words: bytes / size_of::<AtomicU64>(), file };
        // Secret memory is not made by `MAP_POPULATE`: its pages come when they are written, by who has the time. An exchange of
        // the same, since an addition of nothing would become a load.
        memory.iter().step_by(PAGE / size_of::<AtomicU64>()).for_each(|word| {
            let as_it_is = word.load(Ordering::Relaxed);
            let _ = word.compare_exchange(as_it_is, as_it_is, Ordering::Relaxed, Ordering::Relaxed);
        });
        Ok(memory)
    }
}

/// The pages of secret memory are locked, on either side, and count against that side's limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{bytes} bytes that the socket has in common with its station cannot be locked: this program may lock no more (raise \
     RLIMIT_MEMLOCK, `ulimit -l`, by that for each socket, or close some)"
)]
pub struct LockLimit {
    /// Of the memory that was to be locked.
    pub bytes: usize,
}

/// Whether nobody can make a hole in memory that this file is: what [`Memory::new`] has made, if it could.
pub fn is_whole(file: impl AsFd) -> bool {
    is_secret(file).unwrap_or(false)
}

/// Why such memory cannot be made now; `None`: it can.
pub fn why_not_whole(bytes: usize) -> Option<io::Error> {
    Memory::new_secret(bytes.next_multiple_of(PAGE)).err()
}

/// A file whose length is given once, and whose pages stay. Of any other the program can make a hole, and who touches that
/// next waits until it is made: with a priority of 80 for 58 ms, because a program with the lowest one made it.
fn secret(bytes: usize) -> io::Result<OwnedFd> {
    // SAFETY: it takes flags, and gives a descriptor of its own or -1.
    let made = Errno::result(unsafe { libc::syscall(libc::SYS_memfd_secret, libc::O_CLOEXEC) })?;
    // SAFETY: it was just made, and is nobody else's.
    let file = unsafe { OwnedFd::from_raw_fd(made as i32) };
    ftruncate(&file, bytes as i64)?;
    Ok(file)
}

/// An ordinary one, where there is no such, or no more of it may be locked.
fn sealed(bytes: usize) -> io::Result<OwnedFd> {
    let file = memfd_create(c"rtnet-socket", MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING)?;
    ftruncate(&file, bytes as i64)?;
    // Whoever reads a file behind its end is killed: nobody may move that.
    let seals = SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW | SealFlag::F_SEAL_SEAL;
    fcntl(&file, FcntlArg::F_ADD_SEALS(seals))?;
    Ok(file)
}

fn is_secret(file: impl AsFd) -> io::Result<bool> {
    Ok(fstatfs(file)?.filesystem_type() == SECRET)
}

/// `SECRETMEM_MAGIC`.
const SECRET: FsType = FsType(0x5345_434d);

/// What the kernel maps at a time, at the least.
const PAGE: usize = 4096;

impl AsFd for Memory {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

impl Deref for Memory {
    type Target = [AtomicU64];

    #[inline]
    fn deref(&self) -> &[AtomicU64] {
        // SAFETY: the mapping has so many words, begins at a page, and lives as long as `self`. Zeros, and whatever anybody
        // writes there, are valid words; that others write at any time is what atomics are for.
        unsafe { core::slice::from_raw_parts(self.base.as_ptr(), self.words) }
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        // SAFETY: the mapping was made with this length, and nobody can refer to it any more. It cannot fail then.
        let _ = unsafe { munmap(self.base.cast(), self.words * size_of::<AtomicU64>()) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nix::fcntl::{FallocateFlags, fallocate};
    use nix::sys::mman::{MmapAdvise, madvise};
    use nix::sys::resource::{UsageWho, getrusage};

    #[test]
    fn both_ends_see_the_same_words() {
        let ours = Memory::new(5_000).unwrap();
        let theirs = Memory::open(ours.as_fd().try_clone_to_owned().unwrap()).unwrap();
        assert_eq!((ours.len(), theirs.len()), (1024, 1024));
        ours[1023].store(7, Ordering::Relaxed);
        assert_eq!(theirs[1023].load(Ordering::Relaxed), 7);
    }

    #[test]
    fn nobody_can_make_a_hole_in_it_where_the_kernel_has_such_memory() {
        if secret(PAGE).and_then(|file| Memory::map(file, PAGE)).is_err() {
            return;
        }
        let memory = Memory::new(PAGE).unwrap();
        memory[0].store(7, Ordering::Relaxed);
        let hole = FallocateFlags::FALLOC_FL_PUNCH_HOLE | FallocateFlags::FALLOC_FL_KEEP_SIZE;
        assert!(fallocate(memory.as_fd(), hole, 0, PAGE as i64).is_err());
        let (base, advice) = (memory.base.cast(), MmapAdvise::MADV_REMOVE);
        // SAFETY: the mapping is whole, and what its words are after that does not matter.
        assert!(unsafe { madvise(base, PAGE, advice) }.is_err());
        assert_eq!(memory[0].load(Ordering::Relaxed), 7);
    }

    #[test]
    fn ordinary_memory_takes_its_place_where_there_is_none() {
        let ours = Memory::map(sealed(PAGE).unwrap(), PAGE).unwrap();
        let theirs = Memory::open(ours.as_fd().try_clone_to_owned().unwrap()).unwrap();
        ours[0].store(7, Ordering::Relaxed);
        assert_eq!(theirs[0].load(Ordering::Relaxed), 7);
        assert!(ftruncate(ours.as_fd(), 0).is_err());
    }

    #[test]
    fn all_of_it_is_there_before_anybody_touches_it() {
        let faults = || getrusage(UsageWho::RUSAGE_THREAD).unwrap().minor_page_faults();
        for memory in [Memory::new(1 << 20).unwrap(), Memory::map(sealed(1 << 20).unwrap(), 1 << 20).unwrap()]
        {
            let before = faults();
            memory.iter().for_each(|word| word.store(7, Ordering::Relaxed));
            assert!(faults() - before < 8, "of 256 pages {}", faults() - before);
        }
    }

    #[test]
    fn who_may_lock_no_more_is_told_so_and_what_to_do() {
        let told = io::Error::new(io::ErrorKind::OutOfMemory, LockLimit { bytes: 4096 }).to_string();
        assert!(
            told.starts_with("4096 bytes") && told.contains("raise RLIMIT_MEMLOCK, `ulimit -l`"),
            "{told}"
        );
    }

    #[test]
    fn nobody_can_cut_it_short() {
        let memory = Memory::new(4096).unwrap();
        assert!(ftruncate(memory.as_fd(), 0).is_err());
        assert!(ftruncate(memory.as_fd(), 1 << 20).is_err());
        let unsealed = memfd_create(c"odd", MFdFlags::MFD_CLOEXEC).unwrap();
        ftruncate(&unsealed, 4096).unwrap();
        assert!(Memory::open(unsealed).is_err());
    }
}
