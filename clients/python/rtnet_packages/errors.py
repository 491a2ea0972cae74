"""The errors of calls, mailboxes and connections."""

from typing import Optional

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
    """There is no router now, and nothing was sent. The client connects again by itself."""


class Full(Exception):
    """The connection takes no more; it was not sent. Only the asyncio client raises it: the one for threads waits."""


class NameTaken(Exception):
    """The router refuses the mailbox: another connection has the name, or a rule or a limit forbids it. Or this client has it already."""


#: Errors by the kind of the reply.
_ERRORS = {ERROR: Failed, TIMEOUT: TimedOut, NOT_AVAILABLE: NotAvailable}


def checked(reply: Optional[Package], to: int, timeout: float) -> Package:
    """The reply to a call; an error if there is none within `timeout` seconds, or if it is one."""
    if reply is None:
        raise TimedOut(f"{shown(to)} has not answered within {timeout} s")
    error = _ERRORS.get(reply.kind)
    if error:
        raise error(f"{shown(reply.sender)} answers {reply.kind}")
    return reply
