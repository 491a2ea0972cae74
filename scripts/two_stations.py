"""Packages between two stations of a lab, beside what their slots say: part 5 of bench-packages."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from figures import NotRun, SHARES, in_turns, over, shown

LAB = "bench-packages"
CYCLES = [1, 2]
NETWORK = """
cycle = "{cycle}ms"
network = "10.0.0.0/24"
packages = true
package_routes = "{routes}"

[[station]]
name = "here"
role = "master"

[[station]]
name = "there"
role = "slave"
"""
ROUTES = {"0.Pilot.*": "here", "0.0xff.*": "here", "0.Camera.*": "there"}
THERE, NEAR = "0.Camera.0", "0.Pilot.0"
# Of an Ethernet frame's 1500 bytes IP, UDP and a package's head take 44.
FITS = 1456
AS_PROGRAMS, AS_WATCHERS = 70, 40
# Who watches a core wakes so often, and tells of when that was so much late: neither stations nor programs take as long.
WATCHED_EVERY, STALL = 200_000, 300_000


def on_core(core, priority):
    def change():
        os.sched_setaffinity(0, [core])
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))

    return change


def watch():
    """Tells when this core was taken away, a line each: from when to when, by CLOCK_MONOTONIC, until it is ended."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    due = time.monotonic_ns()
    while True:
        due += WATCHED_EVERY
        time.sleep(max(due - time.monotonic_ns(), 0) / 1e9)
        now = time.monotonic_ns()
        if now > due + STALL:
            print(due, now, flush=True)
        due = max(due, now)


class Lab:
    """Two stations, who answers at both, and who watches the cores."""

    def __init__(self, rtnet, options, cycle, scratch):
        self.rtnet, self.scratch, self.started = rtnet, scratch, []
        self.programs, self.stations = options.cores
        routes, network = Path(scratch, "routes.toml"), Path(scratch, "network.toml")
        routes.write_text("".join(f'[[route]]\nto = "{to}"\nstation = "{at}"\n' for to, at in ROUTES.items()))
        network.write_text(NETWORK.format(cycle=cycle, routes=routes.name))
        self.run("lab", "up", network, "--name", LAB, "--warm-core", "--cpu", self.stations)

    def start(self, command, out, core, priority):
        self.started.append(subprocess.Popen(command, stdout=out, preexec_fn=on_core(core, priority)))

    def begin(self):
        for core in (self.programs, self.stations):
            with Path(self.scratch, f"stalls-{core}").open("w") as out:
                self.start([sys.executable, __file__], out, core, AS_WATCHERS)
        for station, mailbox in (("there", THERE), ("here", NEAR)):
            command = [self.rtnet, "package", "-S", f"{LAB}/{station}", "receive", mailbox, "--echo", "--quiet"]
            self.start(command, subprocess.DEVNULL, self.programs, AS_PROGRAMS)
            deadline = time.monotonic() + 5
            while not json.loads(self.run("mailbox", "-S", f"{LAB}/{station}", "list", "--json")):
                if time.monotonic() > deadline:
                    raise NotRun(f"nobody receives at {station}")
                time.sleep(0.01)

    def run(self, *words, with_figures=False, **more):
        """What it prints; `with_figures`: whether it went well is to be seen there, if there is anything."""
        ran = subprocess.run([self.rtnet, *map(str, words)], capture_output=True, text=True, timeout=120, **more)
        if ran.returncode != 0 and not (with_figures and ran.stdout):
            raise NotRun(f"rtnet {' '.join(map(str, words))}: {ran.stderr.strip()}")
        return ran.stdout

    def ask(self, *words):
        run_as = on_core(self.programs, AS_PROGRAMS)
        asked = ["package", "-S", f"{LAB}/here", "bench", *words, "--json"]
        figures = json.loads(self.run(*asked, with_figures=True, preexec_fn=run_as))
        unknown = not_known(figures)
        if unknown:
            raise NotRun(f"rtnet {' '.join(map(str, asked))}: does not tell {', '.join(unknown)}")
        return figures

    def stalls(self):
        """When a core was taken away: from, to."""
        lines = [line for path in Path(self.scratch).glob("stalls-*") for line in path.read_text().splitlines()]
        return [tuple(map(int, line.split())) for line in lines]

    def router(self):
        """What became of what came from the LAN, but for what was delivered."""
        counted = json.loads(self.run("stat", "-S", f"{LAB}/there", "--json"))["packages"]
        return {what: count for what, count in counted.items() if count and what not in ("delivered", "wakes")}

    def end(self):
        for process in self.started:
            process.terminate()
            process.wait()
        ran = subprocess.run([self.rtnet, "lab", "down", LAB, "--json"], capture_output=True, text=True)
        return next(iter(json.loads(ran.stdout or "[]")), None)


def not_known(figures):
    """What is needed of what was measured, and is not there: none came, or nobody knows."""
    needed = {name: figures[name] for name in ("came", "turns") if name in figures}
    # Between two mailboxes of one station there are no slots, and a stream has no way back.
    if "turns" not in figures and "scheduled" in figures:
        needed |= {name: figures["scheduled"][name] for name in ("two_worst_waits_ns", "round_trip_ns")}
    return [name for name, value in needed.items() if not value]


@contextmanager
def lab_of(rtnet, options, cycle):
    with tempfile.TemporaryDirectory() as scratch:
        lab = Lab(rtnet, options, cycle, scratch)
        try:
            lab.begin()
            yield lab
        finally:
            report = lab.end()
        if report:
            missed = f"{report['slots_missed']} of {report['frames_expected']} slots missed, unexplained {report['unexplained']}"
            print(f"  of the lab, in {report['cycles']} cycles: {missed}", flush=True)


def measure(rtnet, table, options):
    for cycle in CYCLES:
        try:
            with lab_of(rtnet, options, cycle) as lab:
                two_stations(lab, table, options, cycle)
        except (NotRun, subprocess.TimeoutExpired) as error:
            table.note(error)


def micros(share):
    return lambda figures: figures["round_trip_ns"][share] / 1000


def bound(lan, near):
    return lan["scheduled"]["two_worst_waits_ns"] / 1000 + micros("p999")(near)


def without_stall(figures, stalls):
    """Of the longest, those that took longer than two waits though no core was taken away meanwhile."""
    begun = lambda trip: trip["asked_at_ns"]
    had_stall = lambda trip: any(since < begun(trip) + trip["took_ns"] and until > begun(trip) for since, until in stalls)
    longer = [trip for trip in figures["longest"] if trip["took_ns"] > figures["scheduled"]["two_worst_waits_ns"]]
    return sum(not had_stall(trip) for trip in longer)


def two_stations(lab, table, options, cycle):
    seconds = lambda times: f"{round(times * options.seconds * 1000)}ms"
    trips, spread = ["--time", seconds(3)], ["--pause", f"{cycle}ms"]
    subjects = {
        "lan": (THERE, *trips),
        "near": (NEAR, "--time", seconds(1)),
        "lan spread": (THERE, *trips, *spread),
        "near spread": (NEAR, *trips, *spread),
        "stream": (THERE, "--stream", "--size", FITS, "--time", seconds(2)),
    }
    rounds = in_turns(lab, table, subjects, options, f"two stations, cycles of {cycle} ms")
    stalls = lab.stalls()
    for way, words in (("", "one after the other"), (" spread", "asked at all moments")):
        there_and_back(table, rounds, [f"lan{way}", f"near{way}"], f"two stations, {cycle} ms, {words}", stalls)
    one = lambda take: over(rounds, ["stream"], take)
    came = lambda figures: figures["came"] / figures["turns"]
    table.row(f"two stations, {cycle} ms, {FITS} bytes one way: came / turns", one(came), (">=", 0.95))
    table.row("  packages that came", one(lambda figures: figures["came"]), None, 0)
    table.row("  such that were lost", one(lambda figures: figures["lost"]), None, 0)
    table.row("  slots that were missed meanwhile", one(lambda figures: figures["scheduled"]["missed"]), None, 0)
    for what, count in lab.router().items():
        print(f"  packages that came from the LAN: {what} {count}", flush=True)


def there_and_back(table, rounds, names, words, stalls):
    lan = lambda take: over(rounds, names[:1], take)
    for share in SHARES:
        table.row(f"{words}: {shown(share)}, us" if share == "p50" else f"  {shown(share)}, us", lan(micros(share)), None, 1)
    table.row("  between two mailboxes of one station, the same: p99.9, us", over(rounds, names[1:], micros("p999")), None, 1)
    table.row("  bound: two worst slot waits and that, us", over(rounds, names, bound), None, 1)
    for share in SHARES[1:]:
        ratio = lambda lan, near: micros(share)(lan) / bound(lan, near)
        table.row(f"  there and back / bound, {shown(share)}", over(rounds, names, ratio), ("<=", 1.0))
    by_places = lambda lan, near: micros("p99")(lan) / (lan["scheduled"]["round_trip_ns"][1] / 1000 + micros("p999")(near))
    table.row("  the same when it is known where the slots are, p99", over(rounds, names, by_places))
    table.row("  questions", lan(lambda figures: figures["asked"]), None, 0)
    table.row("    without an answer", lan(lambda figures: figures["lost"]), None, 0)
    table.row("    that took longer than two worst slot waits", lan(lambda figures: figures["scheduled"]["longer"]), None, 0)
    table.row("    of the longest ten, such without a stall of a core", lan(lambda figures: without_stall(figures, stalls)), None, 0)
    table.row("    slots that were missed meanwhile", lan(lambda figures: figures["scheduled"]["missed"]), None, 0)


if __name__ == "__main__":
    watch()
