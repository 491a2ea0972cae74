//! Memory that one process writes and others read, in a mapping that they cannot write.
//!
//! It is a sealed file without a name. Its writer's mapping is from before the seals, and there is no other that can
//! be written, ever, nor can the file be written, cut short or have a hole made in it, by whoever has a descriptor of it: one
//! file does for all readers.

use core::num::NonZeroUsize;
use core::ops::Deref;
use core::ptr::NonNull;
use core::sync::atomic::AtomicU64;
use std::ffi::CStr;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};

use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::mman::{MapFlags, ProtFlags, mlock, mmap, munmap};
use nix::sys::stat::fstat;
use nix::unistd::ftruncate;

const WORD: usize = size_of::<AtomicU64>();
/// What the kernel maps at a time, at the least.
const PAGE: usize = 4096;

/// A mapping of whole words, which it dereferences to. One that was opened is only to be loaded from, and as single words
/// without a change: that is what atomics promise of memory that cannot be written.
pub struct Sealed {
    base: NonNull<AtomicU64>,
    words: usize,
    file: OwnedFd,
}

// SAFETY: what it refers to is only reached as atomics, from whatever thread, and stays mapped as long as it lives.
unsafe impl Send for Sealed {}
// SAFETY: as above.
unsafe impl Sync for Sealed {}

impl Sealed {
    /// New memory for so many words, all zero and there: who touches it does not wait for the kernel. The name is for people
    /// who look at the process.
    pub fn new(name: &CStr, words: usize) -> io::Result<Self> {
        let bytes = (words * WORD).next_multiple_of(PAGE);
        let file = memfd_create(name, MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING)?;
        ftruncate(&file, bytes as i64)?;
        let memory = Self::of(file, bytes, ProtFlags::PROT_READ | ProtFlags::PROT_WRITE)?;
        let cut = SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW;
        // To open it for reading only would be no obstacle: its owner may open it once more.
        let seals = cut | SealFlag::F_SEAL_FUTURE_WRITE | SealFlag::F_SEAL_SEAL;
        fcntl(&memory.file, FcntlArg::F_ADD_SEALS(seals))?;
        Ok(memory)
    }

    /// Memory of at least so many words that another process has made, to be read: no more of it than that, however long its
    /// file is.
    pub fn open(file: OwnedFd, words: usize) -> io::Result<Self> {
        let odd = |why| Err(io::Error::new(io::ErrorKind::InvalidData, why));
        // Whoever reads a file behind its end is killed.
        if !SealFlag::from_bits_retain(fcntl(&file, FcntlArg::F_GET_SEALS)?).contains(SealFlag::F_SEAL_SHRINK)
        {
            return odd("shared memory that could be cut short");
        }
        let (bytes, there) = ((words * WORD).next_multiple_of(PAGE), fstat(&file)?.st_size);
        if usize::try_from(there).unwrap_or(0) < bytes {
            return odd("shared memory of an odd length");
        }
        Self::of(file, bytes, ProtFlags::PROT_READ)
    }

    /// Keeps it in memory, as far as this process may lock as much: who touches it does not wait for a disk.
    pub fn lock(&self) -> io::Result<()> {
        // SAFETY: the mapping is there as long as `self`; that it stays in memory changes nothing of it.
        Ok(unsafe { mlock(self.base.cast(), self.words * WORD) }?)
    }

    /// Whether nobody can write it, or make a hole in it, but who had mapped it before: who reads it never waits for the kernel.
    pub fn is_final(&self) -> bool {
        let seals = fcntl(&self.file, FcntlArg::F_GET_SEALS).map(SealFlag::from_bits_retain);
        seals.is_ok_and(|seals| seals.intersects(SealFlag::F_SEAL_FUTURE_WRITE | SealFlag::F_SEAL_WRITE))
    }

    fn of(file: OwnedFd, bytes: usize, protection: ProtFlags) -> io::Result<Self> {
        let flags = MapFlags::MAP_SHARED | MapFlags::MAP_POPULATE;
        let length = NonZeroUsize::new(bytes)
            .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidData, "shared memory of no length"))?;
        // SAFETY: a new mapping at a place of the kernel's choice touches nothing that exists; its file is as long, and stays
        // so: nobody else has it yet, or it is sealed.
        let base = unsafe { mmap(None, length, protection, flags, &file, 0)? };
        Ok(Self { base: base.cast(), words: bytes / WORD, file })
    }
}

impl AsFd for Sealed {
    /// What other processes open.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

impl Deref for Sealed {
    type Target = [AtomicU64];

    #[inline]
    fn deref(&self) -> &[AtomicU64] {
        // SAFETY: the mapping has so many words, begins at a page, and lives as long as `self`. Zeros, and whatever its
        // writer writes there, are valid words; that it does so at any time is what atomics are for.
        unsafe { core::slice::from_raw_parts(self.base.as_ptr(), self.words) }
    }
}

impl Drop for Sealed {
    fn drop(&mut self) {
        // SAFETY: the mapping was made with this length, and nobody can refer to it any more. It cannot fail then.
        let _ = unsafe { munmap(self.base.cast(), self.words * WORD) };
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

    /// A writer's memory, and a descriptor as a reader gets it.
    fn memory() -> (Sealed, OwnedFd) {
        let memory = Sealed::new(c"rtnet-test", 512).expect("this kernel has memfd_create");
        let file = memory.as_fd().try_clone_to_owned().unwrap();
        (memory, file)
    }

    #[test]
    fn a_reader_sees_what_the_writer_writes() {
        let (ours, file) = memory();
        let theirs = Sealed::open(file, 512).unwrap();
        assert!(theirs.is_final());
        assert_eq!((ours.len(), theirs.len()), (512, 512));
        assert_eq!(theirs[511].load(Ordering::Relaxed), 0);
        ours[511].store(7, Ordering::Relaxed);
        assert_eq!(theirs[511].load(Ordering::Relaxed), 7);
        drop(ours);
        assert_eq!(theirs[511].load(Ordering::Relaxed), 7, "the writer is gone, and what it wrote is there");
    }

    #[test]
    fn a_hostile_reader_can_neither_write_it_nor_make_it_shorter_nor_take_it_away() {
        let (ours, file) = memory();
        ours[0].store(7, Ordering::Relaxed);
        // As it came, and opened once more: it is this user's file.
        let once_more = format!("/proc/self/fd/{}", file.as_raw_fd());
        let again = open(once_more.as_str(), OFlag::O_RDWR, Mode::empty()).unwrap();
        for file in [file, again] {
            assert_eq!(write(&file, &[1; 8]), Err(Errno::EPERM));
            assert_eq!(ftruncate(&file, 0), Err(Errno::EPERM));
            assert_eq!(ftruncate(&file, 1 << 20), Err(Errno::EPERM));
            let hole = FallocateFlags::FALLOC_FL_PUNCH_HOLE | FallocateFlags::FALLOC_FL_KEEP_SIZE;
            assert_eq!(fallocate(&file, hole, 0, PAGE as i64), Err(Errno::EPERM));
            assert_eq!(fcntl(&file, FcntlArg::F_ADD_SEALS(SealFlag::F_SEAL_WRITE)), Err(Errno::EPERM));
            let both = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
            let writable = Sealed::of(file.try_clone().unwrap(), PAGE, both);
            assert_eq!(writable.err().unwrap().raw_os_error(), Some(libc::EPERM));
            let theirs = Sealed::of(file, PAGE, ProtFlags::PROT_READ).unwrap();
            // SAFETY: a mapping that could be written, too, would be what it is now for who only reads it.
            let writable = unsafe { mprotect(theirs.base.cast(), PAGE, both) };
            assert_eq!(writable, Err(Errno::EACCES));
            // SAFETY: if it were done, zeros would be there, which nobody relies on.
            let taken = unsafe { madvise(theirs.base.cast(), PAGE, MmapAdvise::MADV_REMOVE) };
            assert_eq!(taken, Err(Errno::EACCES));
        }
        assert_eq!(ours[0].load(Ordering::Relaxed), 7);
    }

    #[test]
    fn a_file_that_could_be_cut_short_or_is_too_short_is_not_read() {
        let odd = |bytes, seals| {
            let file = memfd_create(c"odd", MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING).unwrap();
            ftruncate(&file, bytes).unwrap();
            fcntl(&file, FcntlArg::F_ADD_SEALS(seals)).unwrap();
            Sealed::open(file, 512).err().map(|error| error.kind())
        };
        let page = PAGE as i64;
        assert_eq!(odd(page, SealFlag::empty()), Some(io::ErrorKind::InvalidData));
        assert_eq!(odd(page - 1, SealFlag::F_SEAL_SHRINK), Some(io::ErrorKind::InvalidData));
        assert_eq!(odd(0, SealFlag::F_SEAL_SHRINK), Some(io::ErrorKind::InvalidData));
        assert_eq!(odd(page, SealFlag::F_SEAL_SHRINK), None);
        let file = memfd_create(c"odd", MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING).unwrap();
        ftruncate(&file, page).unwrap();
        fcntl(&file, FcntlArg::F_ADD_SEALS(SealFlag::F_SEAL_SHRINK)).unwrap();
        assert!(!Sealed::open(file, 1).unwrap().is_final(), "its maker may take pages out of it");
        let (_ours, long) = memory();
        assert_eq!(Sealed::open(long, 1).map(|memory| memory.len()).ok(), Some(512), "a page at the least");
        assert!(Sealed::open(std::fs::File::open("/dev/null").unwrap().into(), 1).is_err());
    }
}
