//! The device that Linux sees, as the kernel's TUN driver has it: one frame by one system call.

#![allow(unsafe_code)]

use std::fs::{File, OpenOptions};
use std::io::{self, IoSlice, IoSliceMut};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};
use std::os::unix::fs::OpenOptionsExt;

use nix::sys::uio::{readv, writev};
use rtnet::buf::Buf;
use rtnet::live::rights;
use rtnet::wire::ethernet::EtherType;

use crate::tunnel::Inner;

/// Where the driver is.
const DRIVER: &str = "/dev/net/tun";
/// A name without a number: the kernel gives it the first that is free.
const ANY_NUMBER: &str = "vnic%d";
/// What is read beyond a buffer, only to see that there was more.
const BEYOND: usize = 16;

/// What goes through a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Mode {
    /// Ethernet frames of any type: a host of its own, with its own ARP. As RTnet's.
    #[default]
    Tap,
    /// Packets of IPv4 and IPv6 only: which station has an address is known by a table.
    Tun,
}

/// A network device whose other end is this process.
pub struct Device {
    file: File,
    name: String,
    mode: Mode,
}

/// Why there is no device, and what to do. The station runs on without it.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The kernel has no TUN driver.
    #[error("no VNIC: there is no {DRIVER}: load the driver (`modprobe tun`, CONFIG_TUN)")]
    Absent,
    /// The device file is not for this user.
    #[error(
        "no VNIC: {DRIVER}: {0} (give this user the device file, `chmod`, or in a container `--device {DRIVER}`)"
    )]
    File(#[source] io::Error),
    /// No right to make a device in this network namespace.
    #[error("no VNIC: a device may not be made here: {0} ({remedy})", remedy = rights::remedy(&["CAP_NET_ADMIN"]))]
    Right(#[source] io::Error),
    /// Somebody else has a device of this name.
    #[error("no VNIC: the name '{0}' is taken: choose another by `--vnic-name`")]
    Taken(String),
    /// So has somebody since the device of this name is gone.
    #[error(
        "no VNIC: the name '{0}' is taken meanwhile: free it (`ip link set {0} down name ANOTHER`), or start the station anew \
         with another `--vnic-name`"
    )]
    TakenMeanwhile(String),
    /// The kernel does not take the name.
    #[error(
        "no VNIC: '{0}' is no name for a device: 1 to 15 characters without spaces, '/', ':' and '%', and neither '.' nor '..'"
    )]
    Name(String),
    /// Whatever else the kernel says.
    #[error("no VNIC: {0}")]
    Other(#[source] io::Error),
}

impl Device {
    /// Makes a device in the network namespace of the calling thread, which is down; it is gone when this is dropped.
    pub fn open(name: Option<&str>, mode: Mode) -> Result<Self, OpenError> {
        let wanted = name.unwrap_or(ANY_NUMBER);
        let is_fine = |c: char| !c.is_whitespace() && !c.is_control() && c != '/' && c != ':';
        if wanted.is_empty() || wanted.len() >= libc::IFNAMSIZ || !wanted.chars().all(is_fine) {
            return Err(OpenError::Name(wanted.to_owned()));
        }
        let mut options = OpenOptions::new();
        let opened = options.read(true).write(true).custom_flags(libc::O_NONBLOCK).open(DRIVER);
        let file = opened.map_err(|error| match error.raw_os_error() {
            Some(libc::ENOENT | libc::ENODEV | libc::ENXIO) => OpenError::Absent,
            _ => OpenError::File(error),
        })?;
        let flags = match mode {
            Mode::Tap => libc::IFF_TAP,
            Mode::Tun => libc::IFF_TUN,
        };
        // A new one: the driver would attach this to a device of somebody else's that outlives its maker.
        let flags = flags | libc::IFF_NO_PI | libc::IFF_TUN_EXCL;
        let name = attach(&file, wanted, flags).map_err(|error| match error.raw_os_error() {
            Some(libc::EPERM | libc::EACCES) => OpenError::Right(error),
            Some(libc::EBUSY | libc::EEXIST) => OpenError::Taken(wanted.to_owned()),
            Some(libc::EINVAL) => OpenError::Name(wanted.to_owned()),
            _ => OpenError::Other(error),
        })?;
        Ok(Self { file, name, mode })
    }

    /// The name that it was made with.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What goes through it.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Reads what Linux sends next, to where it stays from there on; its length, which may be more than there is room for.
    /// `None` when there is nothing.
    pub fn read(&self, to: &mut Buf, at: usize) -> io::Result<Option<usize>> {
        let mut beyond = [0; BEYOND];
        let mut parts = [IoSliceMut::new(&mut to.room_mut()[at..]), IoSliceMut::new(&mut beyond)];
        match readv(&self.file, &mut parts) {
            Ok(n) => Ok(Some(n)),
            Err(nix::errno::Errno::EAGAIN) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Gives Linux what was inside a tunnelled frame. Only packets of IP go through where the device takes only those.
    pub fn write(&self, inner: &Inner<'_>) -> io::Result<()> {
        let pieces = inner.pieces();
        let pieces = match self.mode {
            Mode::Tap => &pieces[..],
            Mode::Tun => &pieces[2..],
        };
        let mut parts = [IoSlice::new(&[]); 3];
        let filled = parts.iter_mut().zip(pieces).map(|(part, piece)| *part = IoSlice::new(piece)).count();
        writev(&self.file, &parts[..filled])?;
        Ok(())
    }

    /// Gives Linux a packet, where the device takes packets.
    pub fn write_packet(&self, packet: &[u8]) -> io::Result<()> {
        writev(&self.file, &[IoSlice::new(packet)])?;
        Ok(())
    }
}

#[cfg(test)]
impl Device {
    /// It is not gone when this is dropped.
    pub fn outlive(&self) {
        // SAFETY: the driver takes the number itself.
        let result = unsafe { libc::ioctl(self.file.as_raw_fd(), libc::TUNSETPERSIST as _, 1) };
        assert_eq!(result, 0);
    }
}

impl AsFd for Device {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

/// The type of a packet of IP, by its first half byte.
pub fn kind_of_packet(first: u8) -> Option<EtherType> {
    match first >> 4 {
        4 => Some(EtherType::IPV4),
        6 => Some(EtherType::IPV6),
        _ => None,
    }
}

/// Has the driver make a device; tells its name.
fn attach(file: &File, name: &str, flags: libc::c_int) -> io::Result<String> {
    // SAFETY: all-zero is a valid ifreq.
    let mut request: libc::ifreq = unsafe { core::mem::zeroed() };
    for (to, from) in request.ifr_name.iter_mut().zip(name.bytes()) {
        *to = from as libc::c_char;
    }
    request.ifr_ifru.ifru_flags = flags as libc::c_short;
    // SAFETY: the driver reads and writes one ifreq, which is alive for the call. Its name is shorter than its field, so
    // that it ends with a zero.
    let result = unsafe { libc::ioctl(file.as_raw_fd(), libc::TUNSETIFF as _, &raw mut request) };
    if result < 0 {
        return Err(io::Error::last_os_error());
    }
    let name = request.ifr_name.iter().take_while(|&&byte| byte != 0);
    Ok(name.map(|&byte| byte as u8 as char).collect())
}
