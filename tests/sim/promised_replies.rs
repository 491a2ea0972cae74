//! A calibration reply is on its way to a station that is something else by then.

use rtmac::tdma::{NewRole, RoleConfig, SlaveConfig, TdmaCommand};
use rtnet::discipline::SyncState;
use tests::networks::{Lab, Plan};

const ID: usize = 2;

/// A network in which one slave, with a turn in every so many cycles, has just sent the first of its requests.
fn has_asked(period: u32) -> Lab {
    let mut plan = Plan::lab(4).with_rounds(20);
    plan.scenario.stations[ID].slots[0].period = period;
    let mut lab = plan.build();
    while lab.status(ID).counters.requests_sent == 0 {
        let now = lab.network.now();
        lab.network.run_until(now + 10_000);
    }
    lab
}

#[test]
fn who_becomes_something_else_right_after_a_request_does_not_meet_the_reply() {
    for (period, rounds) in [(3, 0), (3, 20), (4, 0), (7, 20)] {
        let mut lab = has_asked(period);
        let role = RoleConfig::Slave(SlaveConfig { rounds, ..lab.plan.follow });
        lab.command(ID, TdmaCommand::Become(NewRole::attached(role).unwrap())).unwrap();
        lab.judge_from_here();
        lab.run_cycles(u64::from(period) * 100);
        assert_eq!(lab.judge().overlaps, [], "{rounds} rounds in every cycle of {period}");
        assert!(lab.status(0).counters.replies_sent > 0 && lab.state(ID) == SyncState::Locked);
        assert!(lab.judge().data[ID] > 40, "{}", lab.judge().data[ID]);
    }
}
