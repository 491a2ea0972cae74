//! Labs without a file.

use super::{MODES, assert_answers, shared, status};
use crate::cell::{Cell, text};
use crate::host::unique;
use crate::rtnet;

#[test]
fn stations_of_a_lab_without_a_file_have_vnics_in_the_network_that_an_option_says() {
    shared("stations_of_a_lab_without_a_file_have_vnics_in_the_network_that_an_option_says", || {
        for mode in MODES {
            let cell = Cell { name: unique(&format!("vnics-{mode}")) };
            let network = ["--stations", "3", "--cycle", "4ms", "--vnic", "10.1.0.0/24", "--vnic-mode", mode];
            let up = rtnet().args(["lab", "up", "--name", &cell.name]).args(network).output().unwrap();
            assert_eq!(up.status.code(), Some(0), "{}", text(&up.stderr));
            assert_answers(&cell, "slave2", "10.1.0.1");
            for (station, address) in [("master", "10.1.0.1/24"), ("slave2", "10.1.0.3/24")] {
                let status = status(&cell, station);
                assert_eq!((&status["mode"], &status["mtu"]), (&mode.into(), &1_496.into()), "{status:#}");
                assert_eq!(status["addresses"][0], address, "{status:#}");
            }
            assert_eq!(cell.down()["unexplained"], 0);
        }
    });
}
