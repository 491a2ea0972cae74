//! The stations' processes.

use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Sender, channel};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::sched::{CloneFlags, setns};

use super::namespace::Namespace;
use crate::remedy::explained;
use crate::station::link::{Order, Report};

/// How long a station may take to end when it is told to. The kernel closes its packet sockets one by one, each after an RCU
/// grace period: 13 s in all were measured where real-time threads and others shared two busy cores.
pub const END_WITHIN: Duration = Duration::from_secs(30);

/// This very program, even where another one was put in the place of its file meanwhile.
pub fn this_program() -> Command {
    let mut command = Command::new("/proc/self/exe");
    command.arg0("rtnet");
    command
}

/// A running station; dropping it ends it.
pub struct Process {
    child: Child,
    cpu_at_begin: Option<f64>,
}

/// A station's line, or its end.
pub type Told = (usize, Option<Report>);

impl Process {
    /// Starts a station in a namespace; what it tells goes to `told`, a last `None` at its end.
    ///
    /// Its parent is the thread that listens to it: the kernel takes a thread for the parent whose end kills a station.
    pub fn start(
        namespace: &Namespace,
        station: usize,
        arguments: &[String],
        told: Sender<Told>,
    ) -> Result<Self> {
        let mut command = this_program();
        command.arg("station").args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).current_dir("/");
        let namespace = namespace.fd().try_clone_to_owned().context("no descriptor for a namespace")?;
        let (born, birth) = channel();
        let listener = std::thread::Builder::new().name("listener".into()).spawn(move || {
            match bear(&namespace, command) {
                Ok((child, output)) => {
                    drop(namespace);
                    // The thread that started it waits for it.
                    let _ = born.send(Ok(child));
                    listen(output, station, &told);
                }
                Err(error) => drop(born.send(Err(error))),
            }
        });
        listener.map_err(explained).context("a thread that listens to a station cannot start")?;
        let child = birth.recv().context("the thread that starts a station has ended")??;
        // A station that is stopped reads no orders, and its lab goes on.
        let input = child.stdin.as_ref().context("a station without input")?;
        fcntl(input, FcntlArg::F_SETFL(OFlag::O_NONBLOCK))?;
        Ok(Self { child, cpu_at_begin: None })
    }

    /// Its number.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Processor time is counted from here.
    pub fn begin(&mut self) {
        self.cpu_at_begin = self.cpu_seconds();
    }

    /// Processor time since [`Process::begin`], seconds.
    pub fn cpu_used(&self) -> Option<f64> {
        Some(self.cpu_seconds()? - self.cpu_at_begin?)
    }

    /// Resident memory, bytes.
    pub fn resident(&self) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.pid())).ok()?;
        let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
        line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib * 1024)
    }

    /// Whether somebody has stopped it (SIGSTOP).
    pub fn is_stopped(&self) -> bool {
        self.stat().is_some_and(|stat| stat.starts_with('T'))
    }

    /// Whether it is ending, or has: the kernel takes 50 to 100 ms to close what a station had open, and only then tells.
    pub fn is_ending(&self) -> bool {
        const EXITING: u32 = 4;
        let flags = |stat: String| stat.split_whitespace().nth(6)?.parse::<u32>().ok();
        self.stat()
            .is_none_or(|stat| stat.starts_with(['Z', 'X']) || flags(stat).is_none_or(|of| of & EXITING != 0))
    }

    /// What /proc tells of it, from its state on.
    fn stat(&self) -> Option<String> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.pid())).ok()?;
        // The name in parentheses may hold anything.
        stat.rsplit_once(") ").map(|(_, state)| state.to_owned())
    }

    /// Ends it at once. Fails only if it has ended.
    pub fn kill(&mut self) {
        let _ = self.child.kill();
    }

    /// What became of it within so long; an error if that is not what ought to.
    pub fn outcome(&mut self, within: Duration) -> Result<(), String> {
        let deadline = Instant::now() + within;
        loop {
            match self.child.try_wait() {
                Ok(Some(status)) if status.success() => return Ok(()),
                Ok(Some(status)) => {
                    return Err(format!("it ended badly ({status}): its own message is above"));
                }
                Err(error) => return Err(format!("nobody knows how it ended: {error}")),
                Ok(None) if Instant::now() < deadline => std::thread::sleep(Duration::from_millis(5)),
                Ok(None) => break,
            }
        }
        let threads = self.threads();
        self.kill();
        Err(format!("it did not end in time, and was killed; its threads: {threads}"))
    }

    /// Its threads, each with the function of the kernel that it waits in; 0: it runs, or that is not known.
    fn threads(&self) -> String {
        let threads = std::fs::read_dir(format!("/proc/{}/task", self.pid())).into_iter().flatten().flatten();
        let shown = threads.map(|thread| {
            let [name, waits_in] = ["comm", "wchan"].map(|file| {
                // It may end meanwhile.
                std::fs::read_to_string(thread.path().join(file)).unwrap_or_default()
            });
            format!("{} in {}", name.trim_end(), waits_in)
        });
        shown.collect::<Vec<_>>().join(", ")
    }

    /// Tells it what is to happen to it; whether there was room for that. Who has ended is told nothing.
    pub fn order(&mut self, order: Order) -> bool {
        let (Some(input), Ok(line)) = (&mut self.child.stdin, serde_json::to_string(&order)) else {
            return true;
        };
        // A pipe takes a line as a whole, or nothing of it.
        let told = input.write_all(format!("{line}\n").as_bytes());
        !matches!(told, Err(error) if error.kind() == ErrorKind::WouldBlock)
    }

    /// Tells it to end, without waiting.
    pub fn tell_to_end(&mut self) {
        self.child.stdin = None;
    }

    fn cpu_seconds(&self) -> Option<f64> {
        let stat = self.stat()?;
        let numbers: Vec<&str> = stat.split_whitespace().collect();
        let ticks = numbers.get(11)?.parse::<f64>().ok()? + numbers.get(12)?.parse::<f64>().ok()?;
        let per_second = nix::unistd::sysconf(nix::unistd::SysconfVar::CLK_TCK).ok()??;
        Some(ticks / per_second as f64)
    }
}

/// Enters a namespace and starts a process there.
fn bear(namespace: &OwnedFd, mut command: Command) -> Result<(Child, ChildStdout)> {
    setns(namespace, CloneFlags::CLONE_NEWNET).context("a station's namespace cannot be entered")?;
    let child = command.spawn().map_err(explained);
    let mut child = child.context("a station cannot be started")?;
    let output = child.stdout.take().context("a station without output")?;
    Ok((child, output))
}

/// Passes on what a station tells, until it ends.
fn listen(output: ChildStdout, station: usize, told: &Sender<Told>) {
    let mut output = BufReader::new(output);
    for line in output.by_ref().lines().map_while(Result::ok) {
        let report = serde_json::from_str(&line)
            .unwrap_or_else(|error| Report::Failed(format!("it told nonsense: {error}: {line}")));
        // The lab may have ended, and listens no more. Its stations end in their own time.
        let _ = told.send((station, Some(report)));
    }
    // Whatever else it writes: it lives as long as this thread.
    let _ = std::io::copy(&mut output, &mut std::io::sink());
    let _ = told.send((station, None));
}

impl Drop for Process {
    fn drop(&mut self) {
        self.tell_to_end();
        let deadline = Instant::now() + END_WITHIN;
        while Instant::now() < deadline {
            if !matches!(self.child.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        // It was told and did not: it is ours to end. Neither can fail in a way that matters here.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
