//! Signs of life, answers of the router, and an urgent package, behind packages that wait for the same client.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use hdrhistogram::Histogram;
use package_router::name::MailboxName;
use package_router::tcp::control::{CONFIRM, LIFESIGN, WATCHED, request};
use package_router::wire::{HEAD_LEN, Head, OK};
use serde_json::{Value, json};
use socket2::{Domain, Socket, Type};

use crate::clients::{PATIENCE, joined};
use crate::protocols::{self, Protocol, name};

/// Packages that wait.
const WAITING: usize = 10_000;
/// The priority of the urgent package; those that wait have 0.
const URGENT: u8 = 200;
/// The receiver's socket buffer, which would grow else: most packages wait in the router.
const BUFFER: usize = 64 << 10;

/// Time from a question to its answer, and from sending an urgent package to reading it, and how many waiting packages came first.
pub fn behind(at: SocketAddr, time: Duration) -> Result<Value> {
    let ours = protocols::named("ours")?;
    let (mut receiver, mut sender) = (slow(ours, at)?, joined(ours, at, 1)?);
    let many = ours.package(0, 1).repeat(WAITING);
    let question = question(1);
    let urgent = Head { priority: URGENT, ..Head::new(-6, name(0), name(1)) }.to_bytes();
    let mut answered = Figures::new()?;
    let mut overtook = Figures::new()?;
    let begun = Instant::now();
    while begun.elapsed() < time || answered.times.is_empty() {
        waits(&mut sender, &many)?;
        let asked = Instant::now();
        receiver.write_all(&question)?;
        answered.until(&mut receiver, ours, asked, |head| head.to == MailboxName::NOBODY)?;

        waits(&mut sender, &many)?;
        let sent = Instant::now();
        sender.write_all(&urgent)?;
        overtook.until(&mut receiver, ours, sent, |head| head.priority == URGENT)?;
    }
    Ok(json!({ "answer": answered.shown(), "urgent": overtook.shown() }))
}

/// Time from the router's question for a sign of life to its arrival at a client for which packages wait: the router asks another
/// client, for which nothing waits, in the same round.
pub fn lifesigns(at: SocketAddr, rounds: usize) -> Result<Value> {
    let ours = protocols::named("ours")?;
    let (mut receiver, mut sender, mut other) = (slow(ours, at)?, joined(ours, at, 1)?, joined(ours, at, 2)?);
    let many = ours.package(0, 1).repeat(WAITING);
    let answer = Head::new(OK, MailboxName::NOBODY, MailboxName::NOBODY).to_bytes();
    let mut came = Figures::new()?;
    let watched = Head::new(WATCHED, MailboxName::NOBODY, MailboxName::NOBODY).to_bytes();
    [&mut receiver, &mut other].into_iter().try_for_each(|of| of.write_all(&watched))?;
    for _ in 0..rounds {
        waits(&mut sender, &many)?;
        asked(&mut other)?;
        came.until(&mut receiver, ours, Instant::now(), |head| head.kind == LIFESIGN)?;
        [&mut receiver, &mut other].into_iter().try_for_each(|of| of.write_all(&answer))?;
    }
    Ok(json!({ "lifesign": came.shown() }))
}

/// Waits for the router's question for a sign of life.
fn asked(client: &mut TcpStream) -> Result<()> {
    let mut head = [0; HEAD_LEN];
    client.read_exact(&mut head).context("no question for a sign of life")?;
    let kind = Head::parse(&head)?.kind;
    ensure!(kind == LIFESIGN, "kind {kind} came, no question for a sign of life");
    Ok(())
}

/// The receiver.
fn slow(ours: &dyn Protocol, at: SocketAddr) -> Result<TcpStream> {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None)?;
    socket.set_recv_buffer_size(BUFFER)?;
    socket.connect(&at.into())?;
    socket.set_tcp_nodelay(true)?;
    socket.set_read_timeout(Some(PATIENCE))?;
    let mut stream = TcpStream::from(socket);
    ours.join(&mut stream, 0)?;
    Ok(stream)
}

/// Whether the router has read all before: it answers at once, as a client answers a sign of life.
fn question(id: u8) -> Vec<u8> {
    let body = MailboxName::NOBODY.0.to_le_bytes();
    [&request(CONFIRM, id, &body).to_bytes()[..], &body].concat()
}

/// Sends packages to the receiver, and returns when the router has read them all.
fn waits(sender: &mut TcpStream, many: &[u8]) -> Result<()> {
    sender.write_all(many)?;
    sender.write_all(&question(2))?;
    let mut answer = [0; HEAD_LEN];
    sender.read_exact(&mut answer).context("the sender's question has no answer")
}

struct Figures {
    times: Histogram<u64>,
    /// The most packages that came before.
    before: usize,
}

impl Figures {
    fn new() -> Result<Self> {
        Ok(Self { times: Histogram::new(3)?, before: 0 })
    }

    /// Reads until the package comes that is waited for; then all that waited.
    fn until(
        &mut self,
        receiver: &mut TcpStream,
        ours: &dyn Protocol,
        since: Instant,
        is_it: impl Fn(&Head) -> bool,
    ) -> Result<()> {
        let (mut head, mut body) = ([0; HEAD_LEN], vec![0; ours.comes(0)]);
        let (mut before, mut waited) = (None, 0);
        while waited < WAITING || before.is_none() {
            receiver.read_exact(&mut head).context("the receiver")?;
            let head = Head::parse(&head)?;
            receiver.read_exact(&mut body[..head.body_len()])?;
            if is_it(&head) {
                self.times.record(since.elapsed().as_nanos() as u64)?;
                before = Some(waited);
            } else {
                waited += 1;
            }
        }
        ensure!(before < Some(WAITING), "it came behind all {WAITING} packages");
        self.before = self.before.max(before.unwrap_or(WAITING));
        Ok(())
    }

    fn shown(&self) -> Value {
        let at = |share| self.times.value_at_quantile(share);
        json!({ "n": self.times.len(), "p50": at(0.5), "max": self.times.max(), "before": self.before })
    }
}
