//! The floor: a loop over epoll that forwards bytes between connections, in pairs in the order of their accepts.

use std::io::{ErrorKind, Read, Write};
use std::net::SocketAddr;

use anyhow::Result;
use mio::net::{TcpListener, TcpStream};
use mio::{Events, Interest, Poll, Token};

const LISTENER: Token = Token(usize::MAX);
const READ: usize = 64 << 10;

struct End {
    stream: TcpStream,
    /// Bytes that the peer has not taken yet. The loop reads no more until they have left.
    left: Vec<u8>,
    is_readable: bool,
}

/// Forwards until it is killed.
pub fn forward(at: SocketAddr) -> Result<serde_json::Value> {
    let mut poll = Poll::new()?;
    let mut listener = TcpListener::bind(at)?;
    poll.registry().register(&mut listener, LISTENER, Interest::READABLE)?;
    let (mut ends, mut events, mut room) = (Vec::<End>::new(), Events::with_capacity(1_024), vec![0; READ]);
    loop {
        poll.poll(&mut events, None)?;
        for event in &events {
            if event.token() == LISTENER {
                while let Ok((mut stream, _)) = listener.accept() {
                    stream.set_nodelay(true)?;
                    let both = Interest::READABLE | Interest::WRITABLE;
                    poll.registry().register(&mut stream, Token(ends.len()), both)?;
                    ends.push(End { stream, left: Vec::new(), is_readable: false });
                }
                continue;
            }
            let Token(place) = event.token();
            if event.is_readable() {
                ends[place].is_readable = true;
                pass(&mut ends, place, &mut room);
            }
            if event.is_writable() {
                pass(&mut ends, place ^ 1, &mut room);
            }
        }
    }
}

/// Passes bytes from one end to the other until one of them would block.
fn pass(ends: &mut [End], from: usize, room: &mut [u8]) {
    if ends.len() <= from.max(from ^ 1) {
        return;
    }
    loop {
        let left = core::mem::take(&mut ends[from].left);
        let mut bytes = &left[..];
        let mut is_short = false;
        if bytes.is_empty() {
            if !ends[from].is_readable {
                return;
            }
            match ends[from].stream.read(room) {
                Ok(length) if length > 0 => {
                    bytes = &room[..length];
                    is_short = length < READ;
                }
                _ => {
                    ends[from].is_readable = false;
                    return;
                }
            }
        }
        while !bytes.is_empty() {
            match ends[from ^ 1].stream.write(bytes) {
                Ok(length) => bytes = &bytes[length..],
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    ends[from].left = bytes.to_vec();
                    return;
                }
                Err(_) => return,
            }
        }
        if is_short {
            ends[from].is_readable = false;
            return;
        }
    }
}
