use super::*;
use crate::buf::Pool;
use crate::live::packet;
use crate::live::ring::tests::in_a_namespace;
use crate::wire::ethernet::EtherType;
use socket2::Socket;

const ALWAYS: u32 = 1_000_000;
const DATA: EtherType = EtherType::EXPERIMENTAL;
const CONTROL: EtherType = EtherType::RTMAC;

fn frame(of: EtherType) -> [u8; 60] {
    let mut frame = [0x5a; 60];
    frame[12..14].copy_from_slice(&of.0.to_be_bytes());
    frame
}

/// The loopback of a namespace of the test's own, with both programs at it: what it sends passes by the one for what a
/// station is to hear.
struct Loop {
    impairment: Impairment,
    interface: u32,
    sender: Socket,
    receiver: Socket,
    pool: Pool,
}

impl Loop {
    fn send(&self, of: EtherType, times: usize) {
        for _ in 0..times {
            // A frame that is dropped is an error of `send`.
            let _ = packet::send(&self.sender, &frame(of));
        }
    }

    /// As marked by the wire of its sender.
    fn send_marked(&self, of: EtherType, mark: u32) {
        self.sender.set_mark(mark).unwrap();
        self.send(of, 1);
        self.sender.set_mark(0).unwrap();
    }

    fn receive(&self) -> Vec<Vec<u8>> {
        let next = || {
            let mut buf = self.pool.take().unwrap();
            packet::receive(&self.receiver, &mut buf).map(|_| buf.to_vec())
        };
        std::iter::from_fn(next).collect()
    }
}

fn on_a_loopback(test: fn(&mut Loop)) {
    in_a_namespace(|| {
        let interface = nix::net::if_::if_nametoindex("lo").unwrap();
        let impairment = match Impairment::attach(interface) {
            Ok(impairment) => impairment,
            Err(refused) => {
                let line = format!("SKIP: {refused}: {}\n", refused.remedy());
                let _ = std::io::Write::write_all(&mut std::io::stderr(), line.as_bytes());
                return;
            }
        };
        let open = |protocol| {
            let socket = packet::open().unwrap();
            packet::bind(&socket, interface, protocol).unwrap();
            socket
        };
        let receiver = open(libc::ETH_P_ALL as u16);
        ignore_outgoing(&receiver);
        let (sender, pool) = (open(0), Pool::new(4));
        test(&mut Loop { impairment, interface, sender, receiver, pool });
    });
}

/// A socket for all frames is shown what leaves, too.
fn ignore_outgoing(socket: &Socket) {
    let on = 1_i32;
    // SAFETY: `on` is alive for the call, and its true size is passed.
    let result = unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::SOL_PACKET,
            libc::PACKET_IGNORE_OUTGOING,
            (&raw const on).cast(),
            size_of_val(&on) as libc::socklen_t,
        )
    };
    assert_eq!(result, 0);
}

fn hears(of: &Loop, change: impl FnOnce(&mut Chances)) {
    let mut chances = Chances::default();
    change(&mut chances);
    of.impairment.hears(&chances);
}

#[test]
fn a_wire_that_is_told_nothing_does_nothing() {
    on_a_loopback(|wire| {
        wire.send(DATA, 2);
        wire.send(CONTROL, 1);
        assert_eq!(wire.receive(), [frame(DATA), frame(DATA), frame(CONTROL)]);
        assert_eq!(wire.impairment.counts(), Impaired::default());
    });
}

#[test]
fn control_frames_and_others_are_lost_each_by_its_own_chance_and_counted() {
    on_a_loopback(|wire| {
        hears(wire, |chances| chances.lose_data_ppm = ALWAYS);
        wire.send(DATA, 3);
        wire.send(CONTROL, 1);
        assert_eq!(wire.receive(), [frame(CONTROL)]);
        assert_eq!(wire.impairment.counts(), Impaired { lost_data: 3, ..Impaired::default() });
        hears(wire, |chances| chances.lose_control_ppm = ALWAYS);
        wire.send(DATA, 1);
        wire.send(CONTROL, 2);
        assert_eq!(wire.receive(), [frame(DATA)]);
        assert_eq!(wire.impairment.counts().lost_control, 2);
        hears(wire, |_| ());
        wire.send(CONTROL, 1);
        assert_eq!(wire.receive().len(), 1, "it is over");
    });
}

#[test]
fn about_as_many_are_lost_as_was_said() {
    on_a_loopback(|wire| {
        hears(wire, |chances| chances.lose_data_ppm = ALWAYS / 10);
        let mut came = 0;
        for _ in 0..100 {
            wire.send(DATA, 100);
            came += wire.receive().len() as u64;
        }
        let lost = wire.impairment.counts().lost_data;
        assert_eq!(came + lost, 10_000);
        // Ten standard deviations of 30.
        assert!((700..1_300).contains(&lost), "{lost}");
    });
}

#[test]
fn a_lost_frame_is_written_down_and_of_too_many_the_newest_are() {
    on_a_loopback(|wire| {
        hears(wire, |chances| (chances.lose_control_ppm, chances.lose_data_ppm) = (ALWAYS, ALWAYS));
        let mut taken = Vec::new();
        wire.send(CONTROL, 1);
        wire.send(DATA, 1);
        wire.impairment.take_lost(|bytes| taken.push(bytes));
        assert_eq!(taken, [&frame(CONTROL)[..LOGGED], &frame(DATA)[..LOGGED]]);
        wire.impairment.take_lost(|_| unreachable!("each once"));
        wire.send(CONTROL, LOG + 5);
        let mut n = 0;
        wire.impairment.take_lost(|_| n += 1);
        assert_eq!(n, LOG - 1);
    });
}

#[test]
fn what_a_senders_wire_has_marked_is_so_for_who_hears_it() {
    on_a_loopback(|wire| {
        wire.send_marked(DATA, 1);
        assert_eq!((wire.receive().len(), wire.impairment.counts().lost_data), (0, 1));
        wire.send_marked(DATA, OTHER_SIDE as u32);
        assert_eq!((wire.receive().len(), wire.impairment.counts().lost_data), (0, 2));
        wire.impairment.cut_off(true);
        wire.send_marked(DATA, OTHER_SIDE as u32);
        assert_eq!(wire.receive().len(), 1, "on one side");
        wire.send(DATA, 1);
        assert_eq!(wire.receive().len(), 0, "on two");
    });
}

#[test]
fn one_bit_is_changed_and_a_frame_comes_twice() {
    on_a_loopback(|wire| {
        hears(wire, |chances| chances.corrupt_ppm = ALWAYS);
        wire.send(DATA, 50);
        let came = wire.receive();
        let differs = |came: &Vec<u8>| {
            let bits = came.iter().zip(frame(DATA)).map(|(came, sent)| (came ^ sent).count_ones());
            bits.sum::<u32>()
        };
        assert_eq!(came.iter().map(differs).collect::<Vec<_>>(), [1; 50]);
        let different = came.iter().filter(|other| **other != came[0]).count();
        assert!(different > 20, "any bit of 480, not one");
        hears(wire, |chances| chances.duplicate_ppm = ALWAYS);
        wire.send(CONTROL, 3);
        assert_eq!(wire.receive(), [frame(CONTROL); 6]);
        let expected = Impaired { corrupted: 50, duplicated: 3, ..Impaired::default() };
        assert_eq!(wire.impairment.counts(), expected);
    });
}

#[test]
fn an_rtmac_frame_that_is_changed_is_written_down_as_it_was_and_no_other() {
    on_a_loopback(|wire| {
        hears(wire, |chances| chances.corrupt_ppm = ALWAYS);
        let (mut changed, mut taken) = (0, 0);
        for _ in 0..200 {
            wire.send(DATA, 1);
            wire.send(CONTROL, 1);
            let control = &wire.receive()[1];
            changed += usize::from(control[..LOGGED] != frame(CONTROL)[..LOGGED]);
            wire.impairment.take_lost(|bytes| {
                taken += 1;
                assert_eq!(bytes, frame(CONTROL)[..LOGGED]);
            });
        }
        assert_eq!(taken, changed, "what fills it says nothing");
        assert!((100..180).contains(&changed), "{changed} of 200, if any bit of 42 bytes of 60");
        let expected = Impaired { corrupted: 400, ..Impaired::default() };
        assert_eq!(wire.impairment.counts(), expected);
    });
}

#[test]
fn at_the_next_port_a_wire_does_what_it_did_and_counts_on() {
    on_a_loopback(|wire| {
        hears(wire, |chances| chances.lose_data_ppm = ALWAYS);
        wire.impairment.cut_off(true);
        wire.send(CONTROL, 1);
        wire.send_marked(DATA, OTHER_SIDE as u32);
        wire.impairment.take_lost(|_| ());
        wire.impairment.attach_anew(wire.interface).unwrap();
        wire.send(CONTROL, 1);
        wire.send_marked(DATA, OTHER_SIDE as u32);
        wire.send_marked(CONTROL, OTHER_SIDE as u32);
        assert_eq!(wire.receive(), [frame(CONTROL)], "of its side of the cut");
        let expected = Impaired { lost_control: 2, lost_data: 2, ..Impaired::default() };
        assert_eq!(wire.impairment.counts(), expected, "each by one program");
        let mut taken = Vec::new();
        wire.impairment.take_lost(|bytes| taken.push(bytes));
        assert_eq!(taken, [&frame(CONTROL)[..LOGGED], &frame(DATA)[..LOGGED]], "what was lost since");
    });
}

#[test]
fn nothing_is_left_of_it_once_it_is_dropped() {
    on_a_loopback(|wire| {
        hears(wire, |chances| chances.lose_data_ppm = ALWAYS);
        wire.send(DATA, 1);
        assert_eq!(wire.receive().len(), 0);
        wire.impairment = Impairment::attach(wire.interface).unwrap();
        wire.send(DATA, 1);
        assert_eq!(wire.receive().len(), 1);
    });
}

#[test]
fn what_fails_is_a_wire_and_the_remedy_is_a_wires() {
    let refused = |step, errno| {
        let refused = ImpairmentRefused { step, error: io::Error::from_raw_os_error(errno) };
        (refused.to_string(), refused.remedy())
    };
    for (step, errno, expected) in [
        ("bpf map", libc::EPERM, "CAP_BPF and CAP_NET_ADMIN"),
        ("bpf program", libc::EINVAL, "Linux 6.6"),
        (ATTACHED, libc::EINVAL, "needs tcx"),
        (ATTACHED, libc::ENODEV, "the bridge's port is gone"),
    ] {
        let (line, remedy) = refused(step, errno);
        assert!(line.starts_with(&format!("impaired wire, {step}: ")), "{line}");
        assert!(remedy.contains(expected) && !remedy.contains("clsact"), "{step}, {errno}: {remedy}");
    }
}

#[test]
fn a_port_that_is_not_there_is_told_of_as_such() {
    in_a_namespace(|| {
        let Err(refused) = Impairment::attach(4_711) else { panic!("there is none") };
        // Where the kernel takes no programs at all, it says so first.
        let is_expected = refused.step != ATTACHED || refused.remedy().contains("port is gone");
        assert!(is_expected, "{refused}: {}", refused.remedy());
    });
}
