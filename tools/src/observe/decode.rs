//! What a frame is, in a line.

use std::fmt;

use rtmac::wire::change::{Extension, Verdict};
use rtmac::wire::{self, Message, Rtmac};
use rtnet::counters::Refusal;
use rtnet::time::GlobalTime;
use rtnet::wire::ethernet::{Address, EtherType, Header};

use crate::station::traffic::Tag;

/// A frame as an observer understands it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Decoded {
    /// Who sent it; zeros if it is too short to say.
    pub source: Address,
    /// Who it is for.
    pub destination: Address,
    /// What it is.
    pub what: What,
}

/// What a frame is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum What {
    /// A frame of TDMA.
    Tdma(Message),
    /// What of a schedule comes with a change.
    Extension(Extension),
    /// A foreign frame inside an RTmac frame: its EtherType, and its bytes with their padding.
    Tunnel(EtherType, usize),
    /// The lab's test traffic.
    Data(Tag),
    /// Anything else: its EtherType, and bytes of the whole frame.
    Other(EtherType, usize),
    /// No station would take it.
    Refused(Refusal),
}

/// Reads a frame of `wire_len` bytes, of which `bytes` were captured.
pub fn decode(bytes: &[u8], wire_len: usize) -> Decoded {
    let Some((header, _)) = Header::parse(bytes) else {
        let nobody = Address::default();
        return Decoded { source: nobody, destination: nobody, what: What::Refused(Refusal::Runt) };
    };
    let what = match header.ether_type() {
        EtherType::RTMAC => match wire::parse(bytes) {
            Ok(Rtmac::Tdma(message)) => What::Tdma(message),
            Ok(Rtmac::Extension(extension)) => What::Extension(extension),
            Ok(Rtmac::Tunnel(inner, payload)) => What::Tunnel(inner, payload.len()),
            Err(why) => What::Refused(why),
        },
        other => Tag::read(bytes).map_or(What::Other(other, wire_len), |(tag, _)| What::Data(*tag)),
    };
    Decoded { source: header.source, destination: header.destination, what }
}

impl What {
    /// Its kind, as counts name it.
    pub fn kind(&self) -> &'static str {
        match self {
            What::Tdma(Message::Sync { .. }) => "sync",
            What::Tdma(Message::Request { .. }) => "request",
            What::Tdma(Message::Reply { .. }) => "reply",
            What::Extension(Extension::Part(_)) => "schedule part",
            What::Extension(Extension::Answer(_)) => "schedule answer",
            What::Tunnel(..) => "tunnel",
            What::Data(_) => "data",
            What::Other(..) => "other",
            What::Refused(_) => "refused",
        }
    }

    /// When it says that it was to be sent, and in which cycle.
    pub fn scheduled(&self) -> Option<(u32, GlobalTime)> {
        match self {
            What::Tdma(Message::Sync { cycle, sched, .. }) => Some((*cycle, *sched)),
            What::Data(tag) if tag.priority().is_none() => Some((tag.cycle(), tag.scheduled())),
            _ => None,
        }
    }
}

impl fmt::Display for What {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            What::Tdma(Message::Sync { cycle, xmit, sched }) => {
                let (seconds, nanos) = (sched.nanos() / 1_000_000_000, sched.nanos() % 1_000_000_000);
                let late = signed_micros((*xmit - *sched).nanos());
                write!(f, "sync cycle {cycle} sched {seconds}.{nanos:09} xmit {late}")
            }
            What::Tdma(Message::Request { reply_cycle, reply_offset, .. }) => {
                let us = *reply_offset as f64 / 1e3;
                write!(f, "request calibration, reply in cycle {reply_cycle} at {us:.3}us")
            }
            What::Tdma(Message::Reply { reception, xmit, .. }) => {
                let held = signed_micros(xmit.wrapping_sub(*reception) as i64);
                write!(f, "reply calibration, {held} after the request")
            }
            What::Extension(Extension::Part(part)) => {
                let (number, of, slot) = (part.id.number, part.slots, part.slot.id);
                write!(
                    f,
                    "schedule {number} part {} of {of}: slot {slot} of {}",
                    part.index + 1,
                    part.station
                )
            }
            What::Extension(Extension::Answer(answer)) => {
                let number = answer.id.number;
                match answer.verdict {
                    Verdict::Acknowledged => write!(f, "schedule {number} acknowledged"),
                    Verdict::Confirmed => write!(f, "schedule {number} confirmed"),
                    Verdict::Refused(why, slot) => {
                        write!(f, "schedule {number} refused, slot {slot}: {}", why.text())
                    }
                }
            }
            What::Tunnel(inner, bytes) => write!(f, "tunnel {inner:?}, {bytes} bytes"),
            What::Data(tag) => {
                let (station, slot, sequence) = (tag.station(), tag.slot, tag.sequence());
                match tag.priority() {
                    None => write!(
                        f,
                        "data station {station} slot {slot} cycle {} sequence {sequence}",
                        tag.cycle()
                    ),
                    Some(priority) => {
                        write!(f, "data station {station} priority {priority} sequence {sequence}")
                    }
                }
            }
            What::Other(ether_type, bytes) => write!(f, "ethertype {ether_type:?}, {bytes} bytes"),
            What::Refused(why) => write!(f, "refused: {}", why.name()),
        }
    }
}

/// Nanoseconds as microseconds, signed and to the last digit: `+1.234us`.
pub fn signed_micros(ns: i64) -> String {
    let (sign, ns) = (if ns < 0 { '-' } else { '+' }, ns.unsigned_abs());
    format!("{sign}{}.{:03}us", ns / 1_000, ns % 1_000)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// The example frames of the test suite: name and bytes.
    pub(in crate::observe) fn examples() -> Vec<(String, Vec<u8>)> {
        let frames: Vec<(String, u64, String)> =
            serde_json::from_str(include_str!("../../../tests/vectors/rtnet-frames.json")).unwrap();
        let byte = |hex: &str, i: usize| u8::from_str_radix(&hex[i..i + 2], 16).unwrap();
        let bytes = |hex: &str| (0..hex.len()).step_by(2).map(|i| byte(hex, i)).collect();
        frames.into_iter().map(|(name, _, hex)| (name, bytes(&hex))).collect()
    }

    fn text(name: &str) -> String {
        let (_, bytes) = examples().into_iter().find(|(example, _)| example == name).unwrap();
        decode(&bytes, bytes.len()).what.to_string()
    }

    #[test]
    fn every_kind_of_frame_is_a_line() {
        for (name, expected) in [
            ("tdma-sync", "sync cycle 100 sched 1000.100000000 xmit +3.250us"),
            ("tdma-sync-cycle-wrap", "sync cycle 4294967295 sched 1000.151000000 xmit +0.100us"),
            ("tdma-req-cal", "request calibration, reply in cycle 101 at 400.000us"),
            ("tdma-rpl-cal", "reply calibration, +910.000us after the request"),
            ("vnic-ipv4-icmp", "tunnel 0x0800, 60 bytes"),
            ("vnic-arp", "tunnel 0x0806, 42 bytes"),
            ("rtcfg-stage1-ip", "ethertype 0x9022, 103 bytes"),
        ] {
            assert_eq!(text(name), expected, "{name}");
        }
    }

    #[test]
    fn what_no_station_takes_says_why() {
        let (_, sync) = examples().swap_remove(0);
        let refused = |change: fn(&mut Vec<u8>)| {
            let mut frame = sync.clone();
            change(&mut frame);
            let decoded = decode(&frame, frame.len());
            assert_eq!(decoded.what.kind(), "refused");
            decoded.what.to_string()
        };
        assert_eq!(refused(|frame| frame.truncate(13)), "refused: runt");
        assert_eq!(refused(|frame| frame.truncate(40)), "refused: truncated");
        assert_eq!(refused(|frame| frame[16] = 1), "refused: rtmac_version");
        assert_eq!(refused(|frame| frame[15] = 9), "refused: other_discipline");
        assert_eq!(refused(|frame| frame[19] = 0), "refused: tdma_version");
        assert_eq!(refused(|frame| frame[21] = 9), "refused: tdma_message");
    }

    #[test]
    fn a_shortened_frame_is_what_it_was_or_refused_or_foreign() {
        for (name, bytes) in examples() {
            let whole = decode(&bytes, bytes.len()).what.kind();
            for len in 0..bytes.len() {
                let short = decode(&bytes[..len], len).what;
                assert!(len >= 14 || short == What::Refused(Refusal::Runt), "{len} bytes of {name}");
                assert!(
                    [whole, "refused", "other"].contains(&short.kind()),
                    "{len} bytes of {name}: {short}"
                );
            }
        }
    }

    #[test]
    fn signs_and_all_digits_are_kept() {
        let texts = [0, -1, 1_234, -2_000_050].map(signed_micros);
        assert_eq!(texts, ["+0.000us", "-0.001us", "+1.234us", "-2000.050us"]);
    }
}
