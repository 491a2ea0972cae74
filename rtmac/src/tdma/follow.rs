//! What is configured of a station that follows a master.

use rtnet::time::Span;

use super::calibration::{DEFAULT_ROUNDS, MAX_ROUNDS};
use super::config::Refused;
use super::line::LINE_GOOD_FOR;
use super::report::DelayOf;
use super::slot::SlotConfig;

/// Cycles without a Synchronisation that are bridged, unless configured otherwise.
pub const HOLDOVER_CYCLES: i32 = 1;
/// Most that can be: a line that is bridged for longer would be given up before the loss is reported.
pub const MAX_HOLDOVER: u32 = LINE_GOOD_FOR as u32 - 1;

/// A Synchronisation is hardly there sooner after its cycle's start: at 100 Mbit/s the wire alone takes 7 us.
const SYNC_TAKES: Span = Span::from_micros(10);

/// How Synchronisations become a time line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Servo {
    /// Each is the line, as in RTnet: no filter, no drift, no doubt. For comparison runs.
    None,
    /// The line lies below them, with the drift of the clocks; what disagrees has to be confirmed.
    #[default]
    Linear,
}

impl Servo {
    /// Its name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Servo::None => "none",
            Servo::Linear => "linear",
        }
    }
}

/// What becomes of the measured delay when somebody else gives the time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum OnMasterChange {
    /// It is kept, as in RTnet.
    #[default]
    Keep,
    /// It is measured anew, and kept until that is done.
    Repeat,
}

/// What is configured of a slave, and of a master when it follows another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlaveConfig {
    /// Calibration rounds; 0: none, and a delay of 0.
    pub rounds: u32,
    /// How much a Synchronisation may disagree with the line before it is a time step. Default: a
    /// hundredth of the cycle, and at least 20 us.
    pub step_limit: Option<Span>,
    /// How Synchronisations become a time line.
    pub servo: Servo,
    /// What all calibration rounds say together; `None`: the lower quartile, and without a filter the mean, as RTnet.
    pub delay_of: Option<DelayOf>,
    /// Cycles without a Synchronisation that are bridged, at most [`MAX_HOLDOVER`].
    pub holdover: u32,
    /// Whether the delay is measured anew with another master.
    pub on_master_change: OnMasterChange,
}

impl Default for SlaveConfig {
    fn default() -> Self {
        Self {
            rounds: DEFAULT_ROUNDS,
            step_limit: None,
            servo: Servo::default(),
            delay_of: None,
            holdover: HOLDOVER_CYCLES.unsigned_abs(),
            on_master_change: OnMasterChange::default(),
        }
    }
}

impl SlaveConfig {
    /// What all calibration rounds say together.
    pub fn delay_of(&self) -> DelayOf {
        self.delay_of.unwrap_or(match self.servo {
            Servo::None => DelayOf::Mean,
            Servo::Linear => DelayOf::Quartile,
        })
    }

    /// Whether it can be, whatever slots there are.
    pub fn check(&self) -> Result<(), Refused> {
        let &Self { rounds, holdover, .. } = self;
        if rounds > MAX_ROUNDS {
            return Err(Refused::TooManyRounds { rounds });
        }
        if holdover > MAX_HOLDOVER {
            return Err(Refused::Holdover { cycles: holdover });
        }
        Ok(())
    }

    /// Whether these slots can be used: where nothing is bridged, only behind their cycle's Synchronisation, and what is sent
    /// is chosen a `lead` before.
    pub fn check_slots<'a>(
        &self,
        lead: Span,
        slots: impl IntoIterator<Item = &'a SlotConfig>,
    ) -> Result<(), Refused> {
        let earliest = lead + SYNC_TAKES;
        match slots.into_iter().find(|slot| self.holdover == 0 && slot.offset < earliest) {
            Some(&SlotConfig { id, offset, .. }) => Err(Refused::BeforeSync { id, offset, earliest }),
            None => Ok(()),
        }
    }
}
