//! `rtnet token`.

use super::tdma::{describe, found_of, status};
use super::{Failure, print};
use crate::cli::{TokenArgs, TokenVerb};

/// Looks at a station of a ring.
pub fn token(args: &TokenArgs) -> Result<u8, Failure> {
    let which = &found_of(&args.which)?;
    let TokenVerb::Status = args.verb;
    let status = status(which).map_err(Failure::Usage)?;
    if status.ring.is_none() {
        return Err(Failure::Usage(anyhow::anyhow!(
            "station '{}' is in no ring, its discipline is '{}': see `rtnet tdma status`, or start it with --discipline \
             token",
            which.place,
            status.discipline
        )));
    }
    print(which.json, &status, describe).map_err(Failure::Run)?;
    Ok(0)
}
