//! What a backup does when it hears a Synchronisation beside its line.

use super::*;

/// One that has heard cycles 1 to 3, on which cycle n begins at n ms.
fn stand_by(servo: Servo) -> Tdma {
    let follow = SlaveConfig { rounds: 0, servo, ..SlaveConfig::default() };
    let backup = MasterConfig { backup: Some(Span::from_micros(100)), follow, ..master_config() };
    let mut tdma = Tdma::new(&config(RoleConfig::Master(backup))).unwrap();
    tdma.on_timeout(at(500));
    hear_syncs(&mut tdma, 1..=3);
    tdma.on_timeout(at(3_300));
    assert_eq!(tdma.status().mastery, Some(Mastery::StandBy));
    tdma
}

/// The Synchronisation of a cycle, held up or of another line.
fn hear_beside(tdma: &mut Tdma, cycle: u32, rx: Instant) {
    let sched = GlobalTime::from_nanos(u64::from(cycle) * 1_000_000);
    let mut frame = Pool::new(1).take().unwrap();
    Message::Sync { cycle, xmit: sched, sched }.write(Address::BROADCAST, OTHER, &mut frame);
    assert!(matches!(tdma.on_frame(Some(rx), frame), Claimed::Kept));
}

#[test]
fn a_backup_sends_nothing_before_the_next_of_what_it_heard_would_have_come_with_a_filter_or_without() {
    for servo in [Servo::Linear, Servo::None] {
        for rx in [3_600, 3_900, 4_090, 4_240, 4_600] {
            let mut tdma = stand_by(servo);
            hear_beside(&mut tdma, 4, at(rx));
            let Role::Master(master) = &tdma.role else { panic!("it is a master") };
            let (_, at_earliest, _) = master.next_sync().unwrap();
            let next = at(rx) + Span::from_millis(1);
            assert!(at_earliest > next, "{servo:?}, heard at {rx}: {at_earliest:?} is before {next:?}");
        }
    }
}
