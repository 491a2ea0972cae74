//! How many calibration requests a master answers at a time.

use super::*;

fn master(max_requests: usize) -> Result<Tdma, Refused> {
    Tdma::new(&config(RoleConfig::Master(MasterConfig { max_requests, ..master_config() })))
}

#[test]
fn requests_beyond_what_is_configured_are_refused_and_there_is_room_again_after_a_reply() {
    let mut master = master(2).unwrap();
    master.on_timeout(at(0));
    master.on_timeout(at(3_000));
    let request = Message::Request { xmit: 7, reply_cycle: 1, reply_offset: 200_000 };
    let ask = |master: &mut Tdma| hear(master, OTHER, request);
    assert!(matches!(ask(&mut master), Claimed::Kept));
    assert!(matches!(ask(&mut master), Claimed::Kept));
    assert!(matches!(ask(&mut master), Claimed::Refused(Refusal::ReplyBacklog)));
    assert_eq!(sent_next(&mut master), at(4_000), "the Synchronisation");
    assert_eq!(sent_next(&mut master), at(4_200), "a reply");
    let next = Message::Request { xmit: 8, reply_cycle: 2, reply_offset: 200_000 };
    assert!(matches!(hear(&mut master, OTHER, next), Claimed::Kept));
}

#[test]
fn a_master_that_answers_nobody_or_more_than_there_can_be_is_refused() {
    assert!([1, MAX_REQUESTS].into_iter().all(|requests| master(requests).is_ok()));
    for requests in [0, MAX_REQUESTS + 1] {
        let why = master(requests).err().unwrap().to_string();
        assert!(why.contains("at least 1 and at most 256"), "{why}");
    }
}
