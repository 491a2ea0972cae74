//! A station's part in packages: its broker and its TCP client, in threads of their own, and the router in the real-time thread, as far
//! as the station has an address.

use std::any::Any;
use std::io;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, anyhow};
use nix::errno::Errno;
use package_router::bells::Bell;
use package_router::broker::{Beyond, Broker};
use package_router::mailbox::{LaneSender, Layout};
use package_router::name::MailboxName;
use package_router::node::Node;
use package_router::priority::Priorities;
use package_router::registry::ROUTER;
use package_router::route::Routes;
use package_router::router::{Host, LAN_PORT, Router, Way};
use package_router::tcp::client::TcpOptions;
use rtnet::buf::Pool;
use rtnet::ip::{Exit, Stack};
use rtnet::live::Visitor;
use rtnet::live::clock::monotonic;
use rtnet::live::realtime::avoid;
use rtnet::live::sealed::Sealed;
use rtnet::room;
use rtnet::socket::Socket;

use super::sockets::Sockets;
use crate::remedy::explained;

/// Buffers for what comes by the LAN: two of the longest datagrams, and what comes meanwhile.
const BUFFERS: usize = 128;

/// What a station's packages are to be.
#[derive(Clone, Debug)]
pub struct PackagesOptions {
    /// Which stations have which mailboxes.
    pub routes: Routes,
    /// How urgent whose packages are.
    pub priorities: Priorities,
    /// The TCP router, if packages may go there.
    pub tcp: Option<TcpOptions>,
}

/// The router of a live station.
pub type LanRouter = Router<Sealed, Sealed>;
type LanWay = Box<Way<Sealed, Sealed>>;

/// The router, for a stack that is about to be made.
pub fn router(options: &PackagesOptions) -> Box<LanRouter> {
    let priorities = options.priorities.clone();
    Box::new(Router::new(Host { clock: monotonic, priorities }))
}

/// Where it hears.
pub fn listen(stack: &mut Stack) -> Result<()> {
    let socket = Socket::udp(Arc::new(Pool::with_room(BUFFERS, BUFFERS)));
    let socket = stack.open(socket).map_err(|(error, _)| anyhow!("no socket for packages: {error}"))?;
    stack.bind(socket, SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, LAN_PORT)).context("no port for packages")?;
    let router = stack.program_mut::<LanRouter>().context("no router for packages")?;
    router.reads(socket);
    Ok(())
}

/// Starts the broker of a station with this control socket; with sockets it has a way to others. Its threads run on any core but that of the
/// real-time thread: soft interrupts of what the TCP client sends run where it does.
pub fn start(
    options: PackagesOptions,
    control: &Path,
    sockets: Option<Arc<Sockets>>,
    not_on: Option<usize>,
) -> Result<Node> {
    let path = package_router::component::socket_of(control);
    let broker = Broker::bind(&path)
        .map_err(explained)
        .with_context(|| format!("the broker {} cannot be made", path.display()))?;
    let mut broker = broker.with_priorities(options.priorities);
    if let Some(sockets) = sockets {
        broker = broker.with_beyond(Box::new(Lan { sockets, routes: options.routes, gone: Vec::new() }));
    }
    // Threads begin on the cores of the one that starts them.
    let start = || {
        if let Some(core) = not_on {
            // Otherwise they run wherever they may.
            let _ = avoid(core);
        }
        Node::start(broker, &path, options.tcp.as_ref())
    };
    let started = std::thread::scope(|scope| scope.spawn(start).join());
    started.map_err(|_| anyhow!("the start of packages has panicked"))?.context("packages")
}

/// The way to and from other stations.
struct Lan {
    sockets: Arc<Sockets>,
    routes: Routes,
    /// Mailboxes that are gone, and that the real-time thread may not know of yet: nobody waits for it.
    gone: Vec<MailboxName>,
}

impl Beyond for Lan {
    fn created(
        &mut self,
        name: MailboxName,
        layout: &Layout,
        owner: OwnedFd,
        bell: Bell,
    ) -> io::Result<OwnedFd> {
        let own = Sealed::new(c"rtnet-router", layout.sender_words())?;
        let file = own.as_fd().try_clone_to_owned()?;
        let owner = Sealed::open(owner, layout.lane(ROUTER + 1))?;
        // The real-time thread goes there. Where no more may be locked it does so all the same, as to sockets' memory.
        let _ = own.lock().and_then(|()| owner.lock());
        let way = Way::new(name, LaneSender::new(own, owner, *layout, ROUTER), Box::new(move || bell.ring()));
        let change = self.visit(Some(way))?;
        // Which came back was not taken.
        change.brought.map_or(Ok(file), |_| Err(error(Errno::ENOSPC)))
    }

    fn deleted(&mut self, name: MailboxName) {
        self.gone.push(name);
    }

    fn tend(&mut self) {
        if !self.gone.is_empty() {
            // One that does not look now is asked again.
            let _ = self.visit(None);
        }
    }

    fn routes(&mut self) -> &mut Routes {
        &mut self.routes
    }
}

impl Lan {
    /// Has the real-time thread know what has come and gone.
    fn visit(&mut self, brought: Option<LanWay>) -> io::Result<Change> {
        let gone = self.gone.clone();
        let left = room::vec(gone.len() + 1);
        let change = Box::new(Change { gone, brought, left });
        let visitor = self.sockets.let_in(change).map_err(|_| error(Errno::ETIMEDOUT))?;
        self.gone.clear();
        let visitor: Box<dyn Any> = visitor;
        let change = visitor.downcast::<Change>();
        change.map(|change| *change).map_err(|_| io::Error::other("another visitor came back"))
    }
}

/// As a component is told.
fn error(errno: Errno) -> io::Error {
    io::Error::from_raw_os_error(errno as i32)
}

/// Mailboxes go, and one may come. What is replaced is freed where this is.
struct Change {
    gone: Vec<MailboxName>,
    brought: Option<LanWay>,
    left: Vec<LanWay>,
}

impl Visitor for Change {
    fn visit(&mut self, stack: &mut Stack, _exit: &mut dyn Exit) {
        let Some(router) = stack.program_mut::<LanRouter>() else { return };
        // There is room for all.
        self.left.extend(self.gone.iter().filter_map(|name| router.remove(*name)));
        if let Some(way) = self.brought.take() {
            // Whose a name is the broker knows.
            self.left.extend(router.remove(way.name()));
            self.brought = router.add(way).err();
        }
    }
}
