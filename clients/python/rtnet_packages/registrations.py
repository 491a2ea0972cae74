"""The registrations of a connection's mailboxes. The router answers them in their order."""

import itertools
from collections import deque
from typing import Deque, Dict, Iterable, Optional, Tuple

from .names import NOBODY
from .wire import REGISTER, Package

#: Registrations without an answer at a time. Each has an id of its own, which is one byte.
OPEN = 128


class Registrations:
    """Names that wait to be asked for, names that are asked for, and the router's answers."""

    def __init__(self) -> None:
        #: The router's last answer for a name: True if the name is this connection's.
        self.answers: Dict[int, bool] = {}
        self._ids = itertools.count(1)
        #: Names that wait until fewer are open; the keys are in the order of the requests.
        self._waiting: Dict[int, None] = {}
        #: Id and name of the open ones, in the order of the answers.
        self._open: Deque[Tuple[int, int]] = deque()

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
        asked = {name for _, name in self._open}
        for name, is_ours in self.answers.items():
            if not is_ours and name not in asked:
                self.add(name)

    def remove(self, name: int) -> bool:
        """Removes a name; tells whether the router may have it."""
        self._waiting.pop(name, None)
        is_asked = any(asked == name for _, asked in self._open)
        # Nobody takes its answer: if the name is added again, that request has an answer of its own.
        self._open = deque((number, NOBODY if asked == name else asked) for number, asked in self._open)
        return self.answers.pop(name, False) or is_asked

    def requests(self) -> bytes:
        """The requests for names that wait, as many as may be open."""
        data = b""
        while self._waiting and len(self._open) < OPEN:
            name, number = next(iter(self._waiting)), next(self._ids) & 0xFF
            del self._waiting[name]
            self._open.append((number, name))
            data += Package(NOBODY, NOBODY, REGISTER, name.to_bytes(4, "little"), id=number).encode()
        return data

    def answered(self, number: int, is_ours: bool) -> None:
        """Takes the answer to the request of this id. Requests before it have lost theirs: their names wait again."""
        if all(asked != number for asked, _ in self._open):
            return
        asked: Optional[int] = None
        while asked != number:
            asked, name = self._open.popleft()
            if name == NOBODY:
                continue
            if asked == number:
                self.answers[name] = is_ours
            else:
                self.add(name)
