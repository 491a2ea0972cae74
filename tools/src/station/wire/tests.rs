use super::*;

const BEFORE: True = 1_000;
const OWN: Address = Address([2, 0, 0, 0, 0, 1]);
const OTHER: Address = Address([2, 0, 0, 0, 0, 9]);
const STATES: [LinkState; 5] =
    [LinkState::Up, LinkState::NoCarrier, LinkState::Down, LinkState::BridgePort, LinkState::OtherAddress];

fn link(name: &str, state: LinkState) -> Link {
    Link {
        name: name.into(),
        is_up: state != LinkState::Down,
        has_carrier: !matches!(state, LinkState::Down | LinkState::NoCarrier),
        mtu: MTU,
        address: Some(if state == LinkState::OtherAddress { OTHER } else { OWN }),
        bridge: (state == LinkState::BridgePort).then(|| "br0".into()),
    }
}

fn seen(state: LinkState) -> Seen {
    let before = Look { at: BEFORE, link: link("rt0", state) };
    Seen { own: OWN, before, carrier_lost: 0, renamed: 0 }
}

#[test]
fn every_state_follows_every_other_and_is_named() {
    for from in STATES {
        for to in STATES {
            let mut seen = seen(from);
            let changes = seen.take(2_000, Some(link("rt0", to)));
            if from == to {
                assert_eq!(changes, []);
                continue;
            }
            let [Change::State { from: was, to: is, before: BEFORE, .. }] = changes[..] else {
                panic!("{changes:?}")
            };
            assert_eq!((was, is), (from, to));
            assert_eq!((seen.carrier_lost, seen.renamed), (u64::from(from == LinkState::Up), 0));
            let line = changes[0].to_string();
            let named = match to {
                LinkState::Up => "again",
                LinkState::NoCarrier => "no carrier",
                LinkState::Down => "`ip link set rt0 up`",
                LinkState::BridgePort => {
                    "a port of the bridge 'br0', which takes all frames that come: use 'br0'"
                }
                LinkState::OtherAddress => "`ip link set rt0 address 02:00:00:00:00:01`",
            };
            assert!(line.contains(named) && line.contains("'rt0'") && !line.contains('\n'), "{line}");
        }
    }
}

#[test]
fn an_mtu_that_changes_is_named_once() {
    let mut seen = seen(LinkState::Up);
    let of = |mtu| Some(Link { mtu, ..link("rt0", LinkState::Up) });
    for (mtu, part) in
        [(1_000, "no frame is longer"), (9_000, "sends up to 1500 bytes"), (1_500, "an MTU of 1500")]
    {
        let lines: Vec<String> = seen.take(2_000, of(mtu)).iter().map(Change::to_string).collect();
        assert!(lines.len() == 1 && lines[0].contains(part), "{lines:?}");
        assert_eq!(seen.take(3_000, of(mtu)), []);
    }
}

#[test]
fn a_change_is_dated_by_the_last_look_at_which_there_was_none() {
    let mut seen = seen(LinkState::Up);
    assert_eq!(seen.take(2_000, Some(link("rt0", LinkState::Up))), []);
    let changes = seen.take(3_000, Some(link("rt0", LinkState::NoCarrier)));
    assert!(matches!(changes[..], [Change::State { before: 2_000, .. }]), "{changes:?}");
}

#[test]
fn an_interface_that_was_renamed_is_called_by_its_new_name() {
    let mut seen = seen(LinkState::Up);
    // As older kernels want it: nothing is renamed while it is up.
    let changes = seen.take(2_000, Some(link("rt9", LinkState::Down)));
    let lines: Vec<String> = changes.iter().map(Change::to_string).collect();
    assert_eq!(lines[0], "the interface 'rt0' is called 'rt9' now");
    assert!(lines[1].starts_with("the interface 'rt9' is down: bring it up with `ip link set rt9 up`"));
    assert_eq!((seen.before.link.name, seen.renamed), ("rt9".into(), 1));
}

#[test]
fn an_interface_that_is_gone_is_named_with_the_remedy() {
    let changes = seen(LinkState::NoCarrier).take(2_000, None);
    assert!(matches!(changes[..], [Change::Gone { before: 1_000, .. }]), "{changes:?}");
    let line = changes[0].to_string();
    assert!(line.contains("'rt0' is gone") && line.contains("start the station again"), "{line}");
    assert!(!line.contains('\n'), "{line}");
}
