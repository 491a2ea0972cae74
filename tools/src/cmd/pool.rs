//! `rtnet pool`.

use super::Failure;
use super::interface::{asked, unasked};
use super::tdma::found;
use crate::cli::ShowArgs;
use crate::control::{PoolShown, StackReply, StackRequest};
use crate::report::text::{Column, grouped, table};

/// Columns of the table.
const WIDTH: usize = 100;

/// Shows a station's pools.
pub fn pool(args: &ShowArgs) -> Result<u8, Failure> {
    let which = found(&args.which)?;
    let StackReply::Pools(pools) = asked(&which, StackRequest::Pools)? else { return Err(unasked(&which)) };
    super::print_all(which.json, &pools, describe).map_err(Failure::Run)?;
    Ok(0)
}

fn describe(pools: &[PoolShown]) -> String {
    let right = |head, cell: fn(&PoolShown) -> u64| {
        Column::right(["", head], pools.iter().map(|pool| grouped(cell(pool))))
    };
    let lines = table(
        &[
            Column::left(["", "pool"], pools.iter().map(|pool| pool.pool.clone())),
            right("buffers", |pool| pool.capacity as u64),
            right("free", |pool| pool.free as u64),
            right("least", |pool| pool.least as u64),
            right("empty", |pool| pool.exhausted),
            right("lost", |pool| pool.dropped),
        ],
        WIDTH,
    );
    lines.join("\n") + "\n"
}
