"""The bytes that wait for the router, and the end of each package."""

import struct
from collections import deque
from typing import Callable, Deque, Dict, Optional, Tuple

#: Bytes after which a batch takes no further package.
BATCH = 32 << 10
#: The reasons of an account, in its order.
REASONS = ["nobody_there", "foreign_senders", "forbidden", "receiver_full", "overtaken"]


class Leaving:
    """A package on its way out."""

    __slots__ = ["package", "has_left"]

    def __init__(self, package: bytes) -> None:
        self.package = package
        #: Whether it has left; None: it waits.
        self.has_left: Optional[bool] = None


class Outgoing:
    """Packages in their order. Requests and answers of the session overtake them: they wait for one batch at the most."""

    def __init__(self) -> None:
        #: Packages that have left.
        self.sent = 0
        #: Packages that had not left when their connection ended.
        self.lost = 0
        #: Packages that had left, without the router's confirmation when their connection ended: some may have arrived.
        self.unconfirmed = 0
        #: Packages that the router has read and not passed on, by reason, as it said when it last confirmed any.
        self.at_router: Dict[str, int] = dict.fromkeys(REASONS, 0)
        #: Those of earlier connections.
        self._before = self.at_router
        #: Bytes of packages that wait for a batch.
        self.size = 0
        self._first = b""
        self._packages: Deque[Leaving] = deque()
        #: The rest of the batch that is being written, and where in the batch that is.
        self._batch, self._written = memoryview(b""), 0
        #: Where in the batch its packages end.
        self._ends: Deque[Tuple[int, Leaving]] = deque()
        self._confirmed = 0

    def say(self, data: bytes) -> None:
        """Adds a request or an answer of the session."""
        self._first += data

    def put(self, package: bytes) -> Leaving:
        """Adds a package."""
        leaving = Leaving(package)
        self._packages.append(leaving)
        self.size += len(package)
        return leaving

    @property
    def waits(self) -> bool:
        """Whether there is anything to write."""
        return bool(self._batch or self._first or self._packages)

    def next(self, confirm: Optional[Callable[[int], bytes]] = None) -> memoryview:
        """The bytes to write next; empty if there are none. `confirm` returns the request to confirm all packages up to a number."""
        if not self._batch and (self._first or self._packages or confirm):
            batch, length, self._written = [self._first], len(self._first), 0
            while self._packages and length < BATCH:
                leaving = self._packages.popleft()
                batch.append(leaving.package)
                length += len(leaving.package)
                self._ends.append((length, leaving))
            self.size -= length - len(self._first)
            self._first = b""
            sent = self.sent + len(self._ends)
            if confirm and sent > self._confirmed:
                batch.append(confirm(sent))
            self._batch = memoryview(b"".join(batch))
        return self._batch

    def wrote(self, count: int) -> None:
        """So many of those bytes have left."""
        self._batch, self._written = self._batch[count:], self._written + count
        while self._ends and self._ends[0][0] <= self._written:
            self._ends.popleft()[1].has_left = True
            self.sent += 1

    def confirmed(self, number: int) -> None:
        """The router has read all packages up to this number."""
        self._confirmed = min(number, self.sent)

    def account(self, body: bytes) -> None:
        """The router says what it has not passed on of this connection."""
        try:
            counts = struct.unpack(f"<{len(REASONS)}Q", body)
        except struct.error:
            # A router of another make has no account.
            return
        self.at_router = {reason: self._before[reason] + count for reason, count in zip(REASONS, counts)}

    def end(self) -> None:
        """The connection has ended: counts all that waited."""
        waiting = [leaving for _, leaving in self._ends] + list(self._packages)
        for leaving in waiting:
            leaving.has_left = False
        self.lost += len(waiting)
        self.unconfirmed += self.sent - self._confirmed
        self.size, self._first, self._confirmed, self._before = 0, b"", self.sent, self.at_router
        self._batch = memoryview(b"")
        self._packages.clear()
        self._ends.clear()
