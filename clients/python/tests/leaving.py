"""Clients that are closed right after they have sent."""

import asyncio
import ssl
import unittest
from contextlib import contextmanager
from typing import Iterator, Optional
from unittest import mock

from rtnet_packages import Mailbox, Router, aio

from .running import RunningRouter

COUNT = 500
#: A busy host takes longer than a client waits at its end.
PATIENCE = 30.0


@contextmanager
def patient() -> Iterator[None]:
    with mock.patch("rtnet_packages.client.LINGER", PATIENCE), mock.patch("rtnet_packages.aio.LINGER", PATIENCE):
        yield


def leave(case: unittest.TestCase, router: RunningRouter, tls: Optional[ssl.SSLContext]) -> None:
    """All that a client has sent arrives, of both fronts."""
    for _ in range(10):
        with Router(*router.place, tls=tls) as other:
            here = other.mailbox("0.Odometry.0", slots=2 * COUNT)
            with patient(), Router(*router.place, tls=tls) as client:
                mailbox = client.mailbox("0.Pilot.0")
                for _ in range(COUNT):
                    mailbox.send("0.Odometry.0", -6, bytes(2000))
            case.assertEqual(_come(here), COUNT)
            with patient():
                asyncio.run(_leave_a_loop(router, tls))
            case.assertEqual(_come(here), COUNT)


async def _leave_a_loop(router: RunningRouter, tls: Optional[ssl.SSLContext]) -> None:
    async with aio.Router(*router.place, tls=tls) as client:
        mailbox = await client.mailbox("0.Pilot.1")
        for _ in range(COUNT):
            mailbox.send("0.Odometry.0", -6, bytes(2000))


def _come(mailbox: Mailbox) -> int:
    came = 0
    while came < COUNT and mailbox.receive(timeout=5.0) is not None:
        came += 1
    return came
