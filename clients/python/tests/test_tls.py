"""Clients of a router at an address with keys."""

import asyncio
import os
import ssl
import subprocess
import tempfile
import unittest
from pathlib import Path
from typing import ClassVar
from unittest import mock

from rtnet_packages import NotConnected, Router, aio, keys

from .leaving import leave
from .running import RunningRouter

PATIENCE = 30.0


class Tls(unittest.TestCase):
    place: ClassVar["tempfile.TemporaryDirectory[str]"]

    @classmethod
    def setUpClass(cls) -> None:
        cls.place = tempfile.TemporaryDirectory()

    @classmethod
    def tearDownClass(cls) -> None:
        cls.place.cleanup()

    def keys(self, *removed: str) -> str:
        """The keys of a router and a client without these files."""
        made = f"{self.place.name}/{self._testMethodName}"
        subprocess.run([os.environ["RTNET_BIN"], "router", "keys", made], check=True)
        for file in removed:
            Path(made, file).unlink()
        return made

    def test_packages_before_a_close_arrive(self) -> None:
        made = self.keys()
        router = RunningRouter(made)
        try:
            leave(self, router, keys(f"{made}/client"))
        finally:
            router.kill()

    def exchange(self, made: str) -> None:
        router = RunningRouter(made)
        try:
            tls = keys(f"{made}/client")
            with Router(*router.place, tls=tls) as client:
                asyncio.run(self.with_another(router, client, tls))
        finally:
            router.kill()

    async def with_another(self, router: RunningRouter, client: Router, tls: ssl.SSLContext) -> None:
        here = client.mailbox("0.Pilot.0")
        async with aio.Router(*router.place, tls=tls) as other:
            there = await other.mailbox("0.Odometry.0")
            for size in [0, 1, 10_000, 200_000]:
                here.send("0.Odometry.0", -6, bytes(size))
                package = await there.receive(PATIENCE)
                self.assertEqual(package.body if package else None, bytes(size))
                there.send("0.Pilot.0", -6, bytes(size))
                package = await asyncio.to_thread(here.receive, PATIENCE)
                self.assertEqual(package.body if package else None, bytes(size))
            # After a restart, too.
            router.kill()
            while client.is_connected or other.is_connected:
                await asyncio.sleep(0.001)
            router.start()
            self.assertTrue(await asyncio.to_thread(client.wait_until_connected, PATIENCE))
            self.assertTrue(await other.wait_until_connected(PATIENCE))

    def test_a_certificate_lets_clients_in(self) -> None:
        self.exchange(self.keys("client/secret"))

    def test_the_secret_lets_clients_in(self) -> None:
        self.exchange(self.keys("client/client.pem", "client/client.key"))

    def test_a_router_without_ca_pem_takes_the_secret(self) -> None:
        self.exchange(self.keys("router/ca.pem"))

    def test_nothing_else_lets_clients_in(self) -> None:
        made = self.keys("client/client.pem", "client/client.key")
        router = RunningRouter(made)
        try:
            with self.assertRaises(ssl.SSLError):
                Router(*router.place, tls=ssl.create_default_context())
            Path(made, "client/secret").write_text("not the secret of this router")
            for tls in [keys(f"{made}/client"), ssl.create_default_context(cafile=f"{made}/client/ca.pem")]:
                # On a slow host the session does not begin in time, either.
                with self.assertRaises((NotConnected, OSError)):
                    with Router(*router.place, timeout=0.5, tls=tls) as client:
                        client.mailbox("0.Pilot.0")
        finally:
            router.kill()

    def test_keys_say_what_is_missing(self) -> None:
        made = self.keys("client/client.key")
        client = Path(made, "client")

        def fails(*words: str) -> None:
            with self.assertRaises(FileNotFoundError) as caught:
                keys(client)
            for word in [str(client), *words]:
                self.assertIn(word, str(caught.exception))

        fails("client.key", "copy")
        (client / "client.pem").unlink()
        keys(client)
        with mock.patch("rtnet_packages.tls._FILES", "/nowhere"):
            fails("client.pem", "client.key", "secret", "exporter", "copy")
        (client / "secret").unlink()
        fails("client.pem", "secret", "copy")
        (client / "ca.pem").unlink()
        fails("ca.pem", "copy")


if __name__ == "__main__":
    unittest.main()
