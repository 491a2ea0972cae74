//! How fast a device is fed: a token bucket in front of it, tbf (tc-tbf(8)).
//!
//! ```text
//!  TCA_OPTIONS
//!    TCA_TBF_PARMS   struct tc_tbf_qopt
//!      0        1            2        4            6    8     12
//!      +--------+------------+--------+------------+----+-----+-------------------+-------+--------+-----+
//!      |cell_log| link layer |overhead| cell_align | mpu| rate| peak rate, 12 of  | limit | buffer | mtu |
//!      |        | 1: Ethernet|        |            |    |     | the same          |       |        |     |
//!      +--------+------------+--------+------------+----+-----+-------------------+-------+--------+-----+
//!    TCA_TBF_RATE64  u64, bytes a second, where 32 bits are too few
//!    TCA_TBF_PRATE64 the same of the peak rate
//!    TCA_TBF_BURST   u32, bytes
//!    TCA_TBF_PBURST  u32, bytes at the peak rate
//! ```
//!
//! What waits in it waits in a queue of its own, pfifo (tc-pfifo(8)), whose TCA_OPTIONS are a u32: the packets that it takes.
//! The one that a token bucket brings takes bytes, of which many short packets are few. What GSO puts together is one packet
//! to both: a peak rate, which is never in the way, has the bucket take apart what is longer than its burst.

use netlink_packet_core::{DefaultNla, NLM_F_ACK, NLM_F_CREATE, NLM_F_ECHO, NLM_F_REPLACE};
use netlink_packet_route::RouteNetlinkMessage;
use netlink_packet_route::tc::{TcAttribute, TcHandle, TcMessage, TcOption, TcStats2};
use nix::errno::Errno;

use super::{Links, Refused};

const KIND: &str = "tbf";
const QUEUE_KIND: &str = "pfifo";
/// linux/rtnetlink.h.
const TCA_OPTIONS: u16 = 2;
/// linux/pkt_sched.h.
pub(super) const TCA_TBF_PARMS: u16 = 1;
pub(super) const TCA_TBF_RATE64: u16 = 4;
pub(super) const TCA_TBF_PRATE64: u16 = 5;
pub(super) const TCA_TBF_BURST: u16 = 6;
pub(super) const TCA_TBF_PBURST: u16 = 7;
/// Faster than any rate, which the kernel insists on: a frame takes no more than two nanoseconds of it.
pub(super) const PEAK: u64 = 1 << 40;
/// TC_LINKLAYER_ETHERNET: lengths are as they are, without a table of the times that they take.
const ETHERNET: u8 = 1;

/// A device fed by a token bucket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shaping {
    /// What the device is fed on average, at least 1.
    pub bytes_per_second: u64,
    /// What it may be fed at once, in bytes.
    pub burst: u32,
    /// The longest packet, in bytes with its header: each counts as that, however short it is, where each takes as long as
    /// the longest. No longer one gets through.
    pub longest: u16,
    /// How many packets may wait; what comes then is dropped.
    pub limit: u32,
}

/// What went through a token bucket.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ShapingStatistics {
    /// Bytes that were passed on.
    pub bytes: u64,
    /// Packets that were passed on.
    pub packets: u64,
    /// Packets that were dropped: too many waited, or they were too long.
    pub drops: u64,
    /// Packets that wait.
    pub waiting: u64,
    /// Bytes that wait.
    pub backlog: u64,
}

impl Links {
    /// Puts a token bucket in front of the device, instead of what was there; if that was one, what waits in it stays, and its
    /// counts go on. Told is why what waits is not bounded in packets, if it is not: it is in bytes then, those of as many of
    /// the longest.
    ///
    /// # Errors
    /// There is no such device, a rate, burst or length is zero, or the kernel has no tbf ([`Refused::is_unsupported`]).
    pub fn limit_rate(&mut self, index: u32, shaping: &Shaping) -> Result<Option<Refused>, Refused> {
        let what = format!("limit the rate of interface #{index}");
        let needs_tbf = "the kernel must have CONFIG_NET_SCH_TBF (try `modprobe sch_tbf`)";
        let remedies = &[
            (Errno::ENOENT, needs_tbf),
            (Errno::EOPNOTSUPP, needs_tbf),
            (Errno::EINVAL, "rate, burst and length must be more than zero"),
        ];
        if shaping.bytes_per_second == 0 {
            // To the kernel that is no limit.
            return Err(Refused::because(&what, None, Errno::EINVAL, remedies));
        }
        let options = TcAttribute::Options(shaping.options());
        self.put(&what, at(index, TcHandle::ROOT), KIND, options, remedies)?;
        // A bucket that is changed gives its own limit to its queue, whatever that counts.
        Ok(self.limit_queue(index, shaping.limit).err())
    }

    /// Has so many packets wait in the token bucket in front of the device.
    fn limit_queue(&mut self, index: u32, packets: u32) -> Result<(), Refused> {
        let what = format!("bound what waits in front of interface #{index} in packets");
        // The kernel has numbered it.
        let bucket = self.discipline(index, TcHandle::ROOT)?.header.handle;
        let options = DefaultNla::new(TCA_OPTIONS, packets.to_ne_bytes().to_vec());
        let inside = at(index, TcHandle { minor: 1, ..bucket });
        self.put(&what, inside, QUEUE_KIND, TcAttribute::Other(options), &[])
    }

    /// Puts a queueing discipline there, or changes it if it is of that kind already.
    fn put(
        &mut self,
        what: &str,
        mut there: TcMessage,
        kind: &str,
        options: TcAttribute,
        remedies: &[(Errno, &str)],
    ) -> Result<(), Refused> {
        there.attributes = vec![TcAttribute::Kind(kind.into()), options];
        let message = RouteNetlinkMessage::NewQueueDiscipline(there);
        let flags = NLM_F_ACK | NLM_F_CREATE | NLM_F_REPLACE;
        self.kernel.request(what, message, flags, remedies).map(drop)
    }

    /// Takes the token bucket away, if there is one in front of the device: what waits in it is lost.
    ///
    /// # Errors
    /// There is no such device.
    pub fn unlimit_rate(&mut self, index: u32) -> Result<(), Refused> {
        if self.shaping(index)?.is_none() {
            return Ok(());
        }
        let mut message = at(index, TcHandle::ROOT);
        message.attributes = vec![TcAttribute::Kind(KIND.into())];
        let what = format!("let interface #{index} be fed at any rate");
        self.kernel.request(&what, RouteNetlinkMessage::DelQueueDiscipline(message), NLM_F_ACK, &[]).map(drop)
    }

    /// What went through the token bucket in front of the device, if there is one.
    ///
    /// # Errors
    /// There is no such device, or the kernel's answer cannot be understood.
    pub fn shaping(&mut self, index: u32) -> Result<Option<ShapingStatistics>, Refused> {
        Ok(self.bucket(index)?.map(|(_, statistics)| statistics))
    }

    /// The same, with the number that the kernel has given to the token bucket: one that is made anew has another.
    pub(crate) fn bucket(&mut self, index: u32) -> Result<Option<(u32, ShapingStatistics)>, Refused> {
        let TcMessage { header, attributes, .. } = self.discipline(index, TcHandle::ROOT)?;
        let is_tbf = attributes.contains(&TcAttribute::Kind(KIND.into()));
        Ok(is_tbf.then(|| (header.handle.into(), statistics(&attributes))))
    }

    /// The queueing discipline there: without attributes where is none, or one that frames go past.
    pub(super) fn discipline(&mut self, index: u32, parent: TcHandle) -> Result<TcMessage, Refused> {
        let what = format!("look up what feeds interface #{index}");
        let question = RouteNetlinkMessage::GetQueueDiscipline(at(index, parent));
        // Without NLM_F_ECHO the kernel answers those only who listen to all changes.
        let replies = match self.kernel.request(&what, question, NLM_F_ACK | NLM_F_ECHO, &[]) {
            // There is none, or the kernel has none at all (CONFIG_NET_SCHED).
            Err(refused) if matches!(refused.errno(), Some(Errno::ENOENT | Errno::EOPNOTSUPP)) => {
                return Ok(TcMessage::default());
            }
            replies => replies?,
        };
        let discipline = |reply| match reply {
            RouteNetlinkMessage::NewQueueDiscipline(message) => Some(message),
            _ => None,
        };
        Ok(replies.into_iter().find_map(discipline).unwrap_or_default())
    }
}

impl Shaping {
    /// As the kernel wants it. Neither `buffer` nor `mtu`, the bursts in the kernel's ticks, is looked at with what is asked
    /// for here.
    pub(super) fn options(&self) -> Vec<TcOption> {
        let rate = u32::try_from(self.bytes_per_second);
        // Until its queue takes packets, or if it never does.
        let limit = self.limit.saturating_mul(self.longest.into());
        let mut parameters = [0; 36];
        [parameters[1], parameters[13]] = [ETHERNET; 2];
        parameters[6..8].copy_from_slice(&self.longest.to_ne_bytes());
        parameters[8..12].copy_from_slice(&rate.unwrap_or(u32::MAX).to_ne_bytes());
        parameters[20..24].copy_from_slice(&u32::MAX.to_ne_bytes());
        parameters[24..28].copy_from_slice(&limit.to_ne_bytes());
        let option = |kind, value: &[u8]| TcOption::Other(DefaultNla::new(kind, value.to_vec()));
        let mut options = vec![
            option(TCA_TBF_PARMS, &parameters),
            option(TCA_TBF_PRATE64, &PEAK.to_ne_bytes()),
            option(TCA_TBF_BURST, &self.burst.to_ne_bytes()),
            option(TCA_TBF_PBURST, &u32::from(self.longest).to_ne_bytes()),
        ];
        if rate.is_err() {
            options.push(option(TCA_TBF_RATE64, &self.bytes_per_second.to_ne_bytes()));
        }
        options
    }
}

fn at(index: u32, parent: TcHandle) -> TcMessage {
    // The kernel numbers devices from 1 up, in 31 bits.
    let mut message = TcMessage::with_index(index as i32);
    message.header.parent = parent;
    message
}

/// From TCA_STATS2; TCA_STATS, in 32 bits, where a kernel has no other.
fn statistics(discipline: &[TcAttribute]) -> ShapingStatistics {
    let mut found = ShapingStatistics::default();
    for attribute in discipline {
        match attribute {
            TcAttribute::Stats2(parts) => {
                for part in parts {
                    match part {
                        TcStats2::Basic(it) => (found.bytes, found.packets) = (it.bytes, it.packets.into()),
                        TcStats2::Queue(it) => {
                            (found.drops, found.waiting) = (it.drops.into(), it.qlen.into());
                            found.backlog = it.backlog.into();
                        }
                        _ => {}
                    }
                }
                return found;
            }
            TcAttribute::Stats(it) => {
                found = ShapingStatistics {
                    bytes: it.bytes,
                    packets: it.packets.into(),
                    drops: it.drops.into(),
                    waiting: it.qlen.into(),
                    backlog: it.backlog.into(),
                }
            }
            _ => {}
        }
    }
    found
}
