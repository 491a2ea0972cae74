use rtmac::token::RingConfig;

use super::super::Source;
use super::*;
use crate::scenario::Network;

const RING: &str = r#"
discipline = "token"
rate = "100M"
[[station]]
name = "arm"
payload = 100
clock = { offset = "5ms", drift_ppm = 20.0 }
[[station]]
name = "leg"
[[station.traffic]]
priority = 3
every = "10ms"
"#;

fn ring(text: &str) -> Result<RingScenario, String> {
    match Source::new("ring.toml", text).parse_any() {
        Ok(Network::Ring(ring)) => Ok(ring),
        Ok(Network::Slots(_)) => panic!("it has slots"),
        Err(why) => Err(why.to_string()),
    }
}

#[test]
fn a_file_of_a_ring_has_its_stations_in_order_and_usual_times() {
    let RingScenario { ring, network } = ring(RING).unwrap();
    assert_eq!(ring, RingConfig::new((0..2).map(|id| network.address(id)).collect()));
    let [arm, leg] = &network.stations[..] else { panic!("there are two") };
    assert_eq!(
        (arm.name.as_str(), arm.payload, arm.clock),
        ("arm", 100, Some((Span::from_millis(5), 20_000)))
    );
    assert_eq!((leg.name.as_str(), leg.flows.len(), leg.slots.len()), ("leg", 1, 0));
    assert!(leg.clock_drift_ppb.abs() <= 50_000 && leg.clock_drift_ppb != 0, "by the seed");
}

#[test]
fn times_of_a_ring_are_those_that_are_said() {
    let times = "token_hold = \"1ms\"\ntoken_rest = \"0us\"\ntoken_late = \"2ms\"\ntoken_delay = \"50us\"\ntoken_invite = 4\n";
    let said = ring(&RING.replacen("[[station]]", &format!("{times}[[station]]"), 1)).unwrap().ring;
    let us = Span::from_micros;
    let expected = (us(1_000), us(0), us(2_000), us(50), 4);
    assert_eq!((said.hold, said.rest, said.late, said.delay, said.invite_every), expected);
    let slow = ring(&RING.replace("100M", "10M")).unwrap().ring;
    assert_eq!(slow.hold, slow.rate.air_time(1_514) * 4, "four of the longest frames");
}

#[test]
fn what_does_not_go_with_a_ring_is_refused_by_its_line_with_the_remedy() {
    let top = |line: &str| RING.replacen("[[station]]", &format!("{line}\n[[station]]"), 1);
    let of_station = |line: &str| RING.replace("name = \"leg\"", &format!("name = \"leg\"\n{line}"));
    let of_traffic = |line: &str| format!("{RING}{line}\n");
    for (text, line, said) in [
        (top("cycle = \"1ms\""), 4, "cycle: a ring has no cycle"),
        (top("guard = \"20us\""), 4, "guard: a ring has no slots: leave it out"),
        (top("servo = \"none\""), 4, "servo: nobody gives the time in a ring"),
        (top("network = \"10.0.0.0/24\""), 4, "network: stations of a ring in a lab have no sockets"),
        (of_traffic("[expect]\noverlaps = 0"), 13, "expect: what is expected of a ring"),
        (of_station("role = \"slave\""), 10, "role: nobody gives the time in a ring"),
        (of_station("backup = \"1us\""), 10, "backup: nobody gives the time in a ring"),
        (of_station("slots = [{ id = 0, offset = \"50us\" }]"), 10, "slots: a ring has no slots"),
        (
            of_station("vnic = \"10.1.0.7/24\""),
            10,
            "vnic: stations of a ring in a lab have no sockets and no VNICs",
        ),
        (of_traffic("slot = 0"), 13, "slot: a ring has no slots"),
        (of_traffic("[[event]]\nat = \"1s\"\ncut = \"leg\"\nfor = \"1ms\""), 15, "unplug stations"),
        (of_traffic("[[wire]]\nlose_control = \"1%\""), 14, "say lose, or lose_data"),
        (RING.replace("20.0", "251.0"), 7, "off by 251 ppm: time-outs of a ring allow 250 ppm"),
        (
            of_traffic("[[event]]\nat = \"1s\"\nclock = { stations = \"leg\", drift_ppm = -300.0 }"),
            13,
            "off by -300 ppm",
        ),
        (top("token_rest = \"501us\""), 2, "let it rest for less"),
        (RING.replace("leg", "arm"), 9, "the name 'arm' is taken"),
        (of_station("payload = 20"), 10, "a payload of 20 bytes"),
    ] {
        let why = ring(&text).unwrap_err();
        assert!(why.starts_with(&format!("ring.toml:{line}:")) && why.contains(said), "{why}\n{text}");
    }
}

#[test]
fn a_ring_is_refused_where_only_slots_will_do_and_slots_may_be_called_so() {
    let why = Source::new("ring.toml", RING).parse().unwrap_err().to_string();
    assert!(why.starts_with("ring.toml:2:14: a ring, which `rtnet sim run`"), "{why}");
    let slots = "discipline = \"tdma\"\ncycle = \"1ms\"\n[[station]]\nname = \"a\"\nrole = \"master\"\n\
                 [[station]]\nname = \"b\"\nrole = \"slave\"\n";
    assert!(matches!(Source::new("net.toml", slots).parse_any(), Ok(Network::Slots(_))));
    let why = Source::new("net.toml", &slots.replace("tdma", "nomac")).parse_any().unwrap_err().to_string();
    assert!(why.contains("unknown variant `nomac`, expected `tdma` or `token`"), "{why}");
}
