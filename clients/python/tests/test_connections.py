"""Connections that end, are silent, or take nothing; and many mailboxes after a restart."""

import asyncio
import socket
import threading
import time
import unittest
from typing import Callable, List

from rtnet_packages import OK, Full, Mailbox, NotConnected, Router, aio
from rtnet_packages.wire import LIFESIGN, Decoder, control

from .fake import FakeRouter
from .leaving import leave, patient
from .running import RunningRouter

PATIENCE = 30.0
MANY = 300
BODY = bytes(200_000)
#: Packages of nearly 4 MiB.
COUNT = 20


class ManyMailboxes(unittest.TestCase):
    def test_300_mailboxes_come_back_after_a_restart(self) -> None:
        router = RunningRouter()
        try:
            with Router(*router.place) as client:
                for number in range(MANY):
                    client.mailbox(0x00180001 + number)
                router.kill()
                while client.is_connected:
                    time.sleep(0.001)
                router.start()
                self.assertTrue(client.wait_until_connected(PATIENCE))
                client.mailbox("0.Odometry.0")
        finally:
            router.kill()

    def test_300_come_back_in_an_event_loop(self) -> None:
        router = RunningRouter()
        try:
            asyncio.run(self.restart(router))
        finally:
            router.kill()

    async def restart(self, router: RunningRouter) -> None:
        async with aio.Router(*router.place) as client:
            await asyncio.gather(*(client.mailbox(0x00180001 + number) for number in range(MANY)))
            router.kill()
            while client.is_connected:
                await asyncio.sleep(0.001)
            router.start()
            self.assertTrue(await client.wait_until_connected(PATIENCE))
            await client.mailbox("0.Odometry.0")


class Closing(unittest.TestCase):
    """Before Python 3.12 asyncio.wait_for loses a cancellation that comes together with its result."""

    def test_close_ends_while_packages_come(self) -> None:
        router = RunningRouter()
        try:
            asyncio.run(self.close_again_and_again(router))
        finally:
            router.kill()

    async def close_again_and_again(self, router: RunningRouter) -> None:
        async with aio.Router(*router.place) as other:
            pilot = await other.mailbox("0.Pilot.0")
            for _ in range(40):
                client = aio.Router(*router.place)
                await client.__aenter__()
                await client.mailbox("0.Gps.0")
                closing = asyncio.ensure_future(client.close())
                deadline = time.monotonic() + PATIENCE
                while not closing.done():
                    self.assertLess(time.monotonic(), deadline, "it hangs")
                    pilot.send("0.Gps.0", kind=-5)
                    await asyncio.sleep(0)
                # The name is free once the router has seen the end.
                await asyncio.sleep(0.01)


class BackOff(unittest.TestCase):
    """Rests of 50, 100, 200, 400 and 800 ms: five connections in a second, the user's among them."""

    def test_a_router_that_closes_at_once_is_let_rest(self) -> None:
        with FakeRouter(lambda connection: connection.shutdown(socket.SHUT_RDWR)) as router:
            with Router(*router.place):
                time.sleep(1.0)
            self.assertIn(len(router.accepted), range(2, 7))

    def test_it_is_let_rest_in_an_event_loop(self) -> None:
        async def connect() -> None:
            async with aio.Router(*router.place):
                await asyncio.sleep(1.0)

        with FakeRouter(lambda connection: connection.shutdown(socket.SHUT_RDWR)) as router:
            asyncio.run(connect())
            self.assertIn(len(router.accepted), range(2, 7))

    def test_a_client_that_rests_is_closed_at_once(self) -> None:
        with FakeRouter() as router:
            client = Router(*router.place)
            client._session._rest = PATIENCE
        while client.is_connected:
            time.sleep(0.001)
        began = time.monotonic()
        client.close()
        self.assertLess(time.monotonic() - began, PATIENCE / 2)


class Silence(unittest.TestCase):
    def test_a_silent_router_is_connected_to_again(self) -> None:
        with FakeRouter() as router, Router(*router.place) as client:
            client._session._silence = 0.1
            deadline = time.monotonic() + PATIENCE
            while client.connections < 3:
                self.assertLess(time.monotonic(), deadline)
                time.sleep(0.01)

    def test_it_is_given_up_in_an_event_loop(self) -> None:
        async def connect() -> None:
            async with aio.Router(*router.place) as client:
                client._session._silence = 0.1
                deadline = time.monotonic() + PATIENCE
                while client.connections < 3:
                    self.assertLess(time.monotonic(), deadline)
                    await asyncio.sleep(0.01)

        with FakeRouter() as router:
            asyncio.run(connect())


class RouterThatDoesNotRead(unittest.TestCase):
    def test_a_send_that_takes_too_long_ends_the_connection(self) -> None:
        with FakeRouter() as router, Router(*router.place, timeout=0.2) as client:
            mailbox = Mailbox(client, 7)
            began = time.monotonic()
            with self.assertRaises(NotConnected):
                while time.monotonic() < began + PATIENCE:
                    sent = time.monotonic()
                    mailbox.send("0.Odometry.0", -6, BODY)
            self.assertGreaterEqual(time.monotonic() - sent, 0.2)
            while client.connections < 2:
                time.sleep(0.001)

    def test_an_event_loop_hears_that_it_is_full(self) -> None:
        with FakeRouter() as router:
            asyncio.run(self.fill(router))

    async def fill(self, router: FakeRouter) -> None:
        async with aio.Router(*router.place) as client:
            mailbox = aio.Mailbox(client, 7)
            with self.assertRaises(Full):
                for _ in range(1000):
                    mailbox.send("0.Odometry.0", -6, BODY)
            with self.assertRaises(Full):
                await mailbox.call("0.Odometry.0", 21)
            self.assertLess(client._session.outgoing.size, (4 << 20) + len(BODY) + 100)
            # Once the router has read it sends again.
            while not router.accepted:
                await asyncio.sleep(0.001)
            reading = asyncio.get_running_loop().run_in_executor(None, _read_all, router.accepted[0])
            while client._session.outgoing.waits:
                await asyncio.sleep(0.001)
            mailbox.send("0.Odometry.0", -6)
            self.assertEqual(client.connections, 1)
        await reading


class SlowRouter(unittest.TestCase):
    def test_threads_wait_as_long_as_it_reads_something(self) -> None:
        def slowly(connection: socket.socket) -> None:
            # It never answers. In all it takes 6 s at the least, longer than `timeout`; on a busy host a pause takes longer, too. Its buffer
            # holds several segments of loopback: else the kernel sends by its timer for closed windows only, which takes seconds.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 200_000)
            while connection.recv(COUNT * len(BODY) // 100):
                time.sleep(0.06)

        with FakeRouter(slowly) as router:
            with Router(*router.place, timeout=4.0) as client:
                mailbox, began = Mailbox(client, 7), time.monotonic()
                threads = [threading.Thread(target=mailbox.send, args=["0.Odometry.0", -6, BODY]) for _ in range(COUNT)]
                for thread in threads:
                    thread.start()
                for thread in threads:
                    thread.join(PATIENCE)
                    self.assertFalse(thread.is_alive(), "its package has left")
                self.assertGreater(time.monotonic() - began, 4.0)
                self.assertEqual((client.sent, client.lost, client.connections), (COUNT, 0, 1))

    def test_a_router_that_stops_reading_costs_no_processor_time(self) -> None:
        with FakeRouter(_answer_once) as router:
            with Router(*router.place, timeout=PATIENCE) as client:
                mailbox = Mailbox(client, 7)
                mailbox.send("0.Odometry.0", -6)
                _wait_until(lambda: client._session.outgoing.is_settled)
                threads = [threading.Thread(target=self.send, args=[mailbox]) for _ in range(COUNT)]
                for thread in threads:
                    thread.start()
                _wait_until(lambda: client._blocked > 0)
                self.check()
            for thread in threads:
                thread.join(PATIENCE)

    def test_nor_in_an_event_loop(self) -> None:
        async def exchange() -> None:
            async with aio.Router(*router.place) as client:
                mailbox = aio.Mailbox(client, 7)
                mailbox.send("0.Odometry.0", -6)
                while not client._session.outgoing.is_settled:
                    await asyncio.sleep(0.001)
                for _ in range(COUNT):
                    mailbox.send("0.Odometry.0", -6, BODY)
                began = time.process_time()
                await asyncio.sleep(0.5)
                self.assertLess(time.process_time() - began, 0.2)

        with FakeRouter(_answer_once) as router:
            asyncio.run(exchange())

    def send(self, mailbox: Mailbox) -> None:
        try:
            mailbox.send("0.Odometry.0", -6, BODY)
        except NotConnected:
            # The client is closed.
            pass

    def check(self) -> None:
        began = time.process_time()
        time.sleep(0.5)
        self.assertLess(time.process_time() - began, 0.2)


def _answer_once(connection: socket.socket) -> None:
    """Answers the first questions, and reads nothing any more."""
    decoder, answered = Decoder(), 0
    while answered < 2:
        for package in decoder.feed(connection.recv(1000)):
            if package.kind > 0:
                connection.sendall(package.reply(OK).encode())
                answered += 1


class Leaving(unittest.TestCase):
    def test_packages_before_a_close_arrive(self) -> None:
        router = RunningRouter()
        try:
            leave(self, router, None)
        finally:
            router.kill()

    def test_a_close_does_not_wait_for_senders(self) -> None:
        """Another thread sends until the client is closed: what it has sent arrives."""
        router = RunningRouter()
        try:
            for _ in range(10):
                self.close_while_another_sends(router)
        finally:
            router.kill()

    def close_while_another_sends(self, router: RunningRouter) -> None:
        sent: List[int] = []

        def send() -> None:
            try:
                while True:
                    mailbox.send("0.Odometry.0", -6, bytes(1000))
                    sent.append(1)
            except NotConnected:
                pass

        with Router(*router.place) as other:
            here = other.mailbox("0.Odometry.0", slots=1_000_000)
            client = Router(*router.place)
            mailbox = client.mailbox("0.Pilot.0")
            thread = threading.Thread(target=send)
            thread.start()
            time.sleep(0.02)
            with patient():
                client.close()
            thread.join(PATIENCE)
            self.assertFalse(thread.is_alive())
            self.assertEqual(client.lost, 0)
            _wait_until(lambda: len(here._session.inboxes[here.name]) == len(sent))


class SignsOfLife(unittest.TestCase):
    """A router asks for a sign of life while nearly 4 MiB of packages wait for it. Its kernel and the client's have a part of them."""

    #: Packages that may be before the answer.
    BEFORE = (2 << 20) // len(BODY)

    def test_threads_that_wait_do_not_keep_it_back(self) -> None:
        with FakeRouter() as router, Router(*router.place, timeout=PATIENCE) as client:
            mailbox = Mailbox(client, 7)
            threads = [threading.Thread(target=mailbox.send, args=["0.Odometry.0", -6, BODY]) for _ in range(COUNT)]
            for thread in threads:
                thread.start()
            _wait_until(lambda: bool(router.accepted) and client._blocked > 0)
            # Each that has not left waits.
            _wait_until(lambda: client.sent + client._blocked == COUNT)
            kinds = _kinds_after_a_question(router.accepted[0], lambda: client._session.outgoing.is_asked)
            for thread in threads:
                thread.join()
            self.assertEqual((client.sent, client.lost, client.connections), (COUNT, 0, 1))
        self.check(kinds)

    def test_the_queue_of_an_event_loop_does_not_keep_it_back(self) -> None:
        async def exchange() -> None:
            async with aio.Router(*router.place) as client:
                mailbox = aio.Mailbox(client, 7)
                for _ in range(COUNT):
                    mailbox.send("0.Odometry.0", -6, BODY)
                await asyncio.to_thread(_wait_until, lambda: bool(router.accepted))
                is_asked = lambda: client._session.outgoing.is_asked
                kinds = await asyncio.to_thread(_kinds_after_a_question, router.accepted[0], is_asked)
                self.assertEqual((client.sent, client.lost, client.connections), (COUNT, 0, 1))
                self.check(kinds)

        with FakeRouter() as router:
            asyncio.run(exchange())

    def check(self, kinds: List[int]) -> None:
        self.assertEqual(kinds.count(-6), COUNT)
        self.assertLess(kinds[: kinds.index(OK)].count(-6), self.BEFORE)


def _wait_until(is_so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not is_so():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def _kinds_after_a_question(connection: socket.socket, is_asked: Callable[[], bool]) -> List[int]:
    """Asks for a sign of life, and reads all, once the client has heard that; the kinds of all packages."""
    connection.sendall(control(LIFESIGN).encode())
    _wait_until(is_asked)
    decoder = Decoder()
    kinds: List[int] = []
    connection.settimeout(PATIENCE)
    while kinds.count(-6) < COUNT or OK not in kinds:
        kinds += [package.kind for package in decoder.feed(connection.recv(1 << 20))]
    return kinds


def _read_all(connection: socket.socket) -> None:
    while connection.recv(1 << 20):
        pass


if __name__ == "__main__":
    unittest.main()
