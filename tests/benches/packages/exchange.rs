//! There and back between two processes, by whatever carries it: the same loop for all.

use std::str::FromStr;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use rtnet::live::clock::monotonic;
use rtnet::live::realtime::RealTime;
use serde_json::Value;

use crate::figures::Times;

/// Bytes of a message.
pub const MESSAGE: usize = 64;
pub type Message = [u8; MESSAGE];
/// What a measurement begins with, and does not count.
const WARM_UP: Duration = Duration::from_millis(200);
/// As real-time threads of programs are.
const PRIORITY: i32 = 70;

/// Whether who waits sleeps.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Way {
    Block,
    Spin,
}

/// One end: it says something to the other, and hears what that says.
pub trait End {
    fn say(&mut self, message: &Message) -> Result<()>;
    fn hear(&mut self, room: &mut Message) -> Result<()>;
}

impl Way {
    pub fn name(self) -> &'static str {
        if self == Way::Block { "block" } else { "spin" }
    }
}

impl FromStr for Way {
    type Err = anyhow::Error;
    fn from_str(text: &str) -> Result<Self> {
        [Way::Block, Way::Spin].into_iter().find(|way| way.name() == text).context("block or spin")
    }
}

/// To a core, and to a priority if it sleeps.
pub fn set_up(way: Way, core: usize) {
    let realtime = RealTime { priority: (way == Way::Block).then_some(PRIORITY), cpu: Some(core) };
    realtime.apply().into_iter().for_each(|refused| eprintln!("{refused}"));
}

/// Asks until the time is over.
pub fn pings(end: &mut impl End, time: Duration) -> Result<Value> {
    let mut times = Times::new();
    let (mut number, mut room) = (0u64, [0; MESSAGE]);
    for time in [WARM_UP, time] {
        times.clear();
        let until = monotonic() + time.as_nanos() as u64;
        loop {
            number += 1;
            let mut message = [0x5a; MESSAGE];
            message[..8].copy_from_slice(&number.to_ne_bytes());
            let asked = monotonic();
            if asked > until {
                break;
            }
            end.say(&message)?;
            end.hear(&mut room)?;
            times.note(monotonic() - asked);
            ensure!(room == message, "what came back is not what was sent");
        }
    }
    Ok(times.figures())
}

/// Sends back what comes, until it is killed.
pub fn echoes(end: &mut impl End) -> Result<()> {
    let mut room = [0; MESSAGE];
    loop {
        end.hear(&mut room)?;
        end.say(&room)?;
    }
}
