use socket2::{Domain, SockAddr, Socket, Type};

use super::*;
use crate::control::Server;

#[test]
fn a_place_is_a_station_with_or_without_its_lab() {
    let place: Place = "cell/slave1".parse().unwrap();
    assert_eq!((place.lab.as_deref(), place.station.as_str()), (Some("cell"), "slave1"));
    assert_eq!(place.to_string(), "cell/slave1");
    assert_eq!("slave1".parse::<Place>().unwrap().lab, None);
    for bad in
        ["", "/", "a/", "/b", "a/b/c", "..", "../x", "a b", ".hidden", "a.lock", "a/b.sock", &"x".repeat(33)]
    {
        assert!(bad.parse::<Place>().is_err(), "{bad}");
    }
}

#[test]
fn a_name_is_taken_once_and_free_again_afterwards() {
    let scratch = tempfile::tempdir().unwrap();
    let directory = Directory::at(scratch.path().join("rtnet"));
    let held = directory.take_lab("cell").unwrap();
    let error = directory.take_lab("cell").unwrap_err().to_string();
    assert!(error.contains("taken by process") && error.contains(&std::process::id().to_string()), "{error}");
    drop(held);
    assert!(!directory.path().join("cell").exists(), "nothing is left");
    directory.take_lab("cell").unwrap();
    let station = directory.take_station("arm").unwrap();
    assert!(directory.take_station("arm").is_err());
    drop(station);
    let lock = directory.path().join("arm.lock");
    assert!(!lock.exists(), "nothing is left");
    let first = directory.take_station("arm").unwrap();
    fs::remove_file(&lock).unwrap();
    let next = directory.take_station("arm").unwrap();
    drop(first);
    assert!(lock.exists(), "it is another's by now");
    drop(next);
    assert!(!lock.exists());
}

#[test]
fn a_lock_whose_file_was_removed_meanwhile_is_not_the_name_s() {
    let scratch = tempfile::tempdir().unwrap();
    let path = scratch.path().join("arm.lock");
    let stale = lock_once(&path, "arm").unwrap();
    fs::remove_file(&path).unwrap();
    let held = lock(&path, "arm").unwrap();
    assert_ne!(stale.metadata().unwrap().ino(), held.metadata().unwrap().ino());
    assert!(lock(&path, "arm").is_err(), "and that is held");
}

#[test]
fn what_a_dead_lab_left_is_taken_over() {
    let scratch = tempfile::tempdir().unwrap();
    let directory = Directory::at(scratch.path());
    let own = directory.lab("cell");
    fs::create_dir(own.parent().unwrap()).unwrap();
    for left in [LOCK, SOCKET, "slave1.sock"] {
        fs::write(own.with_file_name(left), "").unwrap();
    }
    assert!(directory.labs().is_empty() && directory.stations().is_empty(), "nobody is there");
    assert_eq!((directory.labs_dead_or_alive(), directory.keeper("cell")), (vec!["cell".into()], None));
    let held = directory.take_lab("cell").unwrap();
    assert_eq!(directory.labs(), ["cell"], "it is coming up");
    assert_eq!(directory.keeper("cell"), Some(std::process::id().to_string()));
    assert!(!own.exists() && directory.stations().is_empty());
    drop(held);
    assert!(directory.labs_dead_or_alive().is_empty());
}

#[test]
fn who_is_there_is_listed_and_who_was_killed_is_not() {
    let scratch = tempfile::tempdir().unwrap();
    let directory = Directory::at(scratch.path());
    let _lab = directory.take_lab("cell").unwrap();
    let at = |place: &str| directory.station(&place.parse().unwrap());
    let serve = |place: &str| Server::bind(&at(place)).unwrap();
    let _served = [serve("arm"), serve("cell/slave1")];
    // A socket whose process has not removed it.
    let killed = Socket::new(Domain::UNIX, Type::SEQPACKET, None).unwrap();
    killed.bind(&SockAddr::unix(at("cell/slave2")).unwrap()).unwrap();
    drop(killed);
    assert_eq!(directory.stations(), ["arm", "cell/slave1"]);
}

#[test]
fn a_station_without_its_lab_is_one_of_its_own_or_of_the_only_lab() {
    let scratch = tempfile::tempdir().unwrap();
    let directory = Directory::at(scratch.path());
    let find = |place: &str| directory.find(&place.parse().unwrap()).map(|found| found.to_string());
    let serve = |place: &str| Server::bind(&directory.station(&place.parse().unwrap())).unwrap();
    assert_eq!(find("slave1").unwrap(), "slave1", "there is nothing at all");
    let _labs = ["a", "b"].map(|lab| {
        let held = directory.take_lab(lab).unwrap();
        let found = find("slave1").unwrap();
        assert!(found == "a/slave1" || lab == "b", "{found}");
        held
    });
    let _served = ["a/slave1", "b/slave1", "b/slave2"].map(serve);
    let error = find("slave1").unwrap_err().to_string();
    assert!(error.contains("'slave1' is meant: a/slave1 or b/slave1?"), "{error}");
    assert_eq!(find("b/slave1").unwrap(), "b/slave1");
    let _own = serve("slave1");
    assert_eq!(find("slave1").unwrap(), "slave1");
}

#[test]
fn a_name_can_be_taken_while_others_look_whether_it_is() {
    let scratch = tempfile::tempdir().unwrap();
    // Whoever had it before was killed.
    let path = scratch.path().join("arm.lock");
    let left = File::create(&path).unwrap();
    let looked_at = Flock::lock(left, FlockArg::LockSharedNonblock).unwrap();
    std::thread::scope(|scope| {
        scope.spawn(move || {
            std::thread::sleep(Duration::from_millis(5));
            drop(looked_at);
        });
        // A busy host may let the other wait for longer than one look takes.
        let until = Instant::now() + Duration::from_secs(20);
        let directory = Directory::at(scratch.path());
        let begun = Instant::now();
        let mut taken = directory.take_station("arm");
        assert!(taken.is_ok() || begun.elapsed() >= LOCKED_WITHIN, "it was not waited for");
        while taken.is_err() && Instant::now() < until {
            taken = directory.take_station("arm");
        }
        assert!(taken.is_ok());
    });
}

#[test]
fn a_directory_that_others_can_write_to_is_not_used() {
    use std::os::unix::fs::PermissionsExt;
    let scratch = tempfile::tempdir().unwrap();
    let open = scratch.path().join("open");
    fs::create_dir(&open).unwrap();
    fs::set_permissions(&open, fs::Permissions::from_mode(0o777)).unwrap();
    let directory = Directory::at(&open);
    for error in [
        directory.take_station("arm").unwrap_err(),
        place::check_private(directory.path()).unwrap_err().into(),
    ] {
        assert!(error.to_string().contains("can be written by others"), "{error}");
    }
}
