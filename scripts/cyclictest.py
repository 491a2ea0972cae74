"""Wake-up latencies of a real-time thread, measured by cyclictest: the host without any network."""

import ctypes
import json
import os
import shutil
import signal
import subprocess
from contextlib import contextmanager

from figures import NotRun, fail

# That of a lab's slaves.
PRIORITY = 80
# Upper end of the histogram, ns: the highest that cyclictest accepts.
HISTOGRAM = 1_000_000
PR_SET_PDEATHSIG = 1


def needed():
    """Ends the program where there is no cyclictest."""
    if not shutil.which("cyclictest"):
        fail("'cyclictest' is missing: Debian package rt-tests")


@contextmanager
def warm_core(cpu):
    """Keeps a core from idling, as `--warm-core` does for a lab. It dies with this process."""
    pid = os.fork()
    if pid == 0:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        os.sched_setaffinity(0, {cpu})
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        while True:
            pass
    try:
        yield
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


class WakeUps:
    """Latencies in ns of one run."""

    def __init__(self, thread, due):
        self.n, self.min, self.max, self.due = thread["cycles"], thread["min"], thread["max"], due
        self.seen = sorted((int(latency), count) for latency, count in thread["histogram"].items())

    def percentile(self, share):
        rank = share * self.n
        for latency, count in self.seen:
            rank -= count
            if rank <= 0:
                return latency
        return self.max

    def later_than(self, limit):
        """Share, in %, of those that were due: cyclictest neither makes up for what it slept through, nor counts it."""
        within = sum(count for latency, count in self.seen if latency <= limit)
        return 100 * (1 - within / self.due)


def wake_ups(cpu, interval_us, seconds, scratch):
    """Runs cyclictest on a core that is kept warm."""
    out = scratch / "cyclictest.json"
    command = [
        "cyclictest", "--mlockall", "--policy=fifo", f"--priority={PRIORITY}", "--threads=1", "--quiet", "--nsecs",
        f"--affinity={cpu}", f"--interval={interval_us}", f"--duration={seconds}", f"--histogram={HISTOGRAM}",
        f"--json={out}",
    ]
    with warm_core(cpu):
        ran = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if ran.returncode != 0:
        raise NotRun(f"cyclictest failed: {ran.stderr.strip()}")
    thread = json.loads(out.read_text())["thread"]["0"]
    return WakeUps(thread, max(thread["cycles"], seconds * 1_000_000 // interval_us))
