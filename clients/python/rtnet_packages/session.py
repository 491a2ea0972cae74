"""A client's part of the protocol without I/O. It takes bytes and the time, and has bytes to send. Both fronts stand on it."""

import itertools
import math
from typing import Dict, Optional, Tuple

from .errors import NameTaken, NotConnected
from .inbox import Inbox
from .names import NOBODY, shown
from .outgoing import Outgoing
from .requests import Requests
from .wire import ACCOUNT, DELETE, LIFESIGN, NOT_AVAILABLE, OK, Decoder, Package, control

#: Seconds of rest before an attempt to connect again: the first, and the longest.
FIRST, LONGEST = 0.05, 1.0
#: Seconds until refused names are asked for again.
AGAIN = 0.5
#: Seconds from one question which packages have arrived to the next. Each costs about as much as a package.
CONFIRM_EVERY = 0.01
#: Seconds until the router is asked again about the same packages, which wait there.
CONFIRM_AGAIN = 0.1
#: Seconds without a byte after which a router counts as gone. It asks for a sign of life every 5 s.
SILENCE = 15.0

#: Bytes of requests and answers up to which a command that no mailbox takes is answered: a router that does not read gets no more.
ANSWERS = 64 << 10

#: The key of an open call: the mailbox, its peer, and the id.
Call = Tuple[int, int, int]


class Session:
    """The mailboxes of a client and its open calls; and when it connects, asks again, and gives a router up.

    Methods return the session's own bytes, which go to `outgoing.say`. Times are seconds of one clock that never goes back.
    """

    def __init__(self) -> None:
        self.inboxes: Dict[int, Inbox] = {}
        self.answers: Dict[Call, Package] = {}
        #: Packages for mailboxes that are gone; and answers that were not sent, since as many wait as may.
        self.strays = self.answers_lost = 0
        self._answers = b""
        #: Whether there is a connection; whether the user has closed the client.
        self.is_open = self.is_closed = False
        self.outgoing = Outgoing()
        self._requests = Requests()
        self._decoder, self._ids = Decoder(), itertools.count(1)
        self._calls: Dict[Call, None] = {}
        self._rest, self._silence = FIRST, SILENCE
        self._heard = self._again = 0.0
        #: The packages that the router was asked about last, and when.
        self._asked, self._asked_at = 0, -CONFIRM_EVERY

    def connected(self, now: float) -> bytes:
        """Begins a connection; returns the bytes that register all mailboxes again."""
        self.is_open, self._decoder = True, Decoder()
        self._heard, self._again = now, now + AGAIN
        self._asked, self._asked_at = self.outgoing.sent, now - CONFIRM_EVERY
        self._requests.begin(self.inboxes)
        return self._requests.registrations()

    def lost(self) -> None:
        """Ends the connection."""
        self.is_open = False
        self._requests.begin([])
        self.outgoing.end()

    def to_write(self, now: float) -> memoryview:
        """The bytes to write next; empty if there are none."""

        def confirm(packages: int) -> bytes:
            if now < self._confirm_at(packages):
                return b""
            question = self._requests.confirmation(packages)
            if question:
                self._asked, self._asked_at = packages, now
            return question

        return self.outgoing.next(confirm)

    def _confirm_at(self, packages: int) -> float:
        """When the router may be asked about packages up to this number."""
        if self.is_closed:
            return self._asked_at
        return self._asked_at + (CONFIRM_EVERY if packages > self._asked else CONFIRM_AGAIN)

    def rest(self) -> float:
        """Seconds to rest before the next attempt to connect. They double with each attempt, until a byte has come."""
        rest, self._rest = self._rest, min(2 * self._rest, LONGEST)
        return rest

    def wait(self, now: float) -> float:
        """Seconds until `step` has something to do without new bytes."""
        return max(min(self._again, self._heard + self._silence) - now, 0.0)

    def asks_at(self) -> float:
        """When `to_write` has a question without a new package, if all else has left."""
        if self.outgoing.is_settled or self._requests.has_question or not self.is_open:
            return math.inf
        return self._confirm_at(self.outgoing.sent)

    def step(self, data: Optional[bytes], now: float) -> bytes:
        """Takes the bytes that have come, or None if none have; returns the bytes to send.

        OSError, ProtocolError: drop the connection. It has ended (`data` is empty), is silent, or sends bytes that are no package.
        """
        if data:
            self._heard, self._rest = now, FIRST
            self._sort(data)
        elif data is not None:
            raise ConnectionResetError("the router has ended the connection")
        elif now >= self._heard + self._silence:
            raise TimeoutError(f"the router has sent nothing for {self._silence} s")
        if now >= self._again:
            self._again = now + AGAIN
            self._requests.add_refused()
        answers, self._answers = self._answers, b""
        return self._requests.registrations() + answers

    @property
    def is_ready(self) -> bool:
        """Whether there is a connection, and all mailboxes are registered."""
        return self.is_open and all(self.registered(name) for name in self.inboxes)

    def gone(self) -> NotConnected:
        """The error of sending without a connection."""
        return NotConnected("this client is closed" if self.is_closed else "there is no router now: the client connects again by itself")

    def add(self, name: int, slots: int) -> bytes:
        """Adds a mailbox; returns the bytes that register it, if they may be sent now."""
        if name == NOBODY:
            raise ValueError("0 is nobody's name")
        if name in self.inboxes:
            raise NameTaken(f"{shown(name)} is a mailbox of this client already")
        if not self.is_open:
            raise self.gone()
        self.inboxes[name] = Inbox(slots)
        self._requests.add(name)
        return self._requests.registrations()

    def registered(self, name: int) -> Optional[bool]:
        """Whether the router has registered a name for this connection; None: it has not answered."""
        return self._requests.answers.get(name)

    def settle(self, name: int, timeout: float) -> None:
        """Returns if a name is registered. NameTaken: the router refuses it; NotConnected: it has not answered within `timeout` seconds."""
        is_ours = self.registered(name)
        if is_ours is None:
            if not self.is_open:
                raise self.gone()
            raise NotConnected(f"the router has not answered the registration of {shown(name)} within {timeout} s")
        if not is_ours:
            raise NameTaken(f"the router refuses {shown(name)}: another connection has it, or a rule or a limit forbids it")

    def remove(self, name: int) -> bytes:
        """Removes a mailbox; returns the bytes that delete it, if the router may have it: they follow the packages before them."""
        self.inboxes.pop(name, None)
        return control(DELETE, name.to_bytes(4, "little")).encode() if self._requests.remove(name) else b""

    def take(self, name: int) -> Optional[Package]:
        """The first package of a mailbox; None if there is none, or no such mailbox."""
        inbox = self.inboxes.get(name)
        return inbox.take() if inbox is not None else None

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

    def _answered(self, answer: Package) -> None:
        """Takes an answer of the router."""
        request = self._requests.answered(answer.id, answer.kind == OK)
        if request is not None and request.kind == ACCOUNT:
            self.outgoing.account(answer.body)
        elif request is not None and request.packages:
            self.outgoing.confirmed(request.packages)

    def _sort(self, data: bytes) -> None:
        """Sorts packages into inboxes and answers."""
        for package in self._decoder.feed(data):
            call = (package.to, package.sender, package.id)
            if (package.to, package.sender) == (NOBODY, NOBODY):
                if package.kind == LIFESIGN:
                    # One answer is enough for several questions.
                    self.outgoing.is_asked = True
                else:
                    self._answered(package)
            elif package.kind <= 0 and call in self._calls and call not in self.answers:
                self.answers[call] = package
            elif package.to not in self.inboxes:
                self.strays += 1
                self._refuse(package)
            elif not self.inboxes[package.to].put(package):
                self._refuse(package)

    def _refuse(self, package: Package) -> None:
        """Answers a command that no mailbox takes."""
        if package.kind <= 0:
            return
        if len(self._answers) + self.outgoing.own < ANSWERS:
            self._answers += package.reply(NOT_AVAILABLE).encode()
        else:
            self.answers_lost += 1
