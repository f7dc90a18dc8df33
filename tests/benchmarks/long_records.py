"""Time and memory of the command identify on long records of an oracle stage.

    python tests/benchmarks/long_records.py --json long_records.json

The stage is one of tests/oracles, which share no code with piezojax. Its careful
record, of 60 844 samples, is identified with all models; careful records of other
seeds, one after the other up to 1 000 000 samples, with the default model. With --stop
the first command gets Ctrl-C after so many seconds, and is given again: the table then
holds the time of both together. Memory is the largest resident size of the process.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles import excitation, forty_stages

STAGE, MILLION = 4, 1_000_000


class Case(NamedTuple):
    """A record of at least so many samples, and the options of the command."""

    samples: int
    options: tuple[str, ...]


COLUMNS = (
    *("--time", "time_s", "--input", "input_V"),
    *("--output", "displacement_um"),
)
CASES = {"all models": Case(1, ("--model", "all")), "default": Case(MILLION, ())}


def columns_of(stage, samples):
    """Return time (s), voltage (V) and reading (um) of careful records in a row."""
    voltages = np.zeros(0)
    for seed in range(samples):
        random = np.random.default_rng([40, seed])
        voltages = np.append(voltages, excitation.careful(stage.parameters, random))
        if len(voltages) >= samples:
            break
    voltages = voltages[:samples] if samples > 1 else voltages
    first = stage.reset(voltages[0], 0)
    readings = np.concatenate([[first], stage.respond(voltages[:-1])[0]])
    return np.c_[stage.dt * np.arange(len(voltages)), voltages, readings]


def timed(command, stop=None):
    """Return seconds, peak memory (GB) and exit status; Ctrl-C after ``stop`` s."""
    begun = time.perf_counter()
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    timer = threading.Timer(stop or 1e9, running.send_signal, [signal.SIGINT])
    timer.daemon = True
    timer.start()
    _, status, usage = os.wait4(running.pid, 0)
    timer.cancel()
    seconds = time.perf_counter() - begun
    return seconds, usage.ru_maxrss / 1e6, os.waitstatus_to_exitcode(status)


def line_of(case, stop):
    """Return the line of a case: samples, seconds, memory, and what was found."""
    columns = columns_of(forty_stages.stage(STAGE), case.samples)
    with tempfile.TemporaryDirectory() as name:
        record, out = Path(name, "record.csv"), Path(name, "out")
        header = "time_s,input_V,displacement_um"
        np.savetxt(record, columns, "%.9g", ",", header=header, comments="")
        command = [sys.executable, "-m", "piezojax.identify", str(record)]
        command += [*COLUMNS, *case.options, "--out", str(out)]
        seconds, memory, status = timed(command, stop)
        line = {"samples": len(columns), "stopped": status if stop else None}
        if stop:
            more, memory, status = timed(command)
            seconds += more
        if status not in (0, 3):  # with an alarm
            raise SystemExit(f"identify ended with status {status}")
        line |= {"seconds": seconds, "memory_GB": memory, "status": status}
        if (fit := out / "fit.json").is_file():
            report = json.loads(fit.read_text("utf-8"))
            line |= {"model": report["model"], "rmse_um": report["validation"]["rmse"]}
    return line


def table_of(lines):
    table = Table(title="python -m piezojax.identify")
    table.add_column("models")
    names = ("samples", "seconds", "memory_GB", "status", "model", "rmse_um")
    for name in names:
        table.add_column(name, justify="right")
    for case, line in lines.items():
        shown = (line.get(name, "-") for name in names)
        cells = (f"{x:.4g}" if isinstance(x, float) else str(x) for x in shown)
        table.add_row(case, *cells)
    return table


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, required=True, metavar="FILE")
    parser.add_argument("--cases", nargs="*", choices=CASES, default=[*CASES])
    parser.add_argument("--stop", type=float, metavar="SECONDS")
    chosen = parser.parse_args()
    lines = {name: line_of(CASES[name], chosen.stop) for name in chosen.cases}
    chosen.json.write_text(json.dumps(lines, indent=2) + "\n")
    Console().print(table_of(lines))


if __name__ == "__main__":
    main()
