//! Programs in a station's thread.

use std::net::SocketAddrV4;
use std::sync::{Arc, Mutex, PoisonError};

use rtnet::clock::True;
use rtnet::live::clock::monotonic;
use rtnet::socket::{Access, Flags, Program, Sender};
use tests::stacks::Own;

use crate::figures::Times;
use crate::{MESSAGE, PATIENCE};

/// Where echoes are.
pub const PORT: u16 = 36_000;
const ASKS: u16 = 2_000;
const BUFFERS: usize = 16;

/// Sends everything back to where it came from.
pub struct Echo(Own);

/// Asks, and asks again as soon as it has its answer.
pub struct Ping {
    own: Own,
    to: SocketAddrV4,
    number: u64,
    /// When it asked, as long as it waits for the answer.
    asked: Option<True>,
    times: Arc<Mutex<Times>>,
}

impl Echo {
    pub fn new() -> Box<Self> {
        Box::new(Self(Own::udp(PORT, BUFFERS)))
    }
}

impl Program for Echo {
    fn run(&mut self, sockets: &mut Access<'_>) {
        let (id, mut room) = (self.0.id(sockets), [0; MESSAGE]);
        while let Ok(received) = sockets.receive(id, &mut room, Flags::NONE) {
            let Sender::Udp(from) = received.from else { continue };
            let _ = sockets.send_to(id, &room[..received.len], from);
        }
    }
}

impl Ping {
    pub fn new(to: SocketAddrV4, times: Arc<Mutex<Times>>) -> Box<Self> {
        Box::new(Self { own: Own::udp(ASKS, BUFFERS), to, number: 0, asked: None, times })
    }
}

impl Program for Ping {
    fn run(&mut self, sockets: &mut Access<'_>) {
        let (id, mut room) = (self.own.id(sockets), [0; MESSAGE]);
        while sockets.receive(id, &mut room, Flags::NONE).is_ok() {
            if let Some(asked) = self.asked.filter(|_| number_of(&room) == self.number) {
                self.asked = None;
                let took = monotonic() - asked;
                self.times.lock().unwrap_or_else(PoisonError::into_inner).note(took);
            }
        }
        let now = monotonic();
        match self.asked {
            Some(asked) if now - asked < PATIENCE => return,
            Some(_) => self.times.lock().unwrap_or_else(PoisonError::into_inner).note_lost(),
            None => {}
        }
        self.number += 1;
        self.asked = Some(now);
        let _ = sockets.send_to(id, &message(self.number), self.to);
    }
}

/// A message with this number.
pub fn message(number: u64) -> [u8; MESSAGE] {
    let mut message = [0x5a; MESSAGE];
    message[..8].copy_from_slice(&number.to_be_bytes());
    message
}

pub fn number_of(message: &[u8; MESSAGE]) -> u64 {
    message.first_chunk().map_or(0, |number| u64::from_be_bytes(*number))
}
