"""The requests of a connection that wait for their answers. The router answers them in their order."""

import itertools
from collections import deque
from typing import Deque, Dict, Iterable, NamedTuple, Optional

from .names import NOBODY
from .wire import ACCOUNT, DELETE_ANSWERED, REGISTER, Package

#: Registrations without an answer at a time. Each has an id of its own, which is one byte.
OPEN = 128


class Request(NamedTuple):
    """A request: a registration, or the question for an account or a confirmation of packages."""

    id: int
    kind: int
    #: The name to register; nobody's if that has been taken back, and in a question.
    name: int
    #: The packages to confirm; 0 in other requests.
    packages: int


class Requests:
    """Names that wait to be asked for, names that are asked for, and the router's answers; and questions about packages."""

    def __init__(self) -> None:
        #: The router's last answer for a name: True if the name is this connection's.
        self.answers: Dict[int, bool] = {}
        self._ids = itertools.count(1)
        #: Names that wait until fewer are open; the keys are in the order of the requests.
        self._waiting: Dict[int, None] = {}
        self._open: Deque[Request] = deque()

    def begin(self, names: Iterable[int]) -> None:
        """Forgets all; adds these names."""
        self.answers.clear()
        self._open.clear()
        self._waiting = dict.fromkeys(names)

    def add(self, name: int) -> None:
        """Adds a name."""
        self._waiting[name] = None

    def add_refused(self) -> None:
        """Adds all names again that the router has refused. Their old answers hold until they have new ones."""
        asked = {request.name for request in self._open}
        for name, is_ours in self.answers.items():
            if not is_ours and name not in asked:
                self.add(name)

    def remove(self, name: int) -> bool:
        """Removes a name; tells whether the router may have it."""
        self._waiting.pop(name, None)
        is_asked = any(request.name == name for request in self._open)
        # Its answer is ignored: if the name is added again, that request has an answer of its own.
        self._open = deque(request._replace(name=NOBODY) if request.name == name else request for request in self._open)
        return self.answers.pop(name, False) or is_asked

    def registrations(self) -> bytes:
        """The requests for names that wait, as many as may be open."""
        data = b""
        while self._waiting and len(self._open) < OPEN:
            name = next(iter(self._waiting))
            del self._waiting[name]
            data += self._ask(REGISTER, name)
        return data

    @property
    def has_question(self) -> bool:
        """Whether a question about packages is open."""
        return any(request.kind == DELETE_ANSWERED for request in self._open)

    def confirmation(self, packages: int) -> bytes:
        """The question for the account, and for a confirmation of all packages up to this number; none while one is open."""
        if self.has_question:
            return b""
        # No connection has the name 0: the answer says that the router has read all before.
        return self._ask(ACCOUNT) + self._ask(DELETE_ANSWERED, NOBODY, packages)

    def answered(self, number: int, is_done: bool) -> Optional[Request]:
        """Takes the answer to the request of this id; returns the request, if there is one. Requests before it have lost theirs: their
        names wait again."""
        if all(request.id != number for request in self._open):
            return None
        request: Optional[Request] = None
        while request is None or request.id != number:
            request = self._open.popleft()
            if request.name == NOBODY:
                continue
            if request.id == number:
                self.answers[request.name] = is_done
            else:
                self.add(request.name)
        return request

    def _ask(self, kind: int, name: int = NOBODY, packages: int = 0) -> bytes:
        request = Request(next(self._ids) & 0xFF, kind, name, packages)
        self._open.append(request)
        body = b"" if kind == ACCOUNT else name.to_bytes(4, "little")
        return Package(NOBODY, NOBODY, kind, body, id=request.id).encode()
