"""The same for asyncio: nothing blocks the loop."""

import asyncio
import math
import ssl
import time
from types import TracebackType
from typing import Callable, Optional, Type, TypeVar

from .client import LINGER, PORT, READ, prepare
from .errors import Full, checked
from .mailbox import Client, Sender
from .names import Name, name
from .tls import Handshake
from .wire import Package, ProtocolError

#: While more bytes wait for the router, nothing is sent.
MOST = 4 << 20
#: Bytes that the transport has: what comes after them does not overtake them.
AHEAD = 64 << 10
#: Seconds from one look of a client that is closed whether all has left to the next.
LOOK = 0.01

_T = TypeVar("_T")


class Router(Client):
    """A connection to a TCP router, of one event loop: `async with Router(...) as router`.

    Nothing waits for a router that does not read. While more than 4 MiB wait for it, a method that sends raises Full.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = PORT, timeout: float = 5.0, tls: Optional[ssl.SSLContext] = None
    ) -> None:
        """The router may take `timeout` seconds to answer. `tls`: see `keys`."""
        super().__init__()
        self._place, self._timeout, self._tls = (host, port), timeout, tls
        self._writer: Optional[asyncio.StreamWriter] = None
        self._reads: Optional["asyncio.Task[None]"] = None
        #: Writes what the transport did not take at once.
        self._writes: Optional["asyncio.Task[None]"] = None
        #: Nothing is read any more.
        self._is_over = False
        #: Asks what the router has read.
        self._asks: Optional[asyncio.TimerHandle] = None

    async def __aenter__(self) -> "Router":
        """Connects; OSError if nobody listens there."""
        self._changed = asyncio.Event()
        self._reads = asyncio.ensure_future(self._run(await self._connect()))
        return self

    async def __aexit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Ends the connection; the router forgets its mailboxes. It has read all that was sent, or that took too long."""
        self._session.is_closed = True
        try:
            # With unread bytes the kernel would reset the connection, and drop those that it has not sent.
            end, outgoing = time.monotonic() + LINGER, self._session.outgoing
            while self._writer is not None and (outgoing.waits or not outgoing.is_read) and time.monotonic() < end:
                self._flush()
                try:
                    await asyncio.wait_for(self._changed.wait(), LOOK)
                except asyncio.TimeoutError:
                    pass
        finally:
            self._is_over = True
            if self._reads is not None:
                self._reads.cancel()
                try:
                    await self._reads
                except asyncio.CancelledError:
                    pass
            if self._writer is not None:
                if self._writer.transport.get_write_buffer_size() > 0:
                    # The router does not read.
                    self._writer.transport.abort()
                self._writer.close()
                # The loop may end behind this: it closes the socket in its next turn.
                await asyncio.sleep(0)
            self._lost()

    async def mailbox(self, of: Name, slots: int = 256) -> "Mailbox":
        """A mailbox of this name, with room for `slots` packages.

        NameTaken: the router refuses it; NotConnected: there is no router now.
        """
        number, session = name(of), self._session
        data = session.add(number, slots)
        try:
            self._say(data)
            await self._wait(lambda: session.registered(number), self._timeout)
            session.settle(number, self._timeout)
        except BaseException:
            self._delete(number)
            raise
        return Mailbox(self, number)

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection, and all mailboxes are registered."""
        return self._session.is_ready

    async def wait_until_connected(self, timeout: Optional[float] = None) -> bool:
        """Waits, at most so many seconds; tells whether there is a connection, and all mailboxes are registered."""
        return bool(await self._wait(lambda: self._session.is_ready or None, timeout))

    def _send(self, package: bytes) -> None:
        """Sends a package, or raises NotConnected or Full."""
        if self._writer is None or self._writer.is_closing() or self._session.is_closed:
            raise self._session.gone()
        if self._session.outgoing.size > MOST:
            raise Full(f"the connection takes no more; it was not sent: {MOST} bytes wait for the router")
        self._session.outgoing.put(package)
        self._flush()

    def _delete(self, number: int) -> None:
        """Removes a mailbox. The packages that it has sent go first."""
        data = self._session.remove(number)
        if self._writer is not None and data:
            self._session.outgoing.put(data, counts=False)
            self._flush()

    def _say(self, data: bytes) -> None:
        """Sends bytes of the session if there is a connection."""
        if self._writer is not None and data:
            self._session.outgoing.say(data)
            self._flush()

    def _flush(self) -> None:
        """Gives the transport as much as it may have. A task gives it the rest."""
        if self._writer is None or self._writer.is_closing():
            return
        transport = self._writer.transport
        while transport.get_write_buffer_size() <= AHEAD:
            data = self._session.to_write(time.monotonic())
            if not data:
                return self._ask_later()
            # The transport keeps what it does not write at once.
            self._writer.write(bytes(data))
            self._session.outgoing.wrote(len(data))
        if self._writes is None:
            self._writes = asyncio.ensure_future(self._write(self._writer))

    def _ask_later(self) -> None:
        """Has the next question sent when it is due."""
        at = self._session.asks_at()
        if self._asks is None and at < math.inf:
            self._asks = asyncio.get_running_loop().call_later(at - time.monotonic(), self._ask)

    def _ask(self) -> None:
        self._asks = None
        self._flush()

    async def _write(self, writer: asyncio.StreamWriter) -> None:
        """Gives the transport more whenever it has written half of what it may have, until nothing waits or the connection ends."""
        try:
            while self._session.outgoing.waits:
                await writer.drain()
                self._flush()
        except OSError:
            # The end of the connection is read, too.
            pass
        self._writes = None

    def _lost(self) -> None:
        if self._writes is not None:
            self._writes.cancel()
            self._writes = None
        if self._asks is not None:
            self._asks.cancel()
            self._asks = None
        self._writer = None
        self._session.lost()
        self._tell()

    def _tell(self) -> None:
        """Wakes all that wait."""
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    async def _wait(self, look: Callable[[], Optional[_T]], timeout: Optional[float]) -> Optional[_T]:
        """Waits until `look` finds something, time is up, or the client is closed."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            found = look()
            if found is not None or self._session.is_closed:
                return found
            try:
                left = None if deadline is None else max(deadline - time.monotonic(), 0)
                await asyncio.wait_for(self._changed.wait(), left)
            except asyncio.TimeoutError:
                return look()

    async def _run(self, reader: asyncio.StreamReader) -> None:
        """Reads; connects again whenever a connection has ended."""
        # Before Python 3.12 a cancellation may be lost in wait_for.
        while not self._is_over:
            try:
                await self._read(reader)
            except (OSError, ProtocolError):
                pass
            if self._is_over:
                return
            if self._writer is not None:
                self._writer.transport.abort()
            self._lost()
            if self._session.is_closed:
                return
            reader = await self._connect_again()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        """Reads one connection until it ends, which is an error."""
        reading = asyncio.ensure_future(reader.read(READ))
        try:
            while not self._is_over:
                await asyncio.wait([reading], timeout=self._session.wait(time.monotonic()))
                data = reading.result() if reading.done() else None
                self._session.outgoing.say(self._session.step(data, time.monotonic()))
                self._flush()
                if data:
                    self._tell()
                    reading = asyncio.ensure_future(reader.read(READ))
        finally:
            reading.cancel()

    async def _connect_again(self) -> asyncio.StreamReader:
        """Tries until there is a connection."""
        while True:
            await asyncio.sleep(self._session.rest())
            try:
                return await self._connect()
            except (OSError, asyncio.TimeoutError):
                pass

    async def _connect(self) -> asyncio.StreamReader:
        """Tries once."""
        with Handshake(self._tls) as handshake:
            opened = asyncio.open_connection(*self._place, ssl=handshake.context)
            reader, writer = await asyncio.wait_for(opened, self._timeout)
            try:
                prepare(writer.get_extra_info("socket"))
                proof = handshake.proof()
            except BaseException:
                writer.transport.abort()
                raise
        writer.transport.set_write_buffer_limits(AHEAD, AHEAD // 2)
        self._writer = writer
        self.connections += 1
        self._say(proof + self._session.connected(time.monotonic()))
        self._tell()
        return reader


class Mailbox(Sender):
    """A mailbox of a router's client. It is gone when closed, or when its client is."""

    def __init__(self, router: Router, number: int) -> None:
        super().__init__(router._session, number)
        self._router = router

    def forward(self, package: Package) -> None:
        """Sends a package as it is, such as a reply. NotConnected, Full: it was not sent."""
        self._router._send(package.encode())

    async def call(self, to: Name, kind: int, body: bytes = b"", priority: Optional[int] = None, timeout: float = 2.0) -> Package:
        """Sends a command and returns its reply. NotAvailable, Failed, TimedOut: there is none; NotConnected, Full: nothing was sent."""
        number = name(to)
        call, data = self._session.call(self._package(number, kind, body, priority))
        try:
            self._router._send(data)
            await self._router._wait(lambda: self._session.answers.get(call), timeout)
        finally:
            reply = self._session.end(call)
        return checked(reply, number, timeout)

    async def receive(self, timeout: Optional[float] = None) -> Optional[Package]:
        """The most urgent package, once there is one; None if none came within so many seconds."""
        return await self._router._wait(lambda: self._session.take(self.name), timeout)

    def close(self) -> None:
        """The mailbox is gone."""
        self._router._delete(self.name)
