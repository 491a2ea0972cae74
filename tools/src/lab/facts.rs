//! What a lab knows of its stations beside what the judge saw.

use std::collections::BTreeMap;

use rtnet::live::Impaired;
use rtnet::live::clock::monotonic;

use super::run::Lab;
use crate::judge::delivery::Delivery;
use crate::judge::outcome::Facts;
use crate::scenario::Scenario;

impl Lab {
    /// Of all stations, judged to the end or not.
    pub(super) fn facts(&self, scenario: &Scenario, is_judged: bool) -> Vec<Facts> {
        let facts = |id: usize| {
            let member = &self.members[id];
            let streams = scenario.streams(scenario.sender(id)).filter(|_| member.can_tell());
            let deliveries: BTreeMap<_, _> =
                streams.map(|of| (of, self.delivery(scenario, id, of))).collect();
            let note = wire_note(&self.wires.counts(id));
            let facts = member.facts(&scenario.stations[id].name, is_judged, deliveries, note);
            // Of one that its scenario holds up, nobody knows which was the host's doing.
            Facts { woke_late: facts.woke_late.filter(|_| !scenario.conditions.holds_up(id)), ..facts }
        };
        (0..self.members.len()).map(facts).collect()
    }

    /// What came to a station of one kind of its sender's frames.
    pub(super) fn delivery(&self, scenario: &Scenario, station: usize, of: Option<u8>) -> Delivery {
        let member = &self.members[station];
        let every = self.analysis.sends_every(scenario.sender(station));
        let unheard = member.unplugged.lost(every, monotonic());
        Delivery { heard: member.heard(of), meant: self.wires.meant(station, of).clone().and_any(unheard) }
    }
}

/// What became of frames for a station because its scenario says so, since they were first sent.
fn wire_note(&Impaired { lost_control, lost_data, corrupted, duplicated }: &Impaired) -> Option<String> {
    let counts = [
        (lost_data, "data frames lost"),
        (lost_control, "control frames lost"),
        (corrupted, "frames changed"),
        (duplicated, "frames doubled"),
    ];
    let counts = counts.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}"));
    let counts = counts.collect::<Vec<_>>().join(", ");
    (!counts.is_empty()).then(|| format!("on the way to it, as the scenario says: {counts}"))
}
