"""The parts of a client and of a mailbox that wait for nothing, the same in both fronts."""

from typing import Dict, Optional

from .names import Name, name, priority_of
from .session import Session
from .wire import OK, Package


class Client:
    """A client, with the fate of its packages over all connections."""

    def __init__(self) -> None:
        self._session = Session()
        #: Connections so far.
        self.connections = 0

    @property
    def sent(self) -> int:
        """Packages that the kernel has taken; in an event loop those that the loop has taken."""
        return self._session.outgoing.sent

    @property
    def lost(self) -> int:
        """Packages that were lost with a connection before they had left. A thread that waits for that has got NotConnected."""
        return self._session.outgoing.lost

    @property
    def unconfirmed(self) -> int:
        """Packages of `sent` that the router had not confirmed when their connection was lost: some may have arrived."""
        return self._session.outgoing.unconfirmed

    @property
    def lost_at_router(self) -> Dict[str, int]:
        """Packages, and answers, that the router has read and not passed on, by the reasons in its status."""
        return dict(self._session.outgoing.lost_at_router)

    @property
    def strays(self) -> int:
        """Packages for mailboxes that are gone. A command among them is answered NOT_AVAILABLE, as one that finds its mailbox full."""
        return self._session.strays

    @property
    def answers_lost(self) -> int:
        """Such answers that were not sent, since too many waited."""
        return self._session.answers_lost


class Sender:
    """A mailbox that sends."""

    def __init__(self, session: Session, number: int) -> None:
        self._session = session
        #: The number of its name.
        self.name = number

    def forward(self, package: Package) -> None:
        """Sends a package as it is, such as a reply."""
        raise NotImplementedError

    def send(self, to: Name, kind: int, body: bytes = b"", priority: Optional[int] = None, id: int = 0) -> None:
        """Sends a package, of the priority of this mailbox's class unless another is given; the errors are those of `forward`.

        Whether it arrives is not known: `call` waits for an answer.
        """
        self.forward(self._package(name(to), kind, body, priority, id))

    def _package(self, to: int, kind: int, body: bytes, priority: Optional[int], id: int = 0) -> Package:
        return Package(to, self.name, kind, body, priority_of(self.name) if priority is None else priority, id)

    def reply(self, command: Package, kind: int = OK, body: bytes = b"") -> None:
        """Answers a command that was received here."""
        self.forward(command.reply(kind, body))

    @property
    def refused(self) -> int:
        """Packages that found it full."""
        return self._session.inboxes[self.name].refused
