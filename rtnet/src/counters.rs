//! Whatever is refused is counted by reason.

/// Counts per [`Refusal`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refusals([u64; Refusal::ALL.len()]);

macro_rules! refusals {
    ($($(#[doc = $doc:literal])+ $name:ident = $text:literal,)+) => {
        /// Why a frame was not accepted, or a request not granted.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Refusal { $($(#[doc = $doc])+ $name,)+ }

        impl Refusal {
            /// Every reason, in the order of declaration.
            pub const ALL: &[Refusal] = &[$(Refusal::$name,)+];

            /// The reason's name in reports.
            pub const fn name(self) -> &'static str {
                match self { $(Refusal::$name => $text,)+ }
            }
        }
    };
}

refusals! {
    /// Shorter than an Ethernet header.
    Runt = "runt",
    /// No service and no discipline takes this EtherType.
    UnclaimedEtherType = "unclaimed_ether_type",
    /// Kernel stamp lost to a step of the wall clock.
    NoStamp = "no_stamp",
    /// The consumer's own pool had no empty buffer to give.
    PoolEmpty = "pool_empty",
    /// An RTmac frame whose version is not 2.
    RtmacVersion = "rtmac_version",
    /// An RTmac control frame of another discipline.
    OtherDiscipline = "other_discipline",
    /// An RTmac control frame of NoMAC, which has none.
    NomacControl = "nomac_control",
    /// A tunnelled frame, and nothing here that unwraps it.
    NoTunnel = "no_tunnel",
    /// Sent by a group, or by this station's own address: nobody who is one station.
    ForgedSource = "forged_source",
    /// Ends before its last field.
    Truncated = "truncated",
    /// A packet of another IP than version 4.
    IpVersion = "ip_version",
    /// An IP header shorter than any, or longer than what is there.
    IpHeaderLength = "ip_header_length",
    /// An IP header that was changed on the way.
    IpChecksum = "ip_checksum",
    /// A packet whose total length is less than its header's, or more than is there.
    IpLength = "ip_length",
    /// A packet that had no hop left.
    IpTtl = "ip_ttl",
    /// A fragment that no datagram can be put together with.
    IpFragment = "ip_fragment",
    /// A UDP datagram whose length cannot be its own.
    UdpLength = "udp_length",
    /// A UDP datagram that was changed on the way.
    UdpChecksum = "udp_checksum",
    /// An ICMP message that is neither an echo request nor a reply.
    IcmpType = "icmp_type",
    /// An ICMP message that was changed on the way.
    IcmpChecksum = "icmp_checksum",
    /// An ARP packet that is not of Ethernet and IPv4, or neither request nor reply.
    ArpFormat = "arp_format",
    /// A TDMA frame whose version is not 0x0201.
    TdmaVersion = "tdma_version",
    /// A TDMA message identifier that is not defined.
    TdmaMessage = "tdma_message",
    /// A part of a schedule, or an answer to one, whose fields contradict each other.
    ScheduleFormat = "schedule_format",
    /// A part of a schedule, or an answer to one, that nobody here asks for.
    ScheduleUnknown = "schedule_unknown",
    /// A part of a schedule with more slots than this station has room for.
    ScheduleTooLarge = "schedule_too_large",
    /// A Synchronisation from somebody else while this station is the active master.
    ForeignSync = "foreign_sync",
    /// A Synchronisation whose times cannot be meant: seconds away from its own reception.
    ImplausibleSync = "implausible_sync",
    /// A Synchronisation with a cycle number that has been seen.
    DuplicateCycle = "duplicate_cycle",
    /// A calibration request to a station that is not an active master.
    NotMaster = "not_master",
    /// A calibration request for an answer in a cycle that has passed.
    ReplyOverdue = "reply_overdue",
    /// A calibration request for an answer later than any real one asks, or outside the cycle.
    ReplyImplausible = "reply_implausible",
    /// A calibration request while the most that are answered at a time are pending.
    ReplyBacklog = "reply_backlog",
    /// A calibration reply that nobody here waits for.
    UnexpectedReply = "unexpected_reply",
    /// A calibration reply whose stamps give an impossible delay.
    ImplausibleReply = "implausible_reply",
    /// A TDMA frame while this station takes no part in the cycle.
    Detached = "detached",
    /// A token's frame of another version.
    TokenVersion = "token_version",
    /// A token's frame that neither passes nor claims it.
    TokenKind = "token_kind",
    /// A token's frame that no station of any ring sends.
    TokenFields = "token_fields",
    /// A token of another ring, or of this one as it is configured otherwise.
    TokenRing = "token_ring",
    /// A token that another one has outlasted.
    TokenStale = "token_stale",
    /// An IP packet for another address.
    ForeignAddress = "foreign_address",
    /// An IP packet of a protocol that nobody here speaks.
    NoProtocol = "no_protocol",
    /// A datagram to a port that no socket here listens on for its sender.
    NoSocket = "no_socket",
    /// A fragment of a datagram whose begin has not come, or was given up.
    FragmentOrphan = "fragment_orphan",
    /// A fragment whose bytes have come already: the medium has doubled it.
    FragmentRepeated = "fragment_repeated",
    /// A fragment that is not the next of its datagram, which is given up with it.
    FragmentOrder = "fragment_order",
    /// The begin of a datagram for a socket that waits for the rest of as many as it may.
    FragmentLimit = "fragment_limit",
    /// An echo, or its answer, in fragments.
    IcmpFragmented = "icmp_fragmented",
    /// A question for an echo to all stations at once.
    IcmpBroadcast = "icmp_broadcast",
    /// An echo that nobody here asked for, or asks for any more.
    IcmpUnexpected = "icmp_unexpected",
    /// The answer to an echo while as many as are kept have not been looked at by who asked.
    IcmpBacklog = "icmp_backlog",
    /// An answer is due to an address without a route.
    NoRoute = "no_route",
    /// An answer is due, and the discipline does not take it: no slot, or one too small.
    NotQueued = "not_queued",
    /// Address resolution that concerns others: gratuitous, or for another address.
    ArpNotForUs = "arp_not_for_us",
    /// An address that nobody here asked for.
    ArpUnsolicited = "arp_unsolicited",
    /// A station claims an address that is ours, or another's by the table.
    ArpConflict = "arp_conflict",
    /// An address that finds the table of host routes full.
    RoutesFull = "routes_full",
    /// Test traffic whose sequence, addressing or pattern is not what was sent.
    BadPayload = "bad_payload",
}

impl Refusals {
    /// Counts one.
    pub fn count(&mut self, reason: Refusal) {
        self.0[reason as usize] += 1;
    }
    /// How many for this reason.
    pub fn get(&self, reason: Refusal) -> u64 {
        self.0[reason as usize]
    }
    /// All of them together.
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }
    /// Every reason that occurred, with its count.
    pub fn nonzero(&self) -> impl Iterator<Item = (Refusal, u64)> + '_ {
        Refusal::ALL.iter().map(|&reason| (reason, self.get(reason))).filter(|(_, n)| *n > 0)
    }
}

impl Default for Refusals {
    fn default() -> Self {
        Self([0; Refusal::ALL.len()])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_reason_has_its_own_count_and_name() {
        let mut counts = Refusals::default();
        for &reason in Refusal::ALL {
            counts.count(reason);
        }
        assert_eq!(counts.total(), Refusal::ALL.len() as u64);
        assert!(counts.nonzero().all(|(_, n)| n == 1));
        let mut names: Vec<_> = Refusal::ALL.iter().map(|r| r.name()).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), Refusal::ALL.len());
    }
}
