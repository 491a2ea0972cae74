//! Disks that are full, and standard output as a file: the screen's report comes all the same, and what cannot be written is named.

use std::path::Path;
use std::process::{Command, Output};

use crate::cell::{Cell, text};
use crate::host::{shared, skip, unique};
use crate::rtnet;

const NET: &str = "cycle = \"1ms\"\nduration = \"100ms\"\n[[station]]\nname = \"master\"\nrole = \"master\"\n\
                   [[station]]\nname = \"arm\"\nrole = \"slave\"\n";
const RING: &str =
    "discipline = \"token\"\nduration = \"100ms\"\n[[station]]\nname = \"a\"\n[[station]]\nname = \"b\"\n";
/// How a section header of pcapng begins.
const PCAPNG: [u8; 4] = [0x0a, 0x0d, 0x0d, 0x0a];
const NO_ROOM: &str = "No space left on device (os error 28)";

fn simulated(network: &str, options: &[&str]) -> Output {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("net.toml");
    std::fs::write(&file, network).unwrap();
    rtnet().args(["sim", "run"]).arg(&file).args(options).output().unwrap()
}

fn lab(options: &[&str]) -> Output {
    let network = ["lab", "run", "--stations", "2", "--cycle", "5ms", "--duration", "500ms"];
    rtnet().args(network).args(options).output().unwrap()
}

/// Its report is on the screen, and its status says that this could not be written.
#[track_caller]
fn is_told(output: &Output, file: &str, on_screen: &str) {
    let (screen, said) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(screen.contains(on_screen), "{screen}{said}");
    let all = format!("{screen}{said}").split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(all.contains(file) && all.contains(NO_ROOM), "{all}");
}

#[test]
fn simulation_shows_its_report_when_a_file_has_no_room() {
    for option in ["--json", "--html", "--pcap"] {
        is_told(&simulated(NET, &[option, "/dev/full"]), "/dev/full", "frames");
        is_told(&simulated(RING, &[option, "/dev/full"]), "/dev/full", "frames");
    }
    let both = text(&simulated(NET, &["--json", "/dev/full", "--html", "/dev/full"]).stderr);
    assert_eq!(both.matches("/dev/full cannot be written: ").count(), 2, "{both}");
}

#[test]
fn simulation_shows_its_report_on_a_full_disk() {
    if !nix::unistd::geteuid().is_root() {
        return skip("simulation_shows_its_report_on_a_full_disk", "needs root to mount a disk of its own");
    }
    let place = tempfile::tempdir().unwrap();
    std::fs::write(place.path().join("net.toml"), NET).unwrap();
    std::fs::create_dir(place.path().join("disk")).unwrap();
    // Room for a page, and for no report.
    let mount = "mount -t tmpfs -o size=4k none disk && \"$0\" sim run net.toml";
    for option in ["--json disk/a", "--html disk/a", "--pcap disk/a"] {
        let script = format!("{mount} {option}; s=$?; ls disk >&2; exit $s");
        let mut command = Command::new("unshare");
        command.args(["-m", "sh", "-c", &script, env!("CARGO_BIN_EXE_rtnet")]).current_dir(place.path());
        let output = command.output().unwrap();
        is_told(&output, "disk/a", "frames");
    }
}

#[test]
fn lab_shows_its_report_when_a_file_has_no_room() {
    shared("lab_shows_its_report_when_a_file_has_no_room", || {
        let output = lab(&["--json", "/dev/full", "--html", "/dev/full", "--pcap", "/dev/full"]);
        is_told(&output, "/dev/full", "2 stations, cycle 5ms");
        let said = text(&output.stdout) + &text(&output.stderr);
        assert!(said.matches("/dev/full").count() >= 3, "{said}");
    });
}

#[test]
fn doctor_shows_its_figures_when_a_file_has_no_room() {
    let output = rtnet().args(["doctor", "--duration", "1s", "--json", "/dev/full"]).output().unwrap();
    is_told(&output, "/dev/full", "HOLD");
}

#[test]
fn jitter_shows_its_figures_when_a_file_has_no_room() {
    shared("jitter_shows_its_figures_when_a_file_has_no_room", || {
        let cell = Cell { name: unique("full") };
        let up = ["lab", "up", "--stations", "2", "--cycle", "5ms", "--name", &cell.name];
        assert_eq!(rtnet().args(up).output().unwrap().status.code(), Some(0));
        let jitter = ["jitter", "--lab", &cell.name, "--duration", "1s", "--json", "/dev/full"];
        is_told(&rtnet().args(jitter).output().unwrap(), "/dev/full", "frames");
    });
}

#[test]
fn lab_down_tells_what_its_lab_could_not_write() {
    shared("lab_down_tells_what_its_lab_could_not_write", || {
        for (option, file) in [("--json", "/dev/full"), ("--pcap", "/dev/full")] {
            let cell = Cell { name: unique("full") };
            let mut up = rtnet();
            up.args(["lab", "up", "--stations", "2", "--cycle", "5ms", "--name", &cell.name, option, file]);
            let up = up.output().unwrap();
            assert_eq!(up.status.code(), Some(0), "{}", text(&up.stderr));
            let down = rtnet().args(["lab", "down", &cell.name]).output().unwrap();
            is_told(&down, "/dev/full", &format!("lab '{}': 2 stations", cell.name));
        }
    });
}

#[test]
fn json_to_standard_output_leaves_the_screen_to_standard_error() {
    for (network, on_screen) in [(NET, "OK: every frame in its slot"), (RING, "stations in a ring")] {
        let output = simulated(network, &["--json", "-"]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        let report = crate::schema::read(&output.stdout);
        assert_eq!(report["verdict"]["word"], "ok");
        assert!(text(&output.stderr).contains(on_screen), "{}", text(&output.stderr));
        let page = text(&simulated(network, &["--html", "-"]).stdout);
        assert!(page.starts_with("<!doctype html>") && page.ends_with("</html>\n"), "{page}");
        assert!(!Path::new("-").exists(), "no file is called so");
    }
}

#[test]
fn capture_to_standard_output_is_a_capture() {
    for network in [NET, RING] {
        let output = simulated(network, &["-w", "-"]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert!(output.stdout.starts_with(&PCAPNG) && output.stdout.len() > 5_000, "{}", output.stdout.len());
        assert!(text(&output.stderr).contains("OK: "), "{}", text(&output.stderr));
    }
}

#[test]
fn reader_of_a_capture_may_have_had_enough() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("net.toml");
    std::fs::write(&file, NET.replace("100ms", "2s")).unwrap();
    let mut command = Command::new("sh");
    command.args(["-c", "{ \"$0\" sim run \"$1\" -w -; echo status $? >&2; } | head -c 100 >/dev/null"]);
    let output = command.arg(env!("CARGO_BIN_EXE_rtnet")).arg(&file).output().unwrap();
    assert!(text(&output.stderr).ends_with("status 0\n"), "{}", text(&output.stderr));
}

#[test]
fn lab_writes_a_capture_and_json_to_standard_output() {
    shared("lab_writes_a_capture_and_json_to_standard_output", || {
        let output = lab(&["-w", "-"]);
        assert!(
            output.stdout.starts_with(&PCAPNG) && output.stdout.len() > 5_000,
            "{}",
            text(&output.stderr)
        );
        assert!(text(&output.stderr).contains("2 stations, cycle 5ms"), "{}", text(&output.stderr));
        let output = lab(&["--json", "-"]);
        let report = crate::schema::read(&output.stdout);
        assert_eq!(report["stations"], 2);
    });
}

#[test]
fn dump_writes_a_capture_to_standard_output() {
    shared("dump_writes_a_capture_to_standard_output", || {
        let cell = Cell::up("piped");
        let output =
            rtnet().args(["dump", "--lab", &cell.name, "--count", "20", "-w", "-"]).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        assert!(
            output.stdout.starts_with(&PCAPNG) && output.stdout.len() > 20 * 60,
            "{}",
            output.stdout.len()
        );
    });
}

#[test]
fn standard_output_is_one_file_and_not_of_a_lab_that_stays() {
    let refused = |output: Output| {
        let said = text(&output.stderr);
        assert_eq!((output.status.code(), said.lines().count()), (Some(2), 1), "{said}");
        said
    };
    let twice = refused(simulated(NET, &["--json", "-", "-w", "-"]));
    assert!(twice.contains("- is written twice: each output needs a file of its own"), "{twice}");
    for option in ["--json", "--pcap"] {
        let said = refused(rtnet().args(["lab", "up", option, "-"]).output().unwrap());
        assert!(
            said.contains(&format!("{option} - is standard output")) && said.contains("say --foreground"),
            "{said}"
        );
    }
}
