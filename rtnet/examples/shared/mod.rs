//! How the examples end: with a line that says what failed, of which station or argument, and what to do.

use std::io;
use std::process::ExitCode;
use std::str::FromStr;

use nix::errno::Errno;

/// Tells what failed; the exit status is 1 then.
pub fn end(outcome: Result<(), String>) -> ExitCode {
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            eprintln!("{why}");
            ExitCode::FAILURE
        }
    }
}

/// Reads an argument, or says what was expected.
pub fn read<T: FromStr>(argument: &str, expected: &str) -> Result<T, String> {
    argument.parse().map_err(|_| format!("'{argument}' is no {expected}"))
}

/// What an error of a station's means: they have BSD's numbers, see `rtnet::api`.
pub fn of(station: &str) -> impl Fn(io::Error) -> String {
    move |error| match error.raw_os_error().map(Errno::from_raw) {
        Some(Errno::ENODEV) => {
            format!(
                "station '{station}' does not run, or has ended (ENODEV): start it, then this program again"
            )
        }
        Some(Errno::EOPNOTSUPP) => format!(
            "station '{station}' has no sockets (EOPNOTSUPP): start it with an address (`rtnet station --ip`, or \
             `network` in a lab's file)"
        ),
        Some(Errno::EHOSTUNREACH) => format!(
            "station '{station}' knows no way there (EHOSTUNREACH): add one (`rtnet route -S {station} add`), or ask for \
             it (`rtnet route -S {station} solicit`)"
        ),
        Some(Errno::EADDRINUSE) => {
            format!(
                "another program of station '{station}' has this port (EADDRINUSE): end it, or choose another"
            )
        }
        _ => format!("station '{station}': {error}"),
    }
}
