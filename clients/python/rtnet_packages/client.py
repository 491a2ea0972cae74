"""Mailboxes for threads: each call waits for what it asks for."""

import selectors
import socket
import ssl
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Callable, Optional, Type, TypeVar, Union

from .errors import NameTaken, NotConnected, TimedOut, checked
from .names import Name, name, shown
from .session import Sender, Session
from .wire import Package, ProtocolError

#: Where routers listen.
PORT = 2000
#: Seconds between attempts to connect, the first and the longest; and until a name that is taken is asked for again.
_FIRST, _LONGEST, _AGAIN = 0.05, 1.0, 0.5
_READ = 1 << 16

_T = TypeVar("_T")


class Router:
    """A connection to a TCP router. One thread reads; all methods may be called from any thread."""

    def __init__(
        self, host: str = "127.0.0.1", port: int = PORT, timeout: float = 5.0, tls: Optional[ssl.SSLContext] = None
    ) -> None:
        """Connects; OSError if nobody listens there. `timeout` in seconds is how long the router may take to answer. `tls`: see `keys`."""
        self._place, self._timeout, self._tls = (host, port), timeout, tls
        self._session = Session()
        self._changed = threading.Condition()
        self._socket: Optional[socket.socket] = self._connect()
        self._is_closed = False
        #: Connections so far.
        self.connections = 1
        self._reader = threading.Thread(target=self._read, name="rtnet-router", daemon=True)
        self._reader.start()

    def mailbox(self, of: Name, slots: int = 256) -> "Mailbox":
        """A mailbox of this name, for so many packages. NameTaken: somebody has it; NotConnected: there is no router now."""
        number = name(of)
        with self._changed:
            self._send(self._session.add(number, slots), before=lambda: self._forget(number))
            is_ours = self._wait(lambda: self._session.registered.get(number), self._timeout)
            if not is_ours:
                data = self._session.remove(number)
                if is_ours is None:
                    self._say(data)
                    raise NotConnected(f"the router has not answered the registration of {shown(number)} within {self._timeout} s")
                raise NameTaken(f"another connection has {shown(number)}")
        return Mailbox(self, number)

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection, and all mailboxes are registered."""
        with self._changed:
            return self._is_ready()

    def wait_until_connected(self, timeout: Optional[float] = None) -> bool:
        """Waits, at most so many seconds; tells whether there is a connection, and all mailboxes are registered."""
        with self._changed:
            return bool(self._wait(lambda: self._is_ready() or None, timeout))

    def close(self) -> None:
        """Ends the connection; the router forgets its mailboxes."""
        with self._changed:
            self._is_closed = True
            self._drop()
        self._reader.join()

    def __enter__(self) -> "Router":
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self.close()

    def _connect(self) -> socket.socket:
        connection = socket.create_connection(self._place, self._timeout)
        try:
            prepare(connection)
            if self._tls is not None:
                return self._tls.wrap_socket(connection, server_hostname=self._place[0])
        except OSError:
            connection.close()
            raise
        return connection

    def _receive(self, connection: socket.socket) -> Optional[bytes]:
        """The bytes that have come; None: less than a record of TLS."""
        if not isinstance(connection, ssl.SSLSocket):
            return connection.recv(_READ)
        # One thread at a time has a session of TLS, and this one does not wait in it.
        with self._changed:
            connection.settimeout(0.0)
            try:
                return connection.recv(_READ)
            except ssl.SSLWantReadError:
                return None
            finally:
                connection.settimeout(self._timeout)

    def _is_ready(self) -> bool:
        session = self._session
        return self._socket is not None and all(session.registered.get(of) for of in session.inboxes)

    def _forget(self, number: int) -> None:
        self._session.inboxes.pop(number, None)

    def _send(self, data: bytes, before: Callable[[], Any] = lambda: None) -> None:
        """Sends, or has `before` done and raises."""
        if self._socket is None or not self._say(data):
            before()
            raise NotConnected("there is no router now: it is connected to again as soon as there is one")

    def _say(self, data: bytes) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.sendall(data)
            return True
        except OSError:
            # Part of it may have left: what follows would be read as its rest.
            self._drop()
            return False

    def _drop(self) -> None:
        if self._socket is not None:
            try:
                self._socket.shutdown(socket.SHUT_RDWR)
            except OSError:
                pass
            self._socket.close()
            self._socket = None
        self._changed.notify_all()

    def _wait(self, look: Callable[[], Optional[_T]], timeout: Optional[float]) -> Optional[_T]:
        """Waits until `look` finds something, or time is up."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            found = look()
            if found is not None or self._is_closed:
                return found
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return None
            self._changed.wait(left)

    def _read(self) -> None:
        while not self._is_closed:
            connection = self._socket
            if connection is None:
                self._connect_again()
                continue
            try:
                if not _has_come(connection):
                    self._ask_again()
                    continue
                data = self._receive(connection)
            except (OSError, ValueError):
                # Another thread may have closed it.
                data = b""
            if data is None:
                continue
            with self._changed:
                if self._socket is connection:
                    try:
                        answer = self._session.feed(data)
                        if not data:
                            self._drop()
                        elif answer:
                            self._say(answer)
                    except ProtocolError:
                        self._drop()
                self._changed.notify_all()

    def _connect_again(self) -> None:
        rest = _FIRST
        while not self._is_closed:
            try:
                connection = self._connect()
            except OSError:
                time.sleep(rest)
                rest = min(2 * rest, _LONGEST)
                continue
            with self._changed:
                if self._is_closed:
                    connection.close()
                    return
                self._socket = connection
                self.connections += 1
                self._say(self._session.connected())
            return

    def _ask_again(self) -> None:
        with self._changed:
            for of, is_ours in list(self._session.registered.items()):
                if not is_ours and of in self._session.inboxes:
                    self._say(self._session.again(of))


def keys(directory: Union[str, Path]) -> ssl.SSLContext:
    """The keys of a client as `rtnet router keys` makes them: its certificate, and the authority that has signed the router's."""
    place = Path(directory)
    context = ssl.create_default_context(cafile=str(place / "ca.pem"))
    context.load_cert_chain(str(place / "client.pem"), str(place / "client.key"))
    return context


def prepare(connection: socket.socket) -> None:
    """Sets up a new connection. The kernel may connect a socket to itself if nobody listens at a port of the range for clients."""
    if connection.getsockname() == connection.getpeername():
        raise ConnectionRefusedError("nobody listens there")
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _has_come(connection: socket.socket) -> bool:
    """Whether bytes come before names are to be asked for again."""
    if isinstance(connection, ssl.SSLSocket) and connection.pending():
        return True
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ)
        return bool(selector.select(_AGAIN))


class Mailbox(Sender):
    """A mailbox of a router's client. It is gone when closed, or when its client is."""

    def __init__(self, router: Router, number: int) -> None:
        self._router, self.name = router, number

    def forward(self, package: Package) -> None:
        """Sends a package as it is, such as a reply."""
        data = package.encode()
        with self._router._changed:
            self._router._send(data)

    def call(self, to: Name, kind: int, body: bytes = b"", priority: int = 0, timeout: float = 2.0) -> Package:
        """Sends a command and waits for its reply. NotAvailable, Failed and TimedOut are what may come instead."""
        router = self._router
        with router._changed:
            call, data = router._session.call(Package(name(to), self.name, kind, body, priority))
            try:
                router._send(data)
                router._wait(lambda: router._session.answers.get(call), timeout)
            finally:
                reply = router._session.end(call)
        if reply is None:
            raise TimedOut(f"{shown(name(to))} has not answered within {timeout} s")
        return checked(reply)

    def receive(self, timeout: Optional[float] = None) -> Optional[Package]:
        """The most urgent package, once there is one; None if none came within so many seconds."""
        router = self._router
        with router._changed:
            return router._wait(self._take, timeout)

    @property
    def refused(self) -> int:
        """Packages that found it full."""
        return self._router._session.inboxes[self.name].refused

    def close(self) -> None:
        """The mailbox is gone."""
        with self._router._changed:
            self._router._say(self._router._session.remove(self.name))

    def _take(self) -> Optional[Package]:
        inbox = self._router._session.inboxes.get(self.name)
        return inbox.take() if inbox is not None else None
