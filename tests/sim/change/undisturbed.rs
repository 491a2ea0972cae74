//! Nothing goes wrong: all switch in one cycle, and no frame is lost.

use rtmac::wire::change::State;
use rtnet::counters::Refusal;
use rtnet::discipline::{EventKind, SyncState};

use super::*;

const CYCLE: Span = Span::from_millis(2);

/// All have switched in the activation cycle, which is told; every station sent in every cycle but for its answers.
fn check_switched(changing: &Changing, from: u32) {
    let watch = changing.watch.borrow();
    watch.check("undisturbed");
    let switch = watch.used.iter().find(|(_, used)| used.contains(&1)).map(|(&cycle, _)| cycle);
    assert_eq!(switch, Some(from), "the first cycle of the new schedule");
    assert!(watch.used.range(from..).all(|(_, used)| used.contains(&1)), "and none of the old one after it");
    for id in 0..STATIONS {
        check_syncs(changing, id);
        assert_eq!(changing.in_use(id), 1, "station {id}");
        assert_eq!(changing.lab.cycles_with(id, EventKind::ScheduleSwitched), [from], "station {id}");
        let silent = changing.lab.cycles_with(id, EventKind::SlotSilent);
        assert!(silent.is_empty(), "station {id} was silent in {silent:?}");
    }
    let (first, last) = (from - 60, from + 60);
    for cycle in first..last {
        for id in 0..STATIONS {
            let sent = watch.data[&cycle].iter().filter(|&&of| of == id).count();
            let answered = changing.lab.cycles_with(id, EventKind::AnswerTurn).contains(&cycle);
            assert_eq!(sent, usize::from(!answered), "station {id} in cycle {cycle}");
        }
    }
}

/// Every sync was followed, the one that begins the new schedule, too.
fn check_syncs(changing: &Changing, id: usize) {
    for kind in [EventKind::DuplicateCycle, EventKind::TimeStep, EventKind::Holdover] {
        let cycles = changing.lab.cycles_with(id, kind);
        assert!(cycles.is_empty(), "station {id}: {} in {cycles:?}", kind.name());
    }
    let refusals = changing.lab.network.member(id).station.refusals();
    assert_eq!(refusals.get(Refusal::DuplicateCycle), 0, "station {id}");
}

fn undisturbed(backups: usize, cycle: Span, activate: impl FnOnce(u32) -> Activation) -> (Changing, u32) {
    let first = plan(backups);
    let second = turned(&first, cycle);
    let mut changing = Changing::running(first, second);
    changing.lab.events.clear();
    let activation = activate(changing.lab.status(0).cycle);
    changing.propose(Some(activation)).unwrap();
    changing.run_cycles(40);
    let from = changing.change(0).told.activation;
    assert!(matches!(changing.change(0).told.state, State::Committed | State::Sealed));
    changing.run_cycles(150);
    (changing, from)
}

#[test]
fn all_stations_switch_in_one_cycle_and_only_answers_take_turns() {
    for backups in [0, 2] {
        let (changing, from) = undisturbed(backups, CYCLE, |_| Activation::Soon);
        check_switched(&changing, from);
    }
}

#[test]
fn a_cycle_of_another_length_begins_in_the_activation_cycle() {
    for backups in [0, 2] {
        for micros in [2_500, 4_000, 1_900] {
            let (changing, from) = undisturbed(backups, Span::from_micros(micros), |_| Activation::Soon);
            check_switched(&changing, from);
            for id in 0..STATIONS {
                assert_eq!(changing.lab.status(id).period, Some(Span::from_micros(micros)), "station {id}");
            }
        }
    }
}

#[test]
fn no_sync_is_refused_when_the_cycle_changes_its_length() {
    // Longer and shorter, by little and by half; 50 and 60 ms as with real stations.
    let lengths = [2_500, 2_000, 4_000, 1_900, 1_901, 50_000, 60_000, 50_000, 100_000, 3_333];
    for backups in [0, 2] {
        let first = plan(backups);
        let mut changing = Changing::running(first.clone(), first.clone());
        changing.lab.events.clear();
        for micros in lengths.into_iter().cycle().take(30) {
            let before = changing.lab.status(0).period.unwrap();
            changing.schedules[1] = turned(&first, Span::from_micros(micros));
            changing.propose(Some(Activation::Soon)).unwrap();
            // Of the cycles before and after; one is of 2 ms here.
            let cycles = (before.nanos() + micros * 1_000) as u64 / 2_000_000 + 1;
            changing.run_cycles(150 * cycles);
            for id in 0..STATIONS {
                assert_eq!(changing.lab.status(id).period, Some(Span::from_micros(micros)), "station {id}");
                check_syncs(&changing, id);
                assert_eq!(changing.lab.state(id), SyncState::Locked);
            }
        }
    }
}

#[test]
fn the_activation_cycle_can_be_chosen() {
    let (changing, from) = undisturbed(2, CYCLE, |now| Activation::At(now + 111));
    check_switched(&changing, from);
    assert_eq!(from, changing.lab.cycles_with(0, EventKind::ScheduleSwitched)[0]);
}

#[test]
fn what_is_proposed_waits_until_it_is_activated_or_cancelled() {
    let first = plan(2);
    let mut changing = Changing::running(first.clone(), turned(&first, CYCLE));
    changing.propose(None).unwrap();
    changing.run_cycles(100);
    let waiting = changing.change(0);
    assert_eq!((waiting.told.state, waiting.acknowledged, waiting.asked), (State::Proposed, 4, 4));
    changing.lab.command(0, TdmaCommand::CancelChange).unwrap();
    changing.run_cycles(100);
    assert_eq!(changing.change(0).told.state, State::Idle);
    changing.propose(None).unwrap();
    changing.run_cycles(20);
    changing.lab.command(0, TdmaCommand::Activate(Activation::Soon)).unwrap();
    changing.run_cycles(100);
    changing.watch.borrow().check("cancelled, proposed again, activated");
    assert!((0..STATIONS).all(|id| changing.in_use(id) == 2));
}

#[test]
fn a_station_that_joins_later_learns_the_schedule_that_is_in_use() {
    let first = plan(2);
    let mut changing = Changing::running(first.clone(), turned(&first, Span::from_micros(2_500)));
    changing.propose(Some(Activation::Soon)).unwrap();
    changing.run_cycles(200);
    changing.lab.network.stop(4);
    let now = changing.lab.network.now();
    let again = changing.lab.add(4, None, now + 1_000_000);
    changing.run_cycles(600);
    assert_eq!(changing.in_use(again), 1);
    assert_eq!(changing.lab.state(again), rtnet::discipline::SyncState::Locked);
    let watch = changing.watch.borrow();
    watch.check("one joins later");
    let last = *watch.data.keys().next_back().unwrap() - 1;
    assert_eq!(watch.data[&last].len(), STATIONS);
}

#[test]
fn a_station_that_is_left_out_acknowledges_it_is_silent_from_then_on_and_can_be_taken_in_again() {
    let (first, left_out) = (plan(2), STATIONS - 1);
    let mut second = turned(&first, CYCLE);
    second.scenario.stations[left_out].slots.clear();
    let mut changing = Changing::running(first, second);
    changing.propose(Some(Activation::Soon)).unwrap();
    changing.run_cycles(40);
    // All but the one that gives the time.
    assert_eq!((changing.change(0).acknowledged, changing.change(0).asked), (4, 4));
    changing.run_cycles(150);
    let [from] = changing.lab.cycles_with(left_out, EventKind::ScheduleSwitched)[..] else {
        panic!("it has not switched once");
    };
    changing.schedules.swap(0, 1);
    changing.propose(Some(Activation::Soon)).unwrap();
    changing.run_cycles(200);
    assert!((0..STATIONS).all(|id| changing.in_use(id) == 2));
    let back = changing.lab.cycles_with(left_out, EventKind::ScheduleSwitched)[1];
    let watch = changing.watch.borrow();
    watch.check("one is left out, and taken in again");
    let sent = |cycles: std::ops::Range<u32>| {
        watch.data.range(cycles).filter(|(_, of)| of.contains(&left_out)).count()
    };
    assert!(sent(from - 50..from) > 40 && sent(back..back + 50) > 40);
    assert_eq!(sent(from..back), 0);
}

#[test]
fn a_station_that_does_not_answer_stops_the_change_and_is_named() {
    let first = plan(2);
    let mut changing = Changing::running(first.clone(), turned(&first, CYCLE));
    changing.lab.network.stop(3);
    changing.propose(Some(Activation::Soon)).unwrap();
    changing.run_cycles(700);
    let why = changing.change(0).stopped.expect("it is stopped").to_string();
    let silent = first.address(3).to_string();
    assert!(why.contains(&silent) && why.contains("did not acknowledge"), "{why}");
    changing.watch.borrow().check("one is dead");
    assert!([0, 1, 2, 4].iter().all(|&id| changing.in_use(id) == 0));
    assert_eq!(changing.watch.borrow().last_used(), Some(0));
}

#[test]
fn a_station_that_cannot_take_its_slots_stops_the_change_and_says_why() {
    let first = plan(2);
    let mut second = turned(&first, CYCLE);
    second.scenario.stations[3].slots[0].id = 9;
    let mut changing = Changing::running(first, second);
    changing.propose(Some(Activation::Soon)).unwrap();
    changing.run_cycles(50);
    let why = changing.change(0).stopped.expect("it is stopped").to_string();
    assert!(why.contains("slot 9") && why.contains("max_slot_id"), "{why}");
    assert!((0..STATIONS).all(|id| changing.in_use(id) == 0));
}
