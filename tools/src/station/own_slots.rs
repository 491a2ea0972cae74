//! What a single station knows of a network's slots: its own, and of the cycle what a master gives or a slave hears.

use rtmac::tdma::schedule::{Conflict, Rate, Schedule, Slot};
use rtmac::tdma::{SlotConfig, TdmaConfig, joint};
use rtnet::discipline::Channel;
use rtnet::time::Span;

/// A station's own slots, and what it is certain of that they must keep clear of.
#[derive(Clone, Debug)]
pub struct OwnSlots {
    rate: Rate,
    max_id: u8,
    /// A master's cycle, and its sync window.
    given: Option<(Span, Span)>,
    slots: Vec<SlotConfig>,
}

impl OwnSlots {
    /// Those that a station is configured with; `given` by a master: its cycle and sync window.
    pub fn of(tdma: &TdmaConfig, given: Option<(Span, Span)>, rate: Rate) -> Self {
        // Where that cannot be, the station has refused it already.
        let slots = joint::resolved(&tdma.slots).unwrap_or_else(|_| tdma.slots.clone());
        Self { rate, max_id: tdma.max_slot_id, given, slots }
    }

    /// With this slot, defined or changed, and those that are joined to it as they follow; or why it cannot be joined.
    pub fn with(&self, slot: SlotConfig) -> Result<Self, String> {
        let slots = joint::redefined(&self.slots, slot).map_err(|refused| refused.to_string())?;
        Ok(Self { slots, ..self.clone() })
    }

    /// Without this slot.
    pub fn without(&self, id: Channel) -> Self {
        let slots = self.slots.iter().filter(|slot| slot.id != id).copied().collect();
        Self { slots, ..self.clone() }
    }

    /// This slot, if it is defined.
    pub fn get(&self, id: Channel) -> Option<&SlotConfig> {
        self.slots.iter().find(|slot| slot.id == id)
    }

    /// The medium's.
    pub fn rate(&self) -> Rate {
        self.rate
    }

    /// What a master keeps free for its Synchronisations.
    pub fn sync_window(&self) -> Option<Span> {
        self.given.map(|(_, window)| window)
    }

    /// In another role.
    pub fn giving(&self, given: Option<(Span, Span)>) -> Self {
        Self { given, ..self.clone() }
    }

    /// After a change of the schedule: these, in cycles of this length, if it is known.
    pub fn switched(&self, slots: Vec<SlotConfig>, cycle: Option<Span>) -> Self {
        let given = self.given.map(|(before, window)| (cycle.unwrap_or(before), window));
        Self { given, slots, ..self.clone() }
    }

    /// Whether they go together; if not, a line that says what to do.
    pub fn check(&self) -> Result<(), String> {
        self.conflicts(None).first().map_or(Ok(()), |conflict| Err(refusal(conflict)))
    }

    /// Whether this slot can be, and goes with the others; `heard` is the cycle of a slave's master. What is wrong
    /// with the others is no reason: they could never be set right one by one.
    pub fn check_slot(&self, id: Channel, heard: Option<Span>) -> Result<(), String> {
        if let Some(slot) = self.get(id) {
            slot.check(self.max_id).map_err(|refused| refused.to_string())?;
        }
        let conflicts = self.conflicts(heard);
        let its = conflicts.iter().find(|conflict| is_of(conflict, id));
        its.map_or(Ok(()), |conflict| Err(refusal(conflict)))
    }

    /// Only frames themselves are certain: how wide guard bands must be depends on whose slots are next.
    fn conflicts(&self, heard: Option<Span>) -> Vec<Conflict> {
        let heard = heard.map(|cycle| (cycle, Span::ZERO));
        // A cycle that nobody knows ends behind every slot.
        let unknown = (Span::from_nanos(i64::MAX), Span::ZERO);
        let (cycle, sync_window) = self.given.or(heard).unwrap_or(unknown);
        let slots = self.slots.iter().map(|&SlotConfig { id, offset, phase, period, size, .. }| Slot {
            owner: String::new(),
            id,
            offset,
            phase,
            period,
            size,
        });
        let (guard, backups) = (Span::ZERO, Vec::new());
        Schedule { cycle, sync_window, rate: self.rate, guard, backups, slots: slots.collect() }.conflicts()
    }
}

fn is_of(conflict: &Conflict, slot: Channel) -> bool {
    match conflict {
        Conflict::Overlap { a_id, b_id, .. } => [*a_id, *b_id].contains(&slot),
        Conflict::InSyncWindow { id, .. } | Conflict::BeyondCycle { id, .. } => *id == slot,
        Conflict::BeforeBackup { id, .. } => *id == slot,
        Conflict::DoesNotFit { .. } | Conflict::BackupTooEarly { .. } => true,
    }
}

fn refusal(conflict: &Conflict) -> String {
    let what = match conflict {
        Conflict::Overlap { a_id, a_offset, air, a_end, b_id, b_offset, .. } => format!(
            "slot {a_id} and slot {b_id} overlap: {a_offset} + frame {air} = {a_end}, but slot {b_id} begins at \
             {b_offset}; move one, let them take turns (phase=P/N), or make slot {a_id} smaller (size=B)"
        ),
        Conflict::InSyncWindow { id, offset, sync_window, .. } => format!(
            "slot {id} begins at {offset}, inside the sync window of {sync_window}; let it begin behind that"
        ),
        Conflict::BeyondCycle { id, offset, air, end, cycle, .. } => format!(
            "slot {id} ends after the cycle: {offset} + frame {air} = {end}, the cycle is {cycle}; let it begin \
             earlier, or make it smaller (size=B)"
        ),
        Conflict::DoesNotFit { .. } | Conflict::BackupTooEarly { .. } | Conflict::BeforeBackup { .. } => {
            conflict.to_string()
        }
    };
    format!("{what}. A single station knows only its own slots: keep clear of the others' yourself")
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtmac::tdma::{DEFAULT_LEAD, LatePolicy, RoleConfig, SlaveConfig};
    use rtnet::wire::ethernet::{Address, MTU};

    const FAST: Rate = Rate::from_bits_per_second(1_000_000_000);

    fn slot(id: u8, micros: i64, phase: u32, period: u32) -> SlotConfig {
        let (offset, latest) = (Span::from_micros(micros), Span::from_micros(50));
        SlotConfig { id, offset, phase, period, size: MTU, joint: None, latest }
    }

    fn slave(slots: &[SlotConfig], rate: Rate) -> OwnSlots {
        let tdma = TdmaConfig {
            address: Address::default(),
            role: RoleConfig::Slave(SlaveConfig { rounds: 0, ..SlaveConfig::default() }),
            slots: slots.to_vec(),
            max_slot_id: 7,
            lead: DEFAULT_LEAD,
            late: LatePolicy::Skip,
        };
        OwnSlots::of(&tdma, None, rate)
    }

    fn master(slots: &[SlotConfig]) -> OwnSlots {
        slave(slots, FAST).giving(Some((Span::from_millis(1), Span::from_micros(50))))
    }

    #[track_caller]
    fn refused(checked: Result<(), String>, expected: &str) {
        let why = checked.unwrap_err();
        assert!(why.contains(expected) && why.contains("knows only its own slots"), "{why}");
        assert!(!why.contains('\n'));
    }

    #[test]
    fn own_slots_that_meet_in_time_and_phase_are_refused_by_both_their_names() {
        let both = [slot(0, 100, 0, 1), slot(2, 112, 1, 2)];
        refused(
            slave(&both, FAST).check(),
            "slot 0 and slot 2 overlap: 100us + frame 12.304us = 112.304us, but slot 2 begins at 112us; move",
        );
        assert_eq!(slave(&both, Rate::from_bits_per_second(10_000_000_000)).check(), Ok(()), "1.23 us there");
        assert_eq!(slave(&[slot(0, 100, 0, 2), slot(2, 100, 1, 2)], FAST).check(), Ok(()), "they take turns");
    }

    #[test]
    fn a_masters_slots_keep_clear_of_its_sync_window_and_end_in_its_cycle() {
        refused(master(&[slot(0, 0, 0, 1)]).check(), "slot 0 begins at 0ns, inside the sync window of 50us");
        refused(
            master(&[slot(0, 999, 0, 1)]).check(),
            "slot 0 ends after the cycle: 999us + frame 12.304us = 1.011304ms, the cycle is 1ms",
        );
        assert_eq!(master(&[slot(0, 50, 0, 1), slot(2, 980, 0, 1)]).check(), Ok(()));
        assert_eq!(
            slave(&[slot(0, 0, 0, 1), slot(2, 999, 0, 1)], FAST).check(),
            Ok(()),
            "who knows its cycle?"
        );
    }

    #[test]
    fn a_slot_is_judged_by_what_concerns_it_and_by_the_cycle_that_was_heard() {
        let own = slave(&[slot(0, 999, 0, 1), slot(3, 1_500, 0, 1)], FAST);
        let heard = Some(Span::from_millis(1));
        refused(own.check_slot(0, heard), "slot 0 ends after the cycle");
        assert_eq!(own.check_slot(0, None), Ok(()));
        assert_eq!(
            own.with(slot(0, 100, 0, 1)).unwrap().check_slot(0, heard),
            Ok(()),
            "slot 3 is still to be set right"
        );
        assert_eq!(own.without(0).check_slot(0, heard), Ok(()));
    }

    #[test]
    fn what_cannot_be_a_slot_is_refused_as_such() {
        let none = slave(&[], FAST);
        for (wrong, expected) in [
            (SlotConfig { size: usize::MAX, ..slot(0, 100, 0, 1) }, "a size of"),
            (SlotConfig { offset: Span::from_nanos(-1), ..slot(0, 100, 0, 1) }, "before the cycle's start"),
            (slot(0, 100, 0, 0), "phase 1 of 0"),
            (slot(8, 100, 0, 1), "ids go from 0 to 7"),
        ] {
            let why = none.with(wrong).unwrap().check_slot(wrong.id, None).unwrap_err();
            assert!(why.contains(expected), "{why}");
        }
        // Nobody's slot, but no reason to panic.
        let endless = SlotConfig { offset: Span::from_nanos(i64::MAX), ..slot(1, 0, 0, 1) };
        let _ = none.with(endless).unwrap().check_slot(1, Some(Span::from_millis(1)));
    }

    #[test]
    fn a_joint_slot_takes_its_time_like_any_other_and_follows_as_the_station_has_it() {
        let joined = |micros| SlotConfig { joint: Some(0), ..slot(2, micros, 0, 1) };
        refused(
            slave(&[slot(0, 100, 0, 1), joined(112)], FAST).check(),
            "slot 0 and slot 2 overlap: 100us + frame 12.304us",
        );
        let own = slave(&[joined(500), slot(0, 100, 0, 1)], FAST);
        let small = own.with(SlotConfig { size: 100, ..slot(0, 100, 0, 1) }).unwrap();
        assert_eq!(small.get(2), Some(&SlotConfig { size: 100, ..joined(500) }));
        let grown = small.with(slot(0, 100, 0, 1)).unwrap();
        assert_eq!(grown.get(2), Some(&SlotConfig { size: 100, joint: None, ..joined(500) }));
        let why = grown.with(joined(500)).unwrap().with(SlotConfig { joint: Some(2), ..slot(0, 100, 0, 1) });
        assert!(why.unwrap_err().contains("slot 0 cannot be joined to slot 2: that would take from itself"));
    }
}
