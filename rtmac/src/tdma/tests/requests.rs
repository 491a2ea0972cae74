//! How many calibration requests a master answers at a time.

use super::*;

fn master(max_requests: usize) -> Result<Tdma, Refused> {
    Tdma::new(&config(RoleConfig::Master(MasterConfig { max_requests, ..master_config() })))
}

fn station(last: u8) -> Address {
    Address([2, 0, 0, 0, 0, last])
}

#[test]
fn requests_beyond_what_is_configured_are_refused_and_there_is_room_again_after_a_reply() {
    let mut master = master(2).unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    let request = Message::Request { xmit: 7, reply_cycle: 1, reply_offset: 200_000 };
    let ask = |master: &mut Tdma, last| hear(master, station(last), request);
    assert!(matches!(ask(&mut master, 3), Claimed::Kept));
    assert!(matches!(ask(&mut master, 4), Claimed::Kept));
    assert!(matches!(ask(&mut master, 5), Claimed::Refused(Refusal::ReplyBacklog)));
    assert!(matches!(ask(&mut master, 4), Claimed::Kept), "in the place of its first");
    assert_eq!(sent_next(&mut master), at(4_000), "the Synchronisation");
    assert_eq!(sent_next(&mut master), at(4_200), "a reply");
    let next = Message::Request { xmit: 8, reply_cycle: 2, reply_offset: 200_000 };
    assert!(matches!(hear(&mut master, OTHER, next), Claimed::Kept));
}

#[test]
fn what_a_master_has_promised_when_it_becomes_something_else_is_counted() {
    let mut master = master(2).unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    for (last, reply_offset) in [(3, 200_000), (4, 300_000)] {
        let request = Message::Request { xmit: 7, reply_cycle: 1, reply_offset };
        assert!(matches!(hear(&mut master, station(last), request), Claimed::Kept));
    }
    assert_eq!(sent_next(&mut master), at(4_000), "the Synchronisation");
    assert_eq!(sent_next(&mut master), at(4_200), "a reply");
    master.command(at(4_210), &mut TdmaCommand::Become(NewRole(Role::Detached))).unwrap();
    let counters = master.status().counters;
    assert_eq!((counters.replies_sent, counters.replies_given_up), (1, 1));
}

#[test]
fn a_master_that_answers_nobody_or_more_than_there_can_be_is_refused() {
    assert!([1, MAX_REQUESTS].into_iter().all(|requests| master(requests).is_ok()));
    for requests in [0, MAX_REQUESTS + 1] {
        let why = master(requests).err().unwrap().to_string();
        assert!(why.contains("at least 1 and at most 256"), "{why}");
    }
}
