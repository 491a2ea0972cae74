"""Routers that do not what a router does."""

import socket
import threading
from types import TracebackType
from typing import Callable, List, Optional, Tuple, Type


class FakeRouter:
    """Does one thing with each connection, and nothing else. It keeps connections open until its end."""

    def __init__(self, do: Callable[[socket.socket], None] = lambda connection: None) -> None:
        self._do, self._listener = do, socket.create_server(("127.0.0.1", 0))
        #: All connections so far.
        self.accepted: List[socket.socket] = []
        self._thread = threading.Thread(target=self._accept)
        self._thread.start()

    @property
    def place(self) -> Tuple[str, int]:
        return "127.0.0.1", int(self._listener.getsockname()[1])

    def __enter__(self) -> "FakeRouter":
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        for closed in [self._listener, *self.accepted]:
            closed.close()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self.accepted.append(connection)
            self._do(connection)
