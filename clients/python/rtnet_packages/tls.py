"""A client's keys for TLS, and the proof that it knows the router's secret.

The proof needs a value that only the two ends of a session can compute (RFC 8446, 7.5). Python's ssl does not export it. But OpenSSL
writes the secret that it is derived from to a log of keys. Here that log is a file in memory, for one handshake.
"""

import hashlib
import hmac
import os
import re
import ssl
import struct
from pathlib import Path
from types import TracebackType
from typing import Optional, Type, Union

from .wire import PROOF, control

_LABEL = b"EXPORTER-rtnet-router-secret"
#: Where a process finds its open files by their number.
_FILES = "/proc/self/fd"


class _Keys(ssl.SSLContext):
    """The keys of a client, from this directory."""

    place: Path
    secret: Optional[bytes]

    def __new__(cls, place: Path, secret: Optional[bytes]) -> "_Keys":
        self = super().__new__(cls, ssl.PROTOCOL_TLS_CLIENT)
        self.place, self.secret = place, secret
        self.minimum_version = ssl.TLSVersion.TLSv1_3
        self.load_verify_locations(str(place / "ca.pem"))
        if (place / "client.pem").exists():
            self.load_cert_chain(str(place / "client.pem"), str(place / "client.key"))
        return self


def keys(directory: Union[str, Path]) -> ssl.SSLContext:
    """The keys of a client, from a directory as `rtnet router keys` makes it.

    It holds `ca.pem`, by which the client knows the router, and `client.pem` with `client.key`, or `secret`, or all of them.
    FileNotFoundError: something is missing. On systems without memory files (all but Linux) the secret alone is not enough.
    """
    place = Path(directory)
    has = {file: (place / file).exists() for file in ["ca.pem", "client.pem", "client.key", "secret"]}
    if not has["ca.pem"]:
        raise FileNotFoundError(f"{place} has no ca.pem, by which a client knows the router: copy it from the router's keys")
    if has["client.pem"] and not has["client.key"]:
        raise FileNotFoundError(f"{place} has client.pem and no client.key: copy both from where they were made")
    if not has["client.pem"] and not has["secret"]:
        raise FileNotFoundError(f"{place} has neither client.pem nor secret: copy client.pem and client.key, or secret, to it")
    can_prove = _can_log()
    if not has["client.pem"] and not can_prove:
        raise FileNotFoundError(
            f"{place} has no client.pem and no client.key, and its secret is not enough here: Python's ssl has no exporter, and "
            f"this system has no memory files in its place; copy client.pem and client.key to it"
        )
    return _Keys(place, (place / "secret").read_bytes().strip() if has["secret"] and can_prove else None)


def _can_log() -> bool:
    """Whether there are memory files."""
    return hasattr(os, "memfd_create") and os.path.isdir(_FILES)


class Handshake:
    """The begin of one connection; `with` ends it."""

    def __init__(self, tls: Optional[ssl.SSLContext]) -> None:
        #: Makes the session; None: it is not encrypted.
        self.context = tls
        self._secret: Optional[bytes] = None
        self._log: Optional[int] = None

    def __enter__(self) -> "Handshake":
        if isinstance(self.context, _Keys) and self.context.secret is not None:
            # A context of its own, so that the log is of this session.
            self.context, self._secret = _Keys(self.context.place, self.context.secret), self.context.secret
            self._log = os.memfd_create("rtnet-handshake")
            self.context.keylog_filename = f"{_FILES}/{self._log}"
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        if self._log is not None:
            # The context lives as long as its session: it closes the log.
            setattr(self.context, "keylog_filename", None)
            os.close(self._log)

    def proof(self) -> bytes:
        """The package that a client with a secret sends first, once its session has begun; else nothing."""
        if self._secret is None or self._log is None:
            return b""
        found = re.search(rb"^EXPORTER_SECRET \w+ (\w+)", os.pread(self._log, 1 << 16, 0), re.MULTILINE)
        if found is None:
            raise ssl.SSLError("OpenSSL has logged no exporter secret, from which the proof is made: a certificate needs none")
        value = exported(bytes.fromhex(found[1].decode()), _LABEL)
        return control(PROOF, hmac.new(self._secret, value, "sha256").digest()).encode()


def exported(secret: bytes, label: bytes) -> bytes:
    """32 bytes that a session of TLS 1.3 with this exporter secret exports, without a context (RFC 8446, 7.5)."""
    kind = {32: "sha256", 48: "sha384"}[len(secret)]
    empty = hashlib.new(kind).digest()
    derived = _expanded(kind, secret, label, empty, len(secret))
    return _expanded(kind, derived, b"exporter", empty, 32)


def _expanded(kind: str, secret: bytes, label: bytes, context: bytes, length: int) -> bytes:
    """HKDF-Expand-Label (RFC 8446, 7.1), of no more bytes than one hash has."""
    label = b"tls13 " + label
    info = struct.pack(">HB", length, len(label)) + label + struct.pack("B", len(context)) + context
    return hmac.new(secret, info + b"\x01", kind).digest()[:length]
