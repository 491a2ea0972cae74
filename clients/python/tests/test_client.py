"""Clients of a router that runs: it is killed and comes back."""

import asyncio
import threading
import time
import unittest
from typing import ClassVar

from rtnet_packages import Failed, NameTaken, NotAvailable, NotConnected, Router, TimedOut, aio

from .running import RunningRouter

PATIENCE = 30.0
#: The priority of the class, which a reply has, too.
OF_PILOT = 247


class Clients(unittest.TestCase):
    router: ClassVar[RunningRouter]

    @classmethod
    def setUpClass(cls) -> None:
        cls.router = RunningRouter()

    @classmethod
    def tearDownClass(cls) -> None:
        cls.router.kill()

    def test_the_most_urgent_package_is_received_first(self) -> None:
        with Router(*self.router.place) as a, Router(*self.router.place) as b:
            sender, receiver = a.mailbox("0.Pilot.0"), b.mailbox("0.Odometry.0")
            self.assertIsNone(receiver.receive(timeout=0))
            for priority in [5, 200, 5]:
                sender.send("0.Odometry.0", -6, bytes([priority]), priority)
            sender.send("0.Odometry.0", -6, b"last", 0)
            time.sleep(0.1)
            seen = [receiver.receive(PATIENCE) for _ in range(4)]
            self.assertEqual([package.body for package in seen if package], [b"\xc8", b"\x05", b"\x05", b"last"])

    def test_a_call_is_answered_or_says_why_not(self) -> None:
        with Router(*self.router.place) as a, Router(*self.router.place) as b:
            asks, serves = a.mailbox("0.Pilot.1"), b.mailbox("0.Odometry.1")

            def serve() -> None:
                for kind in [-21, -1]:
                    command = serves.receive(PATIENCE)
                    assert command is not None
                    serves.reply(command, kind, command.body[::-1])

            thread = threading.Thread(target=serve)
            thread.start()
            reply = asks.call("0.Odometry.1", 21, b"abc", timeout=PATIENCE)
            self.assertEqual((reply.body, reply.priority), (b"cba", OF_PILOT))
            with self.assertRaises(Failed):
                asks.call("0.Odometry.1", 21, timeout=PATIENCE)
            thread.join()
            with self.assertRaises(NotAvailable):
                asks.call("0.Odometry.99", 21, timeout=PATIENCE)
            with self.assertRaises(TimedOut):
                asks.call("0.Odometry.1", 21, timeout=0.05)

    def test_a_name_has_one_owner_until_it_is_closed(self) -> None:
        with Router(*self.router.place) as a, Router(*self.router.place) as b:
            first = a.mailbox("0.Pilot.2")
            with self.assertRaises(NameTaken):
                b.mailbox("0.Pilot.2")
            first.close()
            deadline = time.monotonic() + PATIENCE
            while True:
                try:
                    b.mailbox("0.Pilot.2")
                    break
                except NameTaken:
                    self.assertLess(time.monotonic(), deadline)


class Restarts(unittest.TestCase):
    def test_mailboxes_are_registered_again_after_a_restart(self) -> None:
        router = RunningRouter()
        try:
            with Router(*router.place) as a, Router(*router.place) as b:
                sender, receiver = a.mailbox("0.Pilot.0"), b.mailbox("0.Odometry.0")
                for restart in range(5):
                    router.kill()
                    deadline = time.monotonic() + PATIENCE
                    while a.is_connected:
                        self.assertLess(time.monotonic(), deadline)
                        time.sleep(0.001)
                    with self.assertRaises(NotConnected):
                        sender.send("0.Odometry.0", -6)
                    router.start()
                    for client in (a, b):
                        self.assertTrue(client.wait_until_connected(PATIENCE))
                    sender.send("0.Odometry.0", -6, bytes([restart]))
                    package = receiver.receive(PATIENCE)
                    self.assertEqual(package.body if package else None, bytes([restart]))
                # A router that is killed may take a connection with it that it has not accepted yet.
                self.assertGreaterEqual(a.connections, 6)
        finally:
            router.kill()

    def test_nobody_listens_is_an_error_at_once(self) -> None:
        router = RunningRouter()
        router.kill()
        with self.assertRaises(OSError):
            Router(*router.place)


class Asyncio(unittest.TestCase):
    def test_the_same_holds_in_an_event_loop(self) -> None:
        router = RunningRouter()
        try:
            asyncio.run(self.exchange(router))
        finally:
            router.kill()

    async def exchange(self, router: RunningRouter) -> None:
        async with aio.Router(*router.place) as a, aio.Router(*router.place) as b:
            asks, serves = await a.mailbox("0.Pilot.0"), await b.mailbox("0.Odometry.0")
            with self.assertRaises(NameTaken):
                await b.mailbox("0.Pilot.0")

            async def serve() -> None:
                command = await serves.receive(PATIENCE)
                assert command is not None
                serves.reply(command, -21, command.body[::-1])

            reply, _ = await asyncio.gather(asks.call("0.Odometry.0", 21, b"abc", timeout=PATIENCE), serve())
            self.assertEqual((reply.body, reply.priority), (b"cba", OF_PILOT))
            with self.assertRaises(NotAvailable):
                await asks.call("0.Odometry.99", 21, timeout=PATIENCE)
            self.assertIsNone(await asks.receive(timeout=0.01))
            router.kill()
            while a.is_connected or b.is_connected:
                await asyncio.sleep(0.001)
            with self.assertRaises(NotConnected):
                asks.send("0.Odometry.0", -6)
            router.start()
            for client in (a, b):
                self.assertTrue(await client.wait_until_connected(PATIENCE))
            asks.send("0.Odometry.0", -6, b"again")
            package = await serves.receive(PATIENCE)
            self.assertEqual(package.body if package else None, b"again")


if __name__ == "__main__":
    unittest.main()
