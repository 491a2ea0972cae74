use nix::errno::Errno;

use super::*;
use crate::netlink::LinkStatistics;

const INDEX: u32 = 7;
const FRAME: usize = 1510;
/// One in each millisecond.
const KNOWN: Turns = Turns::In1000Seconds(1_000_000);
const RATE: u64 = 985 * 1510;

/// A kernel with one device.
#[derive(Default)]
struct Host {
    link: Option<Link>,
    filter: Option<(u32, ShapingStatistics)>,
    /// What it was asked for.
    limits: Vec<Shaping>,
    numbered: u32,
    has_no_tbf: bool,
}

impl Host {
    fn new() -> Self {
        let link = Link { index: INDEX, is_up: true, ..Link::default() };
        Self { link: Some(link), ..Self::default() }
    }

    /// Its driver's queue has had no room for so many.
    fn drops(&mut self, send_dropped: u64) {
        let statistics = LinkStatistics { send_dropped, ..LinkStatistics::default() };
        self.link.as_mut().unwrap().statistics = statistics;
    }

    fn filters(&mut self, packets: u64, drops: u64, waiting: u64) {
        let (bytes, backlog) = (packets * 100, waiting * 100);
        self.filter.as_mut().unwrap().1 = ShapingStatistics { bytes, packets, drops, waiting, backlog };
    }
}

impl Kernel for Host {
    fn link(&mut self, index: u32) -> Result<Option<Link>, Refused> {
        assert_eq!(index, INDEX);
        Ok(self.link.clone())
    }
    fn filter(&mut self, _: u32) -> Result<Option<(u32, ShapingStatistics)>, Refused> {
        Ok(self.filter)
    }
    fn limit(&mut self, _: u32, shaping: &Shaping) -> Result<Option<Refused>, Refused> {
        self.limits.push(*shaping);
        if self.has_no_tbf {
            let source = Some(Errno::ENOENT.into());
            let remedy = Some("try `modprobe sch_tbf`".into());
            return Err(Refused { what: "limit the rate".into(), said: None, remedy, source });
        }
        self.numbered += u32::from(self.filter.is_none());
        self.filter.get_or_insert((self.numbered, ShapingStatistics::default()));
        Ok(None)
    }
    fn unlimit(&mut self, _: u32) -> Result<(), Refused> {
        self.filter = None;
        Ok(())
    }
}

/// What is told of it once it has followed.
fn told(held_back: &mut HeldBack, host: &mut Host, turns: Turns) -> Result<Shaped, String> {
    assert!(held_back.follow(host, INDEX, turns, FRAME).is_none());
    held_back.count(host, Some(INDEX)).unwrap();
    held_back.shaping()
}

fn why(why: &str) -> Result<Shaped, String> {
    Err(why.to_owned())
}

fn limited(as_before: Option<&str>) -> Result<Shaped, String> {
    Ok(Shaped { bytes_per_second: RATE, as_before: as_before.map(str::to_owned) })
}

#[test]
fn linux_is_held_back_to_a_little_less_than_the_turns_of_the_slots() {
    let every_millisecond = shaping(1_000_000, 1510);
    assert_eq!(every_millisecond.bytes_per_second, 985 * 1510);
    assert_eq!((every_millisecond.limit, every_millisecond.longest), (100, 1510));
    let seldom = shaping(1_000, 500);
    assert_eq!((seldom.bytes_per_second, seldom.limit, seldom.burst), (492, 16, 2000));
    assert_eq!(shaping(1, 60).bytes_per_second, 1);
}

#[test]
fn while_no_cycle_is_known_the_filter_stays_with_what_waits_in_it() {
    let (mut held_back, mut host) = (HeldBack::default(), Host::new());
    assert_eq!(told(&mut held_back, &mut host, Turns::NoCycle), why("no cycle is known yet"));
    assert_eq!(host.limits.len(), 0);
    assert_eq!(told(&mut held_back, &mut host, KNOWN), limited(None));
    host.filters(50, 9, 5);
    let counted = host.filter.unwrap().1;
    for (turns, why) in [
        (Turns::NoCycle, "no cycle is known any more"),
        (Turns::NoSlot, "the station has no slot 1 or 0 for it"),
        (Turns::NoCycle, "no cycle is known any more"),
    ] {
        assert_eq!(told(&mut held_back, &mut host, turns), limited(Some(why)));
        assert_eq!(host.filter, Some((1, counted)));
        assert_eq!(held_back.filter(), counted);
    }
    // Frames may become longer meanwhile, and would not get through.
    assert!(held_back.follow(&mut host, INDEX, Turns::NoCycle, 1000).is_none());
    assert_eq!(host.limits.last().unwrap().longest, 1000);
    assert_eq!(told(&mut held_back, &mut host, KNOWN), limited(None));
    assert_eq!(held_back.filter(), counted);
}

#[test]
fn why_nothing_holds_linux_back_is_told_once() {
    for (turns, said) in [
        (Turns::AtOnce, "there are no slots"),
        (Turns::NoSlot, "the station has no slot 1 or 0 for it"),
        (Turns::NoCycle, "no cycle is known yet"),
    ] {
        let mut held_back = HeldBack::default();
        assert_eq!(told(&mut held_back, &mut Host::new(), turns), why(said));
    }
    assert_eq!(HeldBack::default().shaping(), why("there is no device"));
}

#[test]
fn a_filter_that_somebody_takes_away_takes_no_figure_with_it_and_is_put_back_on_request() {
    let (mut held_back, mut host) = (HeldBack::default(), Host::new());
    told(&mut held_back, &mut host, KNOWN).unwrap();
    host.filters(50, 9, 5);
    told(&mut held_back, &mut host, KNOWN).unwrap();
    host.filter = None;
    let taken = "somebody has taken the filter away: `rtnet vnic up` puts it back";
    for _ in 0..2 {
        assert_eq!(told(&mut held_back, &mut host, KNOWN), why(taken));
        let ShapingStatistics { packets, bytes, drops, waiting, backlog } = held_back.filter();
        assert_eq!((packets, bytes, drops, waiting, backlog), (50, 5000, 14, 0, 0));
    }
    held_back.try_again();
    assert_eq!(told(&mut held_back, &mut host, KNOWN), limited(None));
    host.filters(60, 2, 1);
    told(&mut held_back, &mut host, KNOWN).unwrap();
    let ShapingStatistics { packets, drops, waiting, .. } = held_back.filter();
    assert_eq!((packets, drops, waiting), (110, 16, 1));
}

#[test]
fn what_a_device_has_counted_outlasts_it() {
    let (mut held_back, mut host) = (HeldBack::default(), Host::new());
    told(&mut held_back, &mut host, KNOWN).unwrap();
    host.filters(50, 9, 5);
    host.drops(3);
    told(&mut held_back, &mut host, KNOWN).unwrap();
    // Deleted, and that is not noticed yet; then it is.
    let device = host.link.take();
    held_back.count(&mut host, Some(INDEX)).unwrap();
    held_back.count(&mut host, None).unwrap();
    assert_eq!(held_back.shaping(), why("there is no device"));
    assert_eq!((held_back.filter().packets, held_back.filter().drops, held_back.queue_full()), (50, 14, 3));
    // Another, which begins at 0.
    (host.link, host.filter) = (device, None);
    host.drops(2);
    held_back.try_again();
    assert_eq!(told(&mut held_back, &mut host, KNOWN), limited(None));
    host.filters(1, 1, 0);
    told(&mut held_back, &mut host, KNOWN).unwrap();
    assert_eq!((held_back.filter().packets, held_back.filter().drops, held_back.queue_full()), (51, 15, 5));
}

#[test]
fn what_waited_when_the_device_was_set_down_is_lost() {
    let (mut held_back, mut host) = (HeldBack::default(), Host::new());
    told(&mut held_back, &mut host, KNOWN).unwrap();
    host.filters(50, 9, 5);
    told(&mut held_back, &mut host, KNOWN).unwrap();
    host.link.as_mut().unwrap().is_up = false;
    host.filters(51, 9, 0);
    for _ in 0..2 {
        told(&mut held_back, &mut host, KNOWN).unwrap();
        assert_eq!(held_back.filter().drops, 13, "one was passed on before");
    }
}

#[test]
fn figures_that_the_kernel_counts_in_32_bits_go_on_beyond() {
    let (mut held_back, mut host) = (HeldBack::default(), Host::new());
    told(&mut held_back, &mut host, KNOWN).unwrap();
    host.filters(u64::from(u32::MAX), 0, 0);
    told(&mut held_back, &mut host, KNOWN).unwrap();
    host.filters(9, 0, 0);
    told(&mut held_back, &mut host, KNOWN).unwrap();
    assert_eq!(held_back.filter().packets, u64::from(u32::MAX) + 9);
}

#[test]
fn a_kernel_without_the_filter_is_told_of_and_asked_again_on_request_and_the_device_counts_what_it_drops() {
    let (mut held_back, mut host) = (HeldBack::default(), Host { has_no_tbf: true, ..Host::new() });
    let without = why("cannot limit the rate: try `modprobe sch_tbf`: `rtnet vnic up` tries again");
    for _ in 0..2 {
        assert_eq!(told(&mut held_back, &mut host, KNOWN), without);
    }
    assert_eq!(host.limits.len(), 1, "it is not asked again and again");
    host.drops(49_117);
    assert_eq!(told(&mut held_back, &mut host, KNOWN), without);
    assert_eq!((held_back.queue_full(), held_back.filter()), (49_117, ShapingStatistics::default()));
    host.has_no_tbf = false;
    held_back.try_again();
    assert_eq!(told(&mut held_back, &mut host, KNOWN), limited(None));
}
