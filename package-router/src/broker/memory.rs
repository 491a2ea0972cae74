//! What a mailbox lies in, as the broker has it.

use std::io::{self, ErrorKind};
use std::os::fd::{AsFd, OwnedFd};

use nix::sys::stat::fstat;
use rtnet::live::sealed::Sealed;

use crate::bells::{Bell, Bells};
use crate::handshake::FILES;
use crate::mailbox::{Layout, Shape};
use crate::name::MailboxName;
use crate::shared::lane_at;

/// What a mailbox lies in.
pub(super) struct Memory {
    pub name: MailboxName,
    pub layout: Layout,
    /// The owner's process.
    pub process: u32,
    pub owner: Sealed,
    pub lanes: OwnedFd,
    pub bells: Bells,
    /// The broker's own among them.
    pub bell: Bell,
}

impl Memory {
    /// What an owner has brought for its mailbox.
    pub fn new(name: MailboxName, shape: &Shape, process: u32, files: Vec<OwnedFd>) -> io::Result<Self> {
        let odd = |why| io::Error::new(ErrorKind::InvalidInput, why);
        let [owner, lanes, bells]: [OwnedFd; FILES] =
            files.try_into().map_err(|_| odd("three files come with a mailbox"))?;
        let layout = Layout::of(shape);
        let owner = Sealed::open(owner, layout.owner_words(shape.lanes()))?;
        if !owner.is_final() {
            return Err(odd("a mailbox's own memory is sealed: nobody takes pages out of it"));
        }
        let bytes = (lane_at(&layout, shape.lanes()) * size_of::<u64>()) as i64;
        if fstat(&lanes)?.st_size < bytes {
            return Err(odd("the lanes of a mailbox are all there"));
        }
        let bells = Bells::of(bells);
        let bell = bells.hang()?;
        Ok(Self { name, layout, process, owner, lanes, bells, bell })
    }

    /// What a sender is given: the bell is its own, and goes with it.
    pub fn for_a_sender(&self) -> io::Result<Vec<OwnedFd>> {
        let owner = self.owner.as_fd().try_clone_to_owned()?;
        Ok(vec![owner, self.lanes.try_clone()?, self.bells.hang()?.into()])
    }
}
