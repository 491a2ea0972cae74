//! The NoMAC discipline: RTmac without time slots. Frames leave at once, the most urgent first; what a VNIC sends is
//! tunnelled as with TDMA, so that stations of both understand each other's.
//!
//! Its number among RTmac's types is 0, and it has no control frames: one that comes is refused, and none ever leaves.

use rtnet::at_once::{AtOnce, Rules};
use rtnet::buf::Buf;
use rtnet::counters::Refusal;
use rtnet::discipline::Claimed;
use rtnet::queue::Priority;
use rtnet::wire::ethernet::{EtherType, Header};

use crate::wire::{RTMAC_VERSION, head};

/// RTmac's type of NoMAC's control frames, if there were any.
pub const TYPE_NOMAC: u16 = 0x0000;

/// A station that shares the medium with whoever else sends.
pub type NoMac = AtOnce<Unslotted>;

/// The rules of [`NoMac`].
pub enum Unslotted {}

impl Rules for Unslotted {
    const NAME: &'static str = "nomac";

    fn claims(header: &Header) -> bool {
        header.ether_type() == EtherType::RTMAC
    }

    fn on_frame(frame: Buf) -> Claimed {
        let refusal = match head(&frame) {
            Err(reason) => reason,
            Ok((head, _)) if head.version != RTMAC_VERSION => Refusal::RtmacVersion,
            Ok((head, _)) if head.is_tunnel() => return Claimed::Tunnel(frame),
            Ok((head, _)) if head.kind() == TYPE_NOMAC => Refusal::NomacControl,
            Ok(_) => Refusal::OtherDiscipline,
        };
        Claimed::Refused(refusal)
    }

    /// Of RTmac's frames only tunnelled ones: a real station never frees a control frame that is not its discipline's
    /// (invariant 8), nor one of NoMAC's own.
    fn may_leave(frame: &[u8]) -> bool {
        let Some((header, _)) = Header::parse(frame) else { return false };
        header.ether_type() != EtherType::RTMAC || head(frame).is_ok_and(|(head, _)| head.is_tunnel())
    }

    fn level(asked: Priority) -> Priority {
        asked
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtnet::at_once::DEFAULT_ASK_EVERY;
    use rtnet::buf::Pool;
    use rtnet::discipline::{Discipline, SendError, Sent};
    use rtnet::time::Instant;

    const NOW: Instant = Instant::from_nanos(1_000_000);

    fn frame(pool: &Pool, ether_type: EtherType, rtmac: [u8; 4]) -> Buf {
        let mut bytes = [0; 60];
        bytes[12..14].copy_from_slice(&ether_type.0.to_be_bytes());
        bytes[14..18].copy_from_slice(&rtmac);
        let mut frame = pool.take().unwrap();
        frame.fill(&bytes);
        frame
    }

    fn rtmac(pool: &Pool, kind: u16, version: u8, flags: u8) -> Buf {
        let [high, low] = kind.to_be_bytes();
        frame(pool, EtherType::RTMAC, [high, low, version, flags])
    }

    #[test]
    fn the_most_urgent_frame_leaves_first_whatever_its_channel() {
        let pool = Pool::new(4);
        let mut nomac = NoMac::new(DEFAULT_ASK_EVERY);
        nomac.on_timeout(NOW);
        for (number, level, channel) in [(1, 31, 1), (2, 15, 0), (3, 15, 99), (4, 0, 7)] {
            let data = frame(&pool, EtherType::EXPERIMENTAL, [number, 0, 0, 0]);
            nomac.enqueue(data, Priority::new(level).unwrap(), channel).unwrap();
            assert_eq!(nomac.payload_limit(channel), Ok(1500));
        }
        let next = || {
            let chosen = nomac.next_transmission(NOW)?;
            nomac.on_sent(Sent::At(NOW));
            Some(chosen.frame[14])
        };
        assert_eq!(std::iter::from_fn(next).collect::<Vec<_>>(), [4, 2, 3, 1]);
    }

    #[test]
    fn a_control_frame_is_refused_by_reason_and_only_a_tunnelled_one_is_taken() {
        let pool = Pool::new(1);
        let mut nomac = NoMac::new(DEFAULT_ASK_EVERY);
        for (kind, version, flags, reason) in [
            (TYPE_NOMAC, 2, 0, Refusal::NomacControl),
            (1, 2, 0, Refusal::OtherDiscipline),
            (0x42, 2, 0xfe, Refusal::OtherDiscipline),
            (0x0800, 1, 1, Refusal::RtmacVersion),
        ] {
            let claimed = nomac.on_frame(None, rtmac(&pool, kind, version, flags));
            assert!(matches!(claimed, Claimed::Refused(why) if why == reason), "{reason:?}: {claimed:?}");
        }
        let mut short = rtmac(&pool, 0x0800, 2, 1);
        short.set_len(17);
        assert!(matches!(nomac.on_frame(None, short), Claimed::Refused(Refusal::Truncated)));
        assert!(matches!(nomac.on_frame(None, rtmac(&pool, 0x0800, 2, 1)), Claimed::Tunnel(_)));
    }

    #[test]
    fn no_control_frame_of_any_discipline_ever_leaves_a_nomac_station() {
        let pool = Pool::new(2);
        let mut nomac = NoMac::new(DEFAULT_ASK_EVERY);
        nomac.on_timeout(NOW);
        for kind in 0..=u16::MAX {
            let refused = nomac.enqueue(rtmac(&pool, kind, 2, 0), Priority::FIRST, 0);
            assert!(matches!(refused, Err((SendError::Lethal, _))), "type {kind:#06x}");
        }
        let mut short = rtmac(&pool, 0x0800, 2, 1);
        short.set_len(17);
        assert!(nomac.enqueue(short, Priority::FIRST, 0).is_err(), "without a whole head");
        nomac.enqueue(rtmac(&pool, 0x0800, 2, 1), Priority::NON_RT, 1).unwrap();
        let tunnelled = nomac.next_transmission(NOW).unwrap();
        assert_eq!(tunnelled.frame[14..18], [8, 0, 2, 1]);
        assert!(nomac.next_transmission(NOW).is_none());
    }
}
