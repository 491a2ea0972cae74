//! A router with clients that are a burden, compared with one without.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use anyhow::{Context, Result};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::{Value, json};

use crate::clients::{BATCH, Pairs, Trips, histogram, joined, shown};
use crate::protocols::{Ours, Protocol};

/// Connections that say nothing.
const SILENT: usize = 1_000;
/// Connections that begin a TLS session and go no further. A router keeps a few more of these (256), and closes the oldest for another.
const BEGUN: usize = 250;
/// The head of a TLS record of 512 bytes, and of the hello of a client within it.
const HELLO: [u8; 9] = [22, 3, 1, 2, 0, 1, 0, 1, 252];
/// The clients that are a burden, after all others.
const DEAF: u32 = 900_000;
/// Bytes for the client that does not read, before anything is measured: more than its queue and the kernel take.
const FILLS: usize = 16 << 20;
/// From one batch for it to the next: a thousand packages a second while it runs.
const BEAT: Duration = Duration::from_millis(64);
/// Beats of a second: a byte of the client that sends one a second, and a look at each silent connection.
const BEATS: usize = 16;
/// Senders that are measured at once, each with a receiver.
const PAIRS: u32 = 8;
/// A turn of a router: a host changes its speed little within two of them.
const WINDOW: Duration = Duration::from_millis(100);

/// Clients that are a burden, until they are killed: one is sent to and does not read, one sends a byte a second, a thousand say
/// nothing, 250 have begun a TLS session, and all these come again when the router has closed them.
pub fn burden(at: SocketAddr, by_tls: SocketAddr) -> Result<Value> {
    let begins = [(SILENT, at, &[][..]), (BEGUN, by_tls, &HELLO)];
    let begins = begins.into_iter().flat_map(|(count, at, says)| std::iter::repeat_n((at, says), count));
    let mut half_open =
        begins.map(|begin| Ok((begin, opened(begin)?))).collect::<Result<Vec<(Begin, TcpStream)>>>()?;
    let (_deaf, mut sender, mut slow) =
        (joined(&Ours, at, DEAF)?, joined(&Ours, at, DEAF + 1)?, joined(&Ours, at, DEAF + 2)?);
    let batch = Ours.package(DEAF, DEAF + 1).repeat(BATCH);
    let slowly = Ours.package(DEAF, DEAF + 2);
    for _ in 0..FILLS / batch.len() {
        sender.write_all(&batch)?;
    }
    println!("{}", json!({ "ready": true }));
    for beat in 0.. {
        sender.write_all(&batch)?;
        if beat % BEATS == 0 {
            slow.write_all(&slowly[beat / BEATS % slowly.len()..][..1])?;
        }
        for (begin, stream) in half_open.iter_mut().skip(beat % BEATS).step_by(BEATS) {
            // It has a question for a sign of life, or nothing, or it is closed.
            let has_ended = match stream.read(&mut [0; 64]) {
                Ok(length) => length == 0,
                Err(error) => error.kind() != ErrorKind::WouldBlock,
            };
            if has_ended {
                *stream = opened(*begin)?;
            }
        }
        std::thread::sleep(BEAT);
    }
    Ok(Value::Null)
}

/// A router, and all that a connection says to it.
type Begin = (SocketAddr, &'static [u8]);

fn opened((at, says): Begin) -> Result<TcpStream> {
    let mut stream = TcpStream::connect(at)?;
    stream.write_all(says)?;
    stream.set_nonblocking(true)?;
    Ok(stream)
}

/// A router and the clients that are its burden. They are stopped while the other router is measured, and so cost it nothing.
struct Burdened(Vec<Pid>);

impl Burdened {
    fn send(&self, signal: Signal) -> Result<()> {
        self.0.iter().try_for_each(|&pid| kill(pid, signal)).context("the router with burdens")
    }
}

impl Drop for Burdened {
    fn drop(&mut self) {
        let _ = self.send(Signal::SIGCONT);
    }
}

/// Packages a second and round trips by a router with burdens and by one without, in turns of 100 ms. `pids` are the first router and
/// its burdens.
pub fn compare(burdened: SocketAddr, free: SocketAddr, pids: &[&str], time: Duration) -> Result<Value> {
    let pids = pids.iter().map(|pid| Ok(Pid::from_raw(pid.parse()?))).collect::<Result<_>>()?;
    let processes = Burdened(pids);
    // An earlier comparison may have been killed.
    processes.send(Signal::SIGCONT)?;
    let mut rates = [Pairs::join(&Ours, burdened, PAIRS, false)?, Pairs::join(&Ours, free, PAIRS, false)?];
    let mut sums = [(0, 0.0); 2];
    in_turns(&processes, time, |at| {
        let (came, seconds) = rates[at].run(WINDOW)?;
        sums[at] = (sums[at].0 + came, sums[at].1 + seconds);
        Ok(())
    })?;
    drop(rates);
    let mut trips = [Trips::join(&Ours, burdened, 2)?, Trips::join(&Ours, free, 2)?];
    let mut times = [histogram()?, histogram()?];
    in_turns(&processes, time, |at| trips[at].run(WINDOW, &mut times[at]))?;
    let [with, without] = sums.map(|(came, seconds)| json!({ "rate": came as f64 / seconds, "n": came }));
    let rate = json!({ "with": with, "without": without });
    Ok(json!({ "rate": rate, "trips": { "with": shown(&times[0]), "without": shown(&times[1]) } }))
}

/// Measures both routers by turns; the one that comes first comes second the next time.
fn in_turns(burdened: &Burdened, time: Duration, mut measure: impl FnMut(usize) -> Result<()>) -> Result<()> {
    let turns = time.div_duration_f64(2 * WINDOW).ceil() as usize;
    for at in (0..turns).flat_map(|turn| [turn % 2, 1 - turn % 2]) {
        burdened.send(if at == 0 { Signal::SIGCONT } else { Signal::SIGSTOP })?;
        measure(at)?;
    }
    burdened.send(Signal::SIGCONT)
}
