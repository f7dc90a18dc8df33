"""Test of ``piezojax.start --yes`` on stages that share no code with piezojax.

    python tests/benchmarks/one_sitting.py [--stages 0:40:2] [--device NAME] [--excite]
    python tests/benchmarks/one_sitting.py --response [--stages 0:40:2]
    python tests/benchmarks/one_sitting.py --treated NAME [--stages 0:40:2]

The record of each stage of tests/oracles is written in one of four dialects of files.
``start`` gets that file and ``--yes``, nothing else. The voltages are those of the
oracles, or with ``--excite`` those of ``piezojax.excite``. Its gains then run on the
stage as in promise.py, whose figures and bar the table has; the bar on the ratio is
1.5, on 18 of 20 stages. Each start has 300 s. With ``--device nv200`` or ``e727`` the
values of that device are tuned, with a scale of 9.3 V/um, on the stages whose record
has its rate. With ``--response``, ``start`` gets the frequency response of each stage
instead, measured with small motions around the middle of the voltages, and the limits
and noise of the stage. The zero of its sensor is then at 0 V. With ``--treated`` the
records are smoothed, shifted or rounded before they are written (treatments.py): the
promise must be kept or the result have an alarm.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
import tomllib
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import promise
from oracles import excitation, forty_stages
from rich.console import Console
from rich.table import Table
from treatments import TREATMENTS, treated

import piezojax as pj
from piezojax.control.devices import DEVICE_DESIGNS
from piezojax.control.devices.servo_loop import FIXED_DT
from piezojax.core.runtime import CACHE_VARIABLE
from piezojax.signals.excitation import Generator
from piezojax.signals.excitation import excitation as excited_by
from piezojax.tuning.result import load_result

RATIO, KEPT, SECONDS = 1.5, 0.9, 300.0
"""Bar: ratio of obtained to promised error, share of stages within it, time."""


def comma(columns, folder):
    path = folder / "record.csv"
    header = "time_s,input_V,displacement_um"
    np.savetxt(path, columns, "%.9g", ",", header=header, comments="")
    return path


def semicolon(columns, folder):
    """Write decimal commas, and the displacement in nm."""
    path, (time_s, voltage, position) = folder / "record.txt", columns.T
    lines = ["Time (s);Command (V);Position (nm)"]
    for row in zip(time_s, voltage, 1e3 * position, strict=True):
        lines.append(";".join(f"{x:.9g}" for x in row).replace(".", ","))
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def units_below(columns, folder):
    """Write tabs, the units in a row of their own, and other columns before."""
    path, (time_s, voltage, position) = folder / "record.dat", columns.T
    table = np.c_[np.arange(len(time_s)), 1e3 * time_s, position, 1e3 * voltage]
    header = "X\tTime\tSensor\tDrive\nSequence\tms\tum\tmV"
    np.savetxt(path, table, "%.9g", "\t", header=header, comments="")
    return path


def archive(columns, folder):
    path, (time_s, voltage, position) = folder / "record.npz", columns.T
    np.savez(path, time_s=time_s, monitor_V=voltage, capacitive_um=position)
    return path


DIALECTS = (comma, semicolon, units_below, archive)


def excited(stage):
    """Return the voltages of ``piezojax.excite`` and the readings of the stage."""
    p = stage.parameters
    generator = Generator(p.lower, p.upper, p.rate, p.slew)
    voltages = excited_by(generator)[1]
    first = stage.reset(voltages[0], 0)
    return voltages, np.concatenate([[first], stage.respond(voltages[:-1])[0]])


def response(stage, folder):
    """Write the response of ``stage`` to a multisine; return its file."""
    frequency, values = excitation.small_response(stage)
    path, decibel = folder / "bench.csv", 20.0 * np.log10(np.abs(values))
    columns = np.c_[frequency, decibel, np.degrees(np.unwrap(np.angle(values)))]
    header = "frequency_Hz,magnitude_dB,phase_deg"
    np.savetxt(path, columns, "%.9g", ",", header=header, comments="")
    return path


def responded(stage, folder):
    """Return the file of the response of ``stage``, and what it does not show."""
    p = stage.parameters
    known = {"lower": p.lower, "upper": p.upper, "noise": p.noise, "rate": p.rate}
    shown = [f"--{name}={value}" for name, value in known.items()]
    return response(stage, folder), ["--response", "--held", *shown]


def recorded(stage, folder, dialect, record_of):
    """Return the file of a record of ``stage``, in a dialect, and no options."""
    voltages, readings = record_of(stage)
    columns = np.c_[stage.dt * np.arange(len(voltages)), voltages, readings]
    return dialect(columns, folder), []


def started(measured, folder, options):
    """Return the exit status of a start, its output, and the seconds.

    No program of an earlier start is at hand, as in the first sitting of a user.
    """
    (file, own), begun = measured, time.perf_counter()
    command = [sys.executable, "-m", "piezojax.start", file, "--yes", *own, *options]
    done = subprocess.run(
        [*command, "--out", folder / "out"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, CACHE_VARIABLE: str(folder / "programs")},
    )
    seconds = time.perf_counter() - begun
    return done.returncode, done.stdout + done.stderr, seconds


def line_of(stage, measure, options=()):
    """Return the line of a stage: exit status, figures and alarms.

    ``measure(stage, folder)`` writes a file of it and returns its path and options.
    """
    line = {"name": stage.parameters.name}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measured = measure(stage, folder)
        status, output, seconds = started(measured, folder, options)
        file = measured[0].suffix[1:]
        line |= {"file": file, "status": status, "wall_s": seconds, "alarms": []}
        if status not in (0, 3):
            return line | {"refused": output.splitlines()[-1]}
        tuned = folder / "out" / "tuned"
        result = load_result(tuned)
        controller = pj.load(tuned / "gains.toml", accept_unsafe=True)
        study = tomllib.loads((folder / "out" / "study.toml").read_text("utf-8"))
        exported = folder / "out" / "controller"
        line["exported"] = exported.is_dir() and any(exported.glob("controller.*"))
    setup = promise.Setup(stage, {}, study)
    outcome = SimpleNamespace(controller=controller, result=result)
    figures = promise.judged(outcome, setup)
    said, got = (
        promise.geomean(f[key] or np.inf for f in figures.values()) for key in _ERRORS
    )
    return line | {
        "alarms": result.alarms,
        "notes": result.warnings,
        "promised": said,
        "obtained": got,
        "ratio": got / said,
        "lost": any(f["lost"] for f in figures.values()),
        "railed": max(f["railed"] for f in figures.values()) > promise.RAILED,
    }


def has_device_rate(number):
    return forty_stages.parameters(number).rate * FIXED_DT == 1.0


def word_of(line):
    if "refused" in line:
        return "refused"
    if line["lost"] or line["railed"]:
        return "lost" if line["lost"] else "at limit"
    return "kept" if line["ratio"] <= RATIO else "above"


_ERRORS = ("promised", "obtained")


def table_of(lines):
    table = Table(title="promised and obtained, nm rms")
    for head in ("stage", "file", "promised", "obtained", "ratio", "s", "", "alarms"):
        table.add_column(head, justify="left" if head in ("stage", "file") else "right")
    for line in lines:
        known = "refused" not in line
        table.add_row(
            line["name"],
            line["file"],
            *(f"{1e3 * line[key]:.4g}" if known else "" for key in _ERRORS),
            f"{line['ratio']:.3g}" if known else "",
            f"{line['wall_s']:.0f}",
            word_of(line),
            str(len(line["alarms"])),
        )
    return table


def summary(lines):
    """Return the bar and the result, one sentence per line."""
    stable = [x for x in lines if word_of(x) in ("kept", "above")]
    kept = [x for x in lines if word_of(x) == "kept"]
    silent = [x["name"] for x in lines if x not in kept and x["status"] == 0]
    late = [x["name"] for x in lines if x["wall_s"] > SECONDS]
    return [
        f"{len(stable)} of {len(lines)} end with gains that are stable on the stage",
        f"{len(kept)} of {len(lines)} within {RATIO} of the promise (bar {KEPT:.0%})",
        f"not kept with exit status 0: {len(silent)} {silent}",
        f"longer than {SECONDS:g} s: {len(late)} {late}",
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--stages", default="0:40:2", metavar="FIRST:STOP:STEP")
    parser.add_argument("--excite", action="store_true", help="piezojax.excite records")
    parser.add_argument("--response", action="store_true", help="frequency responses")
    parser.add_argument("--treated", choices=TREATMENTS, help="before it is written")
    parser.add_argument("--device", choices=DEVICE_DESIGNS)
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 120)
    numbers = range(*(int(number) for number in chosen.stages.split(":")))
    record_of = excited if chosen.excite else excitation.record
    if chosen.treated:
        record_of = treated(record_of, chosen.treated)
    options, lines = [], []
    if chosen.device:
        options = ["--controller", chosen.device, "--scale", "9.3"]
        if chosen.device == "e727":
            options += ["--structure", "series"]
        numbers = [n for n in numbers if has_device_rate(n)]
    for number in numbers:
        stage = forty_stages.stage(number)
        dialect = DIALECTS[number // 2 % len(DIALECTS)]
        measure = partial(recorded, dialect=dialect, record_of=record_of)
        if chosen.response:
            parameters = dataclasses.replace(stage.parameters, zero=0.0)
            stage, measure = forty_stages.Stage(parameters, 0), responded
        line = line_of(stage, measure, options)
        lines.append(line)
        ratio = f", {line['ratio']:.2f}" if "ratio" in line else ""
        console.print(
            f"{number}: {line['name']} ({line['file']}): {word_of(line)}{ratio}, "
            f"{line['wall_s']:.0f} s, exit status {line['status']}",
            soft_wrap=True,
        )
        for text in [*line["alarms"], line.get("refused", "")]:
            if text:
                console.print(f"    {text}", soft_wrap=True)
        if chosen.json:
            chosen.json.write_text(json.dumps(lines, indent=1), encoding="utf-8")
    console.print(table_of(lines))
    for sentence in summary(lines):
        console.print(sentence, soft_wrap=True)


if __name__ == "__main__":
    main()
