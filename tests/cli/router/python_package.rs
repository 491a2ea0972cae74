//! The Python client as a package: pip installs it, what is installed passes its tests, and a wheel is built of it, without a network.

use std::fs;
use std::path::Path;
use std::process::Command;

use super::copy_of_client;
use crate::cell::text;
use crate::host::skip;

const NEEDS: &str = "import ensurepip, setuptools, venv, wheel";

/// The first Python that can make an environment, and build a wheel from what is installed: the user's, or Debian's.
fn builder() -> Option<&'static Path> {
    ["python3", "/usr/bin/python3"].map(Path::new).into_iter().find(|python| {
        let output = Command::new(python).args(["-c", NEEDS]).output();
        output.is_ok_and(|output| output.status.success())
    })
}

/// The output of a program that ends well in this directory. No setting of this user's pip counts.
fn run(program: &Path, arguments: &[&str], directory: &Path) -> String {
    // The labs of other tests go first.
    let mut command = Command::new("nice");
    command.args(["-n", "19"]).arg(program);
    command.args(arguments).current_dir(directory);
    command.env_remove("PYTHONPATH").env("PIP_CONFIG_FILE", "/dev/null").env("PIP_NO_CACHE_DIR", "1");
    command.env("RTNET_BIN", env!("CARGO_BIN_EXE_rtnet"));
    let output = command.env("PIP_DISABLE_PIP_VERSION_CHECK", "1").output().unwrap();
    let printed = text(&output.stdout);
    assert!(output.status.success(), "{arguments:?}: {printed}{}", text(&output.stderr));
    printed
}

/// Names of the files in the only wheel of a directory.
fn wheel(python: &Path, wheels: &Path) -> String {
    let files: Vec<_> = fs::read_dir(wheels).unwrap().map(|file| file.unwrap().file_name()).collect();
    let [file] = files.as_slice() else { panic!("one wheel: {files:?}") };
    let file = file.to_str().unwrap();
    assert!(file.starts_with("rtnet_packages-") && file.ends_with("-py3-none-any.whl"), "{file}");
    run(python, &["-m", "zipfile", "--list", file], wheels)
}

#[test]
fn python_client_installs_and_its_wheel_builds() {
    let test = "python_client_installs_and_its_wheel_builds";
    let Some(python) = builder() else {
        let needs = "needs python3 with venv, pip, setuptools and wheel";
        return skip(
            test,
            &format!("{needs}: Debian package python3-venv, python3-setuptools, python3-wheel"),
        );
    };
    let (place, elsewhere) = (copy_of_client(), tempfile::tempdir().unwrap());
    let (client, venv) = (place.path().join("python"), place.path().join("venv"));
    let arguments = ["-m", "venv", "--system-site-packages", venv.to_str().unwrap()];
    run(python, &arguments, elsewhere.path());
    let python = venv.join("bin/python");
    let pip = |arguments: &[&str]| {
        let offline = ["-m", "pip", arguments[0], "--no-build-isolation", "--no-index"];
        run(&python, &[&offline, &arguments[1..]].concat(), &client);
    };
    pip(&["install", "."]);
    let program = "import rtnet_packages as it; print(it.__file__); print(*it.__all__)";
    let printed = run(&python, &["-c", program], elsewhere.path());
    let (file, names) = printed.split_once('\n').unwrap();
    let installed = Path::new(file);
    assert!(installed.starts_with(&venv) && installed.with_file_name("py.typed").exists(), "{file}");
    assert!(names.split_whitespace().any(|name| name == "Router"), "{names}");

    // Here the tests find only the package that was installed.
    fs::create_dir(elsewhere.path().join("tests")).unwrap();
    for file in fs::read_dir(client.join("tests")).unwrap().map(Result::unwrap) {
        if file.file_type().unwrap().is_file() {
            fs::copy(file.path(), elsewhere.path().join("tests").join(file.file_name())).unwrap();
        }
    }
    let tests = "import unittest; suite = unittest.defaultTestLoader.discover('tests', top_level_dir='.'); \
                 assert suite.countTestCases() > 20; assert unittest.TextTestRunner().run(suite).wasSuccessful()";
    run(&python, &["-W", "error", "-c", tests], elsewhere.path());

    let wheels = place.path().join("wheels");
    pip(&["wheel", "--no-deps", "-w", wheels.to_str().unwrap(), "."]);
    let files = wheel(&python, &wheels);
    for file in ["rtnet_packages/__init__.py", "rtnet_packages/py.typed", "rtnet_packages/aio.py"] {
        assert!(files.lines().any(|line| line.starts_with(file)), "{file}: {files}");
    }
}
