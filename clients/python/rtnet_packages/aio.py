"""The same for asyncio: nothing blocks the loop."""

import asyncio
import ssl
from types import TracebackType
from typing import Callable, Optional, Type, TypeVar

from .client import _AGAIN, _FIRST, _LONGEST, _READ, PORT, prepare
from .errors import NameTaken, NotConnected, TimedOut, checked
from .names import Name, name, shown
from .session import Sender, Session
from .wire import Package, ProtocolError

_T = TypeVar("_T")


class Router:
    """A connection to a TCP router, of one event loop: `async with Router(...) as router`."""

    def __init__(
        self, host: str = "127.0.0.1", port: int = PORT, timeout: float = 5.0, tls: Optional[ssl.SSLContext] = None
    ) -> None:
        """`timeout` in seconds is how long the router may take to answer. `tls`: see `keys`."""
        self._place, self._timeout, self._tls = (host, port), timeout, tls
        self._session = Session()
        self._writer: Optional[asyncio.StreamWriter] = None
        self._reads: Optional["asyncio.Task[None]"] = None
        #: Connections so far.
        self.connections = 0

    async def __aenter__(self) -> "Router":
        """Connects; OSError if nobody listens there."""
        self._changed = asyncio.Event()
        reader = await self._connect()
        self._reads = asyncio.ensure_future(self._read(reader))
        return self

    async def __aexit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Ends the connection; the router forgets its mailboxes."""
        if self._reads is not None:
            self._reads.cancel()
            try:
                await self._reads
            except asyncio.CancelledError:
                pass
        self._drop()

    async def mailbox(self, of: Name, slots: int = 256) -> "Mailbox":
        """A mailbox of this name, for so many packages. NameTaken: somebody has it; NotConnected: there is no router now."""
        number = name(of)
        data = self._session.add(number, slots)
        try:
            self._send(data)
        except NotConnected:
            self._session.remove(number)
            raise
        is_ours = await self._wait(lambda: self._session.registered.get(number), self._timeout)
        if not is_ours:
            data = self._session.remove(number)
            if is_ours is None:
                if self._writer is not None:
                    self._writer.write(data)
                raise NotConnected(f"the router has not answered the registration of {shown(number)} within {self._timeout} s")
            raise NameTaken(f"another connection has {shown(number)}")
        return Mailbox(self, number)

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection, and all mailboxes are registered."""
        session = self._session
        return self._writer is not None and all(session.registered.get(of) for of in session.inboxes)

    async def wait_until_connected(self, timeout: Optional[float] = None) -> bool:
        """Waits, at most so many seconds; tells whether there is a connection, and all mailboxes are registered."""
        return bool(await self._wait(lambda: self.is_connected or None, timeout))

    async def _connect(self) -> asyncio.StreamReader:
        reader, writer = await asyncio.wait_for(asyncio.open_connection(*self._place, ssl=self._tls), self._timeout)
        try:
            prepare(writer.get_extra_info("socket"))
        except OSError:
            writer.close()
            raise
        self._writer = writer
        self.connections += 1
        writer.write(self._session.connected())
        return reader

    def _send(self, data: bytes) -> None:
        if self._writer is None or self._writer.is_closing():
            raise NotConnected("there is no router now: it is connected to again as soon as there is one")
        self._writer.write(data)

    def _drop(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        self._tell()

    def _tell(self) -> None:
        """Wakes all that wait."""
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    async def _wait(self, look: Callable[[], Optional[_T]], timeout: Optional[float]) -> Optional[_T]:
        loop = asyncio.get_running_loop()
        deadline = None if timeout is None else loop.time() + timeout
        while True:
            found = look()
            if found is not None:
                return found
            try:
                left = None if deadline is None else max(deadline - loop.time(), 0)
                await asyncio.wait_for(self._changed.wait(), left)
            except asyncio.TimeoutError:
                return look()

    async def _read(self, reader: asyncio.StreamReader) -> None:
        while True:
            try:
                data = await asyncio.wait_for(reader.read(_READ), _AGAIN)
                answer = self._session.feed(data) if data else b""
            except asyncio.TimeoutError:
                self._ask_again()
                continue
            except (OSError, ProtocolError):
                data, answer = b"", b""
            if data:
                if answer and self._writer is not None:
                    self._writer.write(answer)
                self._tell()
            else:
                self._drop()
                reader = await self._connect_again()

    async def _connect_again(self) -> asyncio.StreamReader:
        rest = _FIRST
        while True:
            try:
                return await self._connect()
            except (OSError, asyncio.TimeoutError):
                await asyncio.sleep(rest)
                rest = min(2 * rest, _LONGEST)

    def _ask_again(self) -> None:
        for of, is_ours in list(self._session.registered.items()):
            if not is_ours and of in self._session.inboxes and self._writer is not None:
                self._writer.write(self._session.again(of))


class Mailbox(Sender):
    """A mailbox of a router's client. It is gone when closed, or when its client is."""

    def __init__(self, router: Router, number: int) -> None:
        self._router, self.name = router, number

    def forward(self, package: Package) -> None:
        """Sends a package as it is, such as a reply."""
        self._router._send(package.encode())

    async def call(self, to: Name, kind: int, body: bytes = b"", priority: int = 0, timeout: float = 2.0) -> Package:
        """Sends a command and waits for its reply. NotAvailable, Failed and TimedOut are what may come instead."""
        session = self._router._session
        call, data = session.call(Package(name(to), self.name, kind, body, priority))
        try:
            self._router._send(data)
            await self._router._wait(lambda: session.answers.get(call), timeout)
        finally:
            reply = session.end(call)
        if reply is None:
            raise TimedOut(f"{shown(name(to))} has not answered within {timeout} s")
        return checked(reply)

    async def receive(self, timeout: Optional[float] = None) -> Optional[Package]:
        """The most urgent package, once there is one; None if none came within so many seconds."""
        return await self._router._wait(self._take, timeout)

    @property
    def refused(self) -> int:
        """Packages that found it full."""
        return self._router._session.inboxes[self.name].refused

    def close(self) -> None:
        """The mailbox is gone."""
        data = self._router._session.remove(self.name)
        if self._router._writer is not None:
            self._router._writer.write(data)

    def _take(self) -> Optional[Package]:
        inbox = self._router._session.inboxes.get(self.name)
        return inbox.take() if inbox is not None else None
