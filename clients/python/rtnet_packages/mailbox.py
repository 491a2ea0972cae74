"""The part of a mailbox that waits for nothing, the same in both fronts."""

from .names import Name, name
from .session import Session
from .wire import OK, Package


class Sender:
    """A mailbox that sends."""

    def __init__(self, session: Session, number: int) -> None:
        self._session = session
        #: The number of its name.
        self.name = number

    def forward(self, package: Package) -> None:
        """Sends a package as it is, such as a reply."""
        raise NotImplementedError

    def send(self, to: Name, kind: int, body: bytes = b"", priority: int = 0, id: int = 0) -> None:
        """Sends a package; the errors are those of `forward`. Whether it arrives is not known: `call` waits for an answer."""
        self.forward(Package(name(to), self.name, kind, body, priority, id))

    def reply(self, command: Package, kind: int = OK, body: bytes = b"") -> None:
        """Answers a command that was received here."""
        self.forward(command.reply(kind, body))

    @property
    def refused(self) -> int:
        """Packages that found it full."""
        return self._session.inboxes[self.name].refused
