//! Signs of life, answers of the router, and an urgent package, behind packages that wait for the same client; and a client's own answer.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use hdrhistogram::Histogram;
use package_router::component::{Component, Mailbox, SendError};
use package_router::mailbox::{self, Shape};
use package_router::name::MailboxName;
use package_router::tcp::client::TcpOptions;
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
/// Until a client's kernel takes no more of what its router does not read.
const BACKLOG: Duration = Duration::from_millis(50);

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

/// Time from a router's question for a sign of life, behind packages for a client, to the client's answer, behind packages of its own. The
/// router is this program: it has read nothing of the client for a while.
pub fn answers(rounds: usize) -> Result<Value> {
    let listener = Socket::new(Domain::IPV4, Type::STREAM, None)?;
    listener.set_recv_buffer_size(BUFFER)?;
    listener.bind(&SocketAddr::from((Ipv4Addr::LOCALHOST, 0)).into())?;
    listener.listen(1)?;
    let listener = TcpListener::from(listener);
    let component = Component::of_router(&TcpOptions::new(listener.local_addr()?.to_string().parse()?))?;
    let mailbox = component.mailbox(name(0), Shape::new(8, 64))?;
    let (mut router, _) = listener.accept()?;
    router.set_nodelay(true)?;
    router.set_read_timeout(Some(PATIENCE))?;
    router.set_write_timeout(Some(PATIENCE))?;
    let ours = protocols::named("ours")?;
    let question = Head::new(LIFESIGN, MailboxName::NOBODY, MailboxName::NOBODY).to_bytes();
    let many = [&ours.package(0, 1).repeat(WAITING)[..], &question[..]].concat();
    let is_answer =
        |head: &Head| (head.kind, head.to, head.from) == (OK, MailboxName::NOBODY, MailboxName::NOBODY);
    let mut answered = Figures::new()?;
    for _ in 0..rounds {
        let is_over = AtomicBool::new(false);
        thread::scope(|scope| {
            scope.spawn(|| sends(&mailbox, WAITING, &is_over));
            // Until the client's kernel takes no more.
            thread::sleep(BACKLOG);
            let asked = Instant::now();
            let round = router
                .write_all(&many)
                .map_err(Into::into)
                .and_then(|()| answered.until(&mut router, ours, asked, is_answer));
            is_over.store(true, Ordering::Relaxed);
            round
        })?;
    }
    Ok(json!({ "own": answered.shown() }))
}

/// Sends packages to a mailbox elsewhere, each once there is room for it, until that is over.
fn sends(mailbox: &Mailbox, packages: usize, is_over: &AtomicBool) {
    let mut sender = mailbox.sender(name(1)).expect("a mailbox elsewhere");
    for _ in 0..packages {
        while let Err(why) = sender.send(-6, &[0x55; 48]) {
            if is_over.load(Ordering::Relaxed) {
                return;
            }
            assert!(matches!(why, SendError::Mailbox(mailbox::SendError::Full(_))), "{why}");
            thread::sleep(Duration::from_micros(100));
        }
    }
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
            } else if head.kind == -6 {
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
