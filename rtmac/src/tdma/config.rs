//! What is configured of a TDMA station, and what may be asked of it later.

use rtnet::discipline::{Channel, Refused};
use rtnet::time::Span;
use rtnet::wire::ethernet::Address;

use super::slave::PERIODS;
use super::{MasterConfig, SlaveConfig, SlotConfig};

/// How long before a slot its frame is chosen, unless configured otherwise: a woken thread is there
/// within 50 us in 99 of 100 cases on a virtual machine.
pub const DEFAULT_LEAD: Span = Span::from_micros(50);

/// What to do with a slot whose `latest` instant has passed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum LatePolicy {
    /// Send nothing (invariant 5).
    #[default]
    Skip,
    /// Send all the same, as RTnet does, up to a cycle late. For comparison runs.
    Send,
}

/// What a station is in the cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoleConfig {
    /// Gives the time.
    Master(MasterConfig),
    /// Follows it.
    Slave(SlaveConfig),
}

/// Everything that is configured of a TDMA station.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TdmaConfig {
    /// The interface's address.
    pub address: Address,
    /// Master or slave.
    pub role: RoleConfig,
    /// Its slots.
    pub slots: Vec<SlotConfig>,
    /// Highest slot id.
    pub max_slot_id: u8,
    /// How long before a slot its frame is chosen.
    pub lead: Span,
    /// What to do when late.
    pub late: LatePolicy,
}

/// What the control thread may ask of a TDMA station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TdmaCommand {
    /// Define or change a slot, from the next cycle on.
    SetSlot(SlotConfig),
    /// Remove a slot; what is queued in it is dropped.
    RemoveSlot(Channel),
}

/// A master knows its cycle, so that its own slots can be checked against it.
pub fn checked(master: MasterConfig, slots: &[SlotConfig]) -> Result<MasterConfig, Refused> {
    let MasterConfig { cycle, sync_latest, .. } = master;
    if !PERIODS.contains(&cycle) {
        let (least, most) = (PERIODS.start(), PERIODS.end());
        return Err(Refused(format!("a cycle of {cycle}: no slave follows one outside {least} to {most}")));
    }
    if sync_latest >= cycle {
        return Err(Refused(format!("a sync window that lasts beyond the cycle of {cycle}: shorten it")));
    }
    match slots.iter().find(|slot| slot.offset >= master.cycle) {
        Some(slot) => {
            let (id, offset, cycle) = (slot.id, slot.offset, master.cycle);
            Err(Refused(format!("slot {id}: the offset {offset} is beyond the cycle of {cycle}")))
        }
        None => Ok(master),
    }
}
