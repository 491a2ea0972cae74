"""Mailboxes for threads: a call waits until it has its answer."""

import math
import selectors
import socket
import ssl
import threading
import time
from types import TracebackType
from typing import Callable, Optional, Tuple, Type, TypeVar

from .errors import checked
from .mailbox import Client, Sender
from .names import Name, name
from .tls import Handshake
from .wire import Package, ProtocolError

#: Where routers listen.
PORT = 2000
#: Bytes to read at a time.
READ = 1 << 16
#: Bytes that the kernel takes and has not sent, where it has this option. Nothing overtakes them.
UNSENT = 128 << 10
#: Bytes of one record of TLS: a call that sends more tells nothing before all have left.
RECORD = 16 << 10
#: Seconds that a client that is closed waits for the router to read all that it has sent.
LINGER = 1.0

_T = TypeVar("_T")


class Router(Client):
    """A connection to a TCP router. A thread of its own reads, and writes what did not leave at once; all methods may be called from any
    thread.

    A package is sent when the kernel has taken it. Its sender waits while the router does not read; if it reads nothing for `timeout`
    seconds, the connection is dropped, and the sender gets NotConnected.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = PORT, timeout: float = 5.0, tls: Optional[ssl.SSLContext] = None
    ) -> None:
        """Connects; OSError if nobody listens there. The router may take `timeout` seconds to answer, and to read. `tls`: see `keys`."""
        super().__init__()
        self._place, self._timeout, self._tls = (host, port), timeout, tls
        self._changed = threading.Condition()
        self._socket: Optional[socket.socket] = None
        #: Threads that wait until their package has left.
        self._blocked = 0
        #: When the thread looks again by itself; and when a client that is closed waits no more.
        self._looks_at, self._end = 0.0, 0.0
        self._bell = Bell()
        try:
            first = self._connect()
        except BaseException:
            self._bell.close()
            raise
        self._thread = threading.Thread(target=self._run, args=[first], name="rtnet-router", daemon=True)
        try:
            self._thread.start()
        except BaseException:
            first.close()
            self._bell.close()
            raise

    def mailbox(self, of: Name, slots: int = 256) -> "Mailbox":
        """A mailbox of this name, with room for `slots` packages.

        NameTaken: the router refuses it; NotConnected: there is no router now.
        """
        number, session = name(of), self._session
        with self._changed:
            data = session.add(number, slots)
            try:
                if not self._say(data):
                    raise session.gone()
                self._wait(lambda: session.registered(number), self._timeout)
                session.settle(number, self._timeout)
            except BaseException:
                self._delete(number)
                raise
        return Mailbox(self, number)

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection, and all mailboxes are registered."""
        with self._changed:
            return self._session.is_ready

    def wait_until_connected(self, timeout: Optional[float] = None) -> bool:
        """Waits, at most so many seconds; tells whether there is a connection, and all mailboxes are registered."""
        with self._changed:
            return bool(self._wait(lambda: self._session.is_ready or None, timeout))

    def close(self) -> None:
        """Ends the connection; the router forgets its mailboxes. It has read all that was sent, or that took too long."""
        with self._changed:
            self._session.is_closed = True
            self._end = time.monotonic() + LINGER
            # It asks at once for what the router has read.
            self._flush()
            self._bell.ring()
            self._changed.notify_all()
        self._thread.join()

    def __enter__(self) -> "Router":
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self.close()

    def _send(self, package: bytes) -> None:
        """Sends a package, or raises NotConnected."""
        if self._socket is None or self._session.is_closed:
            raise self._session.gone()
        outgoing = self._session.outgoing
        leaving = outgoing.put(package)
        self._flush()
        while leaving.has_left is None:
            progress = outgoing.progress
            self._blocked += 1
            try:
                moved = self._changed.wait_for(lambda: leaving.has_left is not None or outgoing.progress != progress, self._timeout)
            finally:
                self._blocked -= 1
            if not moved:
                # A part may have left: the router would take the next package for the rest of this one.
                self._drop()
        if not leaving.has_left:
            raise self._session.gone()

    def _say(self, data: bytes) -> bool:
        """Sends bytes of the session if there is a connection; tells whether there is one."""
        if self._socket is not None and data:
            self._session.outgoing.say(data)
            self._flush()
        return self._socket is not None

    def _delete(self, number: int) -> None:
        """Removes a mailbox. The packages that it has sent go first."""
        data = self._session.remove(number)
        if self._socket is not None and data:
            self._session.outgoing.put(data, counts=False)
            self._flush()

    def _flush(self) -> None:
        """Writes what the connection takes. The thread writes the rest, and asks what the router has read."""
        self._write()
        if self._session.outgoing.waits or self._session.asks_at() < self._looks_at:
            self._looks_at = 0.0
            self._bell.ring()

    def _write(self) -> None:
        """Writes what the connection takes, and wakes threads that wait for that."""
        outgoing, before = self._session.outgoing, self._session.outgoing.progress
        while self._socket is not None:
            data = self._session.to_write(time.monotonic())
            if not data:
                break
            try:
                outgoing.wrote(self._socket.send(data[:RECORD] if self._tls else data))
            except (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError):
                break
            except OSError:
                self._drop()
        if self._blocked and outgoing.progress != before:
            self._changed.notify_all()

    def _drop(self) -> None:
        """Ends the connection, if there is one. Its thread notices, and closes the socket."""
        if self._socket is not None:
            try:
                self._socket.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass
            self._socket = None
            self._session.lost()
        self._changed.notify_all()

    def _wait(self, look: Callable[[], Optional[_T]], timeout: Optional[float]) -> Optional[_T]:
        """Waits until `look` finds something, time is up, or the client is closed."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            found = look()
            if found is not None or self._session.is_closed:
                return found
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return None
            self._changed.wait(left)

    def _run(self, connection: Optional[socket.socket]) -> None:
        """Serves one connection after the other."""
        while connection is not None:
            try:
                self._serve(connection)
            except (OSError, ProtocolError):
                pass
            with self._changed:
                self._drop()
            connection.close()
            connection = self._connect_again()
        self._bell.close()

    def _serve(self, connection: socket.socket) -> None:
        """Reads one connection until it ends, and writes what it did not take at once."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._bell, selectors.EVENT_READ)
            selector.register(connection, selectors.EVENT_READ)
            events = selectors.EVENT_READ
            while True:
                with self._changed:
                    if self._socket is not connection:
                        return
                    data, outgoing = _received(connection), self._session.outgoing
                    outgoing.say(self._session.step(data, time.monotonic()))
                    self._write()
                    if data:
                        self._changed.notify_all()
                    now = time.monotonic()
                    if self._session.is_closed and (now >= self._end or outgoing.is_read and not outgoing.waits):
                        # With unread bytes the kernel would reset the connection, and drop those that it has not sent.
                        return
                    # The next question is written as soon as all else is.
                    asks_at = math.inf if outgoing.waits else self._session.asks_at()
                    ends_at = self._end if self._session.is_closed else math.inf
                    self._looks_at = min(now + self._session.wait(now), asks_at, ends_at)
                    wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if outgoing.waits else 0)
                if data:
                    continue
                if wanted != events:
                    selector.modify(connection, wanted)
                    events = wanted
                for key, _ in selector.select(max(self._looks_at - now, 0.0)):
                    if key.fileobj is self._bell:
                        self._bell.silence()

    def _connect_again(self) -> Optional[socket.socket]:
        """Tries until there is a connection; None if the client is closed."""
        while True:
            with self._changed:
                if self._changed.wait_for(lambda: self._session.is_closed, self._session.rest()):
                    return None
            try:
                return self._connect()
            except OSError:
                pass

    def _connect(self) -> socket.socket:
        """Tries once. The thread writes the proof and the registrations."""
        connection, proof = _dial(self._place, self._timeout, self._tls)
        with self._changed:
            self._socket = connection
            self.connections += 1
            self._session.outgoing.say(proof + self._session.connected(time.monotonic()))
            self._changed.notify_all()
            if self._session.is_closed:
                self._drop()
        return connection


class Bell:
    """Wakes the thread that waits for its connection."""

    def __init__(self) -> None:
        self._heard, self._rung = socket.socketpair()
        self._heard.setblocking(False)
        self._rung.setblocking(False)

    def fileno(self) -> int:
        return self._heard.fileno()

    def ring(self) -> None:
        """Wakes it now, or as soon as it waits."""
        try:
            self._rung.send(b"\0")
        except OSError:
            # It rings already, or the thread has ended.
            pass

    def silence(self) -> None:
        """Ends all ringing."""
        self._heard.recv(READ)

    def close(self) -> None:
        """Frees it."""
        self._heard.close()
        self._rung.close()


def _received(connection: socket.socket) -> Optional[bytes]:
    """The bytes that have come, b"" at the end; None if none have."""
    try:
        return connection.recv(READ)
    except (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError):
        return None


def _dial(place: Tuple[str, int], timeout: float, tls: Optional[ssl.SSLContext]) -> Tuple[socket.socket, bytes]:
    """A connection, from which no call waits, and the proof that it begins with."""
    connection = socket.create_connection(place, timeout)
    try:
        prepare(connection)
        with Handshake(tls) as handshake:
            if handshake.context is not None:
                connection = handshake.context.wrap_socket(connection, server_hostname=place[0])
            proof = handshake.proof()
        connection.setblocking(False)
        return connection, proof
    except BaseException:
        connection.close()
        raise


def prepare(connection: socket.socket) -> None:
    """Sets up a new connection. The kernel may connect a socket to itself if nobody listens at a port of the range for clients."""
    if connection.getsockname() == connection.getpeername():
        raise ConnectionRefusedError("nobody listens there")
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    try:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
    except (AttributeError, OSError):
        # Without it signs of life wait longer.
        pass


class Mailbox(Sender):
    """A mailbox of a router's client. It is gone when closed, or when its client is."""

    def __init__(self, router: Router, number: int) -> None:
        super().__init__(router._session, number)
        self._router = router

    def forward(self, package: Package) -> None:
        """Sends a package as it is, such as a reply. NotConnected: it has not left, or not in time."""
        data = package.encode()
        with self._router._changed:
            self._router._send(data)

    def call(self, to: Name, kind: int, body: bytes = b"", priority: Optional[int] = None, timeout: float = 2.0) -> Package:
        """Sends a command and returns its reply. NotAvailable, Failed, TimedOut: there is none; NotConnected: nothing was sent."""
        number = name(to)
        with self._router._changed:
            call, data = self._session.call(self._package(number, kind, body, priority))
            try:
                self._router._send(data)
                self._router._wait(lambda: self._session.answers.get(call), timeout)
            finally:
                reply = self._session.end(call)
        return checked(reply, number, timeout)

    def receive(self, timeout: Optional[float] = None) -> Optional[Package]:
        """The most urgent package, once there is one; None if none came within so many seconds."""
        with self._router._changed:
            return self._router._wait(lambda: self._session.take(self.name), timeout)

    def close(self) -> None:
        """The mailbox is gone."""
        with self._router._changed:
            self._router._delete(self.name)
