//! bpf(2), as far as programs at an interface need it: a map in shared memory, a program, a link.

pub mod assembler;

use std::ffi::CStr;
use std::io;
use std::marker::PhantomData;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};
use std::ptr::{self, NonNull};

use assembler::Instruction;
use zerocopy::FromBytes;

use super::rights;

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

/// What may be in a map: any bytes are a value of it.
///
/// # Safety
/// The kernel changes it while this process looks at it: all of it is atomics.
pub unsafe trait Page: FromBytes + Sync {}

/// An array map of one page, all zero.
pub struct Map<P>(OwnedFd, PhantomData<P>);

impl<P: Page> Map<P> {
    /// Asks the kernel for one.
    pub fn create(name: Name) -> io::Result<Self> {
        // Memory that is mapped begins at a multiple of this.
        const { assert!(align_of::<P>() <= 4096 && 0 < size_of::<P>() && size_of::<P>() <= 1 << 30) };
        let map = MapCreate {
            map_type: MAP_TYPE_ARRAY,
            key_size: size_of::<u32>() as u32,
            value_size: size_of::<P>() as u32,
            max_entries: 1,
            map_flags: MAP_MMAPABLE,
            inner_map: 0,
            numa_node: 0,
            name,
        };
        // SAFETY: no field is a pointer.
        Ok(Self(unsafe { bpf(MAP_CREATE, &map) }?, PhantomData))
    }
}

impl<P> AsRawFd for Map<P> {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_raw_fd()
    }
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

/// What to do about an answer that means the same whatever a program is for.
pub fn remedy(error: &io::Error) -> Option<String> {
    match error.raw_os_error()? {
        libc::EPERM | libc::EACCES => Some(rights::remedy(&["CAP_BPF", "CAP_NET_ADMIN"])),
        libc::ENOMEM | libc::EAGAIN => Some("free memory, or raise RLIMIT_MEMLOCK (`ulimit -l`)".into()),
        libc::ENOSYS => Some("the kernel must be built with CONFIG_BPF_SYSCALL".into()),
        _ => None,
    }
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

/// A map's page in this process's memory.
pub struct Mapping<P>(NonNull<P>);

// SAFETY: the mapping belongs to the process, not to a thread, and all may look at a page at once.
unsafe impl<P: Page> Send for Mapping<P> {}

impl<P: Page> Mapping<P> {
    /// Maps it.
    pub fn new(map: &Map<P>) -> io::Result<Self> {
        let (access, fd) = (libc::PROT_READ | libc::PROT_WRITE, map.as_raw_fd());
        // SAFETY: the kernel chooses the address, so that no other mapping is replaced.
        let start = unsafe { libc::mmap(ptr::null_mut(), size_of::<P>(), access, libc::MAP_SHARED, fd, 0) };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        Ok(Self(NonNull::new(start.cast()).ok_or(io::ErrorKind::AddrNotAvailable)?))
    }

    /// What is mapped.
    #[inline]
    pub fn page(&self) -> &P {
        // SAFETY: a `Map<P>` has a value as long as a `P`, which is mapped as a whole, aligned as `create` has it, and
        // lives as long as `self`. Whatever the kernel has written there is a `P`, and all of it atomics.
        unsafe { self.0.as_ref() }
    }
}

impl<P> Drop for Mapping<P> {
    fn drop(&mut self) {
        // SAFETY: mapped by `new` with this length, and nothing borrowed from it is left.
        unsafe { libc::munmap(self.0.as_ptr().cast(), size_of::<P>()) };
    }
}
