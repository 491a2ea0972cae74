//! What is left of two mailboxes without their packages: the bells alone, hung as a broker hangs them. They carry nothing, so
//! who hears has what it says itself.

#![allow(unsafe_code)]

use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};
use std::os::unix::net::UnixStream;

use anyhow::{Context, Result, ensure};
use nix::fcntl::{FcntlArg, FdFlag, fcntl};
use package_router::bells::{Bell, Bells, Woken};

use crate::exchange::{End, MESSAGE, Message};

/// Two owners' bells, and who rings them: for two processes that this one starts.
pub struct Hung {
    _stations: [UnixStream; 2],
    sets: [Bells; 2],
    bells: [OwnedFd; 2],
}

pub struct BareEnd {
    own: Bells,
    other: Bell,
    said: Message,
}

impl Hung {
    pub fn new() -> Result<Self> {
        let stations: [UnixStream; 2] = UnixStream::pair()?.into();
        let sets = [Bells::new(&stations[0])?, Bells::new(&stations[1])?];
        let bells = [sets[0].hang()?.into(), sets[1].hang()?.into()];
        let hung = Self { _stations: stations, sets, bells };
        for file in hung.files() {
            fcntl(file, FcntlArg::F_SETFD(FdFlag::empty()))?;
        }
        Ok(hung)
    }

    /// Numbers of files, as those processes have them.
    pub fn place(&self) -> String {
        self.files().map(|file| file.as_raw_fd().to_string()).join(",")
    }

    fn files(&self) -> [BorrowedFd<'_>; 4] {
        [self.sets[0].as_fd(), self.sets[1].as_fd(), self.bells[0].as_fd(), self.bells[1].as_fd()]
    }
}

impl BareEnd {
    pub fn open(place: &str, number: usize) -> Result<Self> {
        let numbers = place.split(',').map(str::parse).collect::<Result<Vec<i32>, _>>()?;
        let number_of = |at: usize| numbers.get(at).copied().context("four files");
        let [own, other] = [number_of(number)?, number_of(3 - number)?];
        // SAFETY: who started this process has left these files to it, and nothing else here knows of them.
        let [own, other] = [own, other].map(|file| unsafe { OwnedFd::from_raw_fd(file) });
        Ok(Self { own: Bells::of(own), other: Bell::of(other), said: [0; MESSAGE] })
    }
}

impl End for BareEnd {
    fn say(&mut self, message: &Message) -> Result<()> {
        self.said = *message;
        self.other.ring();
        Ok(())
    }

    fn hear(&mut self, room: &mut Message) -> Result<()> {
        ensure!(self.own.wait(None) == Woken::Rung, "the other end has gone");
        *room = self.said;
        Ok(())
    }
}
