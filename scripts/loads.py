"""Programs that run in windows of time, and are stopped outside them."""

import os
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path


class Program:
    """A process that `rtnet lab exec` becomes, in a process group of its own."""

    def __init__(self, what, words, environment, stdout):
        self.what, self.inside_ns = what, 0
        self.process = subprocess.Popen(words, env=environment, stdout=stdout, stderr=subprocess.DEVNULL, start_new_session=True)

    def signal(self, number):
        try:
            os.killpg(self.process.pid, number)
        except ProcessLookupError:
            pass

    def cpu_ns(self):
        """The time that all its threads have had a core."""
        used = 0
        for path in Path(f"/proc/{self.process.pid}/task").glob("*/schedstat"):
            try:
                used += int(path.read_text().split()[0])
            except (OSError, IndexError):
                pass
        return used

    def park(self):
        """Stops it until its first window."""
        self.signal(signal.SIGSTOP)
        time.sleep(0.02)
        self.parked_ns = self.cpu_ns()

    def resume(self):
        self.resumed_ns = self.cpu_ns()
        self.signal(signal.SIGCONT)

    def pause(self):
        self.signal(signal.SIGSTOP)
        self.inside_ns += self.cpu_ns() - self.resumed_ns

    def end(self):
        self.signal(signal.SIGCONT)
        self.signal(signal.SIGKILL)
        self.process.wait()


@contextmanager
def signals_later():
    """Ctrl-C and SIGTERM take effect behind this block."""
    came, numbers = [], (signal.SIGINT, signal.SIGTERM)
    handlers = [signal.signal(number, lambda number, _: came.append(number)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, handlers):
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


@contextmanager
def before_all_loads(core):
    """This script does not use the lab's core, and does not wait for loads."""
    cores, policy = os.sched_getaffinity(0), os.sched_getscheduler(0)
    os.sched_setaffinity(0, [core])
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, os.sched_param(0))
        os.sched_setaffinity(0, cores)
