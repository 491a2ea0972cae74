//! The protocols of the routers: the registration of a client by its number, and a package of 64 bytes.

use std::io::{Read, Write};
use std::net::TcpStream;

use anyhow::{Result, bail, ensure};
use package_router::name::MailboxName;
use package_router::tcp::control::{UNWATCHED, WATCHED};
use package_router::wire::{HEAD_LEN, Head, OK};

/// Bytes behind the 16 of a head.
const BODY: usize = 48;

/// A way to speak to a router.
pub trait Protocol {
    /// Joins as the client of this number.
    fn join(&self, stream: &mut TcpStream, me: u32) -> Result<()>;
    /// The bytes of a package for a client, with 48 bytes of data.
    fn package(&self, to: u32, from: u32) -> Vec<u8>;
    /// Bytes of that package at its receiver.
    fn comes(&self, to: u32) -> usize;
    /// Has a client that has joined asked for signs of life, as it is unless it says otherwise: its answer to each, if there are such.
    fn watched(&self, _: &mut TcpStream) -> Result<Option<Vec<u8>>> {
        Ok(None)
    }
}

/// By its name.
pub fn named(name: &str) -> Result<&'static dyn Protocol> {
    Ok(match name {
        "ours" => &Ours,
        "bare" => &Bare,
        "nats" => &Nats,
        "mqtt" => &Mqtt,
        _ => bail!("no protocol '{name}': ours, bare, nats, mqtt"),
    })
}

/// The protocol of the TCP router.
pub struct Ours;

impl Protocol for Ours {
    fn join(&self, stream: &mut TcpStream, me: u32) -> Result<()> {
        let head = Head::new(13, MailboxName::NOBODY, MailboxName::NOBODY).with_body(4)?;
        stream.write_all(&[&head.to_bytes()[..], &name(me).0.to_le_bytes()].concat())?;
        let mut answer = [0; HEAD_LEN];
        stream.read_exact(&mut answer)?;
        ensure!(Head::parse(&answer)?.kind == OK, "the name {} is taken", name(me));
        // No lifesigns among the packages that are counted.
        stream.write_all(&Head::new(UNWATCHED, MailboxName::NOBODY, MailboxName::NOBODY).to_bytes())?;
        Ok(())
    }

    fn package(&self, to: u32, from: u32) -> Vec<u8> {
        let mut head = Head::new(-6, name(to), name(from));
        head.len = (HEAD_LEN + BODY) as u32;
        [&head.to_bytes()[..], &[0x55; BODY]].concat()
    }

    fn comes(&self, _: u32) -> usize {
        HEAD_LEN + BODY
    }

    fn watched(&self, stream: &mut TcpStream) -> Result<Option<Vec<u8>>> {
        let to_router = |kind| Head::new(kind, MailboxName::NOBODY, MailboxName::NOBODY).to_bytes();
        stream.write_all(&to_router(WATCHED))?;
        Ok(Some(to_router(OK).to_vec()))
    }
}

/// The name of a client in our protocol.
pub fn name(of: u32) -> MailboxName {
    MailboxName(0x0080_0000 + of)
}

/// The loop that only forwards.
struct Bare;

impl Protocol for Bare {
    fn join(&self, _: &mut TcpStream, _: u32) -> Result<()> {
        Ok(())
    }

    fn package(&self, to: u32, from: u32) -> Vec<u8> {
        Ours.package(to, from)
    }

    fn comes(&self, to: u32) -> usize {
        Ours.comes(to)
    }
}

struct Nats;

impl Protocol for Nats {
    fn join(&self, stream: &mut TcpStream, me: u32) -> Result<()> {
        line(stream)?;
        stream.write_all(
            format!("CONNECT {{\"verbose\":false,\"pedantic\":false}}\r\nSUB c{me:06} 1\r\nPING\r\n")
                .as_bytes(),
        )?;
        let said = line(stream)?;
        ensure!(said == "PONG", "nats says {said}");
        Ok(())
    }

    fn package(&self, to: u32, _: u32) -> Vec<u8> {
        [format!("PUB c{to:06} {BODY}\r\n").as_bytes(), &[0x55; BODY], b"\r\n"].concat()
    }

    fn comes(&self, to: u32) -> usize {
        format!("MSG c{to:06} 1 {BODY}\r\n").len() + BODY + 2
    }
}

/// A line without its end.
fn line(stream: &mut TcpStream) -> Result<String> {
    let (mut line, mut byte) = (Vec::new(), [0]);
    while !line.ends_with(b"\r\n") {
        stream.read_exact(&mut byte)?;
        line.push(byte[0]);
    }
    Ok(String::from_utf8_lossy(&line).trim_end().to_owned())
}

/// Version 3.1.1, quality of service 0.
struct Mqtt;

impl Protocol for Mqtt {
    fn join(&self, stream: &mut TcpStream, me: u32) -> Result<()> {
        let client = format!("c{me:06}");
        let about =
            [b"\x00\x04MQTT\x04\x02\x00\x00", &[0, client.len() as u8][..], client.as_bytes()].concat();
        stream.write_all(&[&[0x10, about.len() as u8], &about[..]].concat())?;
        let mut accepted = [0; 4];
        stream.read_exact(&mut accepted)?;
        ensure!(accepted == [0x20, 2, 0, 0], "mqtt says {accepted:?}");
        let wanted = [&[0, 1, 0, client.len() as u8][..], client.as_bytes(), &[0]].concat();
        stream.write_all(&[&[0x82, wanted.len() as u8], &wanted[..]].concat())?;
        let mut subscribed = [0; 5];
        stream.read_exact(&mut subscribed)?;
        ensure!(subscribed == [0x90, 3, 0, 1, 0], "mqtt says {subscribed:?}");
        Ok(())
    }

    fn package(&self, to: u32, _: u32) -> Vec<u8> {
        let topic = format!("c{to:06}");
        let length = 2 + topic.len() + BODY;
        [&[0x30, length as u8, 0, topic.len() as u8][..], topic.as_bytes(), &[0x55; BODY]].concat()
    }

    fn comes(&self, to: u32) -> usize {
        self.package(to, 0).len()
    }
}
