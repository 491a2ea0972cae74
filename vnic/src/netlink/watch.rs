//! What happens to devices, as the kernel tells of it.

use std::collections::VecDeque;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};

use netlink_packet_core::NetlinkPayload;
use netlink_packet_route::link::{LinkAttribute, LinkFlags, LinkMessage};
use netlink_packet_route::{AddressFamily, RouteNetlinkMessage};
use netlink_sys::{Socket, protocols::NETLINK_ROUTE};

use super::Refused;
use super::exchange::{messages, no_socket, receive};

/// The kernel's group for devices: RTNLGRP_LINK (rtnetlink(7)).
const GROUP: u32 = libc::RTNLGRP_LINK;

/// A socket that hears what happens to the devices of one network namespace.
///
/// As an iterator it never waits: it ends where nothing more has come, and goes on once its file is readable again.
pub struct Watch {
    pub(super) socket: Socket,
    /// What came with what was returned last.
    heard: VecDeque<Heard>,
}

/// Something that was heard.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Heard {
    /// What became of a device.
    Change(LinkChange),
    /// Something was lost, as more came than was taken, or cannot be understood: look anew.
    Missed,
}

/// What became of a device. It may be what was known already: the kernel tells more than this.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkChange {
    /// The device's number.
    pub index: u32,
    /// Its name, from now on.
    pub name: String,
    /// Whether it is there, and how.
    pub kind: ChangeKind,
}

/// Whether a device is there, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChangeKind {
    /// It is not there any more: deleted, or in another namespace.
    Gone,
    /// It is there.
    Is {
        /// It is set up.
        is_up: bool,
        /// The largest packet that it takes, in bytes.
        mtu: usize,
    },
}

impl Watch {
    /// Begins to listen in the network namespace of the calling thread.
    ///
    /// # Errors
    /// The kernel gives no netlink socket.
    pub fn open() -> Result<Self, Refused> {
        let open = || -> io::Result<Socket> {
            let mut socket = Socket::new(NETLINK_ROUTE)?;
            socket.bind_auto()?;
            socket.add_membership(GROUP)?;
            socket.set_non_blocking(true)?;
            Ok(socket)
        };
        Ok(Self { socket: open().map_err(no_socket)?, heard: VecDeque::new() })
    }
}

impl AsFd for Watch {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

impl Iterator for Watch {
    type Item = Heard;

    fn next(&mut self) -> Option<Heard> {
        while self.heard.is_empty() {
            match receive(&self.socket) {
                Ok(datagram) => self.heard.extend(in_datagram(&datagram)),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return None,
                // ENOBUFS, once for all that was lost.
                Err(_) => return Some(Heard::Missed),
            }
        }
        self.heard.pop_front()
    }
}

fn in_datagram(datagram: &[u8]) -> impl Iterator<Item = Heard> {
    messages(datagram).filter_map(|message| match message.map(|message| message.payload) {
        Ok(NetlinkPayload::InnerMessage(RouteNetlinkMessage::NewLink(link))) => change(link, true),
        Ok(NetlinkPayload::InnerMessage(RouteNetlinkMessage::DelLink(link))) => change(link, false),
        Ok(NetlinkPayload::Overrun(_)) | Err(_) => Some(Heard::Missed),
        Ok(_) => None,
    })
}

fn change(link: LinkMessage, is_there: bool) -> Option<Heard> {
    // A bridge tells in its own family of its ports: one that left it is not gone.
    if link.header.interface_family != AddressFamily::Unspec {
        return None;
    }
    let (mut name, mut mtu) = (String::new(), 0);
    for attribute in link.attributes {
        match attribute {
            LinkAttribute::IfName(it) => name = it,
            LinkAttribute::Mtu(it) => mtu = it as usize,
            _ => {}
        }
    }
    let is_up = link.header.flags.contains(LinkFlags::Up);
    let kind = if is_there { ChangeKind::Is { is_up, mtu } } else { ChangeKind::Gone };
    Some(Heard::Change(LinkChange { index: link.header.index, name, kind }))
}
