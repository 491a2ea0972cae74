//! Where Linux has the station's own address it must not hear the station's interface: every packet would reach it twice,
//! those for real-time sockets, too, and it would answer echoes and questions for the address beside the station's slots.

use std::fs;
use std::io;
use std::path::PathBuf;

/// What the kernel asks before it takes something that came by an interface: whether the way back is the same (it never is:
/// Linux has no address there), and whether the address that is asked for is one of that interface's.
const ASKED: [&str; 2] = ["rp_filter", "arp_ignore"];
const NO: &str = "0";
const YES: &str = "1";

/// Linux takes no packet of IPv4 from an interface, and answers no question for an address there, until this is dropped.
#[derive(Debug)]
pub struct Aside {
    changed: Vec<PathBuf>,
}

impl Aside {
    /// Stands aside at an interface of the calling thread's network namespace. What was set so by somebody stays.
    pub fn at(interface: &str) -> io::Result<Self> {
        let mut aside = Self { changed: Vec::new() };
        for name in ASKED {
            let path = PathBuf::from(format!("/proc/sys/net/ipv4/conf/{interface}/{name}"));
            if fs::read_to_string(&path)?.trim() == NO {
                fs::write(&path, YES)?;
                aside.changed.push(path);
            }
        }
        Ok(aside)
    }
}

impl Drop for Aside {
    fn drop(&mut self) {
        for path in &self.changed {
            // An interface that is gone has nothing to be set.
            let _ = fs::write(path, NO);
        }
    }
}
