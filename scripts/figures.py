"""What benchmarks have in common: how long they take, tables of medians with their spread and aims, what the host is, and how
they end."""

import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

SHARES = ["p50", "p99", "p999"]
# What stands behind the last comma of a figure's name, if it has a unit.
UNITS = ["ns", "us", "ms", "s", "%", "KiB", "MiB", "Mbit/s", "cycles"]


class NotRun(Exception):
    """What did not run, and why."""


def fail(message, status=2):
    sys.stdout.flush()
    print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    sys.exit(status)


def built(what, *command):
    """Builds something of this checkout, and tells where the program is that cargo calls `what`; none if it does not build."""
    if not shutil.which("cargo"):
        fail("'cargo' is missing: Debian package cargo, or rustup")
    ran = subprocess.run(["cargo", *command, "--message-format=json"], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    messages = [json.loads(line) for line in ran.stdout.splitlines() if line.startswith("{")]
    for message in messages if ran.returncode == 0 else []:
        if message.get("executable") and message["target"]["name"] == what:
            return message["executable"]
    return None


def built_benchmark(name):
    """A program of tests/benches."""
    return built(name, "bench", "-p", "tests", "--bench", name, "--no-run") or fail(f"the benchmark '{name}' does not build")


def built_rtnet():
    """The command: RTNET_BIN names one to measure instead of building one."""
    if os.environ.get("RTNET_BIN"):
        return shutil.which(os.environ["RTNET_BIN"]) or fail(f"there is no program {os.environ['RTNET_BIN']}")
    return built("rtnet", "build", "--release", "-p", "rtnet-tools", "--bin", "rtnet") or fail("rtnet does not build")


def add_lengths(parser, **lengths):
    """How long it takes: in full, briefly (`scripts/bench` asks for that), or only to see that it works. Of each option by its
    name: the default and the two others; see `chosen_lengths`."""
    parser.set_defaults(lengths=lengths)
    for name, (whole, brief, quick) in lengths.items():
        said = f"(default: {whole}; --brief: {brief}; --quick: {quick})"
        parser.add_argument(f"--{name}", type=type(whole), help=said)
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--brief", action="store_true", help="less of everything: the figures are worth a look")
    either.add_argument("--quick", action="store_true", help="as little as can be, only to see that it works")
    parser.add_argument("--figures", metavar="FILE", help="append a line for each figure that has an aim, for scripts/bench")


def chosen_lengths(options):
    """Fills in what was not said, and begins the file of figures."""
    place = 1 if options.brief else 2 if options.quick else 0
    for name, whole_brief_quick in options.lengths.items():
        if getattr(options, name) is None:
            setattr(options, name, whole_brief_quick[place])
    del options.lengths
    Report.begin(options.figures)


class Report:
    """The lines for scripts/bench, their parts parted by tabs:

        FIGURE  name  value  unit  aim  met, MISSED or inconclusive  least..most
        SKIP    name  why
        FAILED  name  why
    """

    file = None

    @classmethod
    def begin(cls, path):
        cls.file = open(path, "a", encoding="utf-8") if path else None

    @classmethod
    def line(cls, *parts):
        if cls.file:
            print(*(str(part).replace("\t", " ").replace("\n", " ") for part in parts), sep="\t", file=cls.file, flush=True)


def is_met(value, aim):
    sign, limit = aim
    return value <= limit if sign == "<=" else value >= limit


def judged(name, value, aim, least, most, places=3, interval=None):
    """`met` or `MISSED`, also for scripts/bench; `-` if there is no aim. With an interval in which the figure lies: `inconclusive` if only
    one of its ends meets the aim."""
    if not aim:
        return "-"
    met = {is_met(bound, aim) for bound in interval or [value]}
    verdict = "inconclusive" if len(met) == 2 else "met" if met == {True} else "MISSED"
    what, _, unit = name.rpartition(", ")
    what, unit = (what, unit) if unit in UNITS else (name, "")
    spread = f"{least:.{places}f}..{most:.{places}f}"
    Report.line("FIGURE", what, f"{value:.{places}f}", unit, f"{aim[0]} {aim[1]}", verdict, spread)
    return verdict


class Names:
    """The whole names of rows: what is indented belongs to what stands above it."""

    def __init__(self):
        self.above = []

    def of(self, row):
        name = row.strip()
        depth = len(row) - len(row.lstrip())
        self.above = [(deep, words) for deep, words in self.above if deep < depth]
        whole = ": ".join([*(words for _, words in self.above), name])
        self.above.append((depth, name.rpartition(", ")[0] if name.rpartition(", ")[2] in UNITS else name))
        return whole


class Table:
    """Lines, and whether anything that was to be measured was not."""

    def __init__(self, width=65):
        self.failed, self.width, self.names = 0, width, Names()
        print(f"{'figure':{width}} {'':6} {'':>8} {'(spread)':22} {'n':>3}  aim")

    def row(self, what, values, aim=None, places=3, kind="median", spread=lambda values: (min(values), max(values)), value=None, interval=None):
        """The figure is of that kind, of `values`; a figure of another kind is `value`, and `values` those of the rounds.

        `interval`: between what `value` lies; it is shown in place of the spread.
        """
        name = self.names.of(what)
        if not values:
            print(f"{what:{self.width}} did not run")
            if aim:
                Report.line("FAILED", name, "did not run")
            return
        if value is None:
            value = {"median": statistics.median, "mean": statistics.mean, "sum": sum, "max": max}[kind](values)
        least, most = interval or spread(values)
        shown = f"({least:.{places}f}..{most:.{places}f})"
        verdict = judged(name, value, aim, least, most, places, interval)
        said = f"{aim[0]} {aim[1]:<4} {verdict}" if aim else verdict
        print(f"{what:{self.width}} {kind:6} {value:8.{places}f} {shown:22} {len(values):3}  {said}", flush=True)

    def skip(self, what, why):
        print(f"{what:{self.width}} SKIP({why})", flush=True)
        Report.line("SKIP", self.names.of(what), why)

    def note(self, error):
        self.failed += 1
        sys.stdout.flush()
        print(f"  did not run: {error}", file=sys.stderr)
        Report.line("FAILED", "a measurement", error)


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
