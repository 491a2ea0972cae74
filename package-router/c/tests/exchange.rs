//! What the header says is what the library does: a component in C beside one in Rust. Without a C compiler it is skipped, and says so.

// Components need real time.
#![allow(clippy::disallowed_methods)]

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use package_router::broker::Broker;
use package_router::component::Component;
use package_router::mailbox::Shape;
use package_router::name::{Class, MailboxName};
use package_router::wire::{Head, OK};

const PATIENCE: Duration = Duration::from_secs(20);
const ECHO: MailboxName = MailboxName::new(0, Class(0x80), 0, 0);
const QUIT: i8 = 22;

fn folder() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Whether there is such a compiler; else it is said that this was not tested.
fn has(compiler: &str) -> bool {
    match Command::new(compiler).arg("--version").output() {
        Err(error) if error.kind() == ErrorKind::NotFound => {
            println!("SKIP the C face is not tested: there is no {compiler}");
            false
        }
        _ => true,
    }
}

fn run(command: &mut Command) -> String {
    let told = command.output().unwrap();
    let [out, error] = [&told.stdout, &told.stderr].map(|text| String::from_utf8_lossy(text).into_owned());
    assert!(told.status.success(), "{command:?}: {}\n{out}{error}", told.status);
    out
}

/// Where cargo has built the library, beside this test.
fn built() -> PathBuf {
    std::env::current_exe().unwrap().parent().unwrap().to_owned()
}

/// A station, and a component that answers what it is sent, in the same order of bytes, until it is told to end.
fn with_an_echo(what: impl FnOnce(&Path)) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("station.packages");
    let mut broker = Broker::bind(&path).unwrap();
    let is_over = AtomicBool::new(false);
    let component_path = path.clone();
    thread::scope(|scope| {
        scope.spawn(|| {
            let deadline = Instant::now() + 3 * PATIENCE;
            while !is_over.load(Ordering::Relaxed) && Instant::now() < deadline {
                broker.serve(Duration::from_millis(20));
            }
            drop(broker);
        });
        let (ready, is_ready) = std::sync::mpsc::channel();
        let is_over = &is_over;
        scope.spawn(move || {
            let component = Component::attach(&component_path).unwrap();
            let mut mailbox = component.mailbox(ECHO, Shape::new(4, 64)).unwrap();
            ready.send(()).unwrap();
            let (mut back, mut room) = (None, [0; 64]);
            while let Ok((command, len)) = mailbox.receive_into(&mut room, Some(PATIENCE)) {
                if command.kind == QUIT {
                    break;
                }
                let back = back.get_or_insert_with(|| mailbox.sender(command.from).unwrap());
                let reply = Head { body_order: command.body_order, ..command.answer(OK) };
                back.send_with(&reply, &room[..len]).unwrap();
            }
            is_over.store(true, Ordering::Relaxed);
        });
        is_ready.recv().unwrap();
        what(&path);
        is_over.store(true, Ordering::Relaxed);
    });
}

fn compile(with: &[&str], to: &Path) {
    let mut cc = Command::new("cc");
    cc.args(["-Wall", "-Wextra", "-Werror", "-std=c11", "-D_POSIX_C_SOURCE=200809L", "-o"]).arg(to);
    cc.arg("-I").arg(folder().join("include")).arg(folder().join("tests/exchange.c"));
    run(cc.args(with));
}

#[test]
fn a_component_in_c_exchanges_packages_with_one_in_rust() {
    if !has("cc") {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (shared, whole) = (dir.path().join("shared"), dir.path().join("static"));
    let built = built().into_os_string().into_string().unwrap();
    let rpath = format!("-Wl,-rpath,{built}");
    compile(&["-L", &built, "-lrtnet_packages", &rpath], &shared);
    // And what the standard library of Rust asks for.
    let archive = format!("{built}/librtnet_packages.a");
    compile(&[&archive, "-lpthread", "-ldl", "-lm"], &whole);
    for program in [shared, whole] {
        // Not the library that an earlier build may have left in the directory above, where cargo looks first.
        let mut program = Command::new(&program);
        program.env("LD_LIBRARY_PATH", &built);
        with_an_echo(|path| assert_eq!(run(program.arg(path)), "done\n"));
    }
}

#[test]
fn the_header_is_c_and_cpp_and_stands_by_itself() {
    let languages = [("cc", "c", "-std=c11"), ("cc", "c", "-std=c99"), ("c++", "c++", "-std=c++11")];
    for (compiler, language, standard) in languages.into_iter().filter(|(compiler, ..)| has(compiler)) {
        let mut check = Command::new(compiler);
        check.args(["-Wall", "-Wextra", "-Werror", "-pedantic", standard, "-fsyntax-only", "-x", language]);
        run(check.arg(folder().join("include/rtnet_packages.h")));
    }
}

/// Each function of the header is one of the library, and the other way round.
#[test]
fn header_and_library_name_the_same_functions() {
    let read = |file: &str| std::fs::read_to_string(folder().join(file)).unwrap();
    let names = |text: &str, before: &str| {
        let lines = text.lines().filter(|line| line.starts_with(before) && line.contains('('));
        let name = |line: &str| {
            let declared = line.split('(').next().unwrap_or_default();
            declared.rsplit([' ', '*']).next().unwrap_or_default().to_owned()
        };
        let mut names: Vec<_> = lines.map(name).filter(|name| name.starts_with("rtnet_")).collect();
        names.sort_unstable();
        names
    };
    let header = read("include/rtnet_packages.h");
    let mut declared: Vec<_> =
        ["int32_t rtnet_", "void rtnet_", "const char *"].iter().flat_map(|of| names(&header, of)).collect();
    declared.sort_unstable();
    let files = std::fs::read_dir(folder().join("src")).unwrap();
    let source: String = files.map(|file| std::fs::read_to_string(file.unwrap().path()).unwrap()).collect();
    let defined = names(&source.replace("pub unsafe extern", "pub extern"), "pub extern \"C\" fn");
    assert_eq!(declared, defined);
    assert_eq!(declared.len(), 20);
}
