"""Mailboxes and prioritised packages by a TCP router (`rtnet router`). `rtnet_packages.aio` has the same for asyncio."""

from .client import PORT, Mailbox, Router
from .errors import Failed, Full, NameTaken, NotAvailable, NotConnected, TimedOut, Unavailable
from .names import CLASSES, NOBODY, Name, name, shown
from .tls import keys
from .wire import ERROR, LONGEST, NOT_AVAILABLE, OK, TIMEOUT, Package, ProtocolError

__all__ = [
    "CLASSES", "ERROR", "Failed", "Full", "LONGEST", "Mailbox", "NOBODY", "NOT_AVAILABLE", "Name", "NameTaken", "NotAvailable",
    "NotConnected", "OK", "PORT", "Package", "ProtocolError", "Router", "TIMEOUT", "TimedOut", "Unavailable", "keys", "name", "shown",
]
