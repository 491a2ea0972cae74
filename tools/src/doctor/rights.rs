//! What this process may do here, and what the kernel can. Every probe leaves nothing behind.

use std::fs::File;
use std::io;
use std::process::Command;

use nix::errno::Errno;
use nix::sched::{CloneFlags, unshare};
use nix::sys::socket::{AddressFamily, SockFlag, SockType, socket};
use nix::unistd::geteuid;
use rtnet::live::Guard;
use rtnet::live::rights::remedy;
use serde::Serialize;

use crate::lab::namespace::{Namespace, Segment};
use crate::lab::userns;
use crate::wakeups::on_core;

/// The hidden option of `rtnet doctor` with which it asks itself, as a process with one thread.
pub const PROBE_OPTION: &str = "--probe-user-namespace";
/// What labs are made of.
pub const NETWORK_NAMESPACES: &str = "network namespaces";
/// `lo`, in every network namespace.
const LOOPBACK: u32 = 1;

/// One thing that the host allows or not.
#[derive(Clone, Debug, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Right {
    /// What it is.
    pub name: &'static str,
    /// Whether it is there; none if that cannot be told.
    pub allowed: Option<bool>,
    /// Why not, or where not; and what can be done.
    pub note: Option<String>,
}

/// All of them.
#[derive(Clone, Debug, Default, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Rights {
    /// Of this process.
    pub process: Vec<Right>,
    /// Of the kernel, as far as this process can see.
    pub kernel: Vec<Right>,
}

/// How this process came to make network namespaces, or why it did not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Way {
    /// It is root.
    Root,
    /// It was an ordinary user's, and is in a user namespace of its own.
    UserNamespace,
    /// It can do neither.
    Refused(String),
}

impl Way {
    /// Goes the way that `lab run` goes: what it finds there is what a lab finds. To be called before there is a second
    /// thread.
    pub fn find() -> Self {
        let root = geteuid().is_root();
        match userns::gain_namespaces() {
            Ok(()) if root => Way::Root,
            Ok(()) => Way::UserNamespace,
            Err(error) => Way::Refused(format!("{error:#}")),
        }
    }
}

impl Rights {
    /// Tries everything, on this core.
    pub fn probe(cpu: usize, way: &Way) -> Self {
        let refused = on_core(cpu, || ()).1;
        let set_up = |name, prefix: &str| {
            let line = refused.iter().find(|line| line.starts_with(prefix));
            // What it is about stands before the colon.
            let why = line.map(|line| line.split_once(": ").map_or(&line[..], |(_, why)| why));
            Right { name, allowed: Some(line.is_none()), note: why.map(str::to_owned) }
        };
        let namespace = Namespace::new();
        let packet = packet_sockets(namespace.as_ref().ok());
        let namespace = namespace.map(drop).map_err(|error| match way {
            Way::Refused(why) => why.clone(),
            Way::Root | Way::UserNamespace => format!("{error:#}"),
        });
        // Without a namespace a refusal tells nothing of bridges and veth pairs.
        let bridge = namespace.is_ok().then(try_bridge);
        let veth = bridge.as_ref().is_some_and(Result::is_ok).then(try_veth);
        let guard = bridge.is_some().then(try_guard);
        let process = vec![
            set_up("SCHED_FIFO", "SCHED_FIFO"),
            set_up("locked memory", "mlockall"),
            set_up("timer slack 1ns", "timer slack"),
            packet,
            right(NETWORK_NAMESPACES, namespace),
            user_namespaces(way),
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
        self.has("SCHED_FIFO")
    }

    /// Whether labs can be had.
    pub fn labs(&self) -> bool {
        self.has(NETWORK_NAMESPACES)
    }

    fn has(&self, name: &str) -> bool {
        self.process.iter().any(|right| right.name == name && right.allowed == Some(true))
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
        None => Right {
            name,
            allowed: None,
            note: Some("needs a network namespace to try, which is not to be had here".into()),
        },
    }
}

/// Here, where a station of its own would run, and in a namespace of one's own, where a lab's do.
fn packet_sockets(namespace: Option<&Namespace>) -> Right {
    let name = "packet sockets";
    let open = || socket(AddressFamily::Packet, SockType::Raw, SockFlag::SOCK_CLOEXEC, None).map(drop);
    let Err(refused) = open() else { return Right { name, allowed: Some(true), note: None } };
    let remedy = format!("{refused}: {}", remedy(&["CAP_NET_RAW"]));
    match namespace.map(|namespace| namespace.run(open)) {
        Some(Ok(Ok(()))) => {
            let note = format!("in labs only; for a station on an interface of this host: {remedy}");
            Right { name, allowed: Some(true), note: Some(note) }
        }
        _ => Right { name, allowed: Some(false), note: Some(remedy) },
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
fn user_namespaces(way: &Way) -> Right {
    let name = "user namespaces";
    let tried = match way {
        // Who is in one sees its settings, which are not those that let it in.
        Way::UserNamespace => return Right { name, allowed: Some(true), note: None },
        Way::Refused(_) => Ok(false),
        Way::Root => try_user_namespace(),
    };
    let (allowed, note) = match (tried, userns::forbidden()) {
        (_, Some(why)) => (Some(false), Some(format!("for ordinary users: {why}"))),
        (Ok(true), None) => (Some(true), None),
        (Ok(false), None) => {
            let why = "refused, though no sysctl forbids it: a seccomp filter, a chroot or CONFIG_USER_NS";
            (Some(false), Some(why.into()))
        }
        (Err(error), None) => (None, Some(format!("not tried: {error}"))),
    };
    Right { name, allowed, note }
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
        assert!(unknown.note.is_some_and(|note| note.contains("needs a network namespace")));
    }

    #[test]
    fn who_is_in_a_user_namespace_has_them_and_who_was_refused_is_told_why() {
        let has = user_namespaces(&Way::UserNamespace);
        assert_eq!((has.allowed, has.note), (Some(true), None));
        let refused = user_namespaces(&Way::Refused("EPERM".into()));
        assert_eq!((refused.allowed, refused.note.is_some()), (Some(false), true));
    }
}
