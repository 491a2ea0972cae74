//! Requests to the kernel about links, bridges and forwarding entries.
//!
//! This is the little of rtnetlink (rtnetlink(7)) that a lab needs, synchronous: each request waits
//! for the kernel's acknowledgement, and a refusal becomes an error that names the operation, the
//! interface, what the kernel said and, where it is known, the remedy.

use std::os::fd::{AsRawFd, BorrowedFd};

use anyhow::{Context, Result};
use netlink_packet_core::{NLM_F_ACK, NLM_F_CREATE, NLM_F_DUMP, NLM_F_EXCL};
use netlink_packet_route::link::{
    BridgeStpState, InfoBridge, InfoBridgePort, InfoData, InfoKind, InfoPortData, InfoPortKind, InfoVeth,
    LinkAttribute, LinkExtentMask, LinkFlags, LinkInfo, LinkMessage,
};
use netlink_packet_route::neighbour::{NeighbourAttribute, NeighbourFlags, NeighbourMessage, NeighbourState};
use netlink_packet_route::{AddressFamily, RouteNetlinkMessage};
use nix::errno::Errno;
use pnet_datalink::MacAddr;
use vnic::netlink::Exchange;

pub use link::{Link, NAME_MAX};
use link::{check_mac, check_name};

mod host;
mod link;

/// A conversation with the kernel about the links of one network namespace.
///
/// The socket belongs to the namespace of the thread that opened it, whichever thread uses it
/// later; as long as it is open, it keeps that namespace alive.
pub struct Netlink {
    kernel: Exchange,
}

impl Netlink {
    /// Opens a conversation about the network namespace of the calling thread.
    ///
    /// # Errors
    /// The kernel gives no netlink socket.
    pub fn open() -> Result<Self> {
        Ok(Self { kernel: Exchange::open()? })
    }

    /// Adds a bridge that is a plain medium: no spanning tree, no VLANs, no multicast snooping,
    /// nothing ages.
    ///
    /// All of these would send frames of their own or hold frames back. VLANs are off unless asked
    /// for; to ask for *off* would be refused by a kernel without CONFIG_BRIDGE_VLAN_FILTERING.
    ///
    /// # Errors
    /// The name is not one for an interface, is taken, or the kernel has no bridges.
    pub fn add_bridge(&mut self, name: &str) -> Result<()> {
        check_name(name)?;
        let mut bridge = LinkMessage::default();
        bridge.attributes = vec![
            LinkAttribute::IfName(name.into()),
            LinkAttribute::LinkInfo(vec![
                LinkInfo::Kind(InfoKind::Bridge),
                LinkInfo::Data(InfoData::Bridge(vec![
                    InfoBridge::StpState(BridgeStpState::Disabled),
                    InfoBridge::AgeingTime(0),
                    InfoBridge::MulticastSnooping(false),
                ])),
            ]),
        ];
        self.create(
            &format!("add bridge `{name}`"),
            RouteNetlinkMessage::NewLink(bridge),
            &[
                (Errno::EEXIST, "an interface of this name exists in the namespace: choose another name"),
                (Errno::EOPNOTSUPP, "the kernel must have CONFIG_BRIDGE (try `modprobe bridge`)"),
            ],
        )
    }

    /// Adds a pair of veth interfaces: `name` here, a port of the bridge with index `bridge`;
    /// `peer_name`, with the MAC `peer_mac`, in the namespace `peer_netns`.
    ///
    /// One request, so that the peer never exists anywhere else or under another MAC. Both ends are
    /// down at first.
    ///
    /// # Errors
    /// A name is not one for an interface or is taken, the MAC is not that of a single station,
    /// there is no such bridge, or the kernel has no veth.
    pub fn add_veth(
        &mut self,
        name: &str,
        bridge: u32,
        peer_name: &str,
        peer_mac: [u8; 6],
        peer_netns: BorrowedFd<'_>,
    ) -> Result<()> {
        check_name(name)?;
        check_name(peer_name)?;
        check_mac(peer_mac).with_context(|| format!("interface `{peer_name}`"))?;
        let mut peer = LinkMessage::default();
        peer.attributes = vec![
            LinkAttribute::IfName(peer_name.into()),
            LinkAttribute::Address(peer_mac.to_vec()),
            LinkAttribute::NetNsFd(peer_netns.as_raw_fd()),
        ];
        let mut port = LinkMessage::default();
        port.attributes = vec![
            LinkAttribute::IfName(name.into()),
            LinkAttribute::Controller(bridge),
            LinkAttribute::LinkInfo(vec![
                LinkInfo::Kind(InfoKind::Veth),
                LinkInfo::Data(InfoData::Veth(InfoVeth::Peer(peer))),
            ]),
        ];
        self.create(
            &format!("add veth `{name}` (port of bridge #{bridge}) with its peer `{peer_name}`"),
            RouteNetlinkMessage::NewLink(port),
            &[
                (Errno::EEXIST, "one of the two names exists in its namespace: choose another name"),
                (Errno::EOPNOTSUPP, "the kernel must have CONFIG_VETH (try `modprobe veth`)"),
            ],
        )
    }

    /// Deletes the interface with this index, and with a veth its peer.
    ///
    /// # Errors
    /// There is no such interface, or it cannot be deleted (`lo`).
    pub fn delete_link(&mut self, index: u32) -> Result<()> {
        let message = RouteNetlinkMessage::DelLink(link_message(index));
        self.kernel.request(&format!("delete interface #{index}"), message, NLM_F_ACK, &[])?;
        Ok(())
    }

    /// The index of the interface called `name`.
    ///
    /// # Errors
    /// As [`Netlink::link`].
    pub fn link_index(&mut self, name: &str) -> Result<u32> {
        Ok(self.link(name)?.index)
    }

    /// What the kernel says about the interface called `name`.
    ///
    /// # Errors
    /// There is no interface of this name in the namespace.
    pub fn link(&mut self, name: &str) -> Result<Link> {
        check_name(name)?;
        let mut question = LinkMessage::default();
        question.attributes =
            vec![LinkAttribute::IfName(name.into()), LinkAttribute::ExtMask(vec![LinkExtentMask::SkipStats])];
        let what = format!("look up interface `{name}`");
        let remedy = &[(Errno::ENODEV, "the namespace has no interface of this name")];
        let replies =
            self.kernel.request(&what, RouteNetlinkMessage::GetLink(question), NLM_F_ACK, remedy)?;
        replies.into_iter().find_map(Link::from_reply).with_context(|| format!("cannot {what}: empty answer"))
    }

    /// All interfaces of the namespace.
    ///
    /// # Errors
    /// The kernel's answer cannot be understood.
    pub fn links(&mut self) -> Result<Vec<Link>> {
        let mut question = LinkMessage::default();
        question.attributes = vec![LinkAttribute::ExtMask(vec![LinkExtentMask::SkipStats])];
        let replies = self.kernel.request(
            "list interfaces",
            RouteNetlinkMessage::GetLink(question),
            NLM_F_DUMP,
            &[],
        )?;
        Ok(replies.into_iter().filter_map(Link::from_reply).collect())
    }

    /// Sets the interface with this index up.
    ///
    /// # Errors
    /// There is no such interface.
    pub fn set_up(&mut self, index: u32) -> Result<()> {
        let mut link = link_message(index);
        link.header.flags = LinkFlags::Up;
        link.header.change_mask = LinkFlags::Up;
        self.change(&format!("set interface #{index} up"), link)
    }

    /// Sets the interface with this index down; the other end of a veth loses its carrier.
    ///
    /// # Errors
    /// There is no such interface.
    pub fn set_down(&mut self, index: u32) -> Result<()> {
        let mut link = link_message(index);
        link.header.change_mask = LinkFlags::Up;
        self.change(&format!("set interface #{index} down"), link)
    }

    /// Gives the interface with this index another name. Kernels before 6.2 want it down for that.
    ///
    /// # Errors
    /// There is no such interface, the name is not one for an interface, or is taken.
    pub fn rename(&mut self, index: u32, name: &str) -> Result<()> {
        check_name(name)?;
        let mut link = link_message(index);
        link.attributes = vec![LinkAttribute::IfName(name.into())];
        self.change(&format!("call interface #{index} `{name}`"), link)
    }

    /// Moves the interface with this index to another namespace, in which it is down.
    ///
    /// # Errors
    /// There is no such interface, or its name is taken there.
    pub fn move_to(&mut self, index: u32, namespace: BorrowedFd<'_>) -> Result<()> {
        let mut link = link_message(index);
        link.attributes = vec![LinkAttribute::NetNsFd(namespace.as_raw_fd())];
        self.change(&format!("move interface #{index} to another namespace"), link)
    }

    /// Makes the interface with this index a port of the bridge with index `bridge`.
    ///
    /// # Errors
    /// One of the two does not exist, or `bridge` is no bridge.
    pub fn set_master(&mut self, index: u32, bridge: u32) -> Result<()> {
        let mut link = link_message(index);
        link.attributes = vec![LinkAttribute::Controller(bridge)];
        self.change(&format!("make interface #{index} a port of bridge #{bridge}"), link)
    }

    /// Stops a bridge from learning which stations are behind this port.
    ///
    /// A learnt entry depends on who spoke first, which would differ from run to run; see
    /// [`Netlink::add_static_fdb`]. Frames for unknown stations are still flooded, as broadcasts
    /// are.
    ///
    /// # Errors
    /// There is no such interface, or it is no port of a bridge.
    pub fn disable_learning(&mut self, port: u32) -> Result<()> {
        let mut link = link_message(port);
        link.attributes = vec![LinkAttribute::LinkInfo(vec![
            LinkInfo::PortKind(InfoPortKind::Bridge),
            LinkInfo::PortData(InfoPortData::BridgePort(vec![InfoBridgePort::Learning(false)])),
        ])];
        self.change(&format!("turn learning off at bridge port #{port}"), link)
    }

    /// Tells the bridge for good that the station `mac` is behind this port, so that it never
    /// floods frames for it.
    ///
    /// # Errors
    /// There is no such port, or the bridge knows the station at some port already.
    pub fn add_static_fdb(&mut self, port: u32, mac: [u8; 6]) -> Result<()> {
        check_mac(mac).with_context(|| format!("bridge port #{port}"))?;
        let mut entry = bridge_neighbour();
        entry.header.ifindex = port;
        // NUD_NOARP is "static". NUD_PERMANENT would be "local": the bridge would keep the frames.
        entry.header.state = NeighbourState::Noarp;
        entry.header.flags = NeighbourFlags::Controller;
        entry.attributes = vec![NeighbourAttribute::LinkLocalAddress(mac.to_vec())];
        self.create(
            &format!("tell the bridge that {} is behind port #{port}", MacAddr::from(mac)),
            RouteNetlinkMessage::NewNeighbour(entry),
            &[(Errno::EEXIST, "another station has this MAC: give every station its own")],
        )
    }

    /// The stations that the bridge was told to be behind this port ([`Netlink::add_static_fdb`]).
    ///
    /// # Errors
    /// The kernel's answer cannot be understood.
    pub fn static_fdb(&mut self, port: u32) -> Result<Vec<[u8; 6]>> {
        let question = RouteNetlinkMessage::GetNeighbour(bridge_neighbour());
        let replies = self.kernel.request("list the entries of bridges", question, NLM_F_DUMP, &[])?;
        let station = |reply| match reply {
            RouteNetlinkMessage::NewNeighbour(entry) => static_entry(&entry, port),
            _ => None,
        };
        Ok(replies.into_iter().filter_map(station).collect())
    }

    fn create(&mut self, what: &str, message: RouteNetlinkMessage, remedies: &[(Errno, &str)]) -> Result<()> {
        self.kernel.request(what, message, NLM_F_ACK | NLM_F_CREATE | NLM_F_EXCL, remedies)?;
        Ok(())
    }

    fn change(&mut self, what: &str, link: LinkMessage) -> Result<()> {
        // RTM_NEWLINK without NLM_F_CREATE; RTM_SETLINK passes over the settings of bridge ports.
        self.kernel.request(what, RouteNetlinkMessage::NewLink(link), NLM_F_ACK, &[])?;
        Ok(())
    }
}

fn link_message(index: u32) -> LinkMessage {
    let mut link = LinkMessage::default();
    link.header.index = index;
    link
}

fn bridge_neighbour() -> NeighbourMessage {
    let mut neighbour = NeighbourMessage::default();
    neighbour.header.family = AddressFamily::Bridge;
    neighbour
}

/// The MAC of a static entry at `port`; the copies that the bridge keeps for its VLANs do not
/// count.
fn static_entry(entry: &NeighbourMessage, port: u32) -> Option<[u8; 6]> {
    let of_vlan = entry.attributes.iter().any(|attribute| matches!(attribute, NeighbourAttribute::Vlan(_)));
    if entry.header.ifindex != port || entry.header.state != NeighbourState::Noarp || of_vlan {
        return None;
    }
    entry.attributes.iter().find_map(|attribute| match attribute {
        NeighbourAttribute::LinkLocalAddress(mac) => mac.as_slice().try_into().ok(),
        _ => None,
    })
}
