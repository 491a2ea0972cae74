//! Mailboxes of several components of a station, each a process, or as good as one: they have nothing in common but the broker.

// Components need real time.
#![allow(clippy::disallowed_methods)]

mod exchange;
mod killed;
mod lan;
mod model;
mod rpc;
mod tcp;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use package_router::broker::Broker;
use package_router::component::{Component, Mailbox, Sender};
use package_router::mailbox::Shape;
use package_router::name::{Class, MailboxName};

/// As long as anything may take on a host that has other things to do.
const PATIENCE: Duration = Duration::from_secs(20);

/// A broker in a thread of its own.
struct Station {
    path: PathBuf,
    is_over: Arc<AtomicBool>,
    serves: Option<JoinHandle<()>>,
    _dir: tempfile::TempDir,
}

impl Station {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("station.packages");
        let mut broker = Broker::bind(&path).unwrap();
        let is_over = Arc::new(AtomicBool::new(false));
        let over = is_over.clone();
        let serves = thread::spawn(move || {
            while !over.load(Ordering::Relaxed) {
                broker.serve(Duration::from_millis(20));
            }
        });
        Self { path, is_over, serves: Some(serves), _dir: dir }
    }

    fn attach(&self) -> Component {
        Component::attach(&self.path).unwrap()
    }

    fn end(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.serves.take().into_iter().for_each(|serves| serves.join().unwrap());
    }
}

impl Drop for Station {
    fn drop(&mut self) {
        self.end();
    }
}

fn name(class: u8, instance: u8) -> MailboxName {
    MailboxName::new(0, Class(class), instance, 0)
}

/// A component with one mailbox.
fn component(at: &Path, name: MailboxName, shape: Shape) -> (Component, Mailbox) {
    let component = Component::attach(at).unwrap();
    let mailbox = component.mailbox(name, shape).unwrap();
    (component, mailbox)
}

/// A way between two, as soon as the other is there.
fn bound(mailbox: &Mailbox, to: MailboxName) -> Sender {
    let deadline = std::time::Instant::now() + PATIENCE;
    loop {
        match mailbox.sender(to) {
            Ok(sender) => return sender,
            Err(error) if std::time::Instant::now() > deadline => panic!("{error}"),
            Err(_) => thread::sleep(Duration::from_millis(1)),
        }
    }
}
