//! Why a call to a socket failed, and the number by which the sockets of an operating system say the same.

use core::net::Ipv4Addr;

use crate::discipline::SendError;
use crate::wire::udp::MAX_PAYLOAD;

/// A call to a socket that failed. Nothing of it has happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SocketError {
    /// It was closed, or never was.
    #[error("there is no such socket: it was closed, or never was")]
    NoSuchSocket,
    /// What is asked for is another kind of socket's.
    #[error("{0}")]
    OtherKind(&'static str),
    /// As many as there may be are open.
    #[error(
        "{0} sockets are open, as many as there may be: close one, or start the station with more (`--sockets`)"
    )]
    TooMany(usize),
    /// All ports that are given out are taken.
    #[error(
        "no port is left of those that are given out, {first} to {last}: bind to another, or give out more"
    )]
    NoPortLeft {
        /// First of the range.
        first: u16,
        /// Last of the range.
        last: u16,
    },
    /// Another socket has it.
    #[error("port {0} is taken by another socket")]
    PortInUse(u16),
    /// A socket is bound once.
    #[error("the socket is bound to port {0} already")]
    AlreadyBound(u16),
    /// Nothing comes to it here.
    #[error("{0} is not an address of this station")]
    NotOurAddress(Ipv4Addr),
    /// A destination that cannot be one.
    #[error("the destination {0}:{1} is none: it has no address or no port")]
    NoDestination(Ipv4Addr, u16),
    /// It was not said where to.
    #[error("the socket is not connected: say where to send, or connect it first")]
    NotConnected,
    /// Nobody told of a way there.
    #[error("no route to {0}: add one (`rtnet route add`), or ask for it (`rtnet route solicit`)")]
    NoRoute(Ipv4Addr),
    /// No datagram is as long.
    #[error("{0} bytes do not fit a datagram, which takes {MAX_PAYLOAD}")]
    TooLong(usize),
    /// A frame without a header, or one that cannot be its.
    #[error("{0} bytes are no frame: its header alone has 14")]
    NoFrame(usize),
    /// The socket's own buffers are used up: frames wait to be sent or to be read.
    #[error(
        "{needed} buffers are needed, and of the socket's {capacity} only {free} are free: \
             read what has come, wait until what was sent has left, or extend the pool"
    )]
    NoBuffers {
        /// How many the call needs.
        needed: usize,
        /// How many are free.
        free: usize,
        /// How many the socket has.
        capacity: usize,
    },
    /// The socket has fewer buffers than the call needs, whatever is free.
    #[error(
        "{needed} buffers are needed, and the socket has {capacity}: send {most} bytes at the most, extend its pool, or \
             start the station with more for each socket (`--socket-buffers`)"
    )]
    NeverFits {
        /// How many the call needs.
        needed: usize,
        /// How many the socket has.
        capacity: usize,
        /// Bytes of the longest datagram that fits, on this way and in this slot.
        most: usize,
    },
    /// Nothing has come yet.
    #[error("nothing has come yet")]
    WouldBlock,
    /// Nothing came in time.
    #[error("nothing came in time")]
    TimedOut,
    /// Flags that mean nothing here.
    #[error("flags {0:#x} mean nothing here")]
    WrongFlags(i32),
    /// There is no urgent data.
    #[error("there is no out-of-band data")]
    NoUrgentData,
    /// A priority that is not a socket's.
    #[error("priority {0} is not for sockets: they send with 0, the most urgent, to 30")]
    WrongPriority(u8),
    /// The way to share the medium does not take it.
    #[error(transparent)]
    Discipline(#[from] SendError),
    /// The station has ended.
    #[error("the station is gone: attach again when it is back")]
    StationGone,
}

impl SocketError {
    /// The number, as BSD sockets and RTnet have it.
    ///
    /// | variant | number | differs from RTnet |
    /// |---|---|---|
    /// | [`NoSuchSocket`](Self::NoSuchSocket) | `EBADF` | |
    /// | [`OtherKind`](Self::OtherKind) | `EOPNOTSUPP` | |
    /// | [`TooMany`](Self::TooMany), [`NoPortLeft`](Self::NoPortLeft) | `EAGAIN` | |
    /// | [`PortInUse`](Self::PortInUse) | `EADDRINUSE` | |
    /// | [`AlreadyBound`](Self::AlreadyBound) | `EINVAL` | binds again |
    /// | [`NotOurAddress`](Self::NotOurAddress) | `EADDRNOTAVAIL` | binds, and hears nothing |
    /// | [`NoDestination`](Self::NoDestination) | `EINVAL` | |
    /// | [`NotConnected`](Self::NotConnected) | `ENOTCONN` | |
    /// | [`NoRoute`](Self::NoRoute) | `EHOSTUNREACH` | |
    /// | [`TooLong`](Self::TooLong) | `EMSGSIZE` | |
    /// | [`NoFrame`](Self::NoFrame) | `EINVAL` | |
    /// | [`NoBuffers`](Self::NoBuffers) | `ENOBUFS` | sends a part |
    /// | [`NeverFits`](Self::NeverFits) | `EMSGSIZE` | sends a part |
    /// | [`WouldBlock`](Self::WouldBlock) | `EAGAIN` | |
    /// | [`TimedOut`](Self::TimedOut) | `ETIMEDOUT` | |
    /// | [`WrongFlags`](Self::WrongFlags) | `EINVAL` | |
    /// | [`NoUrgentData`](Self::NoUrgentData) | `EOPNOTSUPP` | |
    /// | [`WrongPriority`](Self::WrongPriority) | `EINVAL` | a debug assertion |
    /// | [`Discipline`](Self::Discipline) | [`SendError::errno`] | |
    /// | [`StationGone`](Self::StationGone) | `ENODEV` | |
    pub const fn errno(&self) -> i32 {
        match self {
            SocketError::NoSuchSocket => libc::EBADF,
            SocketError::OtherKind(_) | SocketError::NoUrgentData => libc::EOPNOTSUPP,
            SocketError::TooMany(_) | SocketError::NoPortLeft { .. } | SocketError::WouldBlock => {
                libc::EAGAIN
            }
            SocketError::PortInUse(_) => libc::EADDRINUSE,
            SocketError::NotOurAddress(_) => libc::EADDRNOTAVAIL,
            SocketError::AlreadyBound(_)
            | SocketError::NoDestination(..)
            | SocketError::NoFrame(_)
            | SocketError::WrongFlags(_)
            | SocketError::WrongPriority(_) => libc::EINVAL,
            SocketError::NotConnected => libc::ENOTCONN,
            SocketError::NoRoute(_) => libc::EHOSTUNREACH,
            SocketError::TooLong(_) | SocketError::NeverFits { .. } => libc::EMSGSIZE,
            SocketError::NoBuffers { .. } => libc::ENOBUFS,
            SocketError::TimedOut => libc::ETIMEDOUT,
            SocketError::Discipline(error) => error.errno(),
            SocketError::StationGone => libc::ENODEV,
        }
    }
}
