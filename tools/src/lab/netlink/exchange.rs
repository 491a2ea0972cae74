//! One request to the kernel and its answer, whatever it is about.

use std::io;

use anyhow::{Context, Result, bail};
use netlink_packet_core::{
    ErrorMessage, NLM_F_REQUEST, NetlinkHeader, NetlinkMessage, NetlinkPayload, NlasIterator,
};
use netlink_packet_route::RouteNetlinkMessage;
use netlink_sys::{Socket, SocketAddr, protocols::NETLINK_ROUTE};
use nix::errno::Errno;

/// A netlink message is at least its header, and begins on a multiple of four bytes (netlink(7)).
const HEADER_LEN: usize = 16;
const ALIGNMENT: usize = 4;

/// NLMSGERR_ATTR_MSG (netlink(7)): the kernel's own words about a refusal.
const EXT_ACK_TEXT: u16 = 1;

/// A socket on which one request at a time is answered.
pub(super) struct Exchange {
    socket: Socket,
    /// Number of the request under way; answers to earlier ones are passed over.
    sequence: u32,
}

impl Exchange {
    /// Opens a socket in the network namespace of the calling thread.
    pub(super) fn open() -> Result<Self> {
        let open = || -> io::Result<Socket> {
            let mut socket = Socket::new(NETLINK_ROUTE)?;
            socket.bind_auto()?;
            socket.connect(&SocketAddr::new(0, 0))?;
            // No need to repeat the request, but say in words what was wrong with it.
            socket.set_cap_ack(true)?;
            socket.set_ext_ack(true)?;
            Ok(socket)
        };
        let socket = open().context("cannot open a NETLINK_ROUTE socket: the kernel must have CONFIG_NET")?;
        Ok(Self { socket, sequence: 0 })
    }

    /// Sends one request and collects the answers up to the acknowledgement, or up to the end of a
    /// dump.
    pub(super) fn request(
        &mut self,
        what: &str,
        message: RouteNetlinkMessage,
        flags: u16,
        remedies: &[(Errno, &str)],
    ) -> Result<Vec<RouteNetlinkMessage>> {
        self.sequence = self.sequence.wrapping_add(1);
        let mut header = NetlinkHeader::default();
        header.flags = NLM_F_REQUEST | flags;
        header.sequence_number = self.sequence;
        let mut request = NetlinkMessage::new(header, NetlinkPayload::from(message));
        request.finalize();
        let mut bytes = vec![0; request.buffer_len()];
        request.serialize(&mut bytes);
        self.socket.send(&bytes, 0).with_context(|| format!("cannot {what}: the request cannot be sent"))?;

        let mut replies = Vec::new();
        loop {
            let datagram =
                self.receive().with_context(|| format!("cannot {what}: no answer from the kernel"))?;
            for reply in messages(&datagram) {
                let reply = reply.with_context(|| format!("cannot {what}"))?;
                if reply.header.sequence_number != self.sequence {
                    continue; // the rest of an answer that was given up
                }
                match reply.payload {
                    NetlinkPayload::InnerMessage(inner) => replies.push(inner),
                    NetlinkPayload::Error(ErrorMessage { code: None, .. }) => return Ok(replies),
                    NetlinkPayload::Error(refusal) => {
                        return Err(explain(what, &refusal, remedies));
                    }
                    NetlinkPayload::Done(end) if end.code == 0 => return Ok(replies),
                    NetlinkPayload::Done(end) => {
                        let cause = io::Error::from_raw_os_error(end.code.abs());
                        return Err(cause).with_context(|| format!("cannot {what}: the answer broke off"));
                    }
                    NetlinkPayload::Overrun(_) => {
                        bail!("cannot {what}: part of the answer was lost")
                    }
                    _ => {}
                }
            }
        }
    }

    fn receive(&self) -> io::Result<Vec<u8>> {
        loop {
            match self.socket.recv_from_full() {
                Ok((datagram, _)) => return Ok(datagram),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
    }
}

/// The messages of one datagram.
fn messages(mut datagram: &[u8]) -> impl Iterator<Item = Result<NetlinkMessage<RouteNetlinkMessage>>> {
    std::iter::from_fn(move || {
        if datagram.len() < HEADER_LEN {
            return None;
        }
        let message =
            NetlinkMessage::deserialize(datagram).context("the kernel's answer cannot be understood");
        let length = message.as_ref().map_or(datagram.len(), |message| message.header.length as usize);
        let next = length.max(HEADER_LEN).next_multiple_of(ALIGNMENT);
        datagram = datagram.get(next..).unwrap_or_default();
        Some(message)
    })
}

fn explain(what: &str, refusal: &ErrorMessage, remedies: &[(Errno, &str)]) -> anyhow::Error {
    let errno = Errno::from_raw(refusal.raw_code().abs());
    let remedy = match remedies.iter().find(|(code, _)| *code == errno) {
        Some((_, remedy)) => Some(*remedy),
        None if errno == Errno::EPERM => Some("this needs root (CAP_NET_ADMIN): run as root"),
        None if errno == Errno::ENODEV => Some("no such interface in the namespace"),
        None => None,
    };
    let mut text = format!("cannot {what}");
    for reason in [kernel_text(&refusal.header), remedy.map(String::from)].into_iter().flatten() {
        text = format!("{text}: {reason}");
    }
    anyhow::Error::new(refusal.to_io()).context(text)
}

/// What the kernel said in words, in the attributes after the header of the refused request.
fn kernel_text(refusal: &[u8]) -> Option<String> {
    let attributes = NlasIterator::new(refusal.get(HEADER_LEN..)?);
    let text = attributes.flatten().find(|attribute| attribute.kind() == EXT_ACK_TEXT)?;
    Some(String::from_utf8_lossy(text.value()).trim_end_matches('\0').to_string())
}
