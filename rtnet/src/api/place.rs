//! Where the control sockets of running stations are.

use std::io::{Error, ErrorKind, Result};
use std::path::PathBuf;

/// For root.
const SYSTEM: &str = "/run/rtnet";
/// Behind a station's name.
pub const SOCKET: &str = ".sock";

/// The directory of this user's stations: `/run/rtnet` for root, else `$XDG_RUNTIME_DIR/rtnet`, else `/tmp/rtnet-UID`.
/// To be asked before entering a user namespace.
pub fn directory() -> PathBuf {
    let uid = nix::unistd::geteuid();
    if uid.is_root() {
        return SYSTEM.into();
    }
    match std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from) {
        Some(runtime) if runtime.is_absolute() => runtime.join("rtnet"),
        _ => format!("/tmp/rtnet-{uid}").into(),
    }
}

/// The control socket of the station that is called `[LAB/]STATION`.
pub fn socket_of(name: &str) -> Result<PathBuf> {
    let (lab, station) = match name.split_once('/') {
        Some((lab, station)) => (Some(lab), station),
        None => (None, name),
    };
    let is_name = |part: &str| !part.is_empty() && !part.starts_with('.') && !part.contains(['/', '\0']);
    if !lab.into_iter().chain([station]).all(is_name) {
        let why = format!("'{name}' is no station: write STATION, or LAB/STATION");
        return Err(Error::new(ErrorKind::InvalidInput, why));
    }
    let home = lab.map_or_else(directory, |lab| directory().join(lab));
    Ok(home.join(format!("{station}{SOCKET}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_leads_nowhere_but_to_a_socket_of_this_user() {
        let home = directory();
        assert_eq!(socket_of("arm").unwrap(), home.join("arm.sock"));
        assert_eq!(socket_of("cell/arm").unwrap(), home.join("cell").join("arm.sock"));
        for bad in ["", "/", "cell/", "/arm", "../arm", "cell/../arm", "a/b/c", ".", "cell/.lock"] {
            let error = socket_of(bad).unwrap_err();
            assert!(error.to_string().contains(&format!("'{bad}'")), "{error}");
        }
    }
}
