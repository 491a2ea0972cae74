"""The packages that wait in a mailbox."""

import heapq
import itertools
from typing import List, Optional, Tuple

from .wire import Package


class Inbox:
    """The packages of one mailbox: the most urgent first, of equals the oldest. A full one refuses packages and counts them."""

    def __init__(self, slots: int) -> None:
        self._slots, self._number = slots, itertools.count()
        self._waiting: List[Tuple[int, int, Package]] = []
        #: Packages that found it full.
        self.refused = 0

    def put(self, package: Package) -> bool:
        """Adds a package, or refuses it; tells whether it was added."""
        is_taken = len(self._waiting) < self._slots
        if is_taken:
            heapq.heappush(self._waiting, (-package.priority, next(self._number), package))
        else:
            self.refused += 1
        return is_taken

    def take(self) -> Optional[Package]:
        """Removes and returns the first package; None if there is none."""
        return heapq.heappop(self._waiting)[2] if self._waiting else None

    def __len__(self) -> int:
        return len(self._waiting)
