//! What comes beside the command: manual pages, completions, and the unit for systemd.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use clap::CommandFactory;
use tools::cli::Cli;

use crate::host::{figure, skip};
use crate::rtnet;

/// `rtnet`, `rtnet-lab`, `rtnet-lab-run` and so on, each with the verbs it has.
fn commands(of: &clap::Command, name: &str) -> Vec<(String, Vec<String>)> {
    let verbs: Vec<_> = of.get_subcommands().filter(|verb| verb.get_name() != "help").collect();
    let names = verbs.iter().map(|verb| verb.get_name().to_owned()).collect();
    let below = verbs.iter().flat_map(|verb| commands(verb, &format!("{name}-{}", verb.get_name())));
    [(name.to_owned(), names)].into_iter().chain(below).collect()
}

fn output(arguments: &[&str]) -> String {
    let output = rtnet().args(arguments).output().unwrap();
    assert_eq!((output.status.code(), &output.stderr[..]), (Some(0), &b""[..]), "{arguments:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// What a program says of a text at its standard input; none if there is no such program.
fn judged(program: &str, arguments: &[&str], text: &str) -> Option<Output> {
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().ok()?;
    // One that gives up early says why.
    let _ = child.stdin.take().unwrap().write_all(text.as_bytes());
    Some(child.wait_with_output().unwrap())
}

#[track_caller]
fn assert_accepted(what: &str, output: &Output) {
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.is_empty(), "{what}: {said}");
}

#[test]
fn completions_are_there_for_every_verb_and_a_shell_reads_them() {
    let name = "completions_are_there_for_every_verb_and_a_shell_reads_them";
    for shell in ["bash", "zsh", "fish"] {
        let text = output(&["completions", shell]);
        for (command, verbs) in commands(&Cli::command(), "rtnet") {
            let missing: Vec<_> = verbs.iter().filter(|verb| !text.contains(*verb)).collect();
            assert!(missing.is_empty(), "{shell}: {command} {missing:?}");
        }
        for option in ["slot-guard", "sync-window", "warm-core"] {
            assert!(text.contains(option), "{shell}: --{option}");
        }
        match judged(shell, &["-n"], &text) {
            Some(read) => assert_accepted(shell, &read),
            None => figure(name, &format!("no {shell} here to read what was written for it")),
        }
    }
}

#[test]
fn every_command_has_a_manual_page_that_names_its_verbs() {
    let name = "every_command_has_a_manual_page_that_names_its_verbs";
    let dir = tempfile::tempdir().unwrap();
    let pages = dir.path().join("made/if/it/is/not/there");
    assert_eq!(output(&["man", pages.to_str().unwrap()]), "");
    let mut expected = Vec::new();
    for (command, verbs) in commands(&Cli::command(), "rtnet") {
        let page = fs::read_to_string(pages.join(format!("{command}.1"))).unwrap();
        // Two lines before it see to the apostrophe.
        let title = page.lines().find(|line| !line.contains(".ds Aq")).unwrap();
        assert!(title.starts_with(&format!(".TH {command} 1 ")), "{command}: {title}");
        for section in [".SH NAME", ".SH SYNOPSIS", ".SH DESCRIPTION", ".SH OPTIONS"] {
            assert!(page.lines().any(|line| line == section), "{command}: {section}");
        }
        // In a manual page a hyphen is one that may end a line, a minus sign is `\-`.
        let text = page.replace("\\-", "-");
        for verb in verbs {
            assert!(text.contains(&format!("{command}-{verb}(1)")), "{command}: {verb}");
        }
        assert!(!text.contains("--probe-user-namespace"), "what is hidden stays so");
        match judged("groff", &["-man", "-Tutf8", "-ww", "-z"], &page) {
            Some(read) => assert_accepted(&command, &read),
            None => figure(name, "no groff here to read them"),
        }
        expected.push(format!("{command}.1"));
    }
    let written = fs::read_dir(&pages).unwrap().map(|file| file.unwrap().file_name().into_string().unwrap());
    let mut written: Vec<_> = written.collect();
    written.sort();
    expected.sort();
    assert_eq!(written, expected, "and there are no others");
    figure(name, &format!("{} pages", written.len()));
}

#[test]
fn a_manual_that_cannot_be_written_is_one_line() {
    let output = rtnet().args(["man", "/proc/nowhere"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), said.lines().count()), (Some(2), 1), "{said}");
    assert!(said.contains("/proc/nowhere cannot be made"), "{said}");
}

#[test]
fn the_unit_for_systemd_is_one_and_calls_the_command_as_it_is() {
    let name = "the_unit_for_systemd_is_one_and_calls_the_command_as_it_is";
    let unit = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/rtnet-station@.service");
    let unit = fs::read_to_string(unit).unwrap();
    let line = |key: &str| unit.lines().find_map(|line| line.strip_prefix(key));
    let command = line("ExecStart=/usr/bin/").unwrap().replace("%I", "eth0");
    let options = unit.lines().find_map(|line| line.trim_start_matches(['#', ' ']).strip_prefix("OPTIONS="));
    let command = command.replace("$OPTIONS", options.unwrap());
    Cli::command().try_get_matches_from(command.split(' ')).unwrap();
    assert_eq!(
        line("RestartPreventExitStatus="),
        Some("2"),
        "what `rtnet station` ends with if it is misused"
    );

    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("rtnet-station@eth0.service");
    fs::write(&copy, unit.replace("/usr/bin/rtnet", env!("CARGO_BIN_EXE_rtnet"))).unwrap();
    let mut verify = Command::new("systemd-analyze");
    verify.args(["verify", "--man=no"]).arg(&copy);
    let Ok(output) = verify.output() else { return skip(name, "no systemd-analyze to verify it with") };
    let said = String::from_utf8(output.stderr).unwrap();
    let of_ours: Vec<_> = said.lines().filter(|line| line.contains("rtnet")).collect();
    assert!(output.status.success() && of_ours.is_empty(), "{said}");
}
