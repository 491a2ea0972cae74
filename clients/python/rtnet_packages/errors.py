"""The errors of calls, mailboxes and connections."""

from .names import shown
from .wire import ERROR, NOT_AVAILABLE, TIMEOUT, Package


class Unavailable(Exception):
    """A call that was not answered as it should be."""


class NotAvailable(Unavailable):
    """Nobody has the mailbox, or it has no room."""


class Failed(Unavailable):
    """The other side answers that it cannot."""


class TimedOut(Unavailable):
    """No answer came in time, or the other side says that something took too long."""


class NotConnected(Exception):
    """There is no router now. The client connects again by itself; what was to be sent was not."""


class NameTaken(Exception):
    """Another connection of the router has this mailbox, or this one has it already."""


#: Errors by the kind of the reply.
_ERRORS = {ERROR: Failed, TIMEOUT: TimedOut, NOT_AVAILABLE: NotAvailable}


def checked(reply: Package) -> Package:
    """A reply that is no error; else the error."""
    error = _ERRORS.get(reply.kind)
    if error:
        raise error(f"{shown(reply.sender)} answers {reply.kind}")
    return reply
