//! Network namespaces without names, and the medium that joins them.
//!
//! ```text
//!   station a            segment             station b
//!  +---------+     +-------------------+     +---------+
//!  |    rt0 ========= a     br0     b ========= rt0    |
//!  +---------+     +-------------------+     +---------+
//! ```
//!
//! Nothing is entered in `/run/netns`: a namespace lives as long as a handle, a socket or a process
//! in it. So a lab leaves nothing behind, even if every process of it is killed.

#![allow(clippy::disallowed_methods)] // waits for the kernel to bring a wire up

use std::fs::{self, File};
use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};
use std::panic::resume_unwind;
use std::path::PathBuf;
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail, ensure};
use nix::errno::Errno;
use nix::sched::{CloneFlags, setns, unshare};
use nix::sys::stat::fstat;
use pnet_datalink::MacAddr;
use rtnet::live::rights;

use super::netlink::Netlink;
use crate::remedy::explained;

/// Without these the kernel would send router solicitations and the like into the stations' time
/// slots.
const SILENCE: [&str; 2] =
    ["/proc/sys/net/ipv6/conf/all/disable_ipv6", "/proc/sys/net/ipv6/conf/default/disable_ipv6"];

/// `lo` is the first interface of every namespace.
const LOOPBACK: u32 = 1;

const BRIDGE: &str = "br0";

/// How often, a millisecond apart, to look whether a new wire is up. Mostly once is enough.
const WIRE_UP_TRIES: usize = 2000;

/// An anonymous network namespace, with `lo` up and IPv6 off.
#[derive(Debug)]
pub struct Namespace {
    fd: OwnedFd,
}

impl Namespace {
    /// Makes a namespace. The calling thread stays where it is.
    ///
    /// # Errors
    /// The process lacks CAP_SYS_ADMIN, or the kernel refuses for another reason.
    pub fn new() -> Result<Self> {
        // unshare(2) moves the calling thread only, here one that ends with the closure.
        on_helper_thread(|| {
            unshare(CloneFlags::CLONE_NEWNET).map_err(refusal)?;
            let file = File::open("/proc/thread-self/ns/net")
                .map_err(explained)
                .context("cannot open the new network namespace at /proc/thread-self/ns/net: mount /proc")?;
            for setting in SILENCE {
                match fs::write(setting, "1") {
                    // A kernel without IPv6.
                    Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                    outcome => outcome
                        .with_context(|| format!("cannot turn IPv6 off: {setting} must be writable"))?,
                }
            }
            Netlink::open()?.set_up(LOOPBACK).context("cannot bring up `lo` of the new network namespace")?;
            Ok(Self { fd: file.into() })
        })?
    }

    /// Runs `f` on a thread of its own that has entered the namespace, and waits for its result.
    ///
    /// Sockets opened and processes started by `f` belong to the namespace and stay in it after `f`
    /// has returned. A process that asked for a signal at its parent's death (PR_SET_PDEATHSIG)
    /// gets it when `f` returns, because the kernel takes the *thread* for the parent. A panic of
    /// `f` goes on in the caller.
    ///
    /// # Errors
    /// The process lacks CAP_SYS_ADMIN, or no thread can be started.
    pub fn run<R: Send>(&self, f: impl FnOnce() -> R + Send) -> Result<R> {
        on_helper_thread(|| {
            setns(&self.fd, CloneFlags::CLONE_NEWNET).with_context(|| {
                format!("cannot enter a network namespace: {}", rights::remedy(&["CAP_SYS_ADMIN"]))
            })?;
            Ok(f())
        })?
    }

    /// A conversation with the kernel about the links of this namespace, from whatever thread.
    ///
    /// # Errors
    /// The namespace cannot be entered, or the kernel gives no netlink socket.
    pub fn netlink(&self) -> Result<Netlink> {
        self.run(Netlink::open)?
    }

    /// Where other processes of this user find it.
    pub fn path(&self) -> PathBuf {
        format!("/proc/{}/fd/{}", std::process::id(), self.fd.as_raw_fd()).into()
    }

    /// By what number the kernel knows it, as long as it exists.
    ///
    /// # Errors
    /// The kernel does not tell.
    pub fn number(&self) -> Result<u64> {
        Ok(fstat(&self.fd).context("cannot look at a network namespace")?.st_ino)
    }

    /// The namespace as a file, for setns(2) and netlink requests. Closed on exec.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

/// A shared medium in a namespace of its own: a bridge that knows its stations beforehand.
///
/// Broadcasts reach every station, other frames their addressee only, from the first frame on and
/// the same in every run: the bridge neither learns nor ages.
pub struct Segment {
    namespace: Namespace,
    netlink: Netlink,
    bridge: u32,
}

impl Segment {
    /// Makes a medium to which no station is attached.
    ///
    /// # Errors
    /// As [`Namespace::new`]; or the kernel has no bridges.
    pub fn new() -> Result<Self> {
        let namespace = Namespace::new().context("cannot make a segment")?;
        let mut netlink = namespace.netlink()?;
        netlink.add_bridge(BRIDGE)?;
        let bridge = netlink.link_index(BRIDGE)?;
        netlink.set_up(bridge).context("cannot make a segment")?;
        Ok(Self { namespace, netlink, bridge })
    }

    /// Wires a station to the medium: `interface`, with this MAC, in the station's namespace;
    /// `port_name` here.
    ///
    /// On return both ends are up and the bridge forwards: the first frame sent is not lost.
    ///
    /// # Errors
    /// A name is too long or taken, the MAC is not that of a single station or belongs to another
    /// station of the segment, or the wire does not come up within two seconds. Then nothing is
    /// left of the wire.
    pub fn attach(
        &mut self,
        station: &Namespace,
        port_name: &str,
        interface: &str,
        mac: [u8; 6],
    ) -> Result<()> {
        let context =
            || format!("cannot attach `{interface}` ({}) at port `{port_name}`", MacAddr::from(mac));
        self.netlink.add_veth(port_name, self.bridge, interface, mac, station.fd()).with_context(context)?;
        let wired = self.wire(station, port_name, interface, mac).with_context(context);
        if wired.is_err() {
            // The first error is the one to report.
            let _ = self.detach(port_name);
        }
        wired
    }

    /// Cuts the wire at this port: the port and the interface of the station cease to exist.
    ///
    /// # Errors
    /// The segment has no such port.
    pub fn detach(&mut self, port_name: &str) -> Result<()> {
        let port = self.netlink.link(port_name).context("cannot detach a station")?;
        ensure!(port.bridge == Some(self.bridge), "`{port_name}` is not a port of the segment");
        self.netlink.delete_link(port.index).with_context(|| format!("cannot detach port `{port_name}`"))
    }

    /// Name of the bridge in the segment's namespace; a capture there sees what is broadcast.
    pub fn bridge_name(&self) -> &str {
        BRIDGE
    }

    /// The namespace of the medium itself, in which the ports are.
    pub fn namespace(&self) -> &Namespace {
        &self.namespace
    }

    fn wire(&mut self, station: &Namespace, port_name: &str, interface: &str, mac: [u8; 6]) -> Result<()> {
        let port = self.netlink.link_index(port_name)?;
        self.netlink.disable_learning(port)?;
        self.netlink.add_static_fdb(port, mac)?;
        self.netlink.set_up(port)?;
        let mut far = station.netlink()?;
        let index = far.link_index(interface)?;
        far.set_up(index)?;
        // The kernel may make a carrier effective later, from a work queue, and drop frames till then.
        for _ in 0..WIRE_UP_TRIES {
            if self.netlink.link(port_name)?.forwarding && far.link(interface)?.operational {
                return Ok(());
            }
            thread::sleep(Duration::from_millis(1));
        }
        bail!("the wire was not up after two seconds: run again when the machine is less busy")
    }
}

/// Runs `f` on a thread of its own, as unshare(2) and setns(2) must never move a thread that others
/// rely on.
fn on_helper_thread<R: Send>(f: impl FnOnce() -> R + Send) -> Result<R> {
    thread::scope(|scope| {
        let helper = thread::Builder::new()
            .name("netns".into())
            .spawn_scoped(scope, f)
            .map_err(explained)
            .context("cannot start a thread to enter a network namespace")?;
        Ok(helper.join().unwrap_or_else(|panic| resume_unwind(panic)))
    })
}

fn refusal(errno: Errno) -> anyhow::Error {
    let remedy = match errno {
        Errno::EPERM => {
            let remedy =
                super::userns::forbidden().map_or_else(|| rights::remedy(&["CAP_SYS_ADMIN"]), Into::into);
            return anyhow!(errno).context(format!("a network namespace cannot be made: {remedy}"));
        }
        Errno::ENOSPC => "no more network namespaces allowed: raise the sysctl user.max_net_namespaces",
        Errno::EINVAL => "the kernel must have CONFIG_NET_NS",
        _ => "cannot make a network namespace",
    };
    anyhow!(errno).context(remedy)
}

#[cfg(test)]
mod tests;
