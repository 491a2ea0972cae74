//! How old packages are: their stamps, and the station's time.

use std::io;
use std::path::Path;
use std::sync::Arc;

use rtnet::api::Station;
use rtnet::live::TimeBoard;

use super::Package;
use crate::journey::Journey;

/// What a component knows of its station's time. Clones are the same.
#[derive(Clone, Default)]
pub struct Times(Option<Arc<TimeBoard>>);

impl Times {
    /// Of the station with this control socket.
    pub(super) fn of(station: &Path) -> io::Result<Self> {
        Ok(Self(Some(Station::at(station).time()?)))
    }

    /// Where the time of a package that was received went. It takes no system call.
    pub fn journey(&self, package: &Package<'_>) -> Journey {
        let (stamps, waited) = (package.stamps(), package.waited());
        let moments = [stamps.sent, stamps.sent.wrapping_add(waited)];
        Journey::of(&stamps, waited, self.0.as_ref().and_then(|board| board.global_at(moments)))
    }

    /// The station's time itself, if it shows one.
    pub fn board(&self) -> Option<&Arc<TimeBoard>> {
        self.0.as_ref()
    }
}
