use super::*;

use std::os::fd::AsFd;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

fn set(index: u32, attribute: LinkAttribute) {
    let mut link = LinkMessage::default();
    link.header.index = index;
    link.attributes = vec![attribute];
    Exchange::open().unwrap().request("set", RouteNetlinkMessage::SetLink(link), NLM_F_ACK, &[]).unwrap();
}

fn delete(index: u32) {
    let mut link = LinkMessage::default();
    link.header.index = index;
    Exchange::open().unwrap().request("delete", RouteNetlinkMessage::DelLink(link), NLM_F_ACK, &[]).unwrap();
}

fn changes(watch: &mut Watch) -> Vec<(String, ChangeKind)> {
    let change = |heard| match heard {
        Heard::Change(LinkChange { name, kind, .. }) => (name, kind),
        Heard::Missed => panic!("nothing was missed"),
    };
    watch.map(change).collect()
}

fn is_readable(watch: &Watch) -> bool {
    let mut fds = [PollFd::new(watch.as_fd(), PollFlags::POLLIN)];
    poll(&mut fds, PollTimeout::ZERO).unwrap() == 1
}

#[test]
fn who_watches_hears_what_becomes_of_a_device() {
    in_a_namespace("who_watches_hears_what_becomes_of_a_device", || {
        let mut links = Links::open().unwrap();
        let mut watch = Watch::open().unwrap();
        assert_eq!((watch.next(), is_readable(&watch)), (None, false));
        let [a, _] = veth(&mut links);
        assert!(is_readable(&watch));
        let is = |is_up, mtu| (A.to_owned(), ChangeKind::Is { is_up, mtu });
        assert!(changes(&mut watch).contains(&is(false, 1500)));
        links.set_mtu(a, 1400).unwrap();
        assert_eq!(changes(&mut watch).last(), Some(&is(false, 1400)));
        links.set_up(a, true).unwrap();
        assert_eq!(changes(&mut watch).last(), Some(&is(true, 1400)));
        delete(a);
        let heard: Vec<_> = watch.by_ref().collect();
        let gone = LinkChange { index: a, name: A.into(), kind: ChangeKind::Gone };
        assert!(heard.contains(&Heard::Change(gone)), "{heard:?}");
        assert_eq!((watch.next(), is_readable(&watch)), (None, false));
    });
}

#[test]
fn a_device_that_leaves_a_bridge_is_not_gone() {
    in_a_namespace("a_device_that_leaves_a_bridge_is_not_gone", || {
        let mut links = Links::open().unwrap();
        let [a, _] = veth(&mut links);
        add("br0", vec![LinkInfo::Kind(InfoKind::Bridge)]);
        let bridge = links.find("br0").unwrap().unwrap().index;
        let mut watch = Watch::open().unwrap();
        for master in [bridge, 0] {
            set(a, LinkAttribute::Controller(master));
        }
        let heard = changes(&mut watch);
        assert!(heard.iter().any(|(name, _)| name == A), "{heard:?}");
        assert!(heard.iter().all(|(_, kind)| *kind != ChangeKind::Gone), "{heard:?}");
    });
}

#[test]
fn who_watches_too_seldom_is_told_that_something_was_missed() {
    in_a_namespace("who_watches_too_seldom_is_told_that_something_was_missed", || {
        let mut links = Links::open().unwrap();
        let [a, _] = veth(&mut links);
        let mut watch = Watch::open().unwrap();
        watch.socket.set_rx_buf_sz(1_i32).unwrap();
        for i in 0..100 {
            links.set_mtu(a, 1000 + i).unwrap();
        }
        let heard: Vec<_> = watch.by_ref().collect();
        assert_eq!(heard.iter().filter(|heard| **heard == Heard::Missed).count(), 1, "{heard:?}");
        links.set_mtu(a, 1500).unwrap();
        assert_eq!(changes(&mut watch).last(), Some(&(A.into(), ChangeKind::Is { is_up: false, mtu: 1500 })));
    });
}
