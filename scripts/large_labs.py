"""Missed slots of labs with many stations on one core, and late wake-ups of cyclictest on that core."""

import json
import statistics
import subprocess
import sys

from cyclictest import wake_ups
from figures import NotRun

# Stations, and the aims: slots missed by wake-ups of cyclictest behind the last moment, per cent of the core.
SIZES = {8: (0.5, 25), 16: (1.0, 45), 32: (1.5, 75)}
CYCLE, CYCLE_US = "1ms", 1_000
# A lab that does not get locked ends by itself in less.
JOINS_WITHIN = 120


def report_of(rtnet, cpu, stations, cycle, seconds, scratch):
    """A lab's report. A bad verdict (status 1) is a result as any other."""
    out = scratch / "lab.json"
    out.write_text("")
    command = [rtnet, "lab", "run", "--stations", str(stations), "--cycle", cycle, "--warm-core", "--cpu", str(cpu),
               "--duration", f"{seconds}s", "--json", str(out)]
    # Ctrl-C is not for the lab: it ends by itself.
    ran = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, start_new_session=True,
                         timeout=JOINS_WITHIN + 2 * seconds)
    report = json.loads(out.read_text() or "null")
    if report is None or report["frames_expected"] == 0:
        raise NotRun(f"`lab run` ended with status {ran.returncode}: {ran.stderr.strip()}")
    report["missed_percent"] = 100 * report["slots_missed"] / report["frames_expected"]
    return report


def show(stations, report, more=""):
    """Prints the figures of a report, the reasons of its verdict, and its unexplained misses."""
    error = report["slot_error_abs_ns"]
    errors = " ".join(f"{error[share] / 1000:.2f}" for share in ("p50", "p99", "p999"))
    print(f"{stations} stations: {report['slots_missed']} of {report['frames_expected']} slots missed,"
          f" {report['missed_percent']:.3f} %{more}; slot error, abs, p50 p99 p99.9: {errors} us;"
          f" lead {report['lead_ns'] / 1000:.1f} us, last moment {report['last_moment_ns'] / 1000:.1f} us;"
          f" cpu {report['rt_cpu_percent']:.1f} %; overlaps {report['overlaps']}, out of slot {report['out_of_slot']},"
          f" unexplained {report['unexplained']}, steal ticks {report['host']['steal_ticks']}")
    for line in report["verdict"]["reasons"]:
        print(f"  lab: {line}")
    for miss in report["misses"]:
        if miss["kind"] == "unexplained":
            print(f"  unexplained: {miss['station']} in cycle {miss['cycle']}, {miss['span_ns'] / 1000:.2f} us")
    sys.stdout.flush()


def beside_cyclictest(rtnet, cpu, stations, seconds, scratch):
    """A lab between two runs of cyclictest on its core: misses, and the share of wake-ups behind the last moment, in %."""
    wakes = lambda: wake_ups(cpu, CYCLE_US, seconds, scratch)
    before, report, after = wakes(), report_of(rtnet, cpu, stations, CYCLE, seconds, scratch), wakes()
    # A station wakes that much before the last moment for its frame.
    limit = report["lead_ns"] + report["last_moment_ns"]
    floor = statistics.mean(of.later_than(limit) for of in (before, after))
    show(stations, report, f", cyclictest {floor:.3f} % later than {limit / 1000:.1f} us")
    return {"missed": report["missed_percent"], "floor": floor, "cpu": report["rt_cpu_percent"],
            "overlaps": report["overlaps"], "out of slot": report["out_of_slot"], "unexplained": report["unexplained"]}


def rows(row, stations, rounds):
    """The table of a size: ratios of all rounds together, for a round has hardly a late wake-up."""
    by_floor, cpu = SIZES[stations]
    column = lambda name: [of[name] for of in rounds]
    row(f"{stations} stations at {CYCLE}: missed slots, %", column("missed"), kind="mean")
    row("  cyclictest's wake-ups behind the last moment, %", column("floor"), kind="mean")
    floor = sum(column("floor"))
    if floor:
        row("  missed / those, all rounds", [sum(column("missed")) / floor], ("<=", by_floor))
    else:
        print("  missed / those: no wake-up of cyclictest was behind it")
    row("  real-time threads, % of a core", column("cpu"), ("<=", cpu))
    row("  overlaps", column("overlaps"), ("<=", 0), kind="sum")
    row("  out of slot", column("out of slot"), kind="sum")
    row("  unexplained", column("unexplained"), ("<=", 0), kind="sum")
