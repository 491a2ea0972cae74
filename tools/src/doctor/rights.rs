//! What this process may do here, and what the kernel can. Every probe leaves nothing behind.

use std::fs::File;
use std::io;
use std::process::Command;

use nix::errno::Errno;
use nix::sched::{CloneFlags, unshare};
use nix::sys::socket::{AddressFamily, SockFlag, SockType, socket};
use rtnet::live::Guard;
use serde::Serialize;

use super::on_core;
use crate::lab::namespace::{Namespace, Segment};
use crate::lab::userns;

/// The hidden option of `rtnet doctor` with which it asks itself, as a process with one thread.
pub const PROBE_OPTION: &str = "--probe-user-namespace";
/// `lo`, in every network namespace.
const LOOPBACK: u32 = 1;

/// One thing that the host allows or not.
#[derive(Clone, Debug, Serialize)]
pub struct Right {
    /// What it is.
    pub name: &'static str,
    /// Whether it is there; none if that cannot be told.
    pub allowed: Option<bool>,
    /// Why not, or what limits it; and what can be done.
    pub note: Option<String>,
}

/// All of them.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Rights {
    /// Of this process.
    pub process: Vec<Right>,
    /// Of the kernel, as far as this process can see.
    pub kernel: Vec<Right>,
}

impl Rights {
    /// Tries everything, on this core.
    pub fn probe(cpu: usize) -> Self {
        let refused = on_core(cpu, || ()).1;
        let set_up = |name, prefix: &str| {
            let line = refused.iter().find(|line| line.starts_with(prefix));
            // What it is about stands before the colon.
            let why = line.map(|line| line.split_once(": ").map_or(&line[..], |(_, why)| why));
            Right { name, allowed: Some(line.is_none()), note: why.map(str::to_owned) }
        };
        let packet = socket(AddressFamily::Packet, SockType::Raw, SockFlag::SOCK_CLOEXEC, None);
        let namespace = Namespace::new().map(drop);
        // Without a namespace a refusal tells nothing of bridges and veth pairs.
        let bridge = namespace.is_ok().then(try_bridge);
        let veth = bridge.as_ref().is_some_and(Result::is_ok).then(try_veth);
        let guard = bridge.is_some().then(try_guard);
        let process = vec![
            set_up("SCHED_FIFO", "SCHED_FIFO"),
            set_up("locked memory", "mlockall"),
            set_up("timer slack 1ns", "timer slack"),
            right(
                "packet sockets",
                packet.map(drop).map_err(|e| format!("{e}: give CAP_NET_RAW, or run as root")),
            ),
            right("network namespaces", namespace.map_err(|error| format!("{error:#}"))),
            user_namespaces(),
        ];
        let kernel = vec![
            kernel_part("bridge", bridge),
            kernel_part("veth", veth),
            right("tun device", tun()),
            kernel_part("kernel guard", guard),
        ];
        Self { process, kernel }
    }

    /// Whether real-time threads can be had.
    pub fn fifo(&self) -> bool {
        self.process.iter().any(|right| right.name == "SCHED_FIFO" && right.allowed == Some(true))
    }
}

/// What the process of [`PROBE_OPTION`] does: it enters a user namespace, as a lab of an ordinary user
/// would, and ends. Unlike any thread, a process with one thread may.
pub fn enter_user_namespace() -> Result<(), Errno> {
    unshare(CloneFlags::CLONE_NEWUSER | CloneFlags::CLONE_NEWNET)
}

fn right<E: ToString>(name: &'static str, tried: Result<(), E>) -> Right {
    let note = tried.err().map(|error| error.to_string());
    Right { name, allowed: Some(note.is_none()), note }
}

fn kernel_part(name: &'static str, tried: Option<Result<(), String>>) -> Right {
    match tried {
        Some(tried) => right(name, tried),
        None => {
            Right { name, allowed: None, note: Some("needs a network namespace to try: run as root".into()) }
        }
    }
}

/// A bridge in a namespace of its own.
fn try_bridge() -> Result<(), String> {
    Segment::new().map(drop).map_err(|error| format!("{error:#}"))
}

/// A station's wire to it.
fn try_veth() -> Result<(), String> {
    let wired = || Segment::new()?.attach(&Namespace::new()?, "a", "rt0", [2, 0, 0, 0, 0, 1]);
    wired().map_err(|error| format!("{error:#}"))
}

/// The program that a station loads at its interface's egress, at `lo` of a namespace of its own.
fn try_guard() -> Result<(), String> {
    let attached = Namespace::new().and_then(|namespace| namespace.run(|| Guard::attach(LOOPBACK).map(drop)));
    let refused = attached.map_err(|error| format!("{error:#}"))?;
    refused.map_err(|refused| format!("{refused}: {}", refused.remedy()))
}

fn tun() -> Result<(), String> {
    let path = "/dev/net/tun";
    let opened = File::options().read(true).write(true).open(path);
    opened.map(drop).map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => format!("no {path}: load the kernel's module `tun`"),
        _ => format!("{path}: {error}: give read and write access to it, or run as root"),
    })
}

/// Whether an ordinary user could make namespaces, and what forbids it.
fn user_namespaces() -> Right {
    let name = "user namespaces";
    match (try_user_namespace(), userns::forbidden()) {
        (_, Some(why)) => {
            Right { name, allowed: Some(false), note: Some(format!("for ordinary users: {why}")) }
        }
        (Ok(true), None) => Right { name, allowed: Some(true), note: None },
        (Ok(false), None) => Right {
            name,
            allowed: Some(false),
            note: Some(
                "refused, though no sysctl forbids it: a seccomp filter, a chroot or CONFIG_USER_NS".into(),
            ),
        },
        (Err(error), None) => Right { name, allowed: None, note: Some(format!("not tried: {error}")) },
    }
}

fn try_user_namespace() -> io::Result<bool> {
    let status = Command::new(std::env::current_exe()?).args(["doctor", PROBE_OPTION]).status()?;
    match status.code() {
        Some(0) => Ok(true),
        Some(1) => Ok(false),
        _ => Err(io::Error::other(format!("the probe ended with {status}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_says_what_to_do() {
        let unknown = kernel_part("veth", None);
        assert_eq!(unknown.allowed, None, "a kernel that was not asked may have it");
        assert!(unknown.note.is_some_and(|note| note.contains("run as root")));
    }
}
