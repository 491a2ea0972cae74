//! Each verb refuses a run directory that is not its user's alone.

use std::collections::BTreeSet;
use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, chown, symlink};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;

use clap::CommandFactory;
use tools::cli::Cli;

use crate::cell::text;
use crate::host::is_root;
use crate::program::copy_program;

const NOBODY: u32 = 65_534;
/// Verbs that need no run directory.
const WITHOUT: [&str; 6] = ["sim run", "sim example", "plan", "completions", "man", "router keys"];
/// Each of the others, with what it cannot be called without.
const WITH: [(&str, &str); 43] = [
    ("lab run", ""),
    ("lab up", ""),
    ("lab down", "cell"),
    ("lab status", ""),
    ("lab restart", "cell/arm"),
    ("lab exec", "cell/arm -- true"),
    ("doctor", "--duration 1s"),
    ("find-min-cycle", ""),
    ("station", "--interface lo --master --cycle 1ms --name arm"),
    ("tdma status", "-S arm"),
    ("tdma master", "-S arm --cycle 1ms"),
    ("tdma slave", "-S arm"),
    ("tdma calibrate", "-S arm"),
    ("tdma detach", "-S arm"),
    ("token status", "-S arm"),
    ("slot list", "-S arm"),
    ("slot set", "-S arm 0=100us"),
    ("slot remove", "-S arm 0"),
    ("schedule show", "-S arm"),
    ("schedule propose", "-S arm /dev/null"),
    ("schedule activate", "-S arm"),
    ("schedule cancel", "-S arm"),
    ("if", "-S arm"),
    ("route list", "-S arm"),
    ("route add", "-S arm 10.0.0.2 02:00:00:00:00:02"),
    ("route del", "-S arm 10.0.0.2"),
    ("route solicit", "-S arm 10.0.0.2"),
    ("route get", "-S arm 10.0.0.2"),
    ("route load", "-S arm /dev/null"),
    ("ping", "-S arm 10.0.0.2"),
    ("pool", "-S arm"),
    ("stat", "-S arm"),
    ("vnic status", "-S arm"),
    ("vnic up", "-S arm"),
    ("vnic down", "-S arm"),
    ("vnic set", "-S arm --mtu 900"),
    ("mailbox list", "-S arm"),
    ("mailbox stat", "-S arm"),
    ("mailbox watch", "-S arm"),
    ("package send", "-S arm 0.Pilot.0 hello"),
    ("package receive", "-S arm 0.Pilot.0"),
    ("package ping", "-S arm 0.Pilot.0"),
    ("package bench", "-S arm 0.Pilot.0"),
];
/// Verbs with verbs of their own that can be left out, and such that take a lab or not.
const MORE: [(&str, &str); 7] = [
    ("package route", "-S arm"),
    ("package route add", "-S arm 0.Pilot.*=10.0.0.3"),
    ("package route delete", "-S arm 0.Pilot.*"),
    ("router", "--listen 127.0.0.1:0"),
    ("router status", ""),
    ("jitter", "--lab cell"),
    ("dump", "--lab cell"),
];

/// All verbs, those with verbs below them only if they go without.
fn verbs(command: &clap::Command, path: &str) -> BTreeSet<String> {
    let below = command.get_subcommands().filter(|of| of.get_name() != "help" && !of.is_hide_set());
    let mut all: BTreeSet<String> =
        below.flat_map(|of| verbs(of, format!("{path} {}", of.get_name()).trim())).collect();
    if !command.is_subcommand_required_set() && !path.is_empty() {
        all.insert(path.to_owned());
    }
    all
}

/// A run directory that user nobody must not use, and what is wrong with it.
fn others(home: &Path) -> [(std::path::PathBuf, &'static str); 3] {
    let place = |name: &str| {
        let runtime = home.join(name);
        fs::create_dir(&runtime).unwrap();
        (runtime.join("rtnet"), runtime)
    };
    let [(of_root, first), (open, second), (link, third)] = ["root", "open", "link"].map(place);
    fs::create_dir(&of_root).unwrap();
    fs::set_permissions(&of_root, Permissions::from_mode(0o755)).unwrap();
    fs::create_dir(&open).unwrap();
    chown(&open, Some(NOBODY), Some(NOBODY)).unwrap();
    fs::set_permissions(&open, Permissions::from_mode(0o770)).unwrap();
    symlink("nowhere", &link).unwrap();
    [(first, "belongs to user 0"), (second, "can be written by others"), (third, "is a symbolic link")]
}

#[test]
fn all_verbs_refuse_a_run_directory_of_others() {
    let test = "all_verbs_refuse_a_run_directory_of_others";
    if !is_root(test) {
        return;
    }
    let with = || WITH.iter().chain(&MORE);
    let known = with().map(|(verb, _)| *verb).chain(WITHOUT).map(str::to_owned).collect::<BTreeSet<_>>();
    assert_eq!(verbs(&Cli::command(), ""), known, "a new verb belongs to one of the tables");
    let home = tempfile::tempdir().unwrap();
    fs::set_permissions(home.path(), Permissions::from_mode(0o755)).unwrap();
    let binary = home.path().join("rtnet");
    copy_program(env!("CARGO_BIN_EXE_rtnet"), &binary);
    for (runtime, why) in others(home.path()) {
        for (verb, arguments) in with() {
            let mut command = Command::new(&binary);
            command.args(verb.split(' ')).args(arguments.split_whitespace());
            command.env("XDG_RUNTIME_DIR", &runtime).current_dir("/").uid(NOBODY).gid(NOBODY);
            let output = command.output().unwrap();
            let said = text(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{verb}: {said}");
            assert!(said.contains(why) && said.contains("XDG_RUNTIME_DIR"), "{verb}: {said}");
        }
    }
}
