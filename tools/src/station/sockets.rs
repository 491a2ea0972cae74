//! What the control thread asks a station's stack, by visitors.

use std::any::Any;
use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use package_router::router::RouterCounters;
use rtnet::api::line::{LineCounters, Lines};
use rtnet::buf::{Pool, PoolStatistics};
use rtnet::counters::{Refusal, Refusals};
use rtnet::discipline::SendError;
use rtnet::ip::route::{Hop, HostRoute, Interface, Network, NetworkRoute, Origin, RouteError};
use rtnet::ip::{Exit, PoolStatus, Stack, StackCounters};
use rtnet::live::{Driver, Errand, Visitor, Visits};
use rtnet::room;
use rtnet::socket::{SocketCounters, SocketId};
use rtnet::wire::ethernet::{Address, MTU};

use super::access::Access;
use super::desk::{ANSWER_WITHIN, LOOK_EVERY};
use super::packages::LanRouter;
use super::stack::add;
use crate::control::{
    ChannelShown, CountersShown, HostShown, InterfaceShown, NetworkShown, PoolShown, RouteSaid, RoutesShown,
    StackReply, StackRequest, Way,
};

/// The way of other threads to the sockets.
pub struct Sockets {
    visits: Arc<Visits>,
    /// Threads that ask do so one after the other.
    turn: Mutex<()>,
    receive: Arc<Pool>,
    /// What there can be of sockets and routes, if there are any: visitors bring room for that.
    room: Option<Room>,
}

/// How much there can be.
#[derive(Clone, Copy)]
pub struct Room {
    /// Sockets.
    pub sockets: usize,
    /// Host routes.
    pub hosts: usize,
    /// Network routes.
    pub networks: usize,
}

/// A visitor that does one thing with what it brings.
struct Look<T> {
    brought: T,
    does: fn(&mut T, &mut Stack, &mut dyn Exit),
}

impl<T: Send + 'static> Visitor for Look<T> {
    fn visit(&mut self, stack: &mut Stack, exit: &mut dyn Exit) {
        (self.does)(&mut self.brought, stack, exit);
    }
}

/// A socket as a visitor finds it.
struct Found {
    id: SocketId,
    /// Where one of UDP's hears.
    hears: Option<SocketAddrV4>,
    /// To be counted where that may take long.
    pool: Arc<Pool>,
    counters: SocketCounters,
}

impl Found {
    fn name(&self) -> String {
        let number = || format!("{:?}", self.id).replace("SocketId", "packet ");
        self.hears.map_or_else(number, |hears| format!("udp {hears}"))
    }
}

impl Sockets {
    /// To those of this driver's station.
    pub fn new(driver: &Driver<Access>, room: Option<Room>) -> Self {
        Self { visits: driver.visits(), turn: Mutex::new(()), receive: driver.receive_pool(), room }
    }

    /// Answers what needs nothing but the stack.
    pub fn answer(&self, request: StackRequest) -> Result<StackReply, String> {
        match request {
            StackRequest::Routes => self.routes().map(StackReply::Routes),
            StackRequest::AddRoutes(routes) => self.add(&routes),
            StackRequest::DeleteRoute(network) => {
                let network: Network = network.parse().map_err(text)?;
                let deleted =
                    self.change(network, |network, stack, _| stack.routes_mut().delete(*network))?;
                deleted.map(|()| StackReply::Done).map_err(text)
            }
            StackRequest::Solicit(ip) => {
                let asked = self.change(ip, |ip, stack, exit| stack.solicit(*ip, exit))?;
                asked.map(|()| StackReply::Done).map_err(text)
            }
            StackRequest::Lookup(ip) => self.lookup(ip).map(StackReply::Way),
            StackRequest::EchoesLeft(round) => {
                let left = self.change(round, |round, stack, _| stack.echoes_left(*round))?;
                Ok(StackReply::EchoesLeft(left))
            }
            StackRequest::Interface
            | StackRequest::Pools
            | StackRequest::Counters
            | StackRequest::Echo(_)
            | StackRequest::Echoes(_) => Err("this is for the desk to say".into()),
        }
    }

    /// Its place in the Internet Protocol, as far as the stack knows it, and what those of these channels take that
    /// there are.
    pub fn interface(&self, channels: &[u8]) -> Result<InterfaceShown, String> {
        type Limits = Vec<(u8, Option<Result<usize, SendError>>)>;
        let limits: Limits = channels.iter().map(|&channel| (channel, None)).collect();
        let brought: (Option<Interface>, Limits) = (None, limits);
        let (own, limits) = self.visit(brought, |(own, limits), stack, exit| {
            *own = Some(*stack.routes().own());
            for (channel, limit) in limits {
                *limit = Some(exit.limit(*channel));
            }
        })?;
        let own = own.ok_or("it has not looked")?;
        let channels = limits.into_iter().filter_map(|(channel, limit)| {
            let payload = limit?.ok()?;
            Some((channel, ChannelShown { payload }))
        });
        Ok(InterfaceShown {
            name: String::new(),
            interface: String::new(),
            address: own.address.to_string(),
            ip: own.ip,
            prefix: own.prefix,
            broadcast: own.broadcast(),
            link: String::new(),
            mtu: MTU,
            channels: channels.collect(),
            discipline: String::new(),
            silent: None,
            counters: BTreeMap::new(),
        })
    }

    /// Everything that the stack counts.
    pub fn counters(&self) -> Result<CountersShown, String> {
        let brought = (None, None, None, room::vec(self.room()?.sockets));
        let (counters, lines, router, sockets) =
            self.visit(brought, |(counters, lines, router, sockets), stack, _| {
                *counters = Some(stack.counters());
                *lines = stack.program_mut::<Lines>().map(|lines| lines.counters());
                *router = stack.program_mut::<LanRouter>().map(|router| router.counters());
                find_sockets(stack, sockets);
            })?;
        let counters: StackCounters = counters.ok_or("it has not looked")?;
        Ok(CountersShown {
            programs: lines.map(of_programs).unwrap_or_default(),
            packages: router.map(of_router),
            stack: of_stack(&counters),
            loopback: by_reason(&counters.loopback),
            sockets: sockets.iter().map(|found| (found.name(), of_socket(&found.counters))).collect(),
            ..CountersShown::default()
        })
    }

    fn routes(&self) -> Result<RoutesShown, String> {
        let room = self.room()?;
        let brought = (None, room::vec(room.hosts), room::vec(room.networks));
        let (own, hosts, networks) = self.visit(brought, |(own, hosts, networks), stack, _| {
            let routes = stack.routes();
            *own = Some(*routes.own());
            hosts.extend_from_slice(routes.hosts());
            networks.extend_from_slice(routes.networks());
        })?;
        let own: Interface = own.ok_or("it has not looked")?;
        Ok(RoutesShown {
            ip: own.ip,
            prefix: own.prefix,
            hosts: hosts.iter().map(host_shown).collect(),
            hosts_at_most: room.hosts,
            networks: networks.iter().map(network_shown).collect(),
            networks_at_most: room.networks,
        })
    }

    fn add(&self, said: &[RouteSaid]) -> Result<StackReply, String> {
        let routes = said.iter().map(parse).collect::<Result<Vec<Route>, String>>()?;
        let add = |routes: &mut Vec<Route>, stack: &mut Stack, _: &mut dyn Exit| {
            routes.iter().try_for_each(|route| add(stack.routes_mut(), route))
        };
        let added: Result<(), RouteError> = self.change(routes, add)?;
        added.map(|()| StackReply::Done).map_err(text)
    }

    fn lookup(&self, ip: Ipv4Addr) -> Result<Way, String> {
        let brought = (ip, None, None, false);
        let (_, hop, via, is_awaited) = self.visit(brought, |(ip, hop, via, is_awaited), stack, _| {
            let routes = stack.routes();
            *hop = routes.lookup(*ip);
            if !routes.is_direct(*ip) {
                *via = routes.networks().iter().find(|route| route.network.contains(*ip)).copied();
            }
            *is_awaited = stack.is_asked_for(*ip);
        })?;
        let via: Option<NetworkRoute> = via;
        let address = hop.map(|hop| match hop {
            Hop::Loopback => "loopback".to_owned(),
            Hop::Medium(address) => address.to_string(),
        });
        Ok(Way { ip, address, via: via.map(|route| route.gateway), is_awaited })
    }

    /// Whether there can be any.
    pub fn are_there(&self) -> bool {
        self.room.is_some()
    }

    /// The pools below the stack, also where there is none. Frames that found no buffer wait in the kernel, so that what is
    /// lost is what found no room there.
    pub fn pools_below(&self, lost: u64, control: Option<PoolStatistics>) -> Vec<PoolShown> {
        let control =
            control.map(|statistics| PoolShown::new("control".into(), statistics, statistics.exhausted));
        let receive = PoolShown::new("receive".into(), self.receive.statistics(), lost);
        [receive].into_iter().chain(control).collect()
    }

    /// Those of the stack and of its sockets.
    pub fn pools(&self) -> Result<Vec<PoolShown>, String> {
        let brought: (Option<[PoolStatus; 2]>, _) = (None, room::vec(self.room()?.sockets));
        let (own, sockets) = self.visit(brought, |(own, sockets), stack, _| {
            *own = Some(stack.pools());
            find_sockets(stack, sockets);
        })?;
        let own = own.into_iter().flatten().map(|PoolStatus { name, statistics }| {
            PoolShown::new(name.to_owned(), statistics, statistics.exhausted)
        });
        let of_sockets = sockets.iter().map(|found| {
            let lost = found.counters.dropped + found.counters.no_buffers;
            PoolShown::new(found.name(), found.pool.statistics(), lost)
        });
        Ok(own.chain(of_sockets).collect())
    }

    fn room(&self) -> Result<Room, String> {
        self.room.ok_or_else(|| rtnet::live::NoSockets.to_string())
    }

    /// Does something to the stack; with what comes of it.
    fn change<T: Send + 'static, R: Send + 'static>(
        &self,
        brought: T,
        does: fn(&mut T, &mut Stack, &mut dyn Exit) -> R,
    ) -> Result<R, String> {
        let (.., result) = self.visit((brought, does, None), |(brought, does, result), stack, exit| {
            *result = Some(does(brought, stack, exit));
        })?;
        result.ok_or("it has not looked".into())
    }

    /// Does something with what is brought, in the station's thread.
    fn visit<T: Send + 'static>(
        &self,
        brought: T,
        does: fn(&mut T, &mut Stack, &mut dyn Exit),
    ) -> Result<T, String> {
        self.room()?;
        let visitor: Box<dyn Any> = self.let_in(Box::new(Look { brought, does })).map_err(|(why, _)| why)?;
        let look = visitor.downcast::<Look<T>>().map_err(|_| "another visitor came back")?;
        Ok(look.brought)
    }

    /// Sends a visitor, and waits for it. One that has not been let in by then is taken back.
    pub(super) fn let_in(&self, visitor: Box<dyn Visitor>) -> Result<Box<dyn Visitor>, NotLetIn> {
        // One at a time: what comes back is whose turn it is.
        let _turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        if let Err(visitor) = self.visits.send(visitor) {
            let why = "what was asked of its sockets before is not answered yet: ask again";
            return Err((why.into(), Some(visitor)));
        }
        let deadline = Instant::now() + ANSWER_WITHIN;
        loop {
            std::thread::sleep(LOOK_EVERY);
            if let Some(Errand { command, result }) = self.visits.take() {
                return match result {
                    Some(Err(refused)) => Err((refused.to_string(), Some(command))),
                    _ => Ok(command),
                };
            }
            if Instant::now() >= deadline
                && let Some(visitor) = self.visits.take_back()
            {
                let within: Duration = ANSWER_WITHIN;
                let why = format!(
                    "nothing is changed: the real-time thread has not looked at it within {}ms; ask again",
                    within.as_millis()
                );
                return Err((why, Some(visitor)));
            }
            if Arc::strong_count(&self.visits) == 1 {
                return Err(("its real-time thread has ended".into(), None));
            }
        }
    }
}

/// Why not, and who was not let in, unless it is lost.
pub(super) type NotLetIn = (String, Option<Box<dyn Visitor>>);

/// A route that was said by hand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Route {
    /// To a station on the medium.
    Host(HostRoute),
    /// To a network behind one.
    Network(NetworkRoute),
}

/// A route as the stack takes it.
pub fn parse(said: &RouteSaid) -> Result<Route, String> {
    Ok(match said {
        RouteSaid::Host { ip, address } => {
            let address: Address = address.parse().map_err(text)?;
            if address == Address::default() {
                return Err(format!(
                    "{address} is no station's: write the address that its interface has, see `rtnet if` there"
                ));
            }
            Route::Host(HostRoute { ip: *ip, address, origin: Origin::Static })
        }
        RouteSaid::Network { network, via } => {
            Route::Network(NetworkRoute { network: network.parse().map_err(text)?, gateway: *via })
        }
    })
}

fn text(error: impl ToString) -> String {
    error.to_string()
}

fn find_sockets(stack: &Stack, into: &mut Vec<Found>) {
    for (id, socket) in stack.sockets().take(into.capacity()) {
        let hears = stack.local_address(id).ok();
        into.push(Found { id, hears, pool: socket.pool().clone(), counters: socket.counters() });
    }
}

fn host_shown(host: &HostRoute) -> HostShown {
    let origin = origin_name(host.origin);
    HostShown { ip: host.ip, address: host.address.to_string(), origin: origin.into() }
}

fn origin_name(origin: Origin) -> &'static str {
    match origin {
        Origin::Static => "static",
        Origin::Solicited => "solicited",
        Origin::Learned => "learned",
    }
}

/// A host route as it was shown.
pub fn as_shown(host: &HostShown) -> Option<HostRoute> {
    let all = [Origin::Static, Origin::Solicited, Origin::Learned];
    let origin = all.into_iter().find(|&origin| origin_name(origin) == host.origin)?;
    Some(HostRoute { ip: host.ip, address: host.address.parse().ok()?, origin })
}

fn network_shown(route: &NetworkRoute) -> NetworkShown {
    NetworkShown { network: route.network.to_string(), via: route.gateway }
}

/// Every reason, also those that have not occurred.
pub fn by_reason(refusals: &Refusals) -> BTreeMap<String, u64> {
    Refusal::ALL.iter().map(|&reason| (reason.name().to_owned(), refusals.get(reason))).collect()
}

fn named<const N: usize>(all: [(&str, u64); N]) -> BTreeMap<String, u64> {
    all.into_iter().map(|(name, n)| (name.to_owned(), n)).collect()
}

fn of_stack(counters: &StackCounters) -> BTreeMap<String, u64> {
    let StackCounters { collectors, .. } = counters;
    named([
        ("echoes_answered", counters.echoes_answered),
        ("checksums_tolerated", counters.checksums_tolerated),
        ("options_ignored", counters.options_ignored),
        ("arp_conflicts", counters.arp_conflicts),
        ("arp_changed", counters.arp_changed),
        ("fragments_timed_out", collectors.timed_out),
        ("fragments_out_of_order", collectors.out_of_order),
        ("fragments_given_up", collectors.given_up),
        ("fragments_pool_empty", collectors.pool_empty),
    ])
}

fn of_router(counters: RouterCounters) -> BTreeMap<String, u64> {
    named([
        ("delivered", counters.delivered),
        ("no_route", counters.no_route),
        ("answered", counters.answered),
        ("full", counters.full),
        ("too_large", counters.too_large),
        ("forged", counters.forged),
        ("malformed", counters.malformed),
        ("incomplete", counters.incomplete),
        ("wakes", counters.wakes),
    ])
}

fn of_programs(LineCounters { wakes, nonsense }: LineCounters) -> BTreeMap<String, u64> {
    named([("wakes", wakes), ("nonsense", nonsense)])
}

fn of_socket(counters: &SocketCounters) -> BTreeMap<String, u64> {
    named([
        ("received", counters.received),
        ("dropped", counters.dropped),
        ("sent", counters.sent),
        ("no_buffers", counters.no_buffers),
        ("refused", counters.refused),
        ("refused_no_route", counters.no_route),
        ("refused_too_long", counters.too_long),
        ("refused_no_slot", counters.no_slot),
        ("cut_short", counters.cut_short),
    ])
}
