//! Networks on hosts that do the worst that hosts do: whatever is on the medium, or is not, somebody has told why. Tunnelled
//! frames do not say of which turn they are. In virtual time there is no Linux to tunnel for, so that test traffic looks
//! like them to who judges it.

use std::cell::Cell;
use std::collections::BTreeSet;

use rtmac::wire::{FLAG_TUNNEL, RTMAC_VERSION};
use rtnet::sim::Aired;
use rtnet::wire::ethernet::{EtherType, HEADER_LEN};

use super::*;
use crate::judge::findings::FindingKind;
use crate::report::figures::Figures;
use crate::scenario::Source;
use crate::station::traffic::Tag;

const NETWORK: &str = r#"
cycle = "1ms"
duration = "20s"
slot_guard = "user"
[host]
wake = "exponential 13us"
send = "uniform 0us 0.4us"
HOST
[[station]]
name = "primary"
role = "master"
vnic = "10.1.0.1/24"
slots = [{ id = 0, offset = "200us", size = 64 }, { id = 1, offset = "500us" }]
[[station]]
name = "near"
NEAR
vnic = "10.1.0.2/24"
slots = [
    { id = 0, offset = "260us", size = 64 },
    { id = 1, offset = "625us", phase = "2/3" },
    { id = 2, offset = "750us", joint = 1 },
]
[[station]]
name = "far"
FAR
vnic = "10.1.0.3/24"
slots = [{ id = 0, offset = "320us", size = 64 }, { id = 1, offset = "875us", phase = "1/2" }]
"#;

/// That stand still, and hold frames up behind the last look at the clock: for a few cycles, for many, or for short, but often.
const HOSTS: [&str; 3] = [
    "outages = { ppm = 20000, longest = '5ms' }\nstalls = { ppm = 5000, longest = '5ms' }",
    "outages = { ppm = 2000, longest = '30ms' }\nstalls = { ppm = 1000, longest = '60ms' }",
    "outages = { ppm = 100000, longest = '2ms' }\nstalls = { ppm = 50000, longest = '1500us' }",
];

const SLAVE: &str = "role = 'slave'\nrounds = 10";
const BACKUPS: [&str; 2] = ["role = 'backup'\nbackup = '70us'", "role = 'backup'\nbackup = '140us'"];

/// A frame of slot 0 as it is, and any other as a tunnelled one.
fn as_tunnelled(frame: &[u8]) -> Option<Vec<u8>> {
    Tag::of_intact(frame).filter(|tag| tag.slot > 0)?;
    let [ether_type, inner] = [EtherType::RTMAC, EtherType::IPV4].map(|of| of.0.to_be_bytes());
    let mut frame = frame.to_vec();
    frame[HEADER_LEN - 2..HEADER_LEN].copy_from_slice(&ether_type);
    frame[HEADER_LEN..][..2].copy_from_slice(&inner);
    frame[HEADER_LEN + 2..][..2].copy_from_slice(&[RTMAC_VERSION, FLAG_TUNNEL]);
    Some(frame)
}

/// What was found in a run, and how many of its frames were taken for tunnelled ones.
fn judged(network: &str) -> (Account, u64) {
    let scenario = Source::new("net.toml", network).parse().unwrap();
    let options = Options::default();
    let mut run = Run::new(&scenario, &options).unwrap();
    let (watch, frames) = (run.watch.clone(), Rc::new(Cell::new(0)));
    let tunnelled = frames.clone();
    run.world.network.observe(move |aired| {
        let bytes = as_tunnelled(aired.bytes);
        tunnelled.set(tunnelled.get() + u64::from(bytes.is_some()));
        watch.borrow_mut().aired(&Aired { bytes: bytes.as_deref().unwrap_or(aired.bytes), ..*aired });
    });
    run.join().unwrap();
    run.settle();
    run.measure().unwrap();
    let Watch { analysis, records, .. } = &mut *run.watch.borrow_mut();
    analysis.finish();
    run.account.close(&scenario, analysis, records);
    (run.account, frames.get())
}

/// Backups have the network to themselves from here on.
const KILLED: &str = "[[event]]\nat = '2s'\nkill = 'primary'";

/// Runs each of these networks on each host: all of all kinds was found, and explained.
fn all_is_explained(near_and_far: &[[&str; 2]], events: &str) {
    let networks = near_and_far.iter().flat_map(|of| HOSTS.map(|host| (of, host)));
    let (mut kinds, mut frames) = (BTreeSet::new(), 0);
    for (seed, ([near, far], host)) in networks.enumerate() {
        let network = NETWORK.replace("HOST", host).replace("NEAR", near).replace("FAR", far);
        let network = format!("seed = {seed}\n{network}{events}");
        let (account, tunnelled) = judged(&network);
        let mut figures = Figures::default();
        account.report(&mut figures);
        let unexplained: Vec<_> = figures.misses.iter().filter(|miss| miss.found.is_some()).collect();
        assert!(account.unexplained == 0, "{unexplained:?} in\n{network}");
        kinds.extend(account.firsts.keys().map(|(kind, _)| *kind));
        frames += tunnelled;
    }
    use FindingKind::*;
    assert_eq!(kinds, [Overlap, OutOfSlot, SyncGap, SlotMissed, WithoutSync, Repeated].into());
    assert!(frames > 50_000, "{frames}");
}

#[test]
fn tunnelled_frames_of_hosts_that_stand_still_leave_nothing_unexplained() {
    all_is_explained(&[[SLAVE, SLAVE], [BACKUPS[0], SLAVE], BACKUPS], "");
}

#[test]
fn nor_do_backups_that_stand_still_while_their_primary_is_killed() {
    all_is_explained(&[[BACKUPS[0], SLAVE], BACKUPS], KILLED);
}
