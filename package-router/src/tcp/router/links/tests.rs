use super::*;
use crate::tcp::router::{Limits, Status};
use crate::wire::{ERROR, NOT_AVAILABLE};

const PEER: &str = "127.0.0.1:9";

/// Routers of systems 1, 2, ..., each with a link to the next one.
struct Systems {
    routers: Vec<Router>,
    /// Both ends of each link, and the routers there.
    links: Vec<[(usize, Connection); 2]>,
    now: u64,
}

impl Systems {
    fn new(count: usize) -> Self {
        let mut systems = Self { routers: Vec::new(), links: Vec::new(), now: 0 };
        (1..=count).for_each(|system| systems.add(system as u8));
        (1..count).for_each(|first| systems.link(first - 1, first));
        systems
    }

    fn add(&mut self, system: u8) {
        let mut router = Router::new(Limits::default(), 0);
        router.set_links(system, vec![BTreeSet::new()]);
        self.routers.push(router);
    }

    fn link(&mut self, from: usize, to: usize) {
        let there = self.routers[to].connect(PEER.parse().unwrap(), self.now).unwrap();
        let here = self.routers[from].link(0, PEER.parse().unwrap(), None, self.now).unwrap();
        self.links.push([(from, here), (to, there)]);
        self.settle();
    }

    fn connect(&mut self, system: usize) -> Connection {
        self.routers[system].connect(PEER.parse().unwrap(), self.now).unwrap()
    }

    /// Bytes that wait for a connection.
    fn taken(&mut self, system: usize, of: Connection) -> Vec<u8> {
        let mut bytes = Vec::new();
        let send = |slices: &[std::io::IoSlice<'_>]| {
            slices.iter().for_each(|slice| bytes.extend_from_slice(slice));
            Ok(slices.iter().map(|slice| slice.len()).sum())
        };
        self.routers[system].write(of, send).unwrap();
        bytes
    }

    /// Carries all bytes of links.
    fn settle(&mut self) {
        for _ in 0..20 {
            for [one, other] in self.links.clone() {
                for (from, to) in [(one, other), (other, one)] {
                    let bytes = self.taken(from.0, from.1);
                    self.routers[to.0].received(to.1, &bytes, self.now);
                }
            }
        }
    }

    fn sends(&mut self, system: usize, from: Connection, kind: i8, to: u32, of: u32, body: &[u8]) {
        let head = Head::new(kind, MailboxName(to), MailboxName(of)).with_body(body.len()).unwrap();
        self.routers[system].received(from, &[&head.to_bytes(), body].concat(), self.now);
        self.settle();
    }

    fn registers(&mut self, system: usize, connection: Connection, name: u32) -> i8 {
        self.sends(system, connection, REGISTER, 0, 0, &name.to_le_bytes());
        self.heads(system, connection).last().unwrap().kind
    }

    /// Heads of packages that have come for a client.
    fn heads(&mut self, system: usize, of: Connection) -> Vec<Head> {
        let mut frames = crate::tcp::frames::Frames::default();
        let (bytes, mut heads) = (self.taken(system, of), Vec::new());
        frames.cut(&bytes, |head, _| heads.push(head)).unwrap();
        heads
    }

    fn status(&self, system: usize) -> Status {
        self.routers[system].status(self.now)
    }
}

const PILOT_1: u32 = 0x0118_0000;
const PILOT_2: u32 = 0x0218_0000;
const PILOT_3: u32 = 0x0318_0000;

#[test]
fn mailboxes_of_two_systems_meet_by_one_link() {
    let mut systems = Systems::new(2);
    let (first, second) = (systems.connect(0), systems.connect(1));
    assert_eq!(systems.registers(0, first, PILOT_1), OK);
    assert_eq!(systems.registers(1, second, PILOT_2), OK);
    systems.sends(0, first, 21, PILOT_2, PILOT_1, b"hello");
    let command = systems.heads(1, second)[0];
    assert_eq!((command.kind, command.from.0, command.len), (21, PILOT_1, 21));
    systems.sends(1, second, OK, PILOT_1, PILOT_2, b"");
    assert_eq!(systems.heads(0, first)[0].from.0, PILOT_2);
    // A mailbox that has gone is gone there, too.
    systems.sends(0, first, UNREGISTER, 0, 0, &PILOT_1.to_le_bytes());
    systems.sends(1, second, 22, PILOT_1, PILOT_2, b"");
    assert_eq!(systems.heads(1, second)[0].kind, NOT_AVAILABLE);
    assert_eq!(systems.registers(0, first, PILOT_1), OK);
    systems.sends(0, first, 23, 0x0299_0000, PILOT_1, b"");
    assert_eq!(systems.heads(0, first)[0].kind, NOT_AVAILABLE, "nobody has it there");
    let roles: Vec<_> = systems.status(1).clients.iter().map(|client| client.role.clone()).collect();
    assert_eq!(roles, ["router of system 1", "client"]);
    assert_eq!(systems.status(0).clients[0].role, "link");
}

/// Each has a link to the other, which names it.
#[test]
fn systems_that_link_to_each_other_meet() {
    let mut systems = Systems::new(1);
    systems.add(2);
    [2, 1].into_iter().zip([1, 2]).for_each(|(to, of)| {
        systems.routers[usize::from(of) - 1].set_links(of, vec![BTreeSet::from([to])]);
    });
    systems.link(0, 1);
    let (first, second) = (systems.connect(0), systems.connect(1));
    assert_eq!(systems.registers(0, first, PILOT_1), OK);
    systems.link(1, 0);
    assert_eq!(systems.registers(1, second, PILOT_2), OK);
    for (system, from, to) in
        [(0, (first, PILOT_1), (second, PILOT_2)), (1, (second, PILOT_2), (first, PILOT_1))]
    {
        systems.sends(system, from.0, 21, to.1, from.1, b"");
        let there = systems.heads(1 - system, to.0)[0];
        assert_eq!((there.kind, there.from.0), (21, from.1));
        systems.sends(1 - system, to.0, OK, from.1, to.1, b"");
        assert_eq!(systems.heads(system, from.0)[0].kind, OK);
    }
    // A client that has such a name is no router.
    assert_eq!(systems.registers(1, second, 0x0177_0000), OK);
    systems.sends(0, first, 21, PILOT_2, 0x0177_0000, b"");
    assert!(systems.heads(1, second).is_empty());
    assert_eq!(systems.status(1).counters.foreign_senders, 1);
    // One of the links ends: the other is enough.
    let [(_, here), (_, there)] = systems.links.remove(0);
    systems.routers[0].disconnect(here, Ending::Left, 0);
    systems.routers[1].disconnect(there, Ending::Left, 0);
    systems.sends(0, first, 21, PILOT_2, PILOT_1, b"");
    assert_eq!(systems.heads(1, second)[0].kind, 21);
}

/// The second router has a client that sends in a name of system 3, whose router has a link here.
#[test]
fn a_link_to_all_brings_nothing_in_the_name_of_another() {
    let mut systems = Systems::new(2);
    let (first, third) = (systems.connect(0), systems.connect(0));
    assert_eq!(systems.registers(0, first, PILOT_1), OK);
    systems.sends(0, third, ROUTER, 0, 0, &3u32.to_le_bytes());
    assert_eq!(systems.registers(0, third, PILOT_3), OK);
    let forger = systems.connect(1);
    assert_eq!(systems.registers(1, forger, PILOT_3), OK);
    systems.sends(1, forger, 21, PILOT_1, PILOT_3, b"");
    assert!(systems.heads(0, first).is_empty());
    assert_eq!(systems.status(0).counters.foreign_senders, 1);
    assert_eq!((systems.routers[0].unnamed_system(0), systems.routers[1].unnamed_system(0)), (Some(3), None));
    systems.sends(0, third, 21, PILOT_1, PILOT_3, b"");
    assert_eq!(systems.heads(0, first)[0].kind, 21);
}

#[test]
fn a_link_that_opens_later_registers_what_is_there() {
    let mut systems = Systems::new(1);
    systems.add(2);
    let first = systems.connect(0);
    assert_eq!(systems.registers(0, first, PILOT_1), OK);
    systems.link(0, 1);
    let second = systems.connect(1);
    systems.sends(1, second, 21, PILOT_1, PILOT_2, b"");
    assert_eq!(systems.heads(0, first)[0].kind, 21);
}

/// Every router here has a link to the next, which knows the mailbox: one link far it goes, and no further.
#[test]
fn packages_go_one_link_far() {
    let mut systems = Systems::new(3);
    let [first, second, third] = [0, 1, 2].map(|system| systems.connect(system));
    assert_eq!(systems.registers(0, first, PILOT_1), OK);
    assert_eq!(systems.registers(2, third, PILOT_3), OK);
    systems.sends(0, first, 21, PILOT_3, PILOT_1, b"");
    assert_eq!(systems.heads(0, first)[0].kind, NOT_AVAILABLE);
    let refused = [1, 2].map(|system| systems.status(system).counters);
    assert_eq!((refused[0].nobody_there, refused[1].foreign_senders), (1, 0), "by the second router");
    systems.sends(1, second, 21, PILOT_3, PILOT_2, b"");
    assert_eq!(systems.heads(2, third)[0].from.0, PILOT_2);
}

#[test]
fn another_router_has_no_names_but_its_systems() {
    let mut systems = Systems::new(2);
    let (first, second) = (systems.connect(0), systems.connect(1));
    assert_eq!(systems.registers(1, second, PILOT_2), OK);
    // A client of system 1 has a mailbox there under the name of another system: it is not known beyond.
    assert_eq!(systems.registers(0, first, PILOT_3), OK);
    systems.sends(1, second, 21, PILOT_3, PILOT_2, b"");
    assert_eq!(systems.heads(1, second)[0].kind, NOT_AVAILABLE);
    // It cannot send in a name of system 2 to system 2.
    systems.sends(0, first, 21, PILOT_2, 0x0277_0000, b"");
    assert!(systems.heads(1, second).is_empty());
    assert_eq!(systems.status(1).counters.foreign_senders, 1);
    // Nor does a router take packages in its own system's names from a link.
    let [(_, here), (_, there)] = systems.links[0];
    systems.sends(1, second, 21, PILOT_1, PILOT_2, b"");
    let forged = Head::new(21, MailboxName(PILOT_1), MailboxName(0x0177_0000)).to_bytes();
    systems.routers[0].received(here, &forged, 0);
    assert_eq!(systems.status(0).counters.foreign_senders, 1);
    assert!(systems.routers[1].place_of_link(there).is_none());
}

#[test]
fn a_link_to_a_router_of_the_same_system_is_refused() {
    let mut systems = Systems::new(1);
    systems.add(1);
    systems.link(0, 1);
    let [(_, here), _] = systems.links[0];
    assert_eq!(systems.routers[0].next_ending(), Some((here, Ending::SameSystem)));
}

#[test]
fn only_a_connection_without_mailboxes_announces_a_system() {
    let mut systems = Systems::new(1);
    let client = systems.connect(0);
    systems.registers(0, client, PILOT_1);
    systems.sends(0, client, ROUTER, 0, 0, &7u32.to_le_bytes());
    let other = systems.connect(0);
    for (body, kind) in [(300u32, ERROR), (1, ERROR), (7, OK), (8, ERROR)] {
        systems.sends(0, other, ROUTER, 0, 0, &body.to_le_bytes());
        assert_eq!(systems.heads(0, other)[0].kind, kind, "system {body}");
    }
    assert_eq!(systems.heads(0, client)[0].kind, ERROR);
    assert_eq!(systems.registers(0, other, PILOT_2), ERROR, "system 7 has no mailboxes of system 2");
    assert_eq!(systems.registers(0, other, 0x0718_0000), OK);
}

#[test]
fn a_name_that_the_other_router_refuses_is_asked_for_again() {
    let mut systems = Systems::new(2);
    let (first, other) = (systems.connect(0), systems.connect(1));
    // Somebody has it there.
    assert_eq!(systems.registers(1, other, PILOT_1), OK);
    assert_eq!(systems.registers(0, first, PILOT_1), OK);
    assert_eq!(systems.status(0).counters.names_refused, 1);
    systems.sends(1, other, UNREGISTER, 0, 0, &PILOT_1.to_le_bytes());
    systems.now += 5_000;
    systems.routers.iter_mut().for_each(|router| router.round(5_000));
    systems.settle();
    systems.sends(1, other, 21, PILOT_1, PILOT_2, b"");
    assert!(systems.heads(0, first).iter().any(|head| head.kind == 21));
}

/// Another client has all these names at first. They are more than may be asked for at once.
#[test]
fn many_refused_names_are_all_registered_once_they_are_free() {
    const NAMES: u32 = 600;
    let mut systems = Systems::new(2);
    let (first, ghost) = (systems.connect(0), systems.connect(1));
    for instance in 0..NAMES {
        let name = PILOT_1 + instance;
        assert_eq!(systems.registers(1, ghost, name), OK);
        assert_eq!(systems.registers(0, first, name), OK);
    }
    assert_eq!(systems.status(0).counters.names_refused, u64::from(NAMES));
    systems.routers[1].disconnect(ghost, Ending::Left, 0);
    systems.routers[0].round(5_000);
    systems.settle();
    let names = systems.status(1).clients.iter().map(|client| client.names.len()).sum::<usize>();
    assert_eq!((names, systems.status(1).counters.answers_lost), (NAMES as usize, 0));
}

/// Its rounds and those of the other router are as far apart as they happen to be.
#[test]
fn an_idle_link_does_not_depend_on_the_others_rounds() {
    let mut systems = Systems::new(2);
    for round in 1..10 {
        systems.now = round * 5_000;
        systems.routers[0].round(systems.now);
        systems.settle();
        assert!(systems.routers[0].next_ending().is_none(), "round {round}");
    }
}

/// Systems 2 and 3 both have a link to system 1, which knows the mailboxes of both.
#[test]
fn packages_of_one_link_do_not_leave_by_another() {
    let mut systems = Systems::new(1);
    let [second, third] = [2u32, 3].map(|system| {
        let connection = systems.connect(0);
        systems.sends(0, connection, ROUTER, 0, 0, &system.to_le_bytes());
        assert_eq!(systems.registers(0, connection, system << 24 | 0x18_0000), OK);
        connection
    });
    systems.sends(0, second, 21, PILOT_3, PILOT_2, b"");
    assert!(systems.heads(0, third).is_empty());
    assert_eq!(systems.heads(0, second)[0].kind, NOT_AVAILABLE);
}

#[test]
fn a_link_to_one_system_brings_nothing_of_another() {
    let mut systems = Systems::new(1);
    systems.add(2);
    systems.routers[0].set_links(1, vec![BTreeSet::from([2])]);
    systems.link(0, 1);
    let client = systems.connect(0);
    assert_eq!(systems.registers(0, client, PILOT_1), OK);
    let [(_, here), _] = systems.links[0];
    for (from, came) in [(PILOT_3, 0), (PILOT_2, 1)] {
        let head = Head::new(-6, MailboxName(PILOT_1), MailboxName(from));
        systems.routers[0].received(here, &head.to_bytes(), 0);
        assert_eq!(systems.heads(0, client).len(), came, "{from:#x}");
    }
}

/// So that it does not wait for the next event.
#[test]
fn a_mailbox_that_goes_with_its_client_wakes_its_link() {
    let mut systems = Systems::new(2);
    let first = systems.connect(0);
    assert_eq!(systems.registers(0, first, PILOT_1), OK);
    while systems.routers[0].next_awake().is_some() {}
    systems.routers[0].disconnect(first, Ending::Left, 0);
    assert!(systems.routers[0].has_awake());
}

/// The other router asks for signs of life, and is gone if nothing comes for a round.
#[test]
fn links_answer_for_their_life_and_end_in_silence() {
    let mut systems = Systems::new(2);
    for now in [5_000, 10_000, 15_000] {
        systems.now = now;
        systems.routers.iter_mut().for_each(|router| router.round(now));
        systems.settle();
        assert!(systems.routers.iter_mut().all(|router| router.next_ending().is_none()));
    }
    let [(_, here), _] = systems.links[0];
    systems.links.clear();
    systems.routers[0].round(20_000);
    assert_eq!(systems.routers[0].next_ending(), None);
    systems.routers[0].round(25_000);
    assert_eq!(systems.routers[0].next_ending(), Some((here, Ending::Silent)));
}

/// This holds even while that link is not open: the router of the link to all others would not pass its packages on.
#[test]
fn a_link_that_names_a_system_takes_precedence() {
    let peer = PEER.parse().unwrap();
    let mut router = Router::new(Limits::default(), 0);
    router.set_links(1, vec![BTreeSet::new(), BTreeSet::from([3])]);
    let to_all = router.link(0, peer, None, 0).unwrap();
    let client = router.connect(peer, 0).unwrap();
    let send = |router: &mut Router, to: u32| {
        let head = Head::new(-6, MailboxName(to), MailboxName(PILOT_1));
        router.received(client, &head.to_bytes(), 0);
    };
    let sent =
        |router: &Router, link: Connection| router.status(0).clients[link.0 as usize].counters.packages_out;
    send(&mut router, PILOT_3);
    assert_eq!((sent(&router, to_all), router.status(0).counters.nobody_there), (0, 1));
    let to_third = router.link(1, peer, None, 0).unwrap();
    send(&mut router, PILOT_3);
    send(&mut router, PILOT_2);
    assert_eq!((sent(&router, to_all), sent(&router, to_third)), (1, 1));
    // Nor does the link to all others bring packages of that system.
    assert_eq!(send_to_pilot(&mut router, to_all, PILOT_2), 0);
    assert_eq!(send_to_pilot(&mut router, to_all, PILOT_3), 1);
    assert_eq!(send_to_pilot(&mut router, to_third, PILOT_3), 0);
}

/// How many packages in this name a link brought that it may not bring.
fn send_to_pilot(router: &mut Router, link: Connection, from: u32) -> u64 {
    let foreign = |router: &Router| router.status(0).counters.foreign_senders;
    let before = foreign(router);
    router.received(link, &Head::new(-6, MailboxName(PILOT_1), MailboxName(from)).to_bytes(), 0);
    foreign(router) - before
}
