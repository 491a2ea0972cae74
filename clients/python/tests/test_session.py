"""The session of a client, at given times."""

import unittest
from typing import List, Optional, Sequence

from rtnet_packages import ERROR, NOT_AVAILABLE, OK, Failed, NameTaken, NotAvailable, NotConnected, Package, ProtocolError, TimedOut
from rtnet_packages.errors import checked
from rtnet_packages.inbox import Inbox
from rtnet_packages.mailbox import Sender
from rtnet_packages.session import Session
from rtnet_packages.wire import DELETE, LIFESIGN, REGISTER, Decoder, control


def session(names: Sequence[int] = ()) -> Session:
    """A session whose connection begins at 0 s, and whose router has registered these names."""
    it = Session()
    it.connected(0.0)
    for name in names:
        answer(it, it.add(name, 4))
    return it


def answer(it: Session, data: bytes, kind: int = OK, now: float = 0.0) -> bytes:
    """Answers all requests in the order of their bytes; returns what the session sends then."""
    return it.step(b"".join(request.reply(kind).encode() for request in requests(data)), now)


def requests(data: bytes) -> List[Package]:
    """The requests of a session; all of them register a name."""
    packages = Decoder().feed(data)
    assert all(package.kind == REGISTER for package in packages)
    return packages


def names(data: bytes) -> List[int]:
    return [int.from_bytes(request.body, "little") for request in requests(data)]


class Kept(Sender):
    """A mailbox whose packages stay here."""

    def __init__(self, of: Session, number: int) -> None:
        super().__init__(of, number)
        self.sent: List[Package] = []

    def forward(self, package: Package) -> None:
        self.sent.append(package)


class Packages(unittest.TestCase):
    def test_a_full_inbox_refuses_and_counts(self) -> None:
        inbox = Inbox(3)
        for number, priority in enumerate([1, 9, 1, 9]):
            inbox.put(Package(1, 2, 0, bytes([number]), priority))
        taken = [inbox.take() for _ in range(4)]
        self.assertEqual([package.body[0] if package else None for package in taken], [1, 0, 2, None])
        self.assertEqual(inbox.refused, 1)

    def test_a_package_has_the_priority_of_its_senders_class(self) -> None:
        of_class = {0x00: 255, 0x18: 247, 0x80: 191, 0xFF: 135}
        for number, priority in of_class.items():
            mailbox = Kept(session(), number << 16)
            mailbox.send("0.Odometry.0", -6)
            mailbox.send("0.Odometry.0", -6, priority=0)
            self.assertEqual([package.priority for package in mailbox.sent], [priority, 0])

    def test_a_command_that_no_mailbox_takes_is_answered(self) -> None:
        it = session([7])
        command = Package(7, 9, 21, priority=5, id=3)
        data = b"".join(Package(7, 9, -6).encode() for _ in range(4))
        self.assertEqual(it.step(data + command.encode(), 0.0), command.reply(NOT_AVAILABLE).encode())
        self.assertEqual(it.inboxes[7].refused, 1)
        stray = Package(8, 9, 21, id=4)
        self.assertEqual(it.step(Package(8, 9, -6).encode() + stray.encode(), 0.0), stray.reply(NOT_AVAILABLE).encode())
        self.assertEqual((it.strays, it.answers_lost), (2, 0))
        # The router asks, and does not read; a request that keeps its place waits, too.
        for waits in [b"", control(DELETE).encode()]:
            if waits:
                it.outgoing.put(waits, counts=False)
            before = it.answers_lost
            while it.answers_lost == before:
                it.outgoing.say(it.step(stray.encode() * 100, 0.0))
                self.assertLess(it.outgoing.own, 70_000)

    def test_a_lifesign_is_answered(self) -> None:
        it = session()
        self.assertEqual(it.step(control(LIFESIGN).encode(), 0.0), b"")
        self.assertEqual(bytes(it.to_write(0.0)), control(OK).encode())

    def test_a_reply_is_the_calls_and_data_is_the_mailboxs(self) -> None:
        it = session([7])
        call, data = it.call(Package(9, 7, 21))
        command = Decoder().feed(data)[0]
        it.step(Package(7, 9, -6, b"other id", id=command.id ^ 1).encode(), 0.0)
        it.step(Package(7, 8, 0, b"another's", id=command.id).encode(), 0.0)
        it.step(command.reply(-21, b"the reply").encode(), 0.0)
        it.step(command.reply(-21, b"and again").encode(), 0.0)
        reply = it.end(call)
        self.assertEqual(reply.body if reply else None, b"the reply")
        self.assertEqual(len(it.inboxes[7]), 3)
        it.step(Package(99, 8, 0).encode(), 0.0)
        self.assertEqual(it.strays, 1)

    def test_replies_that_are_errors_are_raised(self) -> None:
        self.assertEqual(checked(Package(1, 2, -6), 2, 1.0).kind, -6)
        for kind, error in [(ERROR, Failed), (NOT_AVAILABLE, NotAvailable)]:
            with self.assertRaises(error):
                checked(Package(1, 2, kind), 2, 1.0)
        with self.assertRaises(TimedOut):
            checked(None, 2, 1.0)


class Registrations(unittest.TestCase):
    def test_a_name_is_one_mailbox(self) -> None:
        it = session([7])
        with self.assertRaises(NameTaken):
            it.add(7, 1)
        with self.assertRaises(ValueError):
            it.add(0, 1)
        self.assertEqual(names(it.connected(1.0)), [7])

    def test_a_thousand_mailboxes_are_registered_again(self) -> None:
        all_names = list(range(1, 1001))
        it = session(all_names)
        data, seen = it.connected(1.0), []
        while data:
            asked = requests(data)
            self.assertLessEqual(len(asked), 128)
            self.assertEqual(len({request.id for request in asked}), len(asked))
            seen += names(data)
            self.assertFalse(it.is_ready)
            data = answer(it, data, now=1.0)
        self.assertEqual(seen, all_names)
        self.assertTrue(it.is_ready)

    def test_each_answer_makes_room_for_one_request(self) -> None:
        it = session()
        sent = [it.add(name, 1) for name in range(1, 301)]
        self.assertEqual([len(names(data)) for data in sent], [1] * 128 + [0] * 172)
        self.assertEqual(names(answer(it, sent[0])), [129])
        self.assertEqual(names(answer(it, sent[1] + sent[2])), [130, 131])
        self.assertTrue(it.registered(3))
        self.assertIsNone(it.registered(4))

    def test_lost_answers_are_asked_for_again(self) -> None:
        it = session()
        first, second, third = (it.add(name, 1) for name in [1, 2, 3])
        again = answer(it, third)
        self.assertEqual(names(again), [1, 2])
        self.assertEqual(answer(it, first + second), b"", "the ids are old ones")
        answer(it, again)
        self.assertTrue(it.is_ready)

    def test_late_answers_are_not_those_of_new_mailboxes(self) -> None:
        it = session()
        old = it.add(7, 1)
        self.assertTrue(it.remove(7), "the router may have it")
        new = it.add(7, 1)
        answer(it, old)
        self.assertIsNone(it.registered(7))
        answer(it, new, ERROR)
        with self.assertRaises(NameTaken):
            it.settle(7, 1.0)
        self.assertEqual(it.remove(7), b"", "another connection has it")

    def test_unsent_requests_go_with_their_mailbox(self) -> None:
        it = session()
        sent = b"".join(it.add(name, 1) for name in range(1, 131))
        self.assertEqual(it.remove(129), b"")
        self.assertEqual(names(answer(it, sent)), [130])

    def test_refused_names_are_asked_for_again_under_traffic(self) -> None:
        it = session([1])
        it.inboxes[2] = Inbox(1)
        data = it.connected(100.0)
        first, second = (request.encode() for request in requests(data))
        answer(it, first, OK, 100.0)
        answer(it, second, ERROR, 100.0)
        asked = []
        for tenth in range(1, 21):
            now = 100.0 + tenth / 10
            data = it.step(Package(1, 9, 0).encode(), now)
            if data:
                self.assertEqual(names(data), [2])
                self.assertIs(it.registered(2), False, "its old answer holds")
                asked.append(tenth)
                answer(it, data, ERROR, now)
        self.assertEqual(asked, [5, 10, 15, 20])
        answer(it, it.step(None, 102.5), OK, 102.6)
        self.assertTrue(it.is_ready)

    def test_a_name_is_not_asked_for_twice_at_a_time(self) -> None:
        it = session()
        answer(it, it.add(7, 1), ERROR)
        self.assertEqual([names(it.step(None, now)) for now in [0.5, 1.0, 1.5]], [[7], [], []])


class Connections(unittest.TestCase):
    def rests(self, it: Session, count: int) -> List[float]:
        rests = []
        for _ in range(count):
            rests.append(it.rest())
            it.connected(0.0)
            with self.assertRaises(OSError):
                it.step(b"", 0.0)
            it.lost()
        return rests

    def test_rests_grow_until_bytes_have_come(self) -> None:
        it = session()
        self.assertEqual(self.rests(it, 7), [0.05, 0.1, 0.2, 0.4, 0.8, 1.0, 1.0])
        it.connected(0.0)
        it.step(control(LIFESIGN).encode(), 0.0)
        self.assertEqual(self.rests(it, 2), [0.05, 0.1])

    def test_a_silent_router_is_given_up_after_15_s(self) -> None:
        it = session()
        self.assertEqual(it.step(None, 14.9), b"")
        it.step(control(LIFESIGN).encode(), 14.9)
        self.assertEqual(it.step(None, 29.8), b"")
        with self.assertRaisesRegex(OSError, "nothing for 15"):
            it.step(None, 29.9)
        it.connected(40.0)
        self.assertEqual(it.step(None, 54.9), b"")

    def test_late_bytes_are_no_silence(self) -> None:
        it = session()
        it.step(control(LIFESIGN).encode(), 60.0)
        self.assertTrue(it.outgoing.is_asked)

    def test_no_wait_is_longer_than_until_the_next_deadline(self) -> None:
        it = session()
        self.assertAlmostEqual(it.wait(0.1), 0.4)
        self.assertEqual(it.wait(0.6), 0.0)
        it.step(None, 14.8)
        self.assertAlmostEqual(it.wait(14.8), 0.2)

    def test_without_a_connection_nothing_is_ready_or_added(self) -> None:
        def fails(it: Session, why: str, name: Optional[int] = None) -> None:
            with self.assertRaisesRegex(NotConnected, why):
                it.settle(7, 1.0) if name is None else it.add(name, 1)

        it = session([7])
        it.lost()
        self.assertFalse(it.is_ready)
        fails(it, "connects again")
        fails(it, "connects again", 8)
        it.is_closed = True
        fails(it, "closed", 8)
        self.assertEqual(names(it.connected(1.0)), [7])
        fails(it, "within 1.0 s")

    def test_bytes_that_are_no_package_end_the_connection(self) -> None:
        it = session()
        it.step(bytes(15), 0.0)
        with self.assertRaises(ProtocolError):
            it.step(bytes(1), 0.0)
        it.connected(0.0)
        it.step(control(LIFESIGN).encode(), 0.0)
        self.assertTrue(it.outgoing.is_asked, "it begins with a new package")


if __name__ == "__main__":
    unittest.main()
