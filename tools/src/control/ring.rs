//! What a station tells of its ring.

use rtmac::token::bound::{access_delay_bound, recovery_bound, rotation_bound};
use rtmac::token::{RingConfig, TokenStatus};
use rtnet::time::Span;
use serde::{Deserialize, Serialize};

/// A ring, and where the token is.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct RingShown {
    /// The station's place in it, from 0 on.
    pub place: u8,
    /// The addresses of its stations, in order.
    pub stations: Vec<String>,
    /// Of each whether it takes part, as far as this one knows.
    pub present: Vec<bool>,
    /// How often the token was claimed, and passed on since, both modulo 2^32; `None`: none was heard yet.
    pub token: Option<(u32, u32)>,
    /// How often the token was here.
    pub visits: u32,
    /// How long it took to come back the last time, and at the longest, nanoseconds.
    pub rotation_ns: Option<i64>,
    /// See `rotation_ns`.
    pub longest_rotation_ns: Option<i64>,
    /// The longest that it takes if nothing is lost, nanoseconds.
    pub rotation_bound_ns: i64,
    /// The longest that the most urgent frame waits if nothing is lost, nanoseconds.
    pub access_delay_bound_ns: i64,
    /// From the loss of a token, or the death of its holder, to the next frame of data at the latest, nanoseconds.
    pub recovery_bound_ns: i64,
}

impl RingShown {
    /// Of a station's status, and what its ring is configured with.
    pub fn of(status: &TokenStatus, ring: &RingConfig) -> Self {
        let present: Vec<bool> = (0..status.size).map(|place| status.present >> place & 1 == 1).collect();
        let here = present.iter().filter(|is_here| **is_here).count();
        let absent = present.len() - here;
        Self {
            place: status.index,
            stations: ring.stations.iter().map(ToString::to_string).collect(),
            present,
            token: status.mark.map(|mark| (mark.generation, mark.sequence)),
            visits: status.visits,
            rotation_ns: status.rotation.map(Span::nanos),
            longest_rotation_ns: status.longest_rotation.map(Span::nanos),
            rotation_bound_ns: rotation_bound(ring, here, absent).nanos(),
            access_delay_bound_ns: access_delay_bound(ring, here, absent).nanos(),
            recovery_bound_ns: recovery_bound(ring, 1, 0).nanos(),
        }
    }

    /// In words.
    pub fn describe(&self) -> String {
        let span = |ns: i64| Span::from_nanos(ns).to_string();
        let seen = |ns: Option<i64>| ns.map_or("not seen yet".into(), span);
        let mut text = format!(
            "ring of {}, place {}, {} of them present\n",
            self.stations.len(),
            self.place,
            self.present.iter().filter(|is_here| **is_here).count()
        );
        if let Some((generation, sequence)) = self.token {
            text += &format!("token {sequence} of claim {generation}, {} times here\n", self.visits);
        }
        text += &format!(
            "round in {}, at the longest {}, bound {}\n",
            seen(self.rotation_ns),
            seen(self.longest_rotation_ns),
            span(self.rotation_bound_ns)
        );
        text += &format!(
            "worst wait of the most urgent frame {}; a dead holder costs {} at the most\n",
            span(self.access_delay_bound_ns),
            span(self.recovery_bound_ns)
        );
        let absent = self.stations.iter().zip(&self.present).filter(|(_, is_here)| !**is_here);
        let absent: Vec<&str> = absent.map(|(station, _)| station.as_str()).collect();
        if !absent.is_empty() {
            text += &format!("absent: {}\n", absent.join(", "));
        }
        text
    }
}
