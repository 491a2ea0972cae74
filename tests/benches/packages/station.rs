//! A broker in a thread of its own, and how components find each other.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result};
use package_router::broker::Broker;
use package_router::component::{Component, Mailbox, Sender};
use package_router::mailbox::Shape;
use package_router::name::{Class, MailboxName};
use rtnet::live::clock::monotonic;
use tempfile::TempDir;

/// What does not come in that time does not come.
pub const PATIENCE: Duration = Duration::from_secs(2);
/// How often it looks whether it is over.
const LOOK_EVERY: Duration = Duration::from_millis(100);

pub struct Station {
    path: PathBuf,
    is_over: Arc<AtomicBool>,
    serves: Option<JoinHandle<()>>,
    _scratch: TempDir,
}

impl Station {
    pub fn new() -> Result<Self> {
        let scratch = TempDir::new()?;
        let path = scratch.path().join("station.packages");
        let mut broker = Broker::bind(&path)?;
        let is_over = Arc::new(AtomicBool::new(false));
        let over = is_over.clone();
        let serves = std::thread::spawn(move || {
            while !over.load(Ordering::Relaxed) {
                broker.serve(LOOK_EVERY);
            }
        });
        Ok(Self { path, is_over, serves: Some(serves), _scratch: scratch })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn place(&self) -> Result<&str> {
        self.path.to_str().context("a path that can be written")
    }
}

impl Drop for Station {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.serves.take().into_iter().for_each(|serves| drop(serves.join()));
    }
}

pub fn name(class: u8) -> MailboxName {
    MailboxName::new(0, Class(class), 1, 0)
}

/// A component's mailbox.
pub fn mailbox(place: &Path, name: MailboxName, shape: Shape) -> Result<Mailbox> {
    Ok(Component::attach(place)?.mailbox(name, shape)?)
}

/// A way between two, as soon as the other is there.
pub fn bound(mailbox: &Mailbox, to: MailboxName) -> Result<Sender> {
    let deadline = monotonic() + PATIENCE.as_nanos() as u64;
    loop {
        match mailbox.sender(to) {
            Err(_) if monotonic() < deadline => std::thread::sleep(Duration::from_millis(1)),
            told => return Ok(told?),
        }
    }
}
