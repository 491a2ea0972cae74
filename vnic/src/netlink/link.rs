//! Devices: what they are, and what they are set to.

use netlink_packet_core::NLM_F_ACK;
use netlink_packet_route::RouteNetlinkMessage;
use netlink_packet_route::link::{InfoPortKind, LinkAttribute, LinkFlags, LinkInfo, LinkMessage, Stats64};
use nix::errno::Errno;

use super::{Exchange, Refused};

/// A conversation with the kernel about the devices of one network namespace.
pub struct Links {
    pub(super) kernel: Exchange,
}

/// A device, as the kernel described it at the time of the question.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Link {
    /// Its number, unique within its namespace only.
    pub index: u32,
    /// Its name.
    pub name: String,
    /// The largest packet that it takes, in bytes, without the Ethernet header.
    pub mtu: usize,
    /// It was set up; whether frames pass depends on its other end, too.
    pub is_up: bool,
    /// It is up, and so is its other end: frames can pass. By IFF_LOWER_UP; IFF_RUNNING follows it only when the kernel's link
    /// watch gets to it, up to a second later.
    pub has_carrier: bool,
    /// The number of the bridge (of the kernel, or Open vSwitch) that it is a port of, which takes all frames that come.
    pub bridge: Option<u32>,
    /// Its hardware address, if it has one of six bytes.
    pub address: Option<[u8; 6]>,
    /// What went through it since it was made.
    pub statistics: LinkStatistics,
}

/// What went through a device, in packets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkStatistics {
    /// Those that it gave to Linux.
    pub received: u64,
    /// Those that it took from Linux.
    pub sent: u64,
    /// Those that came and that Linux did not take.
    pub receive_dropped: u64,
    /// Those that the device did not take: for want of a reader, with a TUN device.
    pub send_dropped: u64,
}

impl Links {
    /// Opens a conversation about the network namespace of the calling thread.
    ///
    /// # Errors
    /// The kernel gives no netlink socket.
    pub fn open() -> Result<Self, Refused> {
        Ok(Self { kernel: Exchange::open()? })
    }

    /// The device of this name, if there is one.
    ///
    /// # Errors
    /// The name is longer than 15 bytes, or the kernel's answer cannot be understood.
    pub fn find(&mut self, name: &str) -> Result<Option<Link>, Refused> {
        let mut question = LinkMessage::default();
        question.attributes = vec![LinkAttribute::IfName(name.into())];
        self.look_up(&format!("look up interface `{name}`"), question)
    }

    /// The device with this index, if there is one.
    ///
    /// # Errors
    /// The kernel's answer cannot be understood.
    pub fn get(&mut self, index: u32) -> Result<Option<Link>, Refused> {
        self.look_up(&format!("look up interface #{index}"), message(index))
    }

    /// Sets the largest packet that the device takes, in bytes without the Ethernet header.
    ///
    /// # Errors
    /// There is no such device, or it takes no packets of this size.
    pub fn set_mtu(&mut self, index: u32, mtu: usize) -> Result<(), Refused> {
        // The kernel reads 31 bits; what they cannot say is too much for any device, and it says so.
        let attribute = LinkAttribute::Mtu(mtu.min(i32::MAX as usize) as u32);
        self.set(&format!("set the MTU of interface #{index} to {mtu}"), index, attribute, &[])
    }

    /// Sets the device up, or down.
    ///
    /// # Errors
    /// There is no such device.
    pub fn set_up(&mut self, index: u32, is_up: bool) -> Result<(), Refused> {
        let mut link = message(index);
        link.header.change_mask = LinkFlags::Up;
        link.header.flags = if is_up { LinkFlags::Up } else { LinkFlags::empty() };
        let direction = if is_up { "up" } else { "down" };
        self.change(&format!("set interface #{index} {direction}"), link, &[])
    }

    /// Sets how many packets wait in front of the device, where its queueing discipline asks for that.
    ///
    /// # Errors
    /// There is no such device.
    pub fn set_queue_length(&mut self, index: u32, packets: u32) -> Result<(), Refused> {
        let what = format!("let {packets} packets wait in front of interface #{index}");
        self.set(&what, index, LinkAttribute::TxQueueLen(packets), &[])
    }

    /// Gives the device another hardware address.
    ///
    /// # Errors
    /// There is no such device, it has none or wants to be down for that, or the address is not that of a single station.
    pub fn set_hardware_address(&mut self, index: u32, address: [u8; 6]) -> Result<(), Refused> {
        let [a, b, c, d, e, f] = address;
        let what =
            format!("give interface #{index} the address {a:02x}:{b:02x}:{c:02x}:{d:02x}:{e:02x}:{f:02x}");
        let remedies = &[
            (Errno::EADDRNOTAVAIL, "the first byte must be even, and not all bytes zero"),
            (Errno::EBUSY, "set it down before"),
        ];
        self.set(&what, index, LinkAttribute::Address(address.to_vec()), remedies)
    }

    fn look_up(&mut self, what: &str, question: LinkMessage) -> Result<Option<Link>, Refused> {
        let remedies = &[(Errno::ERANGE, "an interface's name has at most 15 bytes")];
        match self.kernel.request(what, RouteNetlinkMessage::GetLink(question), NLM_F_ACK, remedies) {
            Ok(replies) => Ok(replies.into_iter().find_map(Link::from_reply)),
            Err(refused) if refused.errno() == Some(Errno::ENODEV) => Ok(None),
            Err(refused) => Err(refused),
        }
    }

    fn set(
        &mut self,
        what: &str,
        index: u32,
        attribute: LinkAttribute,
        remedies: &[(Errno, &str)],
    ) -> Result<(), Refused> {
        let mut link = message(index);
        link.attributes = vec![attribute];
        self.change(what, link, remedies)
    }

    fn change(&mut self, what: &str, link: LinkMessage, remedies: &[(Errno, &str)]) -> Result<(), Refused> {
        self.kernel.request(what, RouteNetlinkMessage::SetLink(link), NLM_F_ACK, remedies).map(drop)
    }
}

impl Link {
    /// The device that a reply describes, if it describes one.
    fn from_reply(reply: RouteNetlinkMessage) -> Option<Self> {
        let RouteNetlinkMessage::NewLink(message) = reply else { return None };
        let mut link = Self {
            index: message.header.index,
            is_up: message.header.flags.contains(LinkFlags::Up),
            has_carrier: message.header.flags.contains(LinkFlags::Up | LinkFlags::LowerUp),
            ..Self::default()
        };
        let (mut upper, mut is_port) = (None, false);
        for attribute in message.attributes {
            match attribute {
                LinkAttribute::IfName(name) => link.name = name,
                LinkAttribute::Mtu(mtu) => link.mtu = mtu as usize,
                LinkAttribute::Address(address) => link.address = address.try_into().ok(),
                LinkAttribute::Stats64(counts) => link.statistics = (&counts).into(),
                LinkAttribute::Controller(index) => upper = Some(index),
                LinkAttribute::LinkInfo(infos) => is_port = infos.iter().any(is_of_a_bridge),
                _ => {}
            }
        }
        link.bridge = upper.filter(|_| is_port);
        Some(link)
    }
}

/// Whether it says that the device is a port of a bridge.
fn is_of_a_bridge(info: &LinkInfo) -> bool {
    match info {
        LinkInfo::PortKind(InfoPortKind::Bridge) => true,
        LinkInfo::PortKind(InfoPortKind::Other(kind)) => kind == "openvswitch",
        _ => false,
    }
}

impl From<&Stats64> for LinkStatistics {
    fn from(counts: &Stats64) -> Self {
        Self {
            received: counts.rx_packets,
            sent: counts.tx_packets,
            receive_dropped: counts.rx_dropped,
            send_dropped: counts.tx_dropped,
        }
    }
}

fn message(index: u32) -> LinkMessage {
    let mut link = LinkMessage::default();
    link.header.index = index;
    link
}
