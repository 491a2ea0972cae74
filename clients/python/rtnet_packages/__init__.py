"""Mailboxes and prioritised packages by a TCP router (`rtnet router`)."""

from .client import PORT, Mailbox, Router, keys
from .errors import Failed, NameTaken, NotAvailable, NotConnected, TimedOut, Unavailable
from .names import CLASSES, NOBODY, name, shown
from .wire import ERROR, LONGEST, NOT_AVAILABLE, OK, TIMEOUT, Package, ProtocolError

__all__ = [
    "CLASSES", "ERROR", "Failed", "LONGEST", "Mailbox", "NOBODY", "NOT_AVAILABLE", "NameTaken", "NotAvailable", "NotConnected", "OK",
    "PORT", "Package", "ProtocolError", "Router", "TIMEOUT", "TimedOut", "Unavailable", "keys", "name", "shown",
]
