mod transitions;

use super::*;
use crate::tdma::DEFAULT_MAX_REQUESTS;
use crate::tdma::mark::bridged_below;

const OWN: Address = Address([2, 0, 0, 0, 0, 5]);
const LOWER: Address = Address([2, 0, 0, 0, 0, 1]);
const HIGHER: Address = Address([2, 0, 0, 0, 0, 9]);
/// When a primary sends, and when a backup, after the cycle's start.
const PROMPT: Span = Span::from_micros(5);
const LATE: Span = Span::from_micros(205);
const BACKUP: Span = Span::from_micros(200);

fn at(micros: u64) -> Instant {
    Instant::from_nanos(micros * 1_000)
}

/// A master with the log that it tells.
struct Bench {
    master: Master,
    events: Events,
}

impl Bench {
    fn new(backup: Option<Span>) -> Self {
        let (sync_latest, reply_latest) = (Span::from_micros(40), Span::from_micros(40));
        let epoch = Offset::between(at(0), GlobalTime::from_nanos(u64::MAX - 4_999_999));
        let (cycle, backups_from) = (Span::from_millis(1), Some(BACKUP));
        let follow = SlaveConfig { rounds: 0, ..SlaveConfig::default() };
        let config = MasterConfig {
            cycle,
            sync_latest,
            reply_latest,
            epoch,
            resume: None,
            backup,
            backups_from,
            max_requests: DEFAULT_MAX_REQUESTS,
            behind_sync: None,
            follow,
        };
        Self { master: Master::new(config), events: Events::new() }
    }

    fn wait_until(&mut self, now: Instant) -> bool {
        self.master.on_timeout(now, true, true, &mut self.events)
    }

    /// Another master's Synchronisation of `cycle`, whose grid is this one's clock; whether it is followed.
    fn hear(&mut self, from: Address, cycle: u32, late: Span) -> bool {
        let rx = at(u64::from(cycle) * 1_000) + late;
        let followed = self.master.on_foreign_sync(rx, (from, OWN), late, &mut self.events);
        if let Some(follower) = self.master.follower_mut().filter(|_| followed) {
            let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000);
            let _ = follower.on_sync(rx, from, cycle, sched + late, sched, &mut self.events);
        }
        followed
    }

    /// Its next Synchronisation, in time or not.
    fn send(&mut self, in_time: bool) {
        let (cycle, ..) = self.master.next_sync().unwrap();
        self.master.advance();
        if in_time {
            self.master.sent(cycle, true, &mut self.events);
        }
    }

    fn told(&mut self) -> Vec<EventKind> {
        core::iter::from_fn(|| self.events.take()).map(|event| event.kind).collect()
    }

    /// It has listened since 0, and speaks since 3 ms, a backup since 50.
    fn active(backup: Option<Span>) -> Self {
        let mut bench = Self::new(backup);
        let listened = backup.map_or(3_000, |_| 50_000);
        assert!(!bench.wait_until(at(0)));
        assert!(!bench.wait_until(at(listened - 1)));
        assert!(bench.wait_until(at(listened)));
        assert_eq!(bench.told(), [EventKind::MasterActive]);
        bench
    }

    /// It has heard cycles 1 and 2 of a primary, or of a backup.
    fn following(backup: Option<Span>, late: Span) -> Self {
        let mut bench = Self::new(backup);
        bench.wait_until(at(500));
        assert!(bench.hear(LOWER, 1, late) && bench.hear(LOWER, 2, late));
        bench.told();
        bench
    }

    fn stand_by() -> Self {
        let mut bench = Self::following(Some(BACKUP), PROMPT);
        bench.wait_until(at(2_300));
        assert_eq!(bench.master.mastery(), Mastery::StandBy);
        bench
    }
}

#[test]
fn who_has_nothing_of_the_schedule_in_use_neither_stands_by_nor_takes_its_place_back() {
    for (backup, late) in [(Some(BACKUP), PROMPT), (None, BACKUP)] {
        let mut bench = Bench::following(backup, late);
        bench.hear(LOWER, 3, late);
        let mut mastery = |now, has_schedule| {
            bench.master.on_timeout(at(now), true, has_schedule, &mut bench.events);
            bench.master.mastery()
        };
        assert_eq!(mastery(3_300, false), Mastery::Following);
        assert!([Mastery::StandBy, Mastery::Active].contains(&mastery(3_310, true)));
    }
}

#[test]
fn the_first_synchronisation_carries_cycle_1_one_period_after_the_silence() {
    let (cycle, start, sched) = Bench::active(None).master.next_sync().unwrap();
    assert_eq!((cycle, start), (1, at(4_000)));
    assert_eq!(sched.nanos(), u64::MAX - 999_999, "global time is the epoch's, modulo 2^64");
    let (cycle, start, _) = Bench::active(Some(BACKUP)).master.next_sync().unwrap();
    assert_eq!((cycle, start), (1, at(51_200)), "a backup's comes as late as if it took over");
}

#[test]
fn a_grid_that_is_gone_on_with_keeps_its_numbers_and_its_instants() {
    let mut bench = Bench::new(None);
    let MasterConfig { epoch, .. } = bench.master.config;
    // Its predecessor's cycle u32::MAX was to begin at 1.2 ms on this clock.
    bench.master.config.resume = Some((u32::MAX, epoch.global(at(1_200))));
    bench.wait_until(at(0));
    assert!(bench.wait_until(at(3_300)));
    let (cycle, start, sched) = bench.master.next_sync().unwrap();
    assert_eq!((cycle, start), (2, at(4_200)));
    assert_eq!(sched, epoch.global(at(4_200)));
}

#[test]
fn global_time_wraps_without_a_jump() {
    let mut bench = Bench::active(None);
    bench.master.advance();
    assert_eq!(bench.master.next_sync().unwrap().2.nanos(), 0);
}

#[test]
fn who_does_not_give_the_time_answers_nobody() {
    for mut bench in [Bench::new(None), Bench::following(None, LATE), Bench::stand_by()] {
        assert_eq!(bench.master.on_request(at(2_400), HIGHER, 0, 3, 0), Err(Refusal::NotMaster));
    }
    let mut active = Bench::active(Some(BACKUP));
    assert_eq!(active.master.on_request(at(50_500), HIGHER, 0, 2, 400_000), Ok(()));
    active.hear(LOWER, 51, PROMPT);
    assert_eq!(active.master.replies().next(), None, "and what it had promised is for the other to do");
}

#[test]
fn who_gives_the_time_itself_waits_for_no_reply() {
    let mut primary = Bench::active(None);
    for of in [LOWER, HIGHER] {
        assert_eq!(primary.master.on_request(at(3_400), of, 0, 2, 400_000), Ok(()));
    }
    primary.hear(LOWER, 4, LATE);
    assert_eq!(primary.master.replies_mut().take().map(|reply| reply.to), Some(HIGHER));
    assert_eq!(primary.master.replies().next(), None);
}

#[test]
fn a_primary_that_finds_another_never_speaks() {
    let mut bench = Bench::new(None);
    assert!(!bench.hear(LOWER, 1, PROMPT));
    assert!(!bench.wait_until(at(99_000)), "yielded for good");
    assert_eq!(bench.master.yielded_to(), Some(LOWER));
    assert_eq!((bench.master.deadline(), bench.master.next_sync()), (None, None));
    assert_eq!(bench.told(), [EventKind::OtherMaster]);
}

#[test]
fn a_backup_takes_over_in_the_cycle_whose_synchronisation_is_missing() {
    let mut bench = Bench::stand_by();
    bench.told();
    let (cycle, start, sched) = bench.master.next_sync().unwrap();
    assert_eq!((cycle, start, sched.nanos()), (3, at(3_200), 3_000_000), "scheduled as the primary's");
    bench.hear(LOWER, 3, PROMPT);
    assert_eq!(bench.master.next_sync().unwrap().0, 4, "there is one");
    bench.master.advance();
    bench.master.sent(4, true, &mut bench.events);
    assert_eq!(bench.told(), [EventKind::TookOver]);
    assert_eq!(bench.master.mastery(), Mastery::Active);
    assert_eq!(bench.master.next_sync().unwrap().1, at(5_200));
}

#[test]
fn a_backup_that_was_itself_late_tries_again_in_the_next_cycle() {
    let mut bench = Bench::stand_by();
    bench.master.advance();
    assert_eq!(bench.master.mastery(), Mastery::StandBy, "nothing has left");
    assert_eq!(bench.master.next_sync().unwrap().0, 4);
}

#[test]
fn any_synchronisation_of_a_cycle_keeps_a_backup_from_sending_in_it() {
    // One that does not agree with the line: another grid, or held up.
    let mut bench = Bench::stand_by();
    let late = bridged_below(Span::from_millis(1)) - PROMPT;
    let _ = bench.master.on_foreign_sync(at(3_000) + late, (HIGHER, OWN), late, &mut bench.events);
    assert_eq!(bench.master.next_sync().unwrap().0, 4);
    let early = at(3_950);
    let _ = bench.master.on_foreign_sync(early, (HIGHER, OWN), PROMPT, &mut bench.events);
    assert_eq!(bench.master.next_sync().unwrap().0, 5, "one that is a little early is of the next");
}

#[test]
fn a_backup_that_hears_another_line_is_silent_until_the_next_of_it_would_have_told() {
    // It stands by after cycle 2; the other line's cycles begin so long after its own, and it looks after 180 us.
    for (other, next) in [(100, 4), (179, 4), (180, 5), (300, 5), (950, 5)] {
        for makes_way in [false, true] {
            let mut bench = Bench::stand_by();
            let rx = at(3_000 + other);
            let _ = bench.master.on_foreign_sync(rx, (HIGHER, OWN), PROMPT, &mut bench.events);
            bench.master.doubts_line(rx, makes_way);
            let next = next + u32::from(makes_way);
            assert_eq!(bench.master.next_sync().unwrap().0, next, "{other} us, {makes_way}");
        }
    }
}

#[test]
fn an_active_backup_steps_down_for_whoever_sends_and_goes_on_with_the_line() {
    let mut bench = Bench::active(Some(BACKUP));
    bench.told();
    let line = *bench.master.line().unwrap();
    assert!(bench.hear(HIGHER, 51, PROMPT));
    assert_eq!(bench.told()[0], EventKind::SteppedDown);
    assert_eq!(bench.master.line().unwrap().start_of(9), line.start_of(9));
    assert!(bench.master.next_sync().unwrap().0 > line.cycle.wrapping_add(1), "not in that very cycle");
}

#[test]
fn a_primary_that_returns_takes_its_place_from_a_backup_but_not_from_a_primary() {
    let mut bench = Bench::following(None, LATE);
    bench.wait_until(at(2_300));
    assert_eq!(bench.told(), [EventKind::MasterActive]);
    let (cycle, start, sched) = bench.master.next_sync().unwrap();
    assert_eq!((cycle, start, sched.nanos()), (3, at(3_000), 3_000_000), "the next of the same line");

    let mut bench = Bench::following(None, LATE);
    bench.hear(LOWER, 3, PROMPT);
    bench.wait_until(at(3_300));
    assert_eq!(bench.master.mastery(), Mastery::Following, "somebody else was quicker");
}

#[test]
fn who_has_lost_whom_it_followed_listens_and_goes_on_with_its_line() {
    let mut bench = Bench::following(None, LATE);
    bench.hear(LOWER, 3, PROMPT);
    bench.wait_until(at(5_300));
    assert_eq!(bench.master.mastery(), Mastery::Listening);
    assert!(!bench.wait_until(at(8_300)), "no grid of its own");
    let (cycle, start, sched) = bench.master.next_sync().unwrap();
    assert_eq!((cycle, start, sched.nanos()), (9, at(9_000), 9_000_000));
}

#[test]
fn of_two_primaries_the_one_with_the_lower_address_stays() {
    let heard = |from: Address| {
        let mut bench = Bench::active(None);
        bench.told();
        let mut yields = |cycle: u32| {
            bench.send(true);
            bench.hear(from, cycle, PROMPT)
        };
        let yields = (4..100).position(&mut yields).map(|n| n + 1);
        (yields, bench)
    };
    let (yields, mut bench) = heard(LOWER);
    assert_eq!(yields, Some(3));
    assert_eq!(bench.told().last(), Some(&EventKind::Yielded));
    assert_eq!(heard(HIGHER).0, Some(10), "one that stays for so long does not know that");
    // It follows, and does not take its place back from whom it yielded to.
    let (_, mut bench) = heard(LOWER);
    for cycle in 7..20 {
        bench.hear(LOWER, cycle, LATE);
    }
    bench.wait_until(at(19_300));
    assert_eq!(bench.master.mastery(), Mastery::Following);
}

#[test]
fn a_primary_that_slept_does_not_make_way_for_what_stood_in_for_it_meanwhile() {
    let mut bench = Bench::active(None);
    bench.send(true);
    // When it wakes it reads them all, before it sends again.
    assert!(!(5..40).any(|cycle| bench.hear(HIGHER, cycle, LATE)));
    assert_eq!(bench.master.mastery(), Mastery::Active);
}

#[test]
fn a_primary_that_is_held_up_does_not_make_way_for_a_backup_but_for_one_that_is_deaf() {
    let outlasted = |in_time: bool| {
        let mut bench = Bench::active(None);
        (4..100).any(|cycle| {
            bench.send(in_time);
            bench.hear(LOWER, cycle, LATE)
        })
    };
    assert!(!outlasted(false) && outlasted(true));
}

#[test]
fn a_primary_whose_clock_was_set_back_does_not_make_way_for_a_backup_that_is_in_its_place() {
    let mut bench = Bench::active(None);
    for _ in 0..200 {
        bench.send(true);
    }
    // It waits until its clock shows again what it has shown; backups give the time meanwhile.
    assert!((100..200).all(|cycle| !bench.hear(LOWER, cycle, LATE)));
    assert_eq!(bench.master.mastery(), Mastery::Active);
    assert!((204..220).any(|cycle| {
        bench.send(true);
        bench.hear(LOWER, cycle, LATE)
    }));
}

#[test]
fn a_foreign_synchronisation_never_moves_the_grid_of_an_active_primary() {
    let mut bench = Bench::active(None);
    let before = bench.master.next_sync();
    assert!(!bench.hear(LOWER, 77, PROMPT) && !bench.hear(HIGHER, 5, LATE));
    assert_eq!(bench.master.next_sync(), before);
}

#[test]
fn who_has_heard_one_synchronisation_and_no_more_listens_again_and_speaks() {
    for (backup, listens) in [(None, 3_000), (Some(BACKUP), 50_000)] {
        let mut bench = Bench::new(backup);
        bench.wait_until(at(0));
        bench.hear(LOWER, 1, LATE);
        assert_eq!(bench.master.mastery(), Mastery::Following);
        let until = bench.master.deadline().expect("it does not wait for ever");
        bench.wait_until(until);
        assert_eq!(bench.master.mastery(), Mastery::Listening);
        assert!(bench.wait_until(until + Span::from_micros(listens)), "a grid of its own");
    }
}

#[test]
fn a_backup_that_has_no_line_any_more_listens_again() {
    let mut bench = Bench::stand_by();
    for ms in 3..1_020 {
        bench.wait_until(at(ms * 1_000));
    }
    assert_eq!(bench.master.mastery(), Mastery::Listening, "its syncs did not leave for a thousand cycles");
}

#[test]
fn who_would_bridge_many_cycles_listens_as_soon_as_any_other_when_its_master_is_gone() {
    let mut bench = Bench::new(Some(BACKUP));
    let follow = SlaveConfig { rounds: 5, holdover: 500, ..SlaveConfig::default() };
    bench.master = Master::new(MasterConfig { follow, ..*bench.master.config() });
    bench.wait_until(at(500));
    assert!(bench.hear(LOWER, 1, PROMPT) && bench.hear(LOWER, 2, PROMPT));
    bench.wait_until(at(4_124));
    assert_eq!(bench.master.mastery(), Mastery::Following, "it has not calibrated, and one is missing");
    assert_eq!(bench.master.deadline(), Some(at(4_125)));
    bench.wait_until(at(4_125));
    assert_eq!(bench.master.mastery(), Mastery::Listening);
    assert!(!bench.wait_until(at(54_124)), "as long as a backup does");
    bench.wait_until(at(54_125));
    assert_eq!(bench.master.mastery(), Mastery::Active);
}

#[test]
fn a_master_listens_for_three_cycles_and_a_backup_for_six_and_each_as_long_as_it_must_at_least() {
    for (backup, cycle, listens) in [
        (None, 500, 3_000),
        (None, 20_000, 60_000),
        (Some(BACKUP), 1_000, 50_000),
        (Some(BACKUP), 20_000, 120_000),
    ] {
        let mut bench = Bench::new(backup);
        let cycle = Span::from_micros(cycle);
        bench.master = Master::new(MasterConfig { cycle, ..*bench.master.config() });
        assert!(!bench.wait_until(at(7)));
        assert_eq!(bench.master.deadline(), Some(at(7 + listens)));
        assert!(!bench.wait_until(at(6 + listens)));
        assert_eq!(bench.master.mastery(), Mastery::Listening, "{cycle}");
        assert!(bench.wait_until(at(7 + listens)));
        assert_eq!(bench.master.mastery(), Mastery::Active, "{cycle}");
    }
}
