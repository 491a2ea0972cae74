//! Calls to a mailbox, while the router that they go by is killed and started again.

use std::collections::BTreeSet;
use std::fmt::{self, Display, Formatter};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::Instant;

use package_router::component::{Mailbox, SendError, Sender};
use package_router::mailbox;
use package_router::wire::{NOT_AVAILABLE, OK};

use super::{ANSWER_WITHIN, ASK, ECHO, SENDS_EVERY};

/// The ends of calls, each counted where it was made.
#[derive(Debug, Default)]
pub struct Calls {
    made: u64,
    answered: u64,
    not_available: u64,
    timed_out: u64,
    /// Refused at once: as many wait as may.
    full: u64,
    /// The calls whose answers have come.
    seen: BTreeSet<u64>,
}

impl Display for Calls {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { made, answered, not_available, timed_out, full, .. } = self;
        write!(
            f,
            "{made} calls: {answered} answered, {not_available} not available, {timed_out} timed out, {full} refused"
        )
    }
}

/// Calls, one after the other, and shows how many were answered, be it too late.
pub fn calls(caller: &mut Mailbox, answered: &AtomicU64, is_over: &AtomicBool) -> Calls {
    let mut sender = caller.sender(ECHO).unwrap();
    let mut calls = Calls::default();
    while !is_over.load(Ordering::Relaxed) {
        call(&mut sender, caller, &mut calls);
        answered.store(calls.seen.len() as u64, Ordering::Relaxed);
        thread::sleep(SENDS_EVERY);
    }
    calls
}

fn call(sender: &mut Sender, mailbox: &mut Mailbox, calls: &mut Calls) {
    calls.made += 1;
    let id = match sender.send(ASK, &calls.made.to_le_bytes()) {
        Ok(id) => id,
        Err(SendError::Mailbox(mailbox::SendError::Full(_))) => {
            calls.full += 1;
            return;
        }
        Err(error) => panic!("{error}"),
    };
    let begun = Instant::now();
    while let Some(left) = ANSWER_WITHIN.checked_sub(begun.elapsed()) {
        let Ok(package) = mailbox.receive(Some(left)) else { break };
        let head = *package.head();
        match head.kind {
            // One to an earlier call comes too late: that call has been counted.
            NOT_AVAILABLE if head.id == id => {
                calls.not_available += 1;
                return;
            }
            OK => {
                let number = u64::from_le_bytes(package.body().to_vec()[..].try_into().unwrap());
                assert!(calls.seen.insert(number), "the answer to {number} came twice");
                // The answer to an earlier call comes too late: that call has been counted.
                if number == calls.made {
                    calls.answered += 1;
                    return;
                }
            }
            _ => {}
        }
    }
    calls.timed_out += 1;
}
