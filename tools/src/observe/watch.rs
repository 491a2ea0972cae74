//! What an observer makes of each frame: what it is, and where it is in the cycle. Pure: it is given frames and
//! stamps.

use std::fmt::Write;

use rtmac::wire::Message;
use rtnet::clock::True;
use rtnet::time::Span;

use super::decode::{Decoded, What, decode, signed_micros};
use super::line::Line;
use super::numbers::{Following, Follows, Numbers};

/// An observer's knowledge.
#[derive(Debug, Default)]
pub struct Watch {
    /// Where cycles begin.
    pub line: Line,
    numbers: Numbers,
}

/// A frame, and where it was.
#[derive(Clone, Copy, Debug)]
pub struct Sight {
    /// The frame.
    pub decoded: Decoded,
    /// Its cycle: the one it tells, else the one in which it was on the medium.
    pub cycle: Option<u32>,
    /// Its slot, of test traffic, if that is known.
    pub slot: Option<u8>,
    /// When it was.
    pub when: When,
    /// How long after the cycle's start its slot begins, by its own account, as far as that is known.
    pub offset: Option<Span>,
    /// Of a sync: how it follows the one before.
    pub follows: Option<Following>,
    /// In which count of a master its cycle is, see [`Numbers::counts`]; none if that cannot have begun yet.
    pub count: Option<u64>,
}

/// When a frame was on the medium, as far as an observer can tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    /// So long after it was to be, by its own account.
    SlotError(Span),
    /// So long after the cycle's start; it says nothing itself.
    Place(Span),
    /// There is no line yet, or no stamp to be trusted.
    Unknown,
}

impl Watch {
    /// Takes a frame of `wire_len` bytes. Without a moment, nothing is concluded from when it came.
    pub fn frame(&mut self, at: Option<True>, bytes: &[u8], wire_len: usize) -> Sight {
        let decoded = decode(bytes, wire_len);
        let slot = match decoded.what {
            What::Data(tag) if tag.priority().is_none() => Some(tag.slot),
            _ => None,
        };
        let follows = match decoded.what {
            What::Tdma(Message::Sync { cycle, sched, .. }) => Some(self.numbers.sync(cycle, sched, at)),
            _ => None,
        };
        let Some(at) = at else {
            self.line.forget();
            let cycle = decoded.what.scheduled().map(|(cycle, _)| cycle);
            return Sight { decoded, cycle, slot, when: When::Unknown, offset: None, follows, count: None };
        };
        if let What::Tdma(Message::Sync { cycle, sched, xmit }) = decoded.what
            && follows.is_some_and(|of| !matches!(of.how, Follows::Implausible | Follows::Again))
        {
            self.line.sync(at, cycle, sched, xmit);
        }
        let has_begun = |cycle| self.numbers.can_have_begun(cycle, Some(at)) == Some(true);
        let count = |cycle| has_begun(cycle).then(|| self.numbers.counts());
        let place = self.line.place(at);
        match decoded.what.scheduled() {
            Some((cycle, scheduled)) => {
                let error = self.line.error(at, scheduled);
                // One that came in another cycle than its own says nothing of where in a cycle it was to be.
                let place = place.filter(|(came_in, _)| *came_in == cycle).map(|(_, place)| place);
                let offset = place.zip(error).map(|(place, error)| place - error);
                let when = error.map_or(When::Unknown, When::SlotError);
                Sight { decoded, cycle: Some(cycle), slot, when, offset, follows, count: count(cycle) }
            }
            None => {
                let when = place.map_or(When::Unknown, |(_, span)| When::Place(span));
                let cycle = place.map(|(cycle, _)| cycle);
                Sight { decoded, cycle, slot, when, offset: None, follows, count: cycle.and_then(count) }
            }
        }
    }
}

impl Sight {
    /// A line for the screen; `realtime_ns` is the kernel's stamp.
    pub fn line(&self, realtime_ns: u64) -> String {
        let Decoded { source, destination, what } = &self.decoded;
        let when = match self.when {
            When::SlotError(error) => signed_micros(error.nanos()),
            When::Place(place) => signed_micros(place.nanos()).replacen('+', "@", 1),
            When::Unknown => "-".to_owned(),
        };
        format!("{} {source} > {destination} {when:>14}  {what}", time_of_day(realtime_ns))
    }

    /// A comment for a capture: cycle, slot, slot error.
    pub fn comment(&self) -> String {
        let mut text = self.cycle.map_or_else(|| "no cycle".to_owned(), |cycle| format!("cycle {cycle}"));
        // Writing to a string does not fail.
        let _ = match self.decoded.what {
            What::Data(tag) => {
                let slot = self.slot.map_or(String::new(), |slot| format!(" slot {slot} of"));
                let queued = tag.priority().map_or(String::new(), |of| format!(", priority {of}"));
                write!(text, ",{slot} station {}{queued}", tag.station())
            }
            What::Refused(why) => write!(text, ", refused: {}", why.name()),
            ref what => write!(text, ", {}", what.kind()),
        };
        let _ = match self.when {
            When::SlotError(error) => write!(text, ", slot error {}", signed_micros(error.nanos())),
            When::Place(place) => write!(text, ", {} from its start", signed_micros(place.nanos())),
            When::Unknown => Ok(()),
        };
        text
    }
}

/// `09:19:09.123456789`, UTC.
fn time_of_day(realtime_ns: u64) -> String {
    let (seconds, nanos) = (realtime_ns / 1_000_000_000 % 86_400, realtime_ns % 1_000_000_000);
    format!("{:02}:{:02}:{:02}.{nanos:09}", seconds / 3_600, seconds / 60 % 60, seconds % 60)
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::path::Path;

    use pcap_file::pcap::PcapReader;
    use rtnet::time::GlobalTime;
    use rtnet::wire::ethernet::Address;

    use super::*;
    use crate::observe::decode::tests::examples;
    use crate::observe::tally::tests::{data, sync};

    const PERIOD: u64 = 1_000_000;

    fn sched(cycle: u32) -> GlobalTime {
        GlobalTime::from_nanos(77_000_000_000 + u64::from(cycle) * PERIOD)
    }

    fn watching() -> Watch {
        let mut watch = Watch::default();
        for cycle in 0..80 {
            let frame = sync(cycle, sched(cycle));
            watch.frame(Some(500 + u64::from(cycle) * PERIOD), &frame, frame.len());
        }
        watch
    }

    #[test]
    fn a_frame_is_a_line_and_a_comment() {
        let mut watch = watching();
        let stamp = 86_400 * 1_000_000_000 * 20_000 + 3_661_000_000_042;
        let frame = data(2, 0, 79, sched(79) + Span::from_micros(300));
        let sight = watch.frame(Some(500 + 79 * PERIOD + 301_234), &frame, frame.len());
        assert_eq!(
            sight.line(stamp),
            "01:01:01.000000042 02:00:00:00:00:03 > 02:00:00:00:00:01       +1.234us  \
             data station 2 slot 0 cycle 79 sequence 77"
        );
        assert_eq!(sight.comment(), "cycle 79, slot 0 of station 2, slot error +1.234us");
        let frame = sync(80, sched(80));
        let sight = watch.frame(Some(500 + 80 * PERIOD + 2_000), &frame, frame.len());
        assert_eq!(sight.comment(), "cycle 80, sync, slot error +2.000us");
    }

    #[test]
    fn a_frame_that_does_not_say_when_it_was_to_be_has_its_place() {
        let mut watch = watching();
        let at = 500 + 80 * PERIOD + 512_345;
        let request = &examples()[1].1;
        let sight = watch.frame(Some(at), request, request.len());
        assert_eq!(sight.comment(), "cycle 80, request, +512.345us from its start");
        assert!(sight.line(0).contains("     @512.345us  request calibration"), "{}", sight.line(0));
        let sight = watch.frame(Some(at), &[0; 9], 9);
        assert_eq!(sight.comment(), "cycle 80, refused: runt, +512.345us from its start");
    }

    #[test]
    fn stamps_that_mean_nothing_are_not_used_nor_those_before_compared_with_those_after() {
        let mut watch = watching();
        let frame = data(2, 0, 79, sched(79));
        let sight = watch.frame(None, &frame, frame.len());
        assert_eq!((sight.when, sight.comment().as_str()), (When::Unknown, "cycle 79, slot 0 of station 2"));
        assert_eq!(watch.frame(Some(1), &frame, frame.len()).when, When::Unknown, "no sync since");
        assert_eq!(watch.frame(Some(1), &[0; 60], 60).comment(), "no cycle, other");
    }

    /// A real master, on a virtual machine: 0.14 to 2.3 ms late, which it says.
    #[test]
    fn real_stations_draw_a_line_too() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/vectors/rtnet-real.pcap");
        let mut reader = PcapReader::new(File::open(path).unwrap()).unwrap();
        let (mut watch, mut syncs, mut beside) = (Watch::default(), 0, 0);
        while let Some(packet) = reader.next_packet() {
            let packet = packet.unwrap();
            let at = packet.timestamp().as_nanos() as u64;
            let sight = watch.frame(Some(at), packet.data(), packet.data().len());
            assert_ne!(sight.decoded.source, Address::default());
            if let (What::Tdma(Message::Sync { sched, xmit, .. }), When::SlotError(error)) =
                (sight.decoded.what, sight.when)
            {
                syncs += 1;
                let unsaid = error - (xmit - sched);
                beside += u64::from(unsaid < Span::ZERO || unsaid > Span::from_micros(60));
            }
        }
        assert!(watch.line.is_settled() && watch.line.restarts() <= 1);
        assert!(syncs > 200 && beside * 20 < syncs, "{beside} of {syncs} are elsewhere than they say");
        assert!(watch.line.drift_ppb().unwrap().abs() < 50_000, "{:?}", watch.line.drift_ppb());
    }
}
