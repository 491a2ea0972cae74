//! A broker in a thread of its own, and the TCP client of its components, if there is a router.

use std::fs::DirBuilder;
use std::io::{self, ErrorKind};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Builder, JoinHandle};
use std::time::Duration;

use crate::broker::Broker;
use crate::component::Error;
use crate::tcp::client::{TcpClient, TcpOptions, TcpWatch};

/// Stack of the broker's thread.
const STACK: usize = 256 * 1024;
/// How often the broker's thread looks whether it is to end.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// A broker that runs, with its TCP client. Both end with this.
pub struct Node {
    // It asks the broker until it has ended.
    tcp: Option<TcpClient>,
    _broker: Running,
    _directory: Option<Directory>,
}

impl Node {
    /// Starts the threads of a broker that listens there.
    pub fn start(broker: Broker, path: &Path, tcp: Option<&TcpOptions>) -> Result<Self, Error> {
        let broker = if tcp.is_some() { broker.with_tcp() } else { broker };
        let running = Running::start(broker)?;
        let tcp = tcp.map(|options| TcpClient::start(path, options)).transpose()?;
        Ok(Self { tcp, _broker: running, _directory: None })
    }

    /// Starts a node for this process alone; returns the path of its broker, too.
    pub fn of_process(tcp: &TcpOptions) -> Result<(Self, PathBuf), Error> {
        let directory = Directory::new()?;
        let path = directory.0.join("node.packages");
        let node = Self::start(Broker::bind(&path)?, &path, Some(tcp))?;
        Ok((Self { _directory: Some(directory), ..node }, path))
    }

    /// A look at its TCP client, if it has one.
    pub fn tcp(&self) -> Option<TcpWatch> {
        self.tcp.as_ref().map(TcpClient::watch)
    }
}

/// The broker's thread.
struct Running {
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Running {
    fn start(mut broker: Broker) -> io::Result<Self> {
        let is_over = Arc::new(AtomicBool::new(false));
        let over = is_over.clone();
        let thread = Builder::new().name("packages".into()).stack_size(STACK).spawn(move || {
            while !over.load(Ordering::Relaxed) {
                broker.serve(LOOK_EVERY);
            }
        })?;
        Ok(Self { is_over, thread: Some(thread) })
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.thread.take().into_iter().for_each(|thread| drop(thread.join()));
    }
}

/// A directory of this user alone, removed when dropped.
struct Directory(PathBuf);

impl Directory {
    fn new() -> io::Result<Self> {
        let (all, id) = (std::env::temp_dir(), process::id());
        for number in 0..=u16::MAX {
            let path = all.join(format!("rtnet-packages-{id}-{number}"));
            match DirBuilder::new().mode(0o700).create(&path) {
                Ok(()) => return Ok(Self(path)),
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
            }
        }
        Err(ErrorKind::AlreadyExists.into())
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        // Its socket went with the broker.
        let _ = std::fs::remove_dir(&self.0);
    }
}
