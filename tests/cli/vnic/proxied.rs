//! Labs whose stations share their addresses with Linux.

use std::fs::{self, File};
use std::process::{Command, Stdio};

use super::{PATIENCE, Running, assert_answers, bytes, network, program, status, vnic};
use crate::cell::{Cell, text};
use crate::host::skip;
use crate::rtnet;

/// Three stations, of which the first two share theirs.
const PROXY: &str = include_str!("../proxy.toml");
const MASTER: &str = "10.0.0.1";

#[test]
fn stations_of_a_lab_share_their_addresses_with_linux() {
    let test = "stations_of_a_lab_share_their_addresses_with_linux";
    network(test, || {
        let help = Command::new("nc").arg("-h").output();
        if !help.is_ok_and(|help| (text(&help.stdout) + &text(&help.stderr)).contains("OpenBSD")) {
            return skip(test, "no nc of OpenBSD: apt-get install netcat-openbsd");
        }
        let cell = Cell::with("proxied", |_| PROXY.to_owned());
        // Linux asks, and the stack answers.
        assert_answers(&cell, "arm", MASTER);
        let sent = bytes(200_000);
        let dir = tempfile::tempdir().unwrap();
        let (original, copy) = (dir.path().join("original"), dir.path().join("copy"));
        fs::write(&original, &sent).unwrap();
        let mut server = program(&cell, "master", &["nc", "-l", MASTER, "4000"]);
        server.stdout(File::create(&copy).unwrap());
        let mut server = Running::server(&cell, "master", 4000, server);
        let mut client = program(&cell, "arm", &["nc", "-N", MASTER, "4000"]);
        client.stdin(File::open(&original).unwrap()).stdout(Stdio::null());
        Running::start(client).ended(PATIENCE);
        server.ended(PATIENCE);
        assert!(fs::read(&copy).unwrap() == sent, "every byte came, by TCP between their own addresses");

        for station in ["master", "arm"] {
            let status = status(&cell, station);
            let [mode, device] = ["mode", "device"].map(|of| status[of].as_str().unwrap());
            assert_eq!((mode, device, &status["proxy"]), ("tun", "vnic0", &true.into()), "{status:#}");
            assert!(status["counters"]["proxied_out"].as_u64() > Some(50), "{status:#}");
        }
        assert_eq!(vnic(&cell, "leg", &["status"]).status.code(), Some(2), "it has said nothing of one");
        let ping = ["ping", "-S", &cell.place("leg"), "--size", "16", "-c", "5", "-i", "20ms", "10.0.0.2"];
        let ping = rtnet().args(ping).output().unwrap();
        assert_eq!(ping.status.code(), Some(0), "real-time as ever: {}", text(&ping.stderr));
        // All of it was in slots, and the observer has told whose.
        assert_eq!(cell.down()["unexplained"], 0);
    });
}
