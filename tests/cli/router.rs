//! The TCP router as its clients meet it, in Python among others.

mod crowd;
mod killed;
mod languages;
mod links;
mod meet;
mod python_package;
mod restarts;
mod running;
mod tls;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use package_router::name::MailboxName;
use package_router::wire::{HEAD_LEN, Head, OK};
use serde_json::Value;
use tempfile::TempDir;

use crate::cell::{json, text, wait_until};
use crate::host::{skip, unique};
use crate::rights::assert_gives_up_all;
use crate::rtnet;
pub use running::{Router, forget, has_joined};

/// Sets a flag when dropped, also by a panic: threads of a scope that look at it end, and the scope with them.
struct AtEnd<'a>(&'a AtomicBool);

impl Drop for AtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

fn package(kind: i8, to: u32, from: u32, body: &[u8]) -> Vec<u8> {
    let head = Head::new(kind, MailboxName(to), MailboxName(from)).with_body(body.len()).unwrap();
    [&head.to_bytes()[..], body].concat()
}

fn read(from: &mut TcpStream) -> (Head, Vec<u8>) {
    let mut head = [0; HEAD_LEN];
    from.read_exact(&mut head).unwrap();
    let head = Head::parse(&head).unwrap();
    let mut body = vec![0; head.body_len()];
    from.read_exact(&mut body).unwrap();
    (head, body)
}

fn register(stream: &mut TcpStream, name: u32) {
    stream.write_all(&package(13, 0, 0, &name.to_le_bytes())).unwrap();
    assert_eq!(read(stream).0.kind, OK);
}

/// The message of a router that does not start. Its name is its own: another router may run on this host.
fn not_started(arguments: &[&str]) -> String {
    let name = unique("refused");
    let named = if arguments.contains(&"--name") { vec![] } else { vec!["--name", &name] };
    // A router that starts ends, and fails the test.
    let mut command = Command::new("timeout");
    command.args(["20", env!("CARGO_BIN_EXE_rtnet"), "router"]);
    refusal(&command.args(named).args(arguments).output().unwrap())
}

fn refusal(output: &Output) -> String {
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    message
}

#[test]
fn a_router_shows_its_clients_and_why_others_are_gone() {
    let router = Router::start("seen", &[]);
    let (mut pilot, mut chassis) = (router.connect(), router.connect());
    register(&mut pilot, 0x0018_0000);
    register(&mut chassis, 0x0011_0000);
    pilot.write_all(&package(21, 0x0011_0000, 0x0018_0000, b"forward")).unwrap();
    assert_eq!(read(&mut chassis).1, b"forward");
    pilot.write_all(&package(-6, 0x0099_0000, 0x0018_0000, b"to nobody")).unwrap();
    let mut broken = router.connect();
    broken.write_all(&[0xff; HEAD_LEN]).unwrap();
    assert_eq!(broken.read(&mut [0]).unwrap(), 0);
    wait_until("it is counted", || router.status()["counters"]["nobody_there"] == 1);

    let status = router.status();
    assert_eq!(
        (&status["connections"], &status["names"], &status["waiting"]),
        (&2.into(), &2.into(), &0.into())
    );
    let why = status["closed"][0]["why"].as_str().unwrap();
    assert!(why.starts_with("a package of 4294967295 bytes"), "{why}");
    let shown = text(&rtnet().args(["router", "status", &router.name]).output().unwrap().stdout);
    for words in [
        "2 connections, 2 mailboxes, 0 packages waiting",
        "Pilot(0/0)",
        "Chassis(0/0)",
        "nobody there 1",
        why,
    ] {
        assert!(shown.contains(words), "{words}: {shown}");
    }
    let owners = |pattern: &str| {
        let status = ["router", "status", &router.name, "--mailbox", pattern, "--json"];
        let clients = json(rtnet().args(status))["clients"].clone();
        let names = |client: &Value| client["mailboxes"].to_string();
        clients.as_array().unwrap().iter().map(names).collect::<Vec<_>>()
    };
    assert_eq!((owners("0.Pilot.*"), owners("0.GPS.*")), (vec![r#"["Pilot(0/0)"]"#.to_owned()], vec![]));
    let said = |pattern: &str| {
        let status = ["router", "status", &router.name, "--mailbox", pattern];
        text(&rtnet().args(status).output().unwrap().stdout)
    };
    let (pilots, none) = (said("0.Pilot.*"), said("0.GPS.*"));
    assert!(
        pilots.contains("Pilot(0/0)") && !pilots.contains("Chassis") && !pilots.contains(" more"),
        "{pilots}"
    );
    assert!(none.contains("\nno connection has such a mailbox\n"), "{none}");
    drop(chassis);
    wait_until("its client is gone", || router.clients() == 1);
    pilot.write_all(&package(21, 0x0011_0000, 0x0018_0000, &[])).unwrap();
    assert_eq!(read(&mut pilot).0.kind, package_router::wire::NOT_AVAILABLE);
}

#[test]
fn a_router_ends_when_it_is_told_to_and_its_port_is_free() {
    let mut router = Router::start("ended", &[]);
    let mut client = router.connect();
    register(&mut client, 1);
    kill(Pid::from_raw(router.child.id() as i32), Signal::SIGTERM).unwrap();
    assert_eq!(router.child.wait().unwrap().code(), Some(0));
    assert_eq!(client.read(&mut [0]).unwrap_or(0), 0);
    let again = Router::start("ended", &["--listen", &router.at.to_string()]);
    register(&mut again.connect(), 1);
}

#[test]
fn a_router_listens_for_other_hosts_only_if_that_is_said() {
    let message = not_started(&["--listen", "0.0.0.0:0"]);
    assert!(message.contains("other hosts reach 0.0.0.0:0") && message.contains("--insecure"), "{message}");
    let router = Router::start("open", &["--listen", "0.0.0.0:0", "--insecure"]);
    assert!(router.at.ip().is_unspecified());
}

#[test]
fn what_keeps_a_router_from_its_start_is_named() {
    let router = Router::start("first", &[]);
    let run = not_started;
    let at = router.at.to_string();
    let taken = run(&["--listen", &at, "--name", &unique("second")]);
    assert!(taken.contains(&at) && taken.contains("choose another --listen"), "{taken}");
    let named = run(&["--listen", "127.0.0.1:0", "--name", &router.name]);
    assert!(named.contains("is taken by process"), "{named}");
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("router.toml");
    std::fs::write(&file, "[limits]\nqueue = 5\n").unwrap();
    let wrong = run(&[file.to_str().unwrap()]);
    assert!(wrong.contains("router.toml:2:9: 5 is too few: make it 262144 or more"), "{wrong}");
    let missing = run(&["--listen", "127.0.0.1:0", "/nowhere/router.toml"]);
    assert!(missing.contains("/nowhere/router.toml cannot be read: No such file"), "{missing}");
    let no_address = run(&["--listen", "localhost:2000"]);
    assert!(no_address.contains("write one, as 127.0.0.1:2000"), "{no_address}");
    // It is no station.
    let which = refusal(&rtnet().args(["package", "route"]).output().unwrap());
    assert!(which.contains("-S [LAB/]STATION") && !which.contains(&router.name), "{which}");
    let nobody = refusal(&rtnet().args(["router", "status", "no-such-router"]).output().unwrap());
    assert!(nobody.contains("there is no router 'no-such-router'"), "{nobody}");
}

#[test]
fn a_router_is_as_its_file_says() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("router.toml");
    std::fs::write(&file, "[[listen]]\naddress = \"127.0.0.1:0\"\n[limits]\nconnections = 1\n").unwrap();
    let router = Router::start("file", &[file.to_str().unwrap()]);
    register(&mut router.connect(), 1);
    wait_until("it is gone", || router.status()["closed"].as_array().unwrap().len() == 1);
    let mut first = router.connect();
    register(&mut first, 1);
    let mut second = router.connect();
    assert_eq!(second.read(&mut [0]).unwrap_or(0), 0, "one connection is the limit");
    assert_eq!(router.status()["counters"]["connections_refused"], 1);
}

#[test]
fn a_router_keeps_its_rules_if_the_new_file_is_wrong() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("router.toml");
    let write = |names: &str| {
        std::fs::write(
            &file,
            format!("[[listen]]\naddress = \"127.0.0.1:0\"\n[[register]]\nnames = [{names}]\n"),
        )
        .unwrap();
    };
    write("\"0.Pilot.*\"");
    let router = Router::start("rules", &[file.to_str().unwrap()]);
    let mut client = router.connect();
    let mut registers = |name: u32| {
        client.write_all(&package(13, 0, 0, &name.to_le_bytes())).unwrap();
        read(&mut client).0.kind == OK
    };
    assert!(registers(0x0018_0000) && !registers(0x0011_0000));
    let hup = || kill(Pid::from_raw(router.child.id() as i32), Signal::SIGHUP).unwrap();
    write("\"0.Nobody.*\"");
    hup();
    router.wait_for("the rules stay as they were: ");
    assert!(registers(0x0018_0100) && !registers(0x0011_0000));
    let status = router.status();
    assert_eq!(status["counters"]["rules_refused"], 1);
    assert!(status["rules_error"].as_str().unwrap().contains("0.Nobody.*"), "{status:#}");
    write("\"0.Chassis.*\"");
    hup();
    router.wait_for("the rules were read again");
    // Orders are carried out in turn: the new rules hold once this is answered.
    router.status();
    assert!(registers(0x0011_0000) && !registers(0x0018_0200));
    let status = router.status();
    assert_eq!(status["names"], 3, "nobody was dropped");
    assert!(status.get("rules_error").is_none() && status["counters"]["rules_refused"] == 1);
}

#[test]
fn a_router_has_figures_for_prometheus() {
    let router = Router::start("figures", &["--listen", "127.0.0.1:0", "--metrics", "127.0.0.1:0"]);
    let mut registered = router.connect();
    register(&mut registered, 1);
    let mut client = TcpStream::connect(router.figures.unwrap()).unwrap();
    client.write_all(b"GET /metrics HTTP/1.1\r\n\r\n").unwrap();
    let mut answer = String::new();
    client.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 200 OK") && answer.contains("\nrtnet_mailboxes 1\n"), "{answer}");
    let refused = not_started(&["--listen", "127.0.0.1:0", "--metrics", "0.0.0.0:0"]);
    assert!(
        refused.contains("other hosts reach 0.0.0.0:0") && refused.contains("a reverse proxy"),
        "{refused}"
    );
}

#[test]
fn a_router_that_runs_may_nothing_that_it_does_not_need() {
    let router = Router::start("rights", &[]);
    register(&mut router.connect(), 1);
    assert_gives_up_all(router.child.id());
    let status = std::fs::read_to_string(format!("/proc/{}/status", router.child.id())).unwrap();
    assert!(status.contains("NoNewPrivs:\t1"), "{status}");
}

/// It polls while packages follow each other closely, and sleeps afterwards.
#[test]
fn a_router_without_packages_takes_no_processor_time() {
    let router = Router::start("sleeps", &[]);
    let mut client = router.connect();
    register(&mut client, 1);
    for _ in 0..1_000 {
        client.write_all(&package(21, 1, 1, b"to itself")).unwrap();
        read(&mut client);
    }
    // Milliseconds of all its threads.
    let taken = || -> u64 {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", router.child.id())).unwrap();
        let of = |task: std::io::Result<std::fs::DirEntry>| {
            let nanoseconds = std::fs::read_to_string(task.unwrap().path().join("schedstat")).unwrap();
            nanoseconds.split(' ').next().unwrap().parse::<u64>().unwrap()
        };
        tasks.map(of).sum::<u64>() / 1_000_000
    };
    let before = taken();
    thread::sleep(Duration::from_secs(1));
    let taken = taken() - before;
    assert!(taken < 100, "{taken} ms of a second");
}

/// A file elsewhere is out of its reach, for root, too.
#[test]
fn a_router_reads_no_file_but_those_of_its_directory() {
    let test = "a_router_reads_no_file_but_those_of_its_directory";
    let [dir, elsewhere] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let (file, other) = (dir.path().join("router.toml"), elsewhere.path().join("router.toml"));
    [&file, &other].iter().for_each(|file| std::fs::write(file, "").unwrap());
    let router = Router::start("confined", &[file.to_str().unwrap(), "--listen", "127.0.0.1:0"]);
    if !router.is_confined {
        return skip(test, "needs a kernel with landlock (Linux 6.10)");
    }
    let again = || kill(Pid::from_raw(router.child.id() as i32), Signal::SIGHUP).unwrap();
    std::fs::write(dir.path().join("new"), "[limits]").unwrap();
    std::fs::rename(dir.path().join("new"), &file).unwrap();
    again();
    router.wait_for("the rules were read again");
    std::fs::remove_file(&file).unwrap();
    std::os::unix::fs::symlink(&other, &file).unwrap();
    again();
    router.wait_for("cannot be read: Permission denied");
}

fn clients() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../clients/python")
}

/// A directory with a copy of the Python client, `python`, so that nothing is left in this checkout.
fn copy_of_client() -> TempDir {
    let place = tempfile::tempdir().unwrap();
    let copied = Command::new("cp").arg("-r").arg(clients()).arg(place.path()).status().unwrap();
    assert!(copied.success());
    place
}

/// Runs a program of Python's in a copy of its client.
fn python(test: &str, program: &str, arguments: &[&str], package: &str) {
    // `python3.9` of pyenv runs that version only if it is chosen.
    let version = program.strip_prefix("python").filter(|version| !["", "3"].contains(version));
    let chosen = version.map(|version| ("PYENV_VERSION", version));
    let version = Command::new(program).arg("--version").envs(chosen).output();
    if !version.is_ok_and(|output| output.status.success()) {
        return skip(test, &format!("needs {program}: {package}"));
    }
    let place = copy_of_client();
    // The labs of other tests go first. A client that hangs ends, and fails.
    let mut command = Command::new("nice");
    command.args(["-n", "19", "timeout", "300", program]);
    command
        .args(arguments)
        .current_dir(place.path().join("python"))
        .env("RTNET_BIN", env!("CARGO_BIN_EXE_rtnet"));
    let output = command.env("PYTHONWARNINGS", "error").envs(chosen).output().unwrap();
    assert!(output.status.success(), "{}{}", text(&output.stdout), text(&output.stderr));
}

/// All tests of the Python client.
const OF_CLIENT: [&str; 7] = ["-m", "unittest", "discover", "-t", ".", "-s", "tests"];

#[test]
fn python_clients_join_a_router_and_come_back() {
    python("python_clients_join_a_router_and_come_back", "python3", &OF_CLIENT, "Debian package python3");
}

#[test]
fn oldest_python_joins_a_router() {
    python("oldest_python_joins_a_router", "python3.9", &OF_CLIENT, "pyenv install 3.9");
}

#[test]
fn python_client_is_typed() {
    python("python_client_is_typed", "mypy", &["--strict"], "Debian package mypy");
}
