"""The bytes that wait for the router, and the end of each package."""

import heapq
import itertools
import struct
from collections import deque
from typing import Callable, Deque, Dict, List, Optional, Tuple

from .wire import OK, control

#: Bytes after which a batch takes no further package.
BATCH = 32 << 10
#: The reasons of an account, in its order.
REASONS = ["nobody_there", "foreign_senders", "forbidden", "receiver_full", "overtaken", "receiver_gone"]


class Leaving:
    """A package on its way out, or a request that keeps its place among packages."""

    __slots__ = ["data", "counts", "has_left"]

    def __init__(self, data: bytes, counts: bool) -> None:
        #: `counts`: whether it is a package.
        self.data, self.counts = data, counts
        #: Whether it has left; None: it waits.
        self.has_left: Optional[bool] = None


class Outgoing:
    """Packages that wait: the most urgent leaves first, of equals the oldest. Requests and answers of the session overtake them: they wait
    for one batch at the most."""

    def __init__(self) -> None:
        #: Packages that have left.
        self.sent = 0
        #: Packages that had not left when their connection ended.
        self.lost = 0
        #: Packages that had left, without the router's confirmation when their connection ended: some may have arrived.
        self.unconfirmed = 0
        #: Packages that the router has read and not passed on, by reason, as it said when it last confirmed any.
        self.lost_at_router: Dict[str, int] = dict.fromkeys(REASONS, 0)
        #: Bytes that wait for a batch, without those of the session.
        self.size = 0
        #: Bytes that have left, of all kinds and connections.
        self.progress = 0
        #: The router waits for a sign of life.
        self.is_asked = False
        self._first = b""
        self._waiting: List[Tuple[int, int, int, Leaving]] = []
        #: How many requests kept their place so far: no package overtakes one, nor the reverse. And numbers of packages and of these.
        self._section, self._number = 0, itertools.count()
        #: The rest of the batch that is being written, and where in the batch that is.
        self._batch, self._written = memoryview(b""), 0
        #: Where in the batch its packages end.
        self._ends: Deque[Tuple[int, Leaving]] = deque()
        #: Requests and answers that keep their place among the packages that wait, and their bytes.
        self._requests = self._requests_size = 0
        #: Packages that the router has read; those of them that do not wait there; and those that wait there, as it said last.
        self._read, self._confirmed, self._waiting_there = 0, 0, 0
        #: The losses at routers of earlier connections.
        self._lost_before = dict(self.lost_at_router)

    def say(self, data: bytes) -> None:
        """Adds a request of the session. It overtakes packages, but no other request."""
        if self._requests and data:
            self.put(data, counts=False)
        else:
            self._first += data

    def put(self, data: bytes, counts: bool = True) -> Leaving:
        """Adds a package; or a request, which does not count as one, and follows the packages before it."""
        leaving = Leaving(data, counts)
        # The third byte of a package is its priority. A request is the last of its section.
        heapq.heappush(self._waiting, (self._section, -data[2] if counts else 1, next(self._number), leaving))
        self._section += not counts
        self._requests += not counts
        self._requests_size += 0 if counts else len(data)
        self.size += len(data)
        return leaving

    @property
    def own(self) -> int:
        """Bytes of the session's requests and answers that wait for a batch."""
        return len(self._first) + self._requests_size

    @property
    def waits(self) -> bool:
        """Whether there is anything to write."""
        return bool(self._batch or self._first or self._waiting or self.is_asked)

    @property
    def is_read(self) -> bool:
        """Whether the router has read all packages that have left."""
        return self.sent == self._read

    @property
    def is_settled(self) -> bool:
        """Whether none of them waits there, either."""
        return self.sent == self._confirmed

    def next(self, confirm: Callable[[int], bytes]) -> memoryview:
        """The bytes to write next; empty if there are none. `confirm` returns the question for all packages up to a number, if any."""
        if not self._batch and (self.waits or not self.is_settled):
            first = control(OK).encode() + self._first if self.is_asked else self._first
            batch, length, sent = [first], len(first), self.sent
            while self._waiting and length < BATCH:
                leaving = heapq.heappop(self._waiting)[3]
                batch.append(leaving.data)
                length += len(leaving.data)
                sent += leaving.counts
                self._requests -= not leaving.counts
                self._requests_size -= 0 if leaving.counts else len(leaving.data)
                self._ends.append((length, leaving))
            self.size -= length - len(first)
            if sent > self._confirmed:
                batch.append(confirm(sent))
            self._batch, self._written, self._first, self.is_asked = memoryview(b"".join(batch)), 0, b"", False
        return self._batch

    def wrote(self, count: int) -> None:
        """So many of those bytes have left."""
        self._batch, self._written = self._batch[count:], self._written + count
        self.progress += count
        while self._ends and self._ends[0][0] <= self._written:
            leaving = self._ends.popleft()[1]
            leaving.has_left = True
            self.sent += leaving.counts

    def confirmed(self, number: int) -> None:
        """The router has read all packages up to this number. Those that wait there may still be lost with it."""
        self._read = max(self._read, min(number, self.sent))
        self._confirmed = max(self._confirmed, self._read - self._waiting_there)

    def account(self, body: bytes) -> None:
        """The router says what it has not passed on of this connection, and how much of it waits there."""
        if not body or len(body) % 8:
            # A router of another make has no account. One of another version may know more reasons, or fewer.
            return
        self._waiting_there, *counts = struct.unpack(f"<{len(body) // 8}Q", body)
        for reason, count in zip(REASONS, counts):
            self.lost_at_router[reason] = max(self.lost_at_router[reason], self._lost_before[reason] + count)

    def end(self) -> None:
        """The connection has ended: counts all that waited."""
        waiting = [leaving for _, leaving in self._ends] + [place[3] for place in self._waiting]
        for leaving in waiting:
            leaving.has_left = False
            self.lost += leaving.counts
        self.unconfirmed += self.sent - self._confirmed
        self.size, self._requests, self._requests_size, self._first, self.is_asked = 0, 0, 0, b"", False
        self._read, self._confirmed, self._waiting_there = self.sent, self.sent, 0
        self._lost_before = dict(self.lost_at_router)
        self._batch = memoryview(b"")
        self._waiting.clear()
        self._ends.clear()
