//! What became of a request that the kernel did not grant.

use std::io;

use nix::errno::Errno;
use rtnet::live::rights;

/// What was asked of the kernel and did not come about: one line, `cannot WHAT: SAID: REMEDY`, and the errno as the source.
#[derive(Debug, thiserror::Error)]
#[error("cannot {what}{}{}", after_colon(.said), after_colon(.remedy))]
pub struct Refused {
    /// What was wanted, after "cannot".
    pub what: String,
    /// What the kernel said in words, or where the conversation with it broke off.
    pub said: Option<String>,
    /// What helps, where it is known.
    pub remedy: Option<String>,
    /// The kernel's errno, or what could not be understood of its answer.
    pub source: Option<io::Error>,
}

impl Refused {
    /// By its errno, if it is one of those that a remedy is known for, or that always have the same.
    pub(super) fn because(
        what: &str,
        said: Option<String>,
        errno: Errno,
        remedies: &[(Errno, &str)],
    ) -> Self {
        let remedy = match remedies.iter().find(|(code, _)| *code == errno) {
            Some((_, remedy)) => Some((*remedy).to_owned()),
            None if errno == Errno::EPERM => Some(rights::remedy(&["CAP_NET_ADMIN"])),
            None if errno == Errno::ENODEV => Some("no such interface in the namespace".to_owned()),
            None => None,
        };
        Self { what: what.to_owned(), said, remedy, source: Some(errno.into()) }
    }

    /// The conversation broke off.
    pub(super) fn broken(what: &str, said: &str, source: Option<io::Error>) -> Self {
        Self { what: what.to_owned(), said: Some(said.to_owned()), remedy: None, source }
    }

    /// The same in words of who knows the device with this number by a name.
    pub fn naming(mut self, index: u32, name: &str) -> Self {
        let number = format!("interface #{index}");
        // Not of one whose number begins alike.
        if let Some((before, after)) = self.what.split_once(&number)
            && !after.starts_with(|c: char| c.is_ascii_digit())
        {
            self.what = format!("{before}'{name}'{after}");
        }
        self
    }

    /// The kernel's errno, if it gave one.
    pub fn errno(&self) -> Option<Errno> {
        self.source.as_ref()?.raw_os_error().map(Errno::from_raw)
    }

    /// Whether the kernel was built without what was wanted: it does not know the request (EOPNOTSUPP), or the queueing
    /// discipline (ENOENT).
    pub fn is_unsupported(&self) -> bool {
        matches!(self.errno(), Some(Errno::EOPNOTSUPP | Errno::ENOENT))
    }
}

fn after_colon(reason: &Option<String>) -> String {
    reason.as_ref().map_or_else(String::new, |reason| format!(": {reason}"))
}
