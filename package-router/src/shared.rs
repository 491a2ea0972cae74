//! The memory that a mailbox's parties have in common.
//!
//! ```text
//! owner's file    the owner writes, senders and the broker read            sealed: nobody else can write it
//! lanes' file     [ lane 1 ][ lane 2 ] ...   each sender writes its own lane, in a mapping of that alone; the owner reads
//! router's file   lane 0: the LAN router writes, the owner reads           sealed
//! board           the broker writes, everybody reads                       sealed
//! ```
//!
//! Who makes a mistake cannot write where it is not to: the mapping does not allow it.

#![allow(unsafe_code)]

use core::num::NonZeroUsize;
use core::ptr::NonNull;
use core::sync::atomic::AtomicU64;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::Arc;

use nix::fcntl::{FallocateFlags, FcntlArg, SealFlag, fallocate, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use nix::sys::mman::{MapFlags, ProtFlags, mmap, munmap};
use nix::sys::stat::fstat;
use rtnet::live::sealed::Sealed;

use crate::mailbox::{Layout, Segment, Word};

/// Words that the kernel maps at a time, at the least.
const PAGE: usize = 4096 / size_of::<u64>();

impl Segment for Sealed {
    type Word = AtomicU64;
    #[inline]
    fn at(&self, place: usize) -> &AtomicU64 {
        &self[place]
    }
    #[inline]
    fn part(&self, place: usize, count: usize) -> &[AtomicU64] {
        &self[place..][..count]
    }
    fn count(&self) -> usize {
        self.len()
    }
}

/// A part of memory that somebody else writes.
#[derive(Clone)]
pub struct View {
    memory: Arc<Sealed>,
    begin: usize,
    words: usize,
}

impl View {
    /// These words of it, if it has them.
    pub fn of(memory: Arc<Sealed>, begin: usize, words: usize) -> Option<Self> {
        (begin + words <= memory.len()).then_some(Self { memory, begin, words })
    }
}

impl Segment for View {
    type Word = AtomicU64;
    #[inline]
    fn at(&self, place: usize) -> &AtomicU64 {
        &self.memory[self.begin + place]
    }
    #[inline]
    fn part(&self, place: usize, count: usize) -> &[AtomicU64] {
        &self.memory[self.begin + place..][..count]
    }
    fn count(&self) -> usize {
        self.words
    }
}

/// The word at which a lane begins in the lanes' file. Lane 0 is not there: it has a file of its own.
pub fn lane_at(layout: &Layout, lane: usize) -> usize {
    lane.saturating_sub(1) * layout.sender_words().next_multiple_of(PAGE)
}

/// The file for the lanes of a mailbox that has so many: it cannot be cut short, and its memory is there.
pub fn lanes_file(layout: &Layout, lanes: usize) -> io::Result<OwnedFd> {
    let bytes = lane_at(layout, lanes) * size_of::<u64>();
    let file = memfd_create(c"rtnet-lanes", MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING)?;
    fallocate(&file, FallocateFlags::empty(), 0, bytes as i64)?;
    let seals = SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW | SealFlag::F_SEAL_SEAL;
    fcntl(&file, FcntlArg::F_ADD_SEALS(seals))?;
    Ok(file)
}

/// A lane that this process writes: no other part of its file is in reach.
pub struct Room {
    base: NonNull<AtomicU64>,
    words: usize,
}

// SAFETY: what it refers to is only reached as atomics, from whatever thread, and stays mapped as long as it lives.
unsafe impl Send for Room {}
// SAFETY: as above.
unsafe impl Sync for Room {}

impl Room {
    /// A lane of a file that somebody else has made, all zero: whoever had it before has gone.
    pub fn open(file: &OwnedFd, layout: &Layout, lane: usize) -> io::Result<Self> {
        let seals = SealFlag::from_bits_retain(fcntl(file, FcntlArg::F_GET_SEALS)?);
        let (begin, end) = (lane_at(layout, lane), lane_at(layout, lane + 1));
        let has_lane = fstat(file)?.st_size >= (end * size_of::<u64>()) as i64;
        // Whoever writes to a file behind its end is killed.
        if !seals.contains(SealFlag::F_SEAL_SHRINK) || !has_lane {
            return Err(io::Error::new(
                io::ErrorKind::InvalidData,
                "lanes that could be cut short, or are too few",
            ));
        }
        let words = end - begin;
        let bytes = NonZeroUsize::new(words * size_of::<u64>()).ok_or(io::ErrorKind::InvalidData)?;
        let protection = ProtFlags::PROT_READ | ProtFlags::PROT_WRITE;
        let flags = MapFlags::MAP_SHARED | MapFlags::MAP_POPULATE;
        // SAFETY: a new mapping at a place of the kernel's choice touches nothing that exists; its file is as long, and stays so.
        let base =
            unsafe { mmap(None, bytes, protection, flags, file.as_fd(), (begin * size_of::<u64>()) as i64)? };
        let room = Self { base: base.cast(), words };
        (0..words).for_each(|place| Word::set(room.at(place), 0));
        Ok(room)
    }
}

impl Room {
    #[inline]
    fn words(&self) -> &[AtomicU64] {
        // SAFETY: the mapping has so many words, begins at a page, and lives as long as `self`. Whatever is there is a valid
        // word; that others read it at any time is what atomics are for.
        unsafe { core::slice::from_raw_parts(self.base.as_ptr(), self.words) }
    }
}

impl Segment for Room {
    type Word = AtomicU64;
    #[inline]
    fn at(&self, place: usize) -> &AtomicU64 {
        &self.words()[place]
    }
    #[inline]
    fn part(&self, place: usize, count: usize) -> &[AtomicU64] {
        &self.words()[place..][..count]
    }
    fn count(&self) -> usize {
        self.words
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        // SAFETY: the mapping was made with this length, and nobody can refer to it any more. It cannot fail then.
        let _ = unsafe { munmap(self.base.cast(), self.words * size_of::<u64>()) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mailbox::Shape;
    use core::sync::atomic::Ordering;

    #[test]
    fn a_lane_is_its_senders_alone_and_seen_by_the_owner() {
        let layout = Layout::of(&Shape::new(4, 600));
        let file = lanes_file(&layout, 4).unwrap();
        let memory = Arc::new(Sealed::open(file.try_clone().unwrap(), lane_at(&layout, 4)).unwrap());
        let views = [1, 2, 3]
            .map(|lane| View::of(memory.clone(), lane_at(&layout, lane), layout.sender_words()).unwrap());
        let rooms = [1, 2, 3].map(|lane| Room::open(&file, &layout, lane).unwrap());
        for (n, room) in (1..).zip(&rooms) {
            (0..room.count()).for_each(|place| room.at(place).store(n, Ordering::Relaxed));
        }
        for (n, view) in (1..).zip(&views) {
            assert!((0..view.count()).all(|place| view.at(place).load(Ordering::Relaxed) == n));
        }
        drop(Room::open(&file, &layout, 2).unwrap());
        assert_eq!(
            views.map(|view| view.at(0).load(Ordering::Relaxed)),
            [1, 0, 3],
            "who has it next finds it empty"
        );
    }

    #[test]
    fn a_file_that_has_not_that_lane_or_could_be_cut_short_is_refused() {
        let layout = Layout::of(&Shape::new(4, 600));
        let file = lanes_file(&layout, 3).unwrap();
        assert!([0, 3].iter().all(|lane| Room::open(&file, &layout, *lane).is_err()));
        let odd = memfd_create(c"odd", MFdFlags::MFD_CLOEXEC).unwrap();
        nix::unistd::ftruncate(&odd, 1 << 20).unwrap();
        assert!(Room::open(&odd, &layout, 0).is_err());
    }
}
