"""A client's part of the protocol without I/O: bytes come in, bytes are to be sent. Both fronts stand on it."""

import itertools
from typing import Dict, Optional, Tuple

from .errors import NameTaken
from .inbox import Inbox
from .names import NOBODY, Name, name, shown
from .wire import DELETE, LIFESIGN, OK, REGISTER, Decoder, Package, control

#: The key of an open call: the mailbox, its peer, and the id.
Call = Tuple[int, int, int]


class Session:
    """The mailboxes of a connection, the open calls, and the router's answers to registrations."""

    def __init__(self) -> None:
        self._decoder, self._ids = Decoder(), itertools.count(1)
        self.inboxes: Dict[int, Inbox] = {}
        #: Names by the id of the request that registers them.
        self._asked: Dict[int, int] = {}
        #: The router's answer to the registration of a name: True if the name is this connection's.
        self.registered: Dict[int, bool] = {}
        self.answers: Dict[Call, Package] = {}
        self._calls: Dict[Call, None] = {}
        #: Packages for mailboxes that are gone.
        self.strays = 0

    def connected(self) -> bytes:
        """Begins a new connection; returns the bytes that register all mailboxes again."""
        self._decoder, self._asked = Decoder(), {}
        self.registered.clear()
        return b"".join(self._register(name) for name in self.inboxes)

    def add(self, name: int, slots: int) -> bytes:
        """Adds a mailbox; returns the bytes that register it."""
        if name == NOBODY:
            raise ValueError("0 is nobody's name")
        if name in self.inboxes:
            raise NameTaken(f"{shown(name)} is a mailbox of this client already")
        self.inboxes[name] = Inbox(slots)
        return self._register(name)

    def again(self, name: int) -> bytes:
        """Registers a mailbox again that the router has refused: another connection of the same name may be gone by now."""
        self.registered.pop(name, None)
        return self._register(name)

    def remove(self, name: int) -> bytes:
        """Removes a mailbox; returns the bytes that delete it."""
        self.inboxes.pop(name, None)
        self.registered.pop(name, None)
        return control(DELETE, name.to_bytes(4, "little")).encode()

    def call(self, package: Package) -> Tuple[Call, bytes]:
        """Opens a call; returns its key in `answers`, and the bytes of the command."""
        for _ in range(256):
            number = next(self._ids) & 0xFF
            call = (package.sender, package.to, number)
            if call not in self._calls:
                break
        else:
            raise RuntimeError(f"256 calls of {shown(package.sender)} wait for {shown(package.to)} already")
        command = Package(package.to, package.sender, package.kind, package.body, package.priority, number, package.little)
        data = command.encode()
        self._calls[call] = None
        return call, data

    def end(self, call: Call) -> Optional[Package]:
        """Ends a call; returns its reply, if there is one."""
        self._calls.pop(call, None)
        return self.answers.pop(call, None)

    def feed(self, data: bytes) -> bytes:
        """Sorts packages into inboxes and answers; returns the bytes to send."""
        answer = b""
        for package in self._decoder.feed(data):
            if (package.to, package.sender) == (NOBODY, NOBODY):
                answer += self._from_router(package)
                continue
            call = (package.to, package.sender, package.id)
            if package.kind <= 0 and call in self._calls and call not in self.answers:
                self.answers[call] = package
            elif package.to in self.inboxes:
                self.inboxes[package.to].put(package)
            else:
                self.strays += 1
        return answer

    def _from_router(self, package: Package) -> bytes:
        if package.kind == LIFESIGN:
            return control(OK).encode()
        name = self._asked.pop(package.id, None)
        if name is not None and name in self.inboxes:
            self.registered[name] = package.kind == OK
        return b""

    def _register(self, name: int) -> bytes:
        number = next(self._ids) & 0xFF
        while number in self._asked:
            number = next(self._ids) & 0xFF
        self._asked[number] = name
        return Package(NOBODY, NOBODY, REGISTER, name.to_bytes(4, "little"), id=number).encode()


class Sender:
    """The part of a mailbox that waits for nothing, the same in both fronts."""

    #: The number of the mailbox's name.
    name: int

    def forward(self, package: Package) -> None:
        """Sends a package as it is. NotConnected: it was not sent."""
        raise NotImplementedError

    def send(self, to: Name, kind: int, body: bytes = b"", priority: int = 0, id: int = 0) -> None:
        """Sends a package. NotConnected: it was not sent. Whether it arrives is not known: `call` waits for an answer."""
        self.forward(Package(name(to), self.name, kind, body, priority, id))

    def reply(self, command: Package, kind: int = OK, body: bytes = b"") -> None:
        """Answers a command that was received here."""
        self.forward(command.reply(kind, body))
