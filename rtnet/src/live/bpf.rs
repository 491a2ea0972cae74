//! bpf(2), as far as programs at an interface need it: a map in shared memory, a program, a link.

pub mod assembler;

use std::ffi::CStr;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::ptr::{self, NonNull};

use assembler::Instruction;

const MAP_CREATE: libc::c_long = 0;
const PROG_LOAD: libc::c_long = 5;
const LINK_CREATE: libc::c_long = 28;

const MAP_TYPE_ARRAY: u32 = 2;
const MAP_MMAPABLE: u32 = 1 << 10;
const PROG_TYPE_SCHED_CLS: u32 = 3;
/// Ahead of every other program: one that ends the chain would skip ours.
const BEFORE: u32 = 1 << 3;

/// What `bpftool` shows.
pub type Name = [u8; 16];

/// What goes which way at an interface a program sees.
#[derive(Clone, Copy, Debug)]
pub enum Hook {
    /// What comes in by it.
    Ingress = 46,
    /// What leaves by it.
    Egress = 47,
}

/// Nothing here is asked of the kernel that it gives only to GPL programs.
const LICENCE: &CStr = c"MIT OR Apache-2.0";

#[repr(C)]
struct MapCreate {
    map_type: u32,
    key_size: u32,
    value_size: u32,
    max_entries: u32,
    map_flags: u32,
    inner_map: u32,
    numa_node: u32,
    name: [u8; 16],
}

#[repr(C)]
struct ProgLoad {
    prog_type: u32,
    instruction_count: u32,
    instructions: u64,
    licence: u64,
    log_level: u32,
    log_size: u32,
    log: u64,
    kernel_version: u32,
    flags: u32,
    name: [u8; 16],
}

#[repr(C)]
struct LinkCreate {
    program: u32,
    interface: u32,
    attach_type: u32,
    flags: u32,
}

/// An array map of one `Page`, all zero.
pub fn create_map<Page>(name: Name) -> io::Result<OwnedFd> {
    let map = MapCreate {
        map_type: MAP_TYPE_ARRAY,
        key_size: size_of::<u32>() as u32,
        value_size: size_of::<Page>() as u32,
        max_entries: 1,
        map_flags: MAP_MMAPABLE,
        inner_map: 0,
        numa_node: 0,
        name,
    };
    // SAFETY: no field is a pointer.
    unsafe { bpf(MAP_CREATE, &map) }
}

/// Has the kernel verify and compile a program.
pub fn load(program: &[Instruction], name: Name) -> io::Result<OwnedFd> {
    let load = ProgLoad {
        prog_type: PROG_TYPE_SCHED_CLS,
        instruction_count: program.len() as u32,
        instructions: program.as_ptr() as u64,
        licence: LICENCE.as_ptr() as u64,
        log_level: 0,
        log_size: 0,
        log: 0,
        kernel_version: 0,
        flags: 0,
        name,
    };
    // SAFETY: the instructions, as many as told, and the licence outlive the call; there is no log.
    unsafe { bpf(PROG_LOAD, &load) }
}

/// Runs a program ahead of all others on what passes an interface there, until the link is closed.
pub fn attach(program: &OwnedFd, interface: u32, hook: Hook) -> io::Result<OwnedFd> {
    let program = program.as_raw_fd() as u32;
    let link = LinkCreate { program, interface, attach_type: hook as u32, flags: BEFORE };
    // SAFETY: no field is a pointer.
    unsafe { bpf(LINK_CREATE, &link) }
}

/// A system call that makes a descriptor, which the kernel closes on exec.
///
/// # Safety
/// What in `attributes` is a pointer refers to as much as the command reads or writes there.
// SAFETY: left to the caller, as above.
unsafe fn bpf<T>(command: libc::c_long, attributes: &T) -> io::Result<OwnedFd> {
    let (attributes, size) = (ptr::from_ref(attributes), size_of::<T>());
    // SAFETY: the kernel reads `size` bytes of `attributes`, which has them; the rest is the caller's word.
    let fd = unsafe { libc::syscall(libc::SYS_bpf, command, attributes, size) };
    if fd < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the kernel has just made this descriptor for us.
    Ok(unsafe { OwnedFd::from_raw_fd(fd as i32) })
}

/// The map's value in this process's memory: all atomics, for which zeroes are a value.
pub struct Mapping<Page>(NonNull<Page>);

// SAFETY: the mapping belongs to the process, not to a thread, and a page is all atomics.
unsafe impl<Page: Sync> Send for Mapping<Page> {}

impl<Page> Mapping<Page> {
    /// Maps the one value of a map of [`create_map`] of the same page.
    pub fn new(map: &OwnedFd) -> io::Result<Self> {
        let (access, fd) = (libc::PROT_READ | libc::PROT_WRITE, map.as_raw_fd());
        // SAFETY: the kernel chooses the address, so that no other mapping is replaced.
        let start =
            unsafe { libc::mmap(ptr::null_mut(), size_of::<Page>(), access, libc::MAP_SHARED, fd, 0) };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        Ok(Self(NonNull::new(start.cast()).ok_or(io::ErrorKind::AddrNotAvailable)?))
    }

    /// What is mapped.
    #[inline]
    pub fn page(&self) -> &Page {
        // SAFETY: the mapping is page-aligned, as long as a `Page` at least, initialised by the kernel,
        // and lives as long as `self`. Whoever else writes there, the kernel, does so by whole words.
        unsafe { self.0.as_ref() }
    }
}

impl<Page> Drop for Mapping<Page> {
    fn drop(&mut self) {
        // SAFETY: mapped by `new` with this length, and nothing borrowed from it is left.
        unsafe { libc::munmap(self.0.as_ptr().cast(), size_of::<Page>()) };
    }
}
