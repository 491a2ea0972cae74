//! One request to the kernel and its answer, whatever it is about.

use std::io;

use netlink_packet_core::{
    DecodeError, ErrorMessage, NLM_F_REQUEST, NetlinkHeader, NetlinkMessage, NetlinkPayload, NlasIterator,
};
use netlink_packet_route::RouteNetlinkMessage;
use netlink_sys::{Socket, SocketAddr, protocols::NETLINK_ROUTE};
use nix::errno::Errno;

use super::Refused;

/// A netlink message is at least its header, and begins on a multiple of four bytes (netlink(7)).
const HEADER_LEN: usize = 16;
const ALIGNMENT: usize = 4;

/// NLMSGERR_ATTR_MSG (netlink(7)): the kernel's own words about a refusal.
const EXT_ACK_TEXT: u16 = 1;

/// A socket on which one request at a time is answered.
///
/// It belongs to the network namespace of the thread that opened it, whichever thread uses it later; as long as it is
/// open, it keeps that namespace alive.
pub struct Exchange {
    socket: Socket,
    /// Number of the request under way; answers to earlier ones are passed over.
    sequence: u32,
}

impl Exchange {
    /// Opens a socket in the network namespace of the calling thread.
    ///
    /// # Errors
    /// The kernel gives no netlink socket.
    pub fn open() -> Result<Self, Refused> {
        let open = || -> io::Result<Socket> {
            let mut socket = Socket::new(NETLINK_ROUTE)?;
            socket.bind_auto()?;
            socket.connect(&SocketAddr::new(0, 0))?;
            // No need to repeat the request, but say in words what was wrong with it.
            socket.set_cap_ack(true)?;
            socket.set_ext_ack(true)?;
            Ok(socket)
        };
        let socket = open().map_err(no_socket)?;
        Ok(Self { socket, sequence: 0 })
    }

    /// Sends one request and collects the answers up to the acknowledgement, or up to the end of a dump.
    ///
    /// `what` is wanted, in words that follow "cannot"; `remedies` are what helps against an errno.
    ///
    /// # Errors
    /// The kernel refuses, or its answer does not come or cannot be understood.
    pub fn request(
        &mut self,
        what: &str,
        message: RouteNetlinkMessage,
        flags: u16,
        remedies: &[(Errno, &str)],
    ) -> Result<Vec<RouteNetlinkMessage>, Refused> {
        self.sequence = self.sequence.wrapping_add(1);
        let mut header = NetlinkHeader::default();
        header.flags = NLM_F_REQUEST | flags;
        header.sequence_number = self.sequence;
        let mut request = NetlinkMessage::new(header, NetlinkPayload::from(message));
        request.finalize();
        let mut bytes = vec![0; request.buffer_len()];
        request.serialize(&mut bytes);
        let broken = |said, source| Refused::broken(what, said, source);
        self.socket.send(&bytes, 0).map_err(|error| broken("the request cannot be sent", Some(error)))?;

        let mut replies = Vec::new();
        loop {
            let datagram =
                receive(&self.socket).map_err(|error| broken("no answer from the kernel", Some(error)))?;
            for reply in messages(&datagram) {
                let reply = reply.map_err(|error| {
                    let error = io::Error::new(io::ErrorKind::InvalidData, error);
                    broken("the kernel's answer cannot be understood", Some(error))
                })?;
                if reply.header.sequence_number != self.sequence {
                    continue; // the rest of an answer that was given up
                }
                match reply.payload {
                    NetlinkPayload::InnerMessage(inner) => replies.push(inner),
                    NetlinkPayload::Error(ErrorMessage { code: None, .. }) => return Ok(replies),
                    NetlinkPayload::Error(refusal) => {
                        let errno = Errno::from_raw(refusal.raw_code().abs());
                        return Err(Refused::because(what, kernel_text(&refusal.header), errno, remedies));
                    }
                    NetlinkPayload::Done(end) if end.code == 0 => return Ok(replies),
                    NetlinkPayload::Done(end) => {
                        let cause = io::Error::from_raw_os_error(end.code.abs());
                        return Err(broken("the answer broke off", Some(cause)));
                    }
                    NetlinkPayload::Overrun(_) => {
                        return Err(broken("part of the answer was lost", None));
                    }
                    _ => {}
                }
            }
        }
    }
}

/// Why there is no conversation at all.
pub(super) fn no_socket(error: io::Error) -> Refused {
    let what = "open a NETLINK_ROUTE socket".to_owned();
    Refused {
        what,
        said: None,
        remedy: Some("the kernel must have CONFIG_NET".to_owned()),
        source: Some(error),
    }
}

/// The next datagram, whole.
pub(super) fn receive(socket: &Socket) -> io::Result<Vec<u8>> {
    loop {
        match socket.recv_from_full() {
            Ok((datagram, _)) => return Ok(datagram),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

/// The messages of one datagram.
pub(super) fn messages(
    mut datagram: &[u8],
) -> impl Iterator<Item = Result<NetlinkMessage<RouteNetlinkMessage>, DecodeError>> {
    std::iter::from_fn(move || {
        if datagram.len() < HEADER_LEN {
            return None;
        }
        let message = NetlinkMessage::deserialize(datagram);
        let length = message.as_ref().map_or(datagram.len(), |message| message.header.length as usize);
        let next = length.max(HEADER_LEN).next_multiple_of(ALIGNMENT);
        datagram = datagram.get(next..).unwrap_or_default();
        Some(message)
    })
}

/// What the kernel said in words, in the attributes after the header of the refused request.
fn kernel_text(refusal: &[u8]) -> Option<String> {
    let attributes = NlasIterator::new(refusal.get(HEADER_LEN..)?);
    let text = attributes.flatten().find(|attribute| attribute.kind() == EXT_ACK_TEXT)?;
    Some(String::from_utf8_lossy(text.value()).trim_end_matches('\0').to_string())
}
