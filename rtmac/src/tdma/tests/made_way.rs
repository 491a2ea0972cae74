//! A primary that makes way for another: whom it names meanwhile, and what it tells of its turns.

use super::*;

const CYCLE: u64 = 1_000;
/// Cycle 0 of its own line.
const START: u64 = 3_000;

fn primary(rounds: u32) -> Tdma {
    let follow = SlaveConfig { rounds, ..SlaveConfig::default() };
    let mut tdma =
        Tdma::new(&config(RoleConfig::Master(MasterConfig { follow, ..master_config() }))).unwrap();
    tdma.on_timeout(at(0));
    tdma.on_timeout(at(START));
    tdma
}

/// Gives the time in a cycle; `false` if it does so no more.
fn speaks(tdma: &mut Tdma, cycle: u64) -> bool {
    let start = START + cycle * CYCLE;
    tdma.on_timeout(at(start - 40));
    let sync = tdma.next_transmission(at(start - 40));
    sync.map(|sync| tdma.on_sent(Sent::At(sync.at))).is_some()
}

/// Another primary's Synchronisation of the same cycle, 50 us later.
fn hears_other(tdma: &mut Tdma, cycle: u64) {
    let start = START + cycle * CYCLE;
    let sched = GlobalTime::from_nanos(start * 1_000);
    let mut frame = Pool::new(1).take().unwrap();
    Message::Sync { cycle: cycle as u32, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
    tdma.on_frame(Some(at(start + 50)), frame);
}

/// It has made way in cycle 10.
fn outlasted(rounds: u32) -> Tdma {
    let mut tdma = primary(rounds);
    for cycle in 1..=10 {
        assert!(speaks(&mut tdma, cycle));
        hears_other(&mut tdma, cycle);
    }
    assert_eq!(tdma.status().mastery, Some(Mastery::Following));
    tdma
}

#[test]
fn a_primary_names_its_rival_as_long_as_that_is_heard() {
    let mut tdma = primary(0);
    let named = |tdma: &Tdma| (tdma.status().time_by, tdma.status().rival);
    assert_eq!(named(&tdma), (Some(OWN), None));
    speaks(&mut tdma, 1);
    hears_other(&mut tdma, 1);
    assert_eq!(named(&tdma), (Some(OWN), Some(OTHER)));
    speaks(&mut tdma, 2);
    assert_eq!(named(&tdma), (Some(OWN), Some(OTHER)), "one may be lost");
    (3..5).for_each(|cycle| assert!(speaks(&mut tdma, cycle)));
    assert_eq!(named(&tdma), (Some(OWN), None), "it is silent");
}

#[test]
fn an_outlasted_primary_names_who_outlasted_it_and_whom_it_follows() {
    let mut tdma = outlasted(0);
    let named = |tdma: &Tdma| {
        let TdmaStatus { yielded_to, time_by, rival, .. } = tdma.status();
        (yielded_to, time_by, rival)
    };
    assert_eq!(named(&tdma), (Some(OTHER), None, None), "it has no line yet");
    hears_other(&mut tdma, 11);
    assert_eq!(named(&tdma), (Some(OTHER), Some(OTHER), None));
}

#[test]
fn turns_between_making_way_and_the_next_line_are_told_of() {
    let turns = |tdma: &mut Tdma| -> Vec<u32> {
        let left = told(tdma).into_iter().filter(|&(_, kind, _)| kind == EventKind::TurnLeft);
        left.map(|(cycle, ..)| cycle).collect()
    };
    for rounds in [0, 5] {
        let mut tdma = outlasted(rounds);
        let before = tdma.status().counters;
        assert!(turns(&mut tdma).is_empty());
        // One is lost.
        hears_other(&mut tdma, 12);
        assert_eq!(tdma.status().time_by, Some(OTHER));
        assert_eq!(turns(&mut tdma), [10, 11], "{rounds} rounds");
        let after = tdma.status().counters;
        assert_eq!((after.slots_silent - before.slots_silent, after.overruns - before.overruns), (2, 0));
    }
    // The other is silent, too.
    let mut tdma = outlasted(0);
    turns(&mut tdma);
    let mut now = START + 10 * CYCLE;
    while tdma.status().mastery != Some(Mastery::Active) {
        now += 100;
        tdma.on_timeout(at(now));
    }
    let left = turns(&mut tdma);
    assert!(left.len() > 3 && left.iter().copied().eq(10..10 + left.len() as u32), "{left:?}");
    assert_eq!(tdma.status().yielded_to, None);
}

#[test]
fn who_has_given_the_time_and_calibrates_for_the_first_time_tells_of_every_turn() {
    let mut config = config(RoleConfig::Master(MasterConfig {
        follow: SlaveConfig { rounds: 5, ..SlaveConfig::default() },
        ..master_config()
    }));
    config.slots.push(SlotConfig { id: 2, offset: Span::from_micros(700), ..config.slots[0] });
    let mut tdma = Tdma::new(&config).unwrap();
    tdma.on_timeout(at(0));
    tdma.on_timeout(at(START));
    for cycle in 1..=10 {
        speaks(&mut tdma, cycle);
        hears_other(&mut tdma, cycle);
    }
    hears_other(&mut tdma, 11);
    told(&mut tdma);
    for cycle in 11..=20 {
        // Nobody answers its requests.
        for offset in [360, 660] {
            let now = at(START + cycle * CYCLE + offset + 50);
            tdma.next_transmission(now).map(|sent| tdma.on_sent(Sent::At(sent.at)));
        }
        hears_other(&mut tdma, cycle + 1);
    }
    assert_eq!(tdma.status().counters.requests_sent, 5);
    let mut turns: Vec<_> = std::iter::from_fn(|| tdma.next_event())
        .filter(|event| event.kind == EventKind::CalibrationTurn)
        .map(|event| (event.cycle, event.slot))
        .collect();
    turns.sort_unstable();
    let both = (11..=20).flat_map(|cycle| [(cycle, Some(0)), (cycle, Some(2))]);
    assert_eq!(turns, both.collect::<Vec<_>>());
}
