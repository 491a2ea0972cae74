//! The hook of kernels before 6.6: a filter at the egress of the queueing discipline clsact, by rtnetlink(7).
//!
//! ```text
//! | nlmsghdr: length 4, type 2, flags 2, sequence 4, port 4 |
//! | tcmsg: family 1, padding 3, interface 4, handle 4, parent 4, info 4 |
//! | attribute: length 2, type 2, value, padding to 4 | ...
//! ```

use std::io;
use std::os::fd::{AsRawFd, OwnedFd};

use socket2::{Domain, Protocol, Socket, Type};

use super::program::MARK;

const NEW_QDISC: u16 = 36;
const NEW_FILTER: u16 = 44;
const DELETE_FILTER: u16 = 45;
const REQUEST: u16 = 1;
const ACK: u16 = 4;
const EXCLUSIVE: u16 = 0x200;
const CREATE: u16 = 0x400;

/// Where clsact sits, what it is called, and where it lets filters see what leaves.
const CLSACT: u32 = 0xffff_fff1;
const CLSACT_HANDLE: u32 = 0xffff_0000;
const EGRESS: u32 = 0xffff_fff3;
/// Ahead of all others, frames of every EtherType.
const FIRST_OF_ALL: u32 = 1 << 16 | (libc::ETH_P_ALL as u16).to_be() as u32;
/// Ours among the filters of that priority: one that a killed station left is replaced.
const HANDLE: u32 = MARK;

const KIND: u16 = 1;
const OPTIONS: u16 = 2;
const BPF_FD: u16 = 6;
const BPF_NAME: u16 = 7;
const BPF_FLAGS: u16 = 8;
/// What the program returns is what becomes of the frame.
const DIRECT_ACTION: u32 = 1;

const HEADER: usize = 16;

/// A filter at an interface's egress, removed when dropped.
pub struct Filter {
    netlink: Socket,
    interface: u32,
}

impl Filter {
    /// Attaches a program. The clsact that is made for it stays: others may have come to use it since.
    pub fn attach(program: &OwnedFd, interface: u32) -> io::Result<Self> {
        let netlink = Socket::new(
            Domain::from(libc::AF_NETLINK),
            Type::RAW,
            Some(Protocol::from(libc::NETLINK_ROUTE)),
        )?;
        let mut clsact = Request::new(NEW_QDISC, CREATE | EXCLUSIVE, interface, CLSACT_HANDLE, CLSACT, 0);
        clsact.attribute(KIND, b"clsact\0");
        match clsact.ask(&netlink) {
            Err(error) if error.raw_os_error() == Some(libc::EEXIST) => {}
            answer => answer?,
        }
        let mut filter = Request::new(NEW_FILTER, CREATE, interface, HANDLE, EGRESS, FIRST_OF_ALL);
        filter.attribute(KIND, b"bpf\0");
        filter.nested(OPTIONS, |options| {
            options.attribute(BPF_FD, &program.as_raw_fd().to_ne_bytes());
            options.attribute(BPF_NAME, b"rtnet_guard\0");
            options.attribute(BPF_FLAGS, &DIRECT_ACTION.to_ne_bytes());
        });
        filter.ask(&netlink)?;
        Ok(Self { netlink, interface })
    }
}

impl Drop for Filter {
    fn drop(&mut self) {
        let mut filter = Request::new(DELETE_FILTER, 0, self.interface, HANDLE, EGRESS, FIRST_OF_ALL);
        filter.attribute(KIND, b"bpf\0");
        // The interface may be gone, and the filter with it.
        let _ = filter.ask(&self.netlink);
    }
}

/// One request, which the kernel answers before anything else is asked.
struct Request(Vec<u8>);

impl Request {
    fn new(kind: u16, flags: u16, interface: u32, handle: u32, parent: u32, info: u32) -> Self {
        let mut request = vec![0; size_of::<u32>()];
        request.extend(kind.to_ne_bytes());
        request.extend((REQUEST | ACK | flags).to_ne_bytes());
        // Sequence and port; family and padding.
        request.extend([0; 8 + 4]);
        for word in [interface, handle, parent, info] {
            request.extend(word.to_ne_bytes());
        }
        Self(request)
    }

    fn attribute(&mut self, kind: u16, value: &[u8]) {
        self.nested(kind, |inside| inside.0.extend(value));
        self.0.resize(self.0.len().next_multiple_of(4), 0);
    }

    /// An attribute whose value `fill` appends.
    fn nested(&mut self, kind: u16, fill: impl FnOnce(&mut Self)) {
        let start = self.0.len();
        self.0.extend([0; 2]);
        self.0.extend(kind.to_ne_bytes());
        fill(self);
        let length = (self.0.len() - start) as u16;
        self.0[start..start + 2].copy_from_slice(&length.to_ne_bytes());
    }

    /// Sends it and waits for the kernel's answer.
    fn ask(mut self, netlink: &Socket) -> io::Result<()> {
        let length = self.0.len() as u32;
        self.0[..4].copy_from_slice(&length.to_ne_bytes());
        netlink.send(&self.0)?;
        // An answer is an error number, 0 if there is none, and the request.
        let mut answer = [0; 512];
        let received = io::Read::read(&mut &*netlink, &mut answer)?;
        let number = answer[..received].get(HEADER..).and_then(|body| body.first_chunk());
        match number.map(|&number| i32::from_ne_bytes(number)) {
            Some(0) => Ok(()),
            Some(error) => Err(io::Error::from_raw_os_error(-error)),
            None => Err(io::ErrorKind::InvalidData.into()),
        }
    }
}
