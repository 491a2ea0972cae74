//! A program's end: sockets as those of the standard library, of a station that is another process.

use core::net::SocketAddrV4;
use core::sync::atomic::Ordering;
use core::time::Duration;
use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nix::errno::Errno;

use super::connection::opened;
use super::end::End;
use super::handshake::Ask;
use super::{place, segment};
use crate::buf::ROOM;
use crate::live::TimeBoard;
use crate::queue::Priority;
use crate::socket::{Flags, LinkMode, LinkType, Options, Received};
use crate::wire::ethernet::{Address, EtherType};
use crate::wire::udp::MAX_PAYLOAD;

/// What a send may be told besides.
const UDP_FLAGS: Flags = Flags::from_bits(Flags::DONTWAIT.bits() | Flags::DONTROUTE.bits());

/// A station on this machine, by its control socket.
#[derive(Clone, Debug)]
pub struct Station {
    control: PathBuf,
}

/// A UDP socket of a station's. It can be shared between threads: one may receive while another sends.
pub struct UdpSocket(pub(super) End);

/// A packet socket of a station's, for protocols of one's own.
pub struct PacketSocket(pub(super) End);

impl Station {
    /// The station of this user that is called `[LAB/]STATION`, as behind `rtnet -S`: without its lab one of its own, or else
    /// one of the only lab that runs.
    pub fn named(name: &str) -> io::Result<Self> {
        place::socket_of(name).map(Self::at)
    }

    /// The station whose control socket is there.
    pub fn at(control: impl AsRef<Path>) -> Self {
        Self { control: control.as_ref().to_owned() }
    }

    /// A UDP socket with the station's default of buffers, and an automatic port.
    pub fn udp(&self) -> io::Result<UdpSocket> {
        self.udp_with(0)
    }

    /// The same with so many buffers: a datagram in fragments needs one for each.
    pub fn udp_with(&self, buffers: u32) -> io::Result<UdpSocket> {
        End::open(&self.control, Ask::OpenUdp(buffers)).map(UdpSocket)
    }

    /// A packet socket for frames of one EtherType, or all.
    pub fn packet(&self, mode: LinkMode, link_type: LinkType) -> io::Result<PacketSocket> {
        self.packet_with(mode, link_type, 0)
    }

    /// The same with so many buffers.
    pub fn packet_with(&self, mode: LinkMode, link_type: LinkType, buffers: u32) -> io::Result<PacketSocket> {
        End::open(&self.control, Ask::OpenPacket(mode, link_type, buffers)).map(PacketSocket)
    }

    /// The station's time, and its cycle to wait for: as its own threads have it, without a lock and, but for waiting, without
    /// a system call. A station needs no sockets for that. Once it has ended, be it that it was killed, whoever waits is told
    /// so: the one that is started then has a time of its own.
    ///
    /// ```no_run
    /// use rtnet::api::Station;
    /// use std::time::Duration;
    ///
    /// let time = Station::named("cell/arm")?.time()?;
    /// let cycle = time.waiter().wait_cycle(Duration::from_secs(1))?;
    /// println!("cycle {} began {} ago", cycle.number, time.now() - cycle.start);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn time(&self) -> io::Result<Arc<TimeBoard>> {
        let (control, [page]) = opened(&self.control, Ask::Time)?;
        TimeBoard::open(page, control.into())
    }
}

impl UdpSocket {
    /// Binds it to an address of the station's, or any (0.0.0.0), and to a port, or the one that it has (0).
    pub fn bind(&self, to: SocketAddrV4) -> io::Result<()> {
        self.0.ask(Ask::Bind(to)).map(drop)
    }
    /// From now on it sends to this peer and hears nobody else; `None`: to nobody, and all.
    pub fn connect(&self, peer: Option<SocketAddrV4>) -> io::Result<()> {
        self.0.ask(Ask::Connect(peer))?;
        self.0.is_connected.store(peer.is_some(), Ordering::Relaxed);
        Ok(())
    }
    /// Where it hears.
    pub fn local_addr(&self) -> io::Result<SocketAddrV4> {
        Ok(self.0.ask(Ask::LocalAddress)?.address)
    }
    /// Whom it is connected to.
    pub fn peer_addr(&self) -> io::Result<SocketAddrV4> {
        Ok(self.0.ask(Ask::PeerAddress)?.address)
    }

    /// Hands a datagram of at most 65 507 bytes to the station. It does not wait: where the station has not taken what was
    /// sent before, that is ENOBUFS. An earlier one that could not leave, for want of a route, of a slot, or of buffers since
    /// nobody reads what has come, is told of once: here, and then this one is not sent; by a receive that finds nothing,
    /// if the socket is connected; or by `take_error`. Of a station that was killed it is told at the second datagram after that, ENODEV.
    pub fn send_to(&self, data: &[u8], to: SocketAddrV4) -> io::Result<()> {
        self.send_to_with(data, to, Flags::NONE)
    }
    /// The same to the peer that it is connected to.
    pub fn send(&self, data: &[u8]) -> io::Result<()> {
        self.send_with(data, Flags::NONE)
    }
    /// As [`UdpSocket::send_to`], with flags: `DONTROUTE` is for who is on the medium itself, `DONTWAIT` goes without saying.
    pub fn send_to_with(&self, data: &[u8], to: SocketAddrV4, flags: Flags) -> io::Result<()> {
        self.0.send(&[data], Some(segment::pack_udp(to)), MAX_PAYLOAD, flags, UDP_FLAGS)
    }
    /// The same to the peer that it is connected to.
    pub fn send_with(&self, data: &[u8], flags: Flags) -> io::Result<()> {
        self.send_parts(&[data], flags)
    }
    /// The same for one datagram whose parts lie in several places: nobody need put them together first.
    pub fn send_parts(&self, parts: &[&[u8]], flags: Flags) -> io::Result<()> {
        self.0.send(parts, None, MAX_PAYLOAD, flags, UDP_FLAGS)
    }
}

impl UdpSocket {
    /// Whether what it sends says when that was, and when it left: who receives it by a station of ours is told so
    /// ([`Received::times`]), if this station was started to (`--package-times`) and knows the master's time. It does not
    /// otherwise; and in no case where that would take another frame.
    pub fn set_with_times(&self, with_times: bool) {
        self.0.set_with_times(with_times);
    }
}

impl PacketSocket {
    /// From now on frames of another type come to it.
    pub fn bind(&self, link_type: LinkType) -> io::Result<()> {
        self.0.ask(Ask::BindLink(link_type)).map(drop)
    }
    /// Hands the content of a frame to the station, which writes its header; in `RAW` mode the whole frame, whoever is named.
    pub fn send_to(&self, data: &[u8], to: Address, ether_type: EtherType) -> io::Result<()> {
        self.send_to_with(data, to, ether_type, Flags::NONE)
    }
    /// The same with flags, of which there is `DONTWAIT`, and that goes without saying.
    pub fn send_to_with(
        &self,
        data: &[u8],
        to: Address,
        ether_type: EtherType,
        flags: Flags,
    ) -> io::Result<()> {
        self.0.send(&[data], Some(segment::pack_link(to, ether_type)), ROOM, flags, Flags::DONTWAIT)
    }
    /// Hands a whole frame to the station, from its destination on.
    pub fn send(&self, frame: &[u8]) -> io::Result<()> {
        self.send_with(frame, Flags::NONE)
    }
    /// The same with flags.
    pub fn send_with(&self, frame: &[u8], flags: Flags) -> io::Result<()> {
        self.0.send(&[frame], None, ROOM, flags, Flags::DONTWAIT)
    }
}

macro_rules! of_both {
    ($($socket:ident),+) => {$(
        impl $socket {
            /// Waits for what comes next, as long as the time-out says, and copies it as far as it fits.
            pub fn receive(&self, into: &mut [u8]) -> io::Result<Received> {
                self.0.receive(into, Flags::NONE)
            }
            /// The same with flags: `PEEK` leaves it there, `DONTWAIT` does not wait: who spins so asks the kernel for nothing
            /// but, at every 1024th look in vain, whether the station is there; unless he has asked for the descriptor.
            pub fn receive_with(&self, into: &mut [u8], flags: Flags) -> io::Result<Received> {
                self.0.receive(into, flags)
            }
            /// Receives what has come, or says that nothing has (`WouldBlock`): then the descriptor becomes readable
            /// as soon as something does.
            pub fn try_receive(&self, into: &mut [u8]) -> io::Result<Received> {
                self.0.receive_now(into, Flags::NONE)
            }
            /// The last error of an earlier send that nobody was told of yet, as `SO_ERROR`: what could not leave.
            pub fn take_error(&self) -> Option<io::Error> {
                self.0.take_error()
            }
            /// Whether the station has taken all that was sent: what it has not is lost with the socket.
            pub fn is_drained(&self) -> bool {
                self.0.is_drained()
            }
            /// What the station says that it has taken: to be compared with what it said before, and nothing else.
            pub fn taken(&self) -> u64 {
                self.0.taken()
            }
            /// How long to wait; `None`: for ever.
            pub fn set_timeout(&self, timeout: Option<Duration>) {
                self.0.set_timeout(timeout);
            }
            /// How urgent what it sends is, 0 to 30.
            pub fn set_priority(&self, priority: Priority) -> io::Result<()> {
                if priority > Priority::LAST_REAL_TIME {
                    return Err(Errno::EINVAL.into());
                }
                self.0.set_options(|options| options.priority = priority);
                Ok(())
            }
            /// The slot that it sends in.
            pub fn set_channel(&self, channel: crate::discipline::Channel) {
                self.0.set_options(|options| options.channel = channel);
            }
            /// The type of service in its IP headers.
            pub fn set_tos(&self, tos: u8) {
                self.0.set_options(|options| options.tos = tos);
            }
            /// How it sends, as it was set.
            pub fn options(&self) -> Options {
                self.0.options()
            }
            /// How long it waits, as it was set.
            pub fn timeout(&self) -> Option<Duration> {
                self.0.timeout()
            }
            /// Gives it up to so many more buffers; tells how many.
            pub fn extend(&self, buffers: u32) -> io::Result<u32> {
                Ok(self.0.ask(Ask::Extend(buffers))?.number)
            }
            /// Takes up to so many free buffers from it; tells how many.
            pub fn shrink(&self, buffers: u32) -> io::Result<u32> {
                Ok(self.0.ask(Ask::Shrink(buffers))?.number)
            }
            /// Ends all waiting on it, in whatever thread, and everything that comes after it: EBADF.
            pub fn close(&self) {
                self.0.close();
            }
        }

        impl AsFd for $socket {
            /// For `poll`, `epoll` and whatever is made of them: readable when something has come since a receive found
            /// nothing, or when the station is gone.
            fn as_fd(&self) -> BorrowedFd<'_> {
                self.0.watch().as_fd()
            }
        }

        impl AsRawFd for $socket {
            fn as_raw_fd(&self) -> i32 {
                self.as_fd().as_raw_fd()
            }
        }
    )+};
}

of_both!(UdpSocket, PacketSocket);
