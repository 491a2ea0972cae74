"""What benchmarks have in common: a table of medians with their spread and aims, what the host is, and how they end."""

import os
import platform
import statistics
import sys
from pathlib import Path


SHARES = ["p50", "p99", "p999"]


class NotRun(Exception):
    """What did not run, and why."""


def fail(message, status=2):
    sys.stdout.flush()
    print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    sys.exit(status)


class Table:
    """Lines, and whether anything that was to be measured was not."""

    def __init__(self):
        self.failed = 0
        print(f"{'figure':65} {'':6} {'':>8} {'(spread)':22} {'n':>3}  aim")

    def row(self, what, values, aim=None, places=3):
        if not values:
            print(f"{what:65} did not run")
            return
        value = statistics.median(values)
        spread = f"({min(values):.{places}f}..{max(values):.{places}f})"
        verdict = "-"
        if aim:
            sign, limit = aim
            is_met = value <= limit if sign == "<=" else value >= limit
            verdict = f"{sign} {limit:<4} {'met' if is_met else 'NOT MET'}"
        print(f"{what:65} median {value:8.{places}f} {spread:22} {len(values):3}  {verdict}", flush=True)

    def skip(self, what, why):
        print(f"{what:65} SKIP({why})", flush=True)

    def note(self, error):
        self.failed += 1
        sys.stdout.flush()
        print(f"  did not run: {error}", file=sys.stderr)


def in_turns(bench, table, subjects, options, part):
    """Each of these requests once in every round, and the other way round in the next: name -> figures, a round each."""
    rounds = []
    for number in range(options.rounds):
        print(f"{part}: round {number + 1} of {options.rounds}", file=sys.stderr)
        figures = {}
        for name in list(subjects)[::-1 if number % 2 else 1]:
            try:
                figures[name] = bench.ask(*subjects[name])
            except NotRun as error:
                table.note(error)
        rounds.append(figures)
    return rounds


def over(rounds, names, take):
    """What `take` makes of the figures with these names, of each round that has them all."""
    return [take(*(figures[name] for name in names)) for figures in rounds if all(name in figures for name in names)]


def shown(share):
    return "p99.9" if share == "p999" else share


def quantile(values, q):
    """The smallest value that at least this part of them does not exceed."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, -int(-q * len(ordered) // 1) - 1))]


def host():
    model = next((line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "?")
    load = " ".join(f"{load:.2f}" for load in os.getloadavg())
    return f"host: kernel {platform.release()}, {os.cpu_count()} x {model}, load average {load}"
