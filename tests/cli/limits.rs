//! Where the host gives a lab less than it needs, one line says what is missing, where, and what to do.

use std::process::{Command, Output};

use crate::host::{shared, skip, unique};
use crate::rtnet;

/// Runs the command behind a line of a shell.
fn behind(line: &str, arguments: &[&str]) -> Output {
    let line = format!("{line}; exec \"$0\" \"$@\"");
    let mut command = Command::new("sh");
    command.args(["-c", &line, env!("CARGO_BIN_EXE_rtnet")]).args(arguments).output().unwrap()
}

fn message(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn full_directory_of_labs_is_named() {
    let name = "full_directory_of_labs_is_named";
    shared(name, || {
        let mount = |how: &str| {
            let line = format!("mount -t tmpfs -o size=4k none /run && {how}");
            let inner = format!("{line}; exec \"$0\" lab up --stations 2 --name x");
            Command::new("unshare").args(["-m", "sh", "-c", &inner, env!("CARGO_BIN_EXE_rtnet")]).output()
        };
        let Ok(full) = mount("head -c 4096 /dev/zero > /run/fill") else {
            return skip(name, "needs unshare");
        };
        let full = message(&full);
        assert!(full.starts_with("rtnet: /run/rtnet"), "{full}");
        assert!(full.contains("No space left on device") && full.contains("free room there"), "{full}");
        let locked = message(&mount("mount -o remount,ro /run").unwrap());
        assert!(locked.starts_with("rtnet: /run/rtnet cannot be made: Read-only file system"), "{locked}");
        assert!(locked.contains("choose another place"), "{locked}");
        assert_eq!((full.lines().count(), locked.lines().count()), (1, 1), "{full}{locked}");
    });
}

#[test]
fn capability_that_root_lacks_is_named() {
    let name = "capability_that_root_lacks_is_named";
    shared(name, || {
        for (lacks, full) in
            [("net_admin", "CAP_NET_ADMIN"), ("net_raw", "CAP_NET_RAW"), ("sys_admin", "CAP_SYS_ADMIN")]
        {
            let mut command = Command::new("setpriv");
            command.arg(format!("--bounding-set=-{lacks}")).arg(format!("--inh-caps=-{lacks}"));
            command.arg(env!("CARGO_BIN_EXE_rtnet")).args(["lab", "run", "--stations", "2"]);
            let Ok(output) = command.output() else { return skip(name, "needs setpriv") };
            let message = message(&output);
            assert_eq!((output.status.code(), message.lines().count()), (Some(2), 1), "{message}");
            assert!(message.contains(&format!("this process is root without {full}: ")), "{message}");
            let option = format!("--cap-add {}", lacks.to_uppercase());
            assert!(message.contains(&option) && !message.contains("as root"), "{message}");
        }
    });
}

#[test]
fn too_low_a_limit_of_descriptors_is_named() {
    let output = behind("ulimit -n 40", &["lab", "run", "--stations", "4"]);
    let message = message(&output);
    assert_eq!((output.status.code(), message.lines().count()), (Some(2), 1), "{message}");
    assert!(
        message.contains("(RLIMIT_NOFILE) is 40, which holds 2 stations: raise it, `ulimit -n 44`"),
        "{message}"
    );
}

#[test]
fn lab_raises_the_soft_limit_and_programs_get_it_back() {
    shared("lab_raises_the_soft_limit_and_programs_get_it_back", || {
        // With what is open besides, more than a lab of six stations has.
        let (soft, lab) = ("ulimit -Sn 16", unique("soft"));
        let up = behind(soft, &["lab", "up", "--stations", "6", "--cycle", "20ms", "--name", &lab]);
        assert_eq!(up.status.code(), Some(0), "{}", message(&up));
        let place = format!("{lab}/slave1");
        let exec = behind(soft, &["lab", "exec", &place, "--", "sh", "-c", "ulimit -Sn"]);
        let down = rtnet().args(["lab", "down", &lab]).output().unwrap();
        assert_eq!(String::from_utf8_lossy(&exec.stdout), "16\n", "{}", message(&exec));
        assert!(down.status.code() != Some(2), "{}", message(&down));
    });
}
