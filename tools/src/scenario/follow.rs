//! How a station follows a master, as the command line and files have it.

use clap::ValueEnum;
use rtmac::tdma::{DelayOf, OnMasterChange, Servo};
use serde::{Deserialize, Serialize};

/// How syncs become a time line.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum ServoName {
    /// Each sync is the time line, as in RTnet, however late it is: for comparison
    None,
    /// The time line lies below the syncs, with the drift of the clocks
    #[default]
    Linear,
}

impl ServoName {
    /// As a station takes it.
    pub fn servo(self) -> Servo {
        match self {
            ServoName::None => Servo::None,
            ServoName::Linear => Servo::Linear,
        }
    }
}

/// What all calibration rounds say together of the delay.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum DelayName {
    /// The lower quartile: hold-ups only ever make a round longer
    Quartile,
    /// Half of the rounds were longer
    Median,
    /// As RTnet: one round that is held up moves it
    Mean,
}

impl DelayName {
    /// As a station takes it.
    pub fn delay_of(self) -> DelayOf {
        match self {
            DelayName::Quartile => DelayOf::Quartile,
            DelayName::Median => DelayOf::Median,
            DelayName::Mean => DelayOf::Mean,
        }
    }
}

/// What becomes of the measured delay when somebody else gives the time.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, PartialEq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum DelayPolicy {
    /// It stays, as in RTnet
    #[default]
    Keep,
    /// It is measured anew, and stays until that is done
    Repeat,
}

impl DelayPolicy {
    /// As a station takes it.
    pub fn on_master_change(self) -> OnMasterChange {
        match self {
            DelayPolicy::Keep => OnMasterChange::Keep,
            DelayPolicy::Repeat => OnMasterChange::Repeat,
        }
    }
}
