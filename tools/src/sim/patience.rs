//! For how long after a cycle something of it may still be told or sent: it is judged only then.

use rtmac::tdma::line::LINE_GOOD_FOR;
use rtnet::sim::{Host, Joint};
use rtnet::time::Span;
use rtnet::wire::ethernet::{HEADER_LEN, MTU};

use crate::judge::absences::Absence;
use crate::judge::explain::Records;
use crate::scenario::{Conditions, Happening, Scenario, Wire};

/// As many cycles as a station needs for what it does at once, if nothing holds it up.
const AT_ONCE: u32 = 2 * LINE_GOOD_FOR as u32;
/// Nothing is judged before the end.
const FOREVER: u32 = u32::MAX / 4;

/// In cycles: that of what holds up hosts and frames, twice over, since both may be held up, and by clocks that are set.
pub fn cycles(scenario: &Scenario) -> u32 {
    let Conditions { joint, propagation, host, hosts, wires, events, .. } = &scenario.conditions;
    let longest = |all: &mut dyn Iterator<Item = i64>| i128::from(all.max().unwrap_or(0));
    let hosts = longest(&mut hosts.iter().map(|(_, host)| host).chain([host]).map(of_host));
    let wires = longest(&mut wires.iter().map(of_wire)) + i128::from(propagation.map_or(0, Span::nanos));
    let joint = match *joint {
        Joint::Switch { latency, queue } => {
            i128::from(latency.nanos())
                + queue as i128 * i128::from(scenario.rate.air_time(HEADER_LEN + MTU).nanos())
        }
        _ => 0,
    };
    let events = events.iter().map(|event| match &event.what {
        Happening::Stall(_, span) => i128::from(span.nanos()),
        Happening::Wires(wire, _) => i128::from(of_wire(wire)),
        Happening::Clock(_, step, ..) => i128::from(step.abs().nanos()) * i128::from(event.times),
        _ => 0,
    });
    let all = 2 * (hosts + wires + joint + events.sum::<i128>()) / i128::from(scenario.cycle.nanos().max(1));
    u32::try_from(all).unwrap_or(FOREVER).saturating_add(AT_ONCE).min(FOREVER)
}

/// For so many cycles a host may keep a station from telling of what it missed.
pub fn untold(scenario: &Scenario) -> u64 {
    let Conditions { host, hosts, .. } = &scenario.conditions;
    let longest = hosts.iter().map(|(_, host)| host).chain([host]).map(of_host).max().unwrap_or(0);
    (longest / scenario.cycle.nanos().max(1)) as u64 + 1
}

/// Up to which cycle nothing more will be told, if all who are there need no longer than this: who is stopped, or was a
/// short time ago, tells of what it missed when it goes on.
pub fn judged_to(records: &Records, now: u32, patience: u32) -> u32 {
    let to = now.wrapping_sub(patience);
    records.absences.begin_of(Absence::Stopped, to)
}

fn of_host(host: &Host) -> i64 {
    let latencies = [&host.wake, &host.late, &host.send].map(|latency| latency.longest().nanos());
    latencies.iter().sum::<i64>() + host.longest_outage.nanos() + host.longest_stall.nanos()
}

fn of_wire(wire: &Wire) -> i64 {
    wire.effects.longest().nanos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Source;

    const NETWORK: &str = r#"cycle = "1ms"
duration = "100s"
[[station]]
name = "master"
role = "master"
[[station]]
name = "arm"
role = "slave"
"#;

    fn patience(more: &str) -> u32 {
        let scenario = Source::new("net.toml", &format!("{NETWORK}{more}")).parse().unwrap();
        cycles(&scenario) - AT_ONCE
    }

    #[test]
    fn whatever_holds_a_host_or_a_frame_up_is_waited_for() {
        assert_eq!(patience(""), 0);
        let host = "[host]\nwake = \"exponential 1ms\"\nlate = \"normal 1ms 1ms\"\nstalls = { ppm = 1, longest = \"4ms\" }";
        assert_eq!(patience(host), 2 * (10 + 7 + 4));
        assert_eq!(
            patience("[[wire]]\nreorder = \"1%\"\nreorder_by = \"30ms\"\ndelay = \"uniform 1ms 5ms\""),
            70
        );
        let stall = "[[event]]\nat = \"1s\"\nfor = \"50ms\"\nstall = \"arm\"\n";
        let clock = "[[event]]\nat = \"1s\"\ntimes = 3\nevery = \"1s\"\nclock = { step = \"-5ms\" }";
        assert_eq!(patience(&format!("{stall}{clock}")), 2 * (50 + 15));
        let beyond = "[[event]]\nat = \"1s\"\ntimes = 1000000\nevery = \"1us\"\nclock = { step = \"3600s\" }";
        assert_eq!(patience(beyond), FOREVER - AT_ONCE);
    }

    #[test]
    fn who_is_stopped_or_was_a_short_time_ago_is_waited_for() {
        let mut records = Records::default();
        assert_eq!(judged_to(&records, 5_000, 2_000), 3_000);
        records.absences.begin(1, Absence::Down, 10);
        records.absences.begin(1, Absence::Stopped, 2_500);
        assert_eq!(judged_to(&records, 5_000, 2_000), 2_500);
        records.absences.end(1, Absence::Stopped, 3_500);
        assert_eq!(judged_to(&records, 5_000, 2_000), 2_500);
        assert_eq!(judged_to(&records, 5_501, 2_000), 3_501, "it has told of all");
        records.absences.begin(2, Absence::Stopped, 6_000);
        assert_eq!(judged_to(&records, 9_000, 2_000), 6_000);
        records.absences.break_off(2, Absence::Stopped, 8_000);
        assert_eq!(judged_to(&records, 10_001, 2_000), 8_001, "nobody waits for who was killed meanwhile");
    }
}
