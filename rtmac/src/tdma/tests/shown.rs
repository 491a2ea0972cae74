//! What a station shows of its part in the cycle, in the words of `tdma status`.

use super::*;

/// Where backups send.
const BACKUPS: Span = Span::from_micros(100);

fn shown(tdma: &Tdma) -> (&'static str, Option<&'static str>, &'static str) {
    let TdmaStatus { role, mastery, state, .. } = tdma.status();
    (role.name(), mastery.map(Mastery::name), state.name())
}

fn master(backup: Option<Span>, rounds: u32) -> Tdma {
    let (follow, backups_from) = (SlaveConfig { rounds, ..SlaveConfig::default() }, Some(BACKUPS));
    let master = MasterConfig { backup, backups_from, follow, ..master_config() };
    let mut tdma = Tdma::new(&config(RoleConfig::Master(master))).unwrap();
    tdma.on_timeout(at(500));
    tdma
}

/// The Synchronisations of these cycles, each a millisecond, sent so late.
fn hear_sent(tdma: &mut Tdma, cycles: core::ops::RangeInclusive<u32>, late: Span) {
    for cycle in cycles {
        let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000);
        let xmit = sched + late;
        hear_at(tdma, at(u64::from(cycle) * 1_000) + late, Message::Sync { cycle, xmit, sched });
    }
}

fn hear_at(tdma: &mut Tdma, rx: Instant, message: Message) {
    let mut frame = Pool::new(1).take().unwrap();
    message.write(Address::BROADCAST, OTHER, &mut frame);
    tdma.on_frame(Some(rx), frame);
}

#[test]
fn a_primary_shows_whether_it_listens_gives_the_time_follows_or_has_made_way() {
    let mut primary = master(None, 0);
    assert_eq!(shown(&primary), ("master", Some("listening"), "waiting"));
    primary.on_timeout(at(3_500));
    assert_eq!(shown(&primary), ("master", Some("active"), "locked"));

    let mut second = master(None, 0);
    hear_sent(&mut second, 1..=1, Span::ZERO);
    assert_eq!(shown(&second), ("master", Some("yielded"), "waiting"));
    assert_eq!(second.status().yielded_to, Some(OTHER));

    let mut returned = master(None, 5);
    hear_sent(&mut returned, 1..=1, BACKUPS);
    assert_eq!(shown(&returned), ("master", Some("following"), "waiting"));
    hear_sent(&mut returned, 2..=2, BACKUPS);
    assert_eq!(shown(&returned), ("master", Some("following"), "calibrating"));
}

#[test]
fn a_backup_shows_whether_it_listens_follows_stands_by_or_has_taken_over() {
    let mut backup = master(Some(BACKUPS), 0);
    assert_eq!(shown(&backup), ("backup", Some("listening"), "waiting"));
    hear_sent(&mut backup, 1..=1, Span::ZERO);
    assert_eq!(shown(&backup), ("backup", Some("following"), "waiting"));
    hear_sent(&mut backup, 2..=2, Span::ZERO);
    backup.on_timeout(at(2_300));
    assert_eq!(shown(&backup), ("backup", Some("stand-by"), "locked"));
    let sync = backup.next_transmission(at(3_090)).expect("one is missing");
    backup.on_sent(Sent::At(sync.at));
    assert_eq!(shown(&backup), ("backup", Some("active"), "locked"));
    hear_sent(&mut backup, 4..=4, Span::ZERO);
    assert_eq!(shown(&backup), ("backup", Some("stand-by"), "locked"));
}

#[test]
fn a_slave_shows_how_far_it_is_with_the_time_and_no_mastery() {
    let mut slave = Tdma::new(&with_slots(1, &[(0, 1)])).unwrap();
    assert_eq!(shown(&slave), ("slave", None, "waiting"));
    hear_sent(&mut slave, 1..=2, Span::ZERO);
    assert_eq!(shown(&slave), ("slave", None, "calibrating"));
    let mut slave = locked_slave();
    assert_eq!(shown(&slave), ("slave", None, "locked"));
    assert!(slave.next_transmission(at(3_400)).is_none());
    slave.on_timeout(at(3_400));
    assert_eq!(shown(&slave), ("slave", None, "holdover"));
    slave.on_timeout(at(4_400));
    assert_eq!(shown(&slave), ("slave", None, "lost"));
    slave.command(at(4_500), &mut TdmaCommand::Become(NewRole::detached())).unwrap();
    assert_eq!(shown(&slave), ("detached", None, "waiting"));
}
