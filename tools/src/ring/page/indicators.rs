//! The indicators of IEC 61784-2 that a ring has; of the others, why it has none.

use crate::judge::closely::regular::Largest;
use crate::report::histogram::Summary;
use crate::report::html::indicators::{
    Indicator, measured, not_measured, stations, switches, table, throughput, topology,
};
use crate::ring::figures::RingFigures;
use rtnet::time::Span;

const DELIVERY: &str = "The longest that a value was under way which had just missed its station’s frame: from the begin of that one to \
                        the end of the station’s next frame on the medium, t(n) − t(n−1) + air time; whatever happened to the token \
                        between is in it.";
const WITH_A_LOSS: &str =
    "The same where the frame between is lost: to the end of the one after it, t(n) − t(n−2) + air time.";
const RECOVERY: &str = "Every station is there for every other: from the last token before one was lost to the next frame of who has it.";

/// A table of all.
pub fn html(figures: &RingFigures) -> String {
    let kept = &figures.kept;
    let joint = figures.seed.map(|_| kept.joint);
    let none_twice = "no station sent two frames";
    table([
        measured(
            largest(&figures.delivery_ns),
            "Delivery time, max, no frame lost",
            DELIVERY.into(),
            none_twice,
        ),
        measured(
            kept.delivery_with_a_loss,
            "Delivery time, max, one frame lost",
            WITH_A_LOSS.into(),
            "no station sent three frames",
        ),
        stations(figures.stations, "Stations of the ring; there is no master."),
        topology(joint),
        switches(joint),
        throughput(&kept.carried, figures.measured_ns, "with the token"),
        Indicator {
            name: "Non-RTE bandwidth",
            value: "0 %".into(),
            n: None,
            definition: "No station has a VNIC, so that nothing but real-time frames may be sent.".into(),
        },
        not_measured("Time synchronisation accuracy", "nobody gives the time in a ring"),
        not_measured(
            "Non-time-based synchronisation accuracy",
            "no trigger is common to the stations of a ring",
        ),
        measured(
            largest(&figures.recovery_ns),
            "Redundancy recovery time",
            RECOVERY.into(),
            "no token was lost in this run",
        ),
    ])
}

fn largest(of: &Summary) -> Largest {
    Largest { span: of.max.map(Span::from_nanos), n: of.n }
}
