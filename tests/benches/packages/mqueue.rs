//! POSIX message queues.

#![allow(unsafe_code)]

use std::ffi::{CStr, CString};
use std::io;
use std::ptr::{null, null_mut};

use anyhow::Result;

use crate::exchange::{End, MESSAGE, Message};

/// What an ordinary user may have in a queue.
const SLOTS: i64 = 10;

/// Two queues, there and back, that have names as long as this lives.
pub struct Names([CString; 2]);

pub struct QueueEnd {
    says: libc::mqd_t,
    hears: libc::mqd_t,
}

/// A name is given by what is unique about a measurement.
fn names(place: &str) -> Result<[CString; 2]> {
    Ok([CString::new(format!("/rtnet-{place}-there"))?, CString::new(format!("/rtnet-{place}-back"))?])
}

impl Names {
    pub fn new(place: &str) -> Result<Self> {
        let named = Self(names(place)?);
        for name in &named.0 {
            let queue = open(name, libc::O_RDWR | libc::O_CREAT | libc::O_EXCL)?;
            // SAFETY: it was opened here, and nobody else has it.
            unsafe { libc::mq_close(queue) };
        }
        Ok(named)
    }
}

impl Drop for Names {
    fn drop(&mut self) {
        for name in &self.0 {
            // SAFETY: a string that ends with a zero, and lives.
            unsafe { libc::mq_unlink(name.as_ptr()) };
        }
    }
}

impl QueueEnd {
    /// Number 0 asks, number 1 answers.
    pub fn open(place: &str, number: usize) -> Result<Self> {
        let names = names(place)?;
        let says = open(&names[number], libc::O_WRONLY)?;
        Ok(Self { says, hears: open(&names[1 - number], libc::O_RDONLY)? })
    }
}

impl End for QueueEnd {
    fn say(&mut self, message: &Message) -> Result<()> {
        // SAFETY: the message has so many bytes, and lives.
        done(unsafe { libc::mq_send(self.says, message.as_ptr().cast(), MESSAGE, 0) } as isize)
    }

    fn hear(&mut self, room: &mut Message) -> Result<()> {
        // SAFETY: there is room for so many bytes, which nobody else has; who sent it is not asked.
        done(unsafe { libc::mq_receive(self.hears, room.as_mut_ptr().cast(), MESSAGE, null_mut()) })
    }
}

impl Drop for QueueEnd {
    fn drop(&mut self) {
        for queue in [self.says, self.hears] {
            // SAFETY: it was opened here, and is not used any more.
            unsafe { libc::mq_close(queue) };
        }
    }
}

fn open(name: &CStr, flags: libc::c_int) -> Result<libc::mqd_t> {
    // SAFETY: a struct of numbers, for which zeros are valid.
    let mut attributes: libc::mq_attr = unsafe { core::mem::zeroed() };
    (attributes.mq_maxmsg, attributes.mq_msgsize) = (SLOTS, MESSAGE as i64);
    let attributes = if flags & libc::O_CREAT == 0 { null() } else { &raw const attributes };
    // SAFETY: the name ends with a zero; name and attributes live.
    let queue = unsafe { libc::mq_open(name.as_ptr(), flags, 0o600, attributes) };
    done(queue as isize)?;
    Ok(queue)
}

fn done(told: isize) -> Result<()> {
    if told < 0 { Err(io::Error::last_os_error().into()) } else { Ok(()) }
}
