//! `rtnet doctor`.

use std::io::Write;

use rtnet::time::Span;

use super::delivery::Delivery;
use super::{Failure, screen_width, writable};
use crate::cli::DoctorArgs;
use crate::control::Directory;
use crate::doctor::rights::{self, Way};
use crate::doctor::{self, Options, screen};

/// Measurements up to this long show no progress.
const SHORT: Span = Span::from_millis(2_000);

/// Examines this host and tells what it can hold; the exit status does not depend on the verdict.
pub fn doctor(args: &DoctorArgs) -> Result<u8, Failure> {
    if args.probe_user_namespace {
        return Ok(u8::from(rights::enter_user_namespace().is_err()));
    }
    if let Some(path) = &args.json {
        writable(path).map_err(Failure::Usage)?;
    }
    for lab in Directory::of_user().map_err(Failure::Usage)?.labs() {
        let _ = writeln!(
            std::io::stderr(),
            "rtnet: the lab '{lab}' is up: it and the doctor disturb each other (rtnet lab down {lab})"
        );
    }
    let options = Options { cpu: args.cpu, duration: args.duration, progress: args.duration > SHORT };
    let findings = doctor::examine(&options, &Way::find()).map_err(Failure::Usage)?;
    let json = args.json.as_ref();
    let mut delivery = Delivery::begin(&screen::render(&findings, screen_width()), &[json]);
    delivery.json(json, &findings);
    delivery.end_with(0)
}
