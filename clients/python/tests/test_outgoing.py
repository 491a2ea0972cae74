"""The bytes of a session on their way to the router."""

import struct
import unittest
from typing import List, Tuple

from rtnet_packages import OK, Package
from rtnet_packages.outgoing import BATCH, REASONS
from rtnet_packages.session import CONFIRM_EVERY, Session
from rtnet_packages.wire import ACCOUNT, DELETE, DELETE_ANSWERED, LIFESIGN, REGISTER, Decoder, control

DATA = Package(9, 7, -6, bytes(984))
SIZE = len(DATA.encode())


def session() -> Session:
    it = Session()
    it.connected(0.0)
    return it


def kinds(data: bytes) -> List[int]:
    return [package.kind for package in Decoder().feed(data)]


def written(it: Session, now: float) -> bytes:
    """All that it writes now."""
    data = b""
    while part := bytes(it.to_write(now)):
        it.outgoing.wrote(len(part))
        data += part
    return data


def answers(it: Session, data: bytes, *counts: int, waiting: int = 0) -> None:
    """The router answers the questions in these bytes, with this account. It may know more reasons, or fewer."""
    for package in Decoder().feed(data):
        if package.kind == ACCOUNT:
            it.step(package.reply(OK, struct.pack(f"<{1 + len(counts)}Q", waiting, *counts)).encode(), 0.0)
        elif package.kind == DELETE_ANSWERED:
            it.step(package.reply(OK).encode(), 0.0)


def fate(it: Session) -> Tuple[int, int, int]:
    return it.outgoing.sent, it.outgoing.lost, it.outgoing.unconfirmed


class Overtaking(unittest.TestCase):
    def test_an_answer_waits_for_one_batch(self) -> None:
        it = session()
        for _ in range(1000):
            it.outgoing.put(DATA.encode())
        begun = len(it.to_write(0.0))
        self.assertLess(begun, BATCH + SIZE + 100)
        it.outgoing.wrote(100)
        for _ in range(1000):
            it.outgoing.say(it.step(control(LIFESIGN).encode(), 0.0))
        rest = written(it, 0.0)
        self.assertEqual(kinds(DATA.encode()[:100] + rest[: begun - 100])[0], DATA.kind)
        self.assertEqual(rest[begun - 100 :][:32], control(OK).encode() + DATA.encode()[:16], "one answer is enough")
        self.assertEqual(it.outgoing.sent, 1000)


    def test_urgent_packages_overtake_the_others(self) -> None:
        it = session()
        for number, priority in enumerate([0, 5, 0, 5, 255]):
            it.outgoing.put(Package(9, 7, -6, bytes(8), priority, number).encode())
        it.outgoing.put(control(DELETE, bytes(4)).encode(), counts=False)
        it.outgoing.put(Package(9, 7, -6, bytes(8), 255, 6).encode())
        packages = Decoder().feed(written(it, 0.0))
        left = [package.id if package.kind == -6 else package.kind for package in packages]
        self.assertEqual(left, [4, 1, 3, 0, 2, DELETE, 6, ACCOUNT, DELETE_ANSWERED], "none overtakes a deletion")


class Fate(unittest.TestCase):
    def test_sent_packages_are_unconfirmed_until_the_router_answers(self) -> None:
        it = session()
        it.outgoing.put(DATA.encode())
        first = written(it, 0.0)
        self.assertEqual(kinds(first), [-6, ACCOUNT, DELETE_ANSWERED])
        it.outgoing.put(DATA.encode())
        it.outgoing.put(DATA.encode())
        self.assertEqual(kinds(written(it, CONFIRM_EVERY)), [-6, -6], "one question waits already")
        answers(it, first)
        self.assertEqual(written(it, 0.001), b"", "not that often")
        second = written(it, CONFIRM_EVERY)
        self.assertEqual(kinds(second), [ACCOUNT, DELETE_ANSWERED], "the other two are asked for then")
        it.lost()
        self.assertEqual(fate(it), (3, 0, 2))
        it.connected(2.0)
        it.outgoing.put(DATA.encode())
        answers(it, written(it, 2.0))
        self.assertEqual(written(it, 3.0), b"", "an idle client asks nothing")
        it.lost()
        self.assertEqual(fate(it), (4, 0, 2))

    def test_packages_that_have_not_left_are_lost(self) -> None:
        it = session()
        packages = [it.outgoing.put(DATA.encode()) for _ in range(5)]
        it.to_write(0.0)
        it.outgoing.wrote(2 * SIZE + 50)
        self.assertEqual([package.has_left for package in packages], [True, True, None, None, None])
        it.lost()
        self.assertEqual(fate(it), (2, 3, 2))
        self.assertEqual((it.outgoing.size, it.outgoing.waits), (0, False))
        self.assertEqual([package.has_left for package in packages], [True, True, False, False, False])

    def test_packages_that_wait_at_the_router_are_unconfirmed(self) -> None:
        it = session()
        for _ in range(3):
            it.outgoing.put(DATA.encode())
        answers(it, written(it, 0.0), waiting=2)
        self.assertEqual(written(it, 0.09), b"")
        self.assertAlmostEqual(it.asks_at(), 0.1)
        again = written(it, 0.1)
        self.assertEqual(kinds(again), [ACCOUNT, DELETE_ANSWERED])
        answers(it, again, 0, 0, 0, 0, 0, 0, 99, waiting=1)
        it.lost()
        self.assertEqual(fate(it), (3, 0, 1))

    def test_a_question_that_is_due_is_waited_for(self) -> None:
        it = session()
        for _ in range(2):
            it.outgoing.put(DATA.encode())
            answers(it, written(it, 0.0))
        self.assertAlmostEqual(it.asks_at(), CONFIRM_EVERY)
        it.is_closed = True
        self.assertEqual(it.asks_at(), 0.0)

    def test_a_deletion_follows_the_packages_before_it(self) -> None:
        it = session()
        it.outgoing.put(DATA.encode())
        it.outgoing.put(control(DELETE, bytes(4)).encode(), counts=False)
        # It may register the same name again.
        it.outgoing.say(control(REGISTER, bytes(4)).encode())
        self.assertEqual(kinds(written(it, 0.0)), [-6, DELETE, REGISTER, ACCOUNT, DELETE_ANSWERED])
        it.outgoing.put(DATA.encode())
        it.outgoing.say(control(REGISTER, bytes(4)).encode())
        self.assertEqual(kinds(written(it, 0.0)), [REGISTER, -6])
        it.outgoing.put(control(DELETE, bytes(4)).encode(), counts=False)
        it.lost()
        self.assertEqual(fate(it), (2, 0, 2))

    def test_an_early_answer_confirms_no_more_than_has_left(self) -> None:
        it = session()
        it.outgoing.put(DATA.encode())
        answers(it, bytes(it.to_write(0.0)))
        it.lost()
        self.assertEqual(fate(it), (0, 1, 0))


class Accounts(unittest.TestCase):
    def test_accounts_are_summed_over_connections(self) -> None:
        it = session()
        for now, counts in [(0.0, (1, 0, 2, 0, 0)), (1.0, (3, 0, 2, 1, 9))]:
            it.outgoing.put(DATA.encode())
            answers(it, written(it, now), *counts)
        self.assertEqual(it.outgoing.lost_at_router, dict(zip(REASONS, (3, 0, 2, 1, 9, 0))))
        it.lost()
        it.connected(2.0)
        it.outgoing.put(DATA.encode())
        first = written(it, 2.0)
        answers(it, first, 1, 1, 1, 1, 1)
        # A router that counts down, and one that answers with an error, change nothing.
        it.outgoing.put(DATA.encode())
        answers(it, written(it, 3.0), 0, 0, 0, 0, 0)
        self.assertEqual(it.outgoing.lost_at_router, dict(zip(REASONS, (4, 1, 3, 2, 10, 0))))

    def test_a_router_of_another_make_has_no_account(self) -> None:
        it = session()
        it.outgoing.put(DATA.encode())
        account, confirmation = Decoder().feed(written(it, 0.0))[-2:]
        self.assertEqual((account.kind, confirmation.kind), (ACCOUNT, DELETE_ANSWERED))
        # It ignores the first, as all that it does not know.
        it.step(confirmation.reply(OK).encode(), 0.0)
        it.lost()
        self.assertEqual((fate(it), sum(it.outgoing.lost_at_router.values())), ((1, 0, 0), 0))


if __name__ == "__main__":
    unittest.main()
