"""A lab's medium from its capture (pcapng): its frames, when its cycles began, and the slots of a station."""

import statistics
import struct
from bisect import bisect_left, bisect_right

from figures import NotRun

PACKAGES_PORT = 8192
RTMAC_ETHERTYPE, IPV4_ETHERTYPE = b"\x90\x21", b"\x08\x00"
# RTmac's head, then TDMA's version and its number of a synchronisation.
SYNC = bytes.fromhex("0001 02 00 0201 0000".replace(" ", ""))
# The clocks of a lab, and the stamps of its capture, differ by less than this.
EARLY_NS = 20_000


def frames(path):
    """Each frame of a capture, and its stamp in ns."""
    data, at, order = path.read_bytes(), 0, "<"
    while at + 12 <= len(data):
        if data[at : at + 4] == b"\x0a\x0d\x0d\x0a":
            order = "<" if data[at + 8 : at + 12] == b"\x4d\x3c\x2b\x1a" else ">"
        kind, length = struct.unpack_from(order + "II", data, at)
        if length < 12 or at + length > len(data):
            raise NotRun("the capture is not whole")
        # An interface description has the option if_tsresol (code 9, 1 byte): 9.
        if kind == 1 and struct.pack(order + "HHB", 9, 1, 9) not in data[at + 16 : at + length]:
            raise NotRun("the stamps of the capture are not in ns")
        if kind == 6:
            high, low, captured = struct.unpack_from(order + "III", data, at + 12)
            yield (high << 32) | low, data[at + 28 : at + 28 + captured]
        at += length


def is_package(frame):
    """Whether it is a real-time UDP datagram to the port of packages."""
    if frame[12:14] != IPV4_ETHERTYPE or frame[23] != 17:
        return False
    return struct.unpack_from(">H", frame, 14 + 4 * (frame[14] & 15) + 2)[0] == PACKAGES_PORT


def scheduled(frame):
    """When a synchronisation was to be sent, by the master's clock; `None`: it is another frame."""
    is_sync = frame[12:14] == RTMAC_ETHERTYPE and frame[14:22] == SYNC
    return struct.unpack_from(">Q", frame, 34)[0] if is_sync else None


class Schedule:
    """When cycles began, by the capture's clock: syncs carry the scheduled instants by the master's clock."""

    def __init__(self, syncs):
        """`syncs`: stamp, scheduled instant."""
        self.stamps, self.scheduled = [stamp for stamp, _ in syncs], [scheduled for _, scheduled in syncs]
        self.first, span = self.stamps[0], self.stamps[-1] - self.stamps[0] + 1
        self.parts = max(1, round(span / 1e9))
        self.length = span / self.parts
        parts = [[] for _ in range(self.parts)]
        for stamp, scheduled in syncs:
            parts[self.part(stamp)].append((stamp, stamp - scheduled))
        if not all(parts):
            raise NotRun("a second without syncs")
        # The clocks drift by some 10 us in a second: first by how much, then the smallest difference in each second.
        middles = [statistics.fmean(stamp for stamp, _ in part) - self.first for part in parts]
        apart = [statistics.median(difference for _, difference in part) for part in parts]
        self.drift = (apart[-1] - apart[0]) / (middles[-1] - middles[0]) if self.parts > 1 else 0.0
        self.least = [min(difference - self.drift * (stamp - self.first) for stamp, difference in part) for part in parts]

    def part(self, stamp):
        return min(self.parts - 1, max(0, int((stamp - self.first) / self.length)))

    def last_begin(self, stamp):
        """When the cycle of the last sync before that began."""
        place = max(0, bisect_right(self.stamps, stamp) - 1)
        return self.scheduled[place] + self.least[self.part(stamp)] + self.drift * (stamp - self.first)


def slots(capture, address, period_ns, offsets_ns, windows):
    """Slot errors, slots, missed ones, packages and the time between them, of a station in all windows of each kind.

    `offsets_ns`: where its slots begin in the cycle. `windows`: kind, begin, end.
    """
    offsets, since, until = sorted(offsets_ns), windows[0][1] - 10**8, windows[-1][2] + 10**8
    syncs, sent = [], []
    for stamp, frame in frames(capture):
        if not since <= stamp <= until:
            continue
        if (instant := scheduled(frame)) is not None:
            syncs.append((stamp, instant))
        elif frame[6:12] == address:
            sent.append((stamp, is_package(frame)))
    if not syncs or not sent:
        raise NotRun("the capture has no syncs, or no frames of the station")
    syncs.sort()
    sent.sort()
    schedule, stamps, figures = Schedule(syncs), [stamp for stamp, _ in sent], {}
    for kind, begun, ended in windows:
        of = figures.setdefault(kind, {"errors": [], "slots": 0, "missed": 0, "packages": 0, "between_ns": 0})
        # Cycles whose first slot begins in the window; frames of the last one come after it.
        first = begun + (schedule.last_begin(begun) + offsets[0] - begun) % period_ns
        cycles, used = int((ended - first) // period_ns), set()
        asked = []
        for place in range(bisect_left(stamps, begun - period_ns), bisect_right(stamps, ended + 2 * period_ns)):
            stamp, is_question = sent[place]
            # Since the first slot; where a sync is missing, the last one is some cycles ago.
            since_first = (stamp - schedule.last_begin(stamp) - offsets[0] + EARLY_NS) % period_ns - EARLY_NS
            number = round((stamp - since_first - first) / period_ns)
            if not 0 <= number < cycles:
                continue
            if is_question:
                asked.append(stamp)
            # A frame comes in its slot or later, never before it.
            slot = bisect_right(offsets, since_first + offsets[0] + EARLY_NS) - 1
            used.add((number, slot))
            of["errors"].append(since_first + offsets[0] - offsets[slot])
        of["slots"] += cycles * len(offsets)
        of["missed"] += cycles * len(offsets) - len(used)
        if len(asked) > 1:
            of["packages"] += len(asked) - 1
            of["between_ns"] += asked[-1] - asked[0]
    return figures
