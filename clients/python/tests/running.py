"""A router to test with, of the program RTNET_BIN."""

import os
import re
import subprocess
from pathlib import Path
from typing import Optional, Tuple


class RunningRouter:
    """A router on a port of its own, which can be killed and started again."""

    def __init__(self, keys: Optional[str] = None) -> None:
        self.program = os.environ["RTNET_BIN"]
        self.name, self.port, self.keys = f"python-{os.getpid()}", 0, keys
        self._process: Optional["subprocess.Popen[str]"] = None
        self.start()

    @property
    def place(self) -> Tuple[str, int]:
        return "127.0.0.1", self.port

    def start(self) -> None:
        command = [self.program, "router", "--listen", f"127.0.0.1:{self.port}", "--name", self.name]
        if self.keys is not None:
            command += ["--keys", f"{self.keys}/router"]
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert self._process.stderr is not None
        line = self._process.stderr.readline()
        # A kernel without landlock.
        while line.startswith("rtnet: landlock: "):
            line = self._process.stderr.readline()
        found = re.search(r"listens at 127\.0\.0\.1:(\d+)", line)
        assert found, f"the router says: {line}"
        self.port = int(found.group(1))

    def kill(self) -> None:
        assert self._process is not None and self._process.stderr is not None
        self._process.kill()
        self._process.wait()
        self._process.stderr.close()
        # It could not remove its socket and its lock.
        for end in ["", ".lock"]:
            Path(f"/run/rtnet/.router-{self.name}{end}").unlink(missing_ok=True)
