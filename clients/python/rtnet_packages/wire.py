"""The bytes of packages, and nothing else: no socket is read here.

    0      1      2        3    4        8        12       16
    +------+------+--------+----+--------+--------+--------+------
    | flags| kind |priority| id | to     | from   | length | body
    +------+------+--------+----+--------+--------+--------+------
      bit 0: to, from and length are little-endian; bit 1: numbers in the body are
"""

import struct
from dataclasses import dataclass, field
from typing import List

from .names import NOBODY, shown

HEAD = 16
#: The longest package, head and body.
LONGEST = 256 << 10

OK, ERROR, TIMEOUT, NOT_AVAILABLE = 0, -1, -2, -3
#: Kinds of control packages, which go to nobody from nobody.
DELETE, REGISTER, DELETE_ANSWERED, PURGE, LIFESIGN, PROOF, ACCOUNT = 12, 13, 14, 15, 17, 20, 22


class ProtocolError(Exception):
    """Bytes that are no package: the connection cannot go on."""


@dataclass(frozen=True)
class Package:
    """A package: a command if its kind is above 0, else a reply or data."""

    to: int
    sender: int
    kind: int
    body: bytes = b""
    #: 0 to 255: larger is more urgent.
    priority: int = 0
    #: Copied into the reply.
    id: int = 0
    #: Whether numbers in the body are little-endian.
    little: bool = field(default=True)

    def encode(self) -> bytes:
        """Its bytes; ValueError if something of it does not fit."""
        length = HEAD + len(self.body)
        if length > LONGEST:
            raise ValueError(f"a package of {length} bytes: head and body together have {LONGEST} at the most")
        flags = 1 | (2 if self.little else 0)
        try:
            head = struct.pack("<BbBBIII", flags, self.kind, self.priority, self.id, self.to, self.sender, length)
        except struct.error as error:
            raise ValueError(f"no package has these numbers: {self!r}: {error}") from None
        return head + self.body

    def reply(self, kind: int = OK, body: bytes = b"") -> "Package":
        """The reply to this command: back to its sender, of its priority and id."""
        return Package(self.sender, self.to, kind, body, self.priority, self.id)

    def __str__(self) -> str:
        return f"{self.kind} from {shown(self.sender)} to {shown(self.to)}, {len(self.body)} bytes"


def control(kind: int, body: bytes = b"") -> Package:
    """A control package: for the router itself."""
    return Package(NOBODY, NOBODY, kind, body)


class Decoder:
    """Packages out of bytes that come in pieces of any length."""

    def __init__(self) -> None:
        self._begun = bytearray()

    def feed(self, data: bytes) -> List[Package]:
        """The packages that these bytes complete. ProtocolError: there is no telling where the next one would begin."""
        self._begun += data
        packages, at = [], 0
        while len(self._begun) - at >= HEAD:
            order = "<" if self._begun[at] & 1 else ">"
            flags, kind, priority, number, to, sender, length = struct.unpack_from(order + "BbBBIII", self._begun, at)
            if not HEAD <= length <= LONGEST:
                raise ProtocolError(f"a package of {length} bytes: it has {HEAD} to {LONGEST}")
            if len(self._begun) - at < length:
                break
            body = bytes(self._begun[at + HEAD : at + length])
            packages.append(Package(to, sender, kind, body, priority, number, bool(flags & 2)))
            at += length
        del self._begun[:at]
        return packages
