//! Who bridges nothing sends only behind its cycle's Synchronisation.

use super::*;

fn slave(holdover: u32, offset: i64) -> TdmaConfig {
    let follow = SlaveConfig { rounds: 0, holdover, ..SlaveConfig::default() };
    let mut config = config(RoleConfig::Slave(follow));
    config.slots[0].offset = Span::from_micros(offset);
    config
}

fn refused(offset: i64) -> Option<Refused> {
    let [offset, earliest] = [offset, 60].map(Span::from_micros);
    Some(Refused::BeforeSync { id: 0, offset, earliest })
}

#[test]
fn a_slot_that_could_never_be_used_is_refused_at_the_start() {
    assert_eq!(Tdma::new(&slave(0, 59)).err(), refused(59));
    let why = refused(59).unwrap().to_string();
    assert!(
        why.contains("slot 0") && why.contains("60us or later") && why.contains("bridge 1 cycle"),
        "{why}"
    );
    assert!(Tdma::new(&slave(1, 0)).is_ok(), "the one before is good enough");
    assert!(Tdma::new(&TdmaConfig { lead: Span::from_micros(20), ..slave(0, 30) }).is_ok(), "a shorter lead");

    let mut earliest = Tdma::new(&slave(0, 60)).unwrap();
    queue(&mut earliest, &Pool::new(1), 60);
    hear_syncs(&mut earliest, 1..=2);
    assert!(earliest.next_transmission(at(2_010)).is_some(), "it is used");
}

#[test]
fn no_command_leaves_who_bridges_nothing_with_such_a_slot() {
    let mut tdma = Tdma::new(&slave(0, 400)).unwrap();
    assert_eq!(tdma.command(at(0), &mut moved(59, 100)).err(), refused(59));
    assert!(tdma.command(at(0), &mut moved(60, 100)).is_ok());

    let mut tdma = Tdma::new(&slave(1, 30)).unwrap();
    let SlaveConfig { rounds, .. } = SlaveConfig::default();
    let follow = SlaveConfig { rounds, holdover: 0, ..SlaveConfig::default() };
    let become_it = |role| TdmaCommand::Become(NewRole::attached(role).unwrap());
    assert_eq!(tdma.command(at(0), &mut become_it(RoleConfig::Slave(follow))).err(), refused(30));
    let primary = MasterConfig { follow, ..master_config() };
    let told = MasterConfig { backups_from: Some(Span::from_micros(100)), ..primary };
    assert_eq!(tdma.command(at(0), &mut become_it(RoleConfig::Master(told))).err(), refused(30));
    assert!(tdma.command(at(0), &mut become_it(RoleConfig::Master(primary))).is_ok(), "it follows nobody");
}
