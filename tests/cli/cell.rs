//! A lab of `cell.toml`, for tests of labs that stay.

use std::io::Read;
use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use serde_json::Value;
use socket2::{Domain, SockAddr, Socket, Type};

use crate::host::{is_sound, unique};
use crate::{rtnet, schema};

/// Its stations.
pub const STATIONS: [&str; 4] = ["master", "slave1", "slave2", "slave3"];

/// The lab; taken down, at the latest, when dropped.
pub struct Cell {
    pub name: String,
}

impl Cell {
    /// As the file has it, with a cycle of 4 ms.
    pub fn up(what: &str) -> Self {
        Self::with(what, |text| text)
    }

    /// With the file changed. How many slots are missed, of stations that are stopped and killed, decides nothing.
    pub fn with(what: &str, change: impl FnOnce(String) -> String) -> Self {
        Self::named(unique(what), change)
    }

    /// The same under this name.
    pub fn named(name: String, change: impl FnOnce(String) -> String) -> Self {
        let cell = Self { name };
        let original = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli/cell.toml");
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("cell.toml");
        let changed = change(std::fs::read_to_string(original).unwrap());
        std::fs::write(&file, format!("max_miss = \"100%\"\n{changed}")).unwrap();
        let mut command = rtnet();
        command.args(["lab", "up", "--name", &cell.name]).arg(file).env("RTNET_STOP_BEFORE_SEND", "SIGUSR1");
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert!(text(&output.stdout).contains(" stations, cycle "), "{}", text(&output.stdout));
        cell
    }

    pub fn place(&self, station: &str) -> String {
        format!("{}/{station}", self.name)
    }

    pub fn slot(&self, station: &str, arguments: &[&str]) -> Output {
        rtnet().args(["slot", "-S", &self.place(station)]).args(arguments).output().unwrap()
    }

    pub fn status(&self) -> Value {
        status(&self.name)
    }

    pub fn station(&self, station: &str) -> Value {
        json(rtnet().args(["tdma", "-S", &self.place(station), "status", "--json"]))
    }

    pub fn restart(&self, station: &str) {
        let output = rtnet().args(["lab", "restart", &self.place(station)]).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    }

    /// A connection to a station, or to the lab itself: "".
    pub fn connect(&self, station: &str) -> Socket {
        let path = Path::new("/run/rtnet").join(&self.name).join(format!("{station}.sock"));
        let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        socket.connect(&SockAddr::unix(path).unwrap()).unwrap();
        socket
    }

    pub fn wait_until_locked(&self) {
        wait_until("all are locked again", || {
            let status = self.status();
            status["stations"].as_array().unwrap().iter().all(|station| station["state"] == "locked")
        });
    }

    /// Takes it down; its account.
    pub fn down(self) -> Value {
        let output = rtnet().args(["lab", "down", &self.name, "--json"]).output().unwrap();
        assert!(!output.stdout.is_empty(), "lab down: {}", text(&output.stderr));
        let account = schema::read(&output.stdout);
        let is_sound = is_sound(&self.name, output.status.code(), &account[0]["verdict"]);
        assert!(is_sound, "{}\n{account:#}", wrong(&account[0]));
        assert!(!Path::new("/run/rtnet").join(&self.name).exists(), "nothing is left");
        account[0].clone()
    }
}

impl Drop for Cell {
    fn drop(&mut self) {
        // Gone already where all went well.
        let _ = rtnet().args(["lab", "down", &self.name]).output();
    }
}

/// What an account is not well for, where the whole of it is long.
fn wrong(account: &Value) -> String {
    let figures = |of: &Value, names: &[&str]| {
        names.iter().map(|name| format!("{name} {} ", of[name])).collect::<String>()
    };
    let of = |station: &Value| {
        figures(
            station,
            &["name", "state", "lost", "failed", "payload_errors", "lost_records", "frames_lost"],
        )
    };
    let stations: Vec<String> = account["stations"].as_array().into_iter().flatten().map(of).collect();
    let lab = figures(account, &["verdict", "unexplained", "unexplained_last", "not_judged"]);
    format!("{lab}\n{}", stations.join("\n"))
}

/// What is answered to a status request.
pub fn status_of(socket: &mut Socket) -> Value {
    socket.send(br#"{"version":1,"body":"status"}"#).unwrap();
    let mut reply = vec![0; 1 << 17];
    let length = socket.read(&mut reply).unwrap();
    let reply: Value = serde_json::from_slice(&reply[..length]).unwrap();
    reply["body"]["status"].clone()
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// How a lab is going, whatever its verdict.
pub fn status(lab: &str) -> Value {
    let output = rtnet().args(["lab", "status", lab, "--json"]).output().unwrap();
    assert_ne!(output.status.code(), Some(2), "{}", text(&output.stderr));
    crate::schema::read(&output.stdout)
}

pub fn json(command: &mut Command) -> Value {
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    schema::read(&output.stdout)
}

pub fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(120);
    while !holds() {
        assert!(Instant::now() < deadline, "in vain: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
