//! Frames of the EtherType of test traffic that no station of the network has made.

use rtnet::sim::Joint;
use tools::judge::findings::FindingKind;
use tools::scenario::Source;
use tools::sim::{self, Options};

const NETWORK: &str = r#"
cycle = "20ms"
rate = "10M"
duration = "1s"
sync_window = "100us"
[[station]]
name = "master"
role = "master"
payload = 46
slots = [{ id = 0, offset = "5ms" }]
[[station]]
name = "slave"
role = "slave"
payload = 46
rounds = 10
slots = [{ id = 0, offset = "9ms" }]
[medium]
joint = "hub"
[[event]]
at = "5.03ms"
inject = "020000000002 FROM 88b5 0000 00 00 00000000 00000000000000000000000000000000 0000 0000 0000 0000 0000 0000"
"#;

#[test]
fn a_foreign_frame_that_looks_like_test_traffic_is_an_overlap_and_no_stations() {
    // Of nobody, and as if of the station that is hit, of which the frame says that it is.
    for from in ["020000000099", "020000000001"] {
        let text = NETWORK.replace("FROM", from);
        let scenario = Source::new("foreign.toml", &text).parse().unwrap();
        assert_eq!(scenario.conditions.joint, Joint::Hub);
        let around = Some((0, u32::MAX));
        let ended = sim::run(&scenario, &Options { around, ..Options::default() }).unwrap();
        let (figures, simulation) = (ended.figures.figures, ended.figures.simulation);
        assert_eq!((figures.overlaps, simulation.collisions), (1, 2), "{from}: {:?}", figures.verdict);
        let overlap =
            figures.misses.iter().find(|miss| miss.found == Some(FindingKind::Overlap.name().into()));
        assert!(overlap.is_some(), "{from}: {:?}", figures.misses);
        assert_eq!((figures.frames_seen, figures.frames_lost), (100, 1), "{from}");
    }
}
