//! A master that answers few calibration requests at a time, and many slaves that ask.

use rtmac::tdma::TdmaStatus;
use rtnet::counters::Refusal;
use rtnet::discipline::SyncState;
use tests::networks::Plan;

#[test]
fn slaves_that_are_refused_ask_again_and_all_of_them_calibrate() {
    let plan = Plan { max_requests: 2, ..Plan::lab(8) };
    let mut lab = plan.build();
    lab.run_until_locked();
    let refused = lab.network.member(0).station.refusals().get(Refusal::ReplyBacklog);
    assert!(refused > 100, "seven ask in every other cycle, two are answered: {refused}");
    assert!((0..8).all(|id| lab.state(id) == SyncState::Locked));
    let status: Vec<TdmaStatus> = (1..8).map(|id| lab.status(id)).collect();
    let repeats: u64 = status.iter().map(|status| status.calibration_repeats).sum();
    assert_eq!(repeats, refused, "each of those was repeated");
}
