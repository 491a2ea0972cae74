//! Programs in C and Python, which tests start.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};

use nix::unistd::Pid;

use super::clients;
use crate::cell::text;
use crate::host::skip;

/// A program of a test; killed when dropped.
pub struct Program {
    child: Child,
    says: BufReader<ChildStdout>,
}

impl Program {
    /// Starts it. Its standard input is open until [`Self::end_input`].
    pub fn start(command: &mut Command) -> Self {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let says = BufReader::new(child.stdout.take().unwrap());
        Self { child, says }
    }

    /// Waits for the next line of its standard output.
    pub fn line(&mut self) -> String {
        let mut line = String::new();
        self.says.read_line(&mut line).unwrap();
        line.trim_end().to_owned()
    }

    /// Its process.
    pub fn pid(&self) -> Pid {
        Pid::from_raw(self.child.id() as i32)
    }

    /// Ends its standard input.
    pub fn end_input(&mut self) {
        self.child.stdin = None;
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // Gone already where a test has ended it.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A program in Python of this directory, and that of the client that it uses, if there is Python.
pub fn in_python(test: &str, program: &str) -> Option<(PathBuf, PathBuf)> {
    if Command::new("python3").arg("--version").output().is_err() {
        skip(test, "needs python3: Debian package python3");
        return None;
    }
    Some((clients().join("../../tests/cli/router").join(program), clients()))
}

/// A program in C of this directory, built into `dir`, if there is a compiler, and the library has been built.
pub fn in_c(test: &str, program: &str, dir: &Path) -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let library = std::env::current_exe().unwrap().with_file_name("librtnet_packages.a");
    if !library.exists() {
        skip(test, "needs librtnet_packages.a: run `cargo test --workspace`, which builds it");
        return None;
    }
    let built = dir.join(program).with_extension("");
    let compiled = Command::new("cc")
        .args(["-Wall", "-Wextra", "-Werror", "-std=c11", "-o"])
        .arg(&built)
        .arg("-I")
        .arg(root.join("package-router/c/include"))
        .arg(root.join("tests/cli/router").join(program))
        .arg(library)
        .args(["-lpthread", "-ldl", "-lm"])
        .output();
    match compiled {
        Ok(output) => assert!(output.status.success(), "{}", text(&output.stderr)),
        Err(_) => {
            skip(test, "needs a C compiler: Debian package gcc");
            return None;
        }
    }
    Some(built)
}
