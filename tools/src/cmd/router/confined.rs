//! The rights of a router's process after its start: landlock, where the kernel has it.

use std::path::{Path, PathBuf};

use landlock::{
    ABI, Access, AccessFs, AccessNet, NetPort, Ruleset, RulesetAttr, RulesetCreatedAttr, RulesetError,
    RulesetStatus, path_beneath_rules,
};
use package_router::tcp::config::RouterFile;

/// The newest rights of the kernel that are known here; older kernels have less of them.
const KNOWN: ABI = ABI::V5;

/// From now on this thread, and those that it starts, open no port, connect to the ports of links only, and reach no files but those of
/// the control socket's directory and, to read, those of its own file's. A line if the kernel does not do all of that.
pub fn confine(file: &RouterFile, own_file: Option<&Path>, control: &Path) -> Option<String> {
    match restrict(file, own_file, control) {
        Ok(RulesetStatus::FullyEnforced) => None,
        Ok(RulesetStatus::PartiallyEnforced) => {
            Some(line("this kernel knows a part of the rights (Linux 6.10 all)"))
        }
        Ok(RulesetStatus::NotEnforced) => Some(line("this kernel has none, or it is off (lsm=landlock,...)")),
        Err(error) => Some(line(&error.to_string())),
    }
}

fn line(why: &str) -> String {
    format!("landlock: {why}: an error in this program could reach other files and ports")
}

fn restrict(
    file: &RouterFile,
    own_file: Option<&Path>,
    control: &Path,
) -> Result<RulesetStatus, RulesetError> {
    let (all, read) = (AccessFs::from_all(KNOWN), AccessFs::from_read(KNOWN));
    // The name of a host is looked up by whatever the system has for that.
    let is_named = file.links.iter().any(|link| link.router.host.parse::<std::net::IpAddr>().is_err());
    let mut readable: Vec<PathBuf> = own_file.map(directory_of).into_iter().collect();
    readable.extend(is_named.then(|| "/".into()));
    let mut rules = Ruleset::default()
        .handle_access(all)?
        .handle_access(AccessNet::BindTcp | AccessNet::ConnectTcp)?
        .create()?
        .add_rules(path_beneath_rules([directory_of(control)], all))?
        .add_rules(path_beneath_rules(readable, read))?;
    for link in &file.links {
        rules = rules.add_rule(NetPort::new(link.router.port, AccessNet::ConnectTcp))?;
    }
    Ok(rules.restrict_self()?.ruleset)
}

fn directory_of(file: &Path) -> PathBuf {
    match file.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent.into(),
        _ => ".".into(),
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::{ErrorKind, Result, Write};
    use std::net::{TcpListener, TcpStream};

    use super::*;

    /// A thread of its own has the rights: no other test loses any.
    #[test]
    fn a_router_reaches_no_port_but_those_of_its_links() {
        let [link, other] = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
        let [link_at, other_at] = [&link, &other].map(|of| of.local_addr().unwrap());
        let text = format!("system = 1\n[[link]]\nrouter = \"{link_at}\"\n");
        let file = RouterFile::parse(&text, "router.toml").unwrap();
        let dir = tempfile::tempdir().unwrap();
        let control = dir.path().join("router");
        let confined = std::thread::spawn(move || {
            if restrict(&file, None, &control).unwrap() != RulesetStatus::FullyEnforced {
                let _ = std::io::stderr().write_all(b"SKIP: needs a kernel with landlock (Linux 6.10)\n");
                return;
            }
            fn is_denied<T>(of: Result<T>) -> bool {
                of.is_err_and(|error| error.kind() == ErrorKind::PermissionDenied)
            }
            assert!(TcpStream::connect(link_at).is_ok());
            assert!(is_denied(TcpStream::connect(other_at)));
            assert!(is_denied(TcpListener::bind("127.0.0.1:0")));
            assert!(is_denied(File::open("/etc/passwd")));
            assert!(File::create(control).is_ok());
        });
        confined.join().unwrap();
    }
}
