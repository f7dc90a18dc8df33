"""Search for unsafe gains that leave the command without an alarm.

    python tests/benchmarks/unsafe_gains.py [--studies 0:200] [--json FILE]

Each random study of unsafe_cases.py (lightly damped resonances; tight, wide and
infeasible bounds and limits; one axis and three) is tuned in a few steps by the
command. If it ends with exit status 0, the gains in its folder run in a NumPy loop that
shares no code with piezojax, with these requirements:

- every eigenvalue inside the unit circle, on the branches of the plays at the highest
  point of the references;
- peak of the sensitivity and delay margin within the limits of the study;
- with new noise, no run of a reference, seen or unseen, stays at a voltage limit,
  exceeds the limits of voltage and slew, or has an error above the promised one.

The bar: none of 200.
"""

import argparse
import json
import sys
import tempfile
import time
import tomllib
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import tomli_w
from click.testing import CliRunner
from rich.console import Console
from rich.table import Table

import piezojax as pj
from piezojax.cli.tune import main as tune
from piezojax.signals import motions, waveforms

sys.path.insert(0, str(Path(__file__).parent))

from unsafe_cases import AXES, DT, LOWER, RATE, UPPER, Loop, draw, margins

CLOSE = 0.02
"""Relative amount by which a margin may violate its limit."""

RAILED = 0.02
"""Share of samples at a voltage limit above which a run counts as saturated."""

FAR = 1.3
"""Ratio of obtained to promised error above which a promise is broken."""

COUNT = 200


def ended(case, folder):
    """Run the command on a case; return exit status, last line, gains and result."""
    study, out = folder / "study.toml", folder / "out"
    study.write_text(tomli_w.dumps(case.study), encoding="utf-8")
    run = CliRunner().invoke(tune, [str(study), "--out", str(out), "--quiet"])
    if run.exception is not None and not isinstance(run.exception, SystemExit):
        raise run.exception
    last = run.output.strip().splitlines()[-1:]
    if run.exit_code not in (0, 3):
        return run.exit_code, last, None, None
    with (out / "gains.toml").open("rb") as file:
        data = tomllib.load(file)
    tables = data["parts"] if data["type"] == "PerAxis" else [data]
    return run.exit_code, last, tables, pj.load_result(out)


def references_of(case):
    """Return the references [samples, axes] by name."""
    table, found = case.study["references"], {}
    time_s = waveforms.time_grid(table["duration"], RATE)
    for name in case.references:
        if len(case.stages) == 1:
            column = waveforms.signal(name, time_s, table["amplitude"])
            found[name] = np.asarray(column)[:, None]
        else:
            amplitudes, offsets = [table["amplitude"]] * 3, [0.0] * 3
            moved = motions.motion(name, time_s, AXES, amplitudes, offsets)
            found[name] = np.asarray(moved)
    return found


def faults(case, tables, result):
    """Return the faults of the controllers of a result, and their margins."""
    loop, found = Loop(case, tables), []
    references = references_of(case)
    highest = np.max([r.max(axis=0) for r in references.values()], axis=0)
    branches = {
        "ascending": loop.ascending(highest),
        "descending": [stage.slope for stage in case.stages],
    }
    limits = {"sensitivity_peak": 2.0, "delay_margin": 1.0} | case.limits
    peaks, delays = [], []
    for branch, slopes in branches.items():
        radius, peak, delay = margins(loop, slopes)
        peaks.append(peak)
        delays.append(delay)
        if radius >= 1.0:
            found.append(f"unstable on the {branch} branch: {radius:.6f}")
    limit = limits["sensitivity_peak"]
    if limit != "off" and max(peaks) > limit * (1.0 + CLOSE):
        found.append(f"peak {max(peaks):.3f} above {limit:.3f}")
    limit = limits["delay_margin"]
    if limit != "off" and min(delays) < limit * (1.0 - CLOSE):
        found.append(f"delay margin {min(delays):.3f} below {limit:.3f}")
    found += run_faults(case, loop, references, promises(result))
    return found, max(peaks), min(delays)


def promises(result):
    """Return the promised errors by reference and axis, um."""
    found = {}
    for scores in (result.holdout, result.unseen, result.coupling):
        found |= scores.per_reference_rms_um if scores else {}
    return found


def run_faults(case, loop, references, promised):
    """Yield the faults of the runs of a loop."""
    start = round(case.study["references"]["settle"] * RATE)
    random = np.random.default_rng([19, case.number])
    for name, reference in references.items():
        noise = case.study["sensor"]["noise_rms"] * random.normal(size=reference.shape)
        y, u = loop.run(reference, noise)
        if len(y) < len(reference):
            yield f"{name} diverges"
            continue
        error = np.sqrt(np.mean((y - reference)[start:] ** 2, axis=0))
        for axis, value in zip(AXES, error, strict=False):
            key = name if len(error) == 1 else f"{name} ({axis})"
            if value > FAR * (promised[key] or 0.0):
                yield f"{key}: {value:.3g} um for a promise of {promised[key]}"
        ends = (u[start:] <= LOWER) | (u[start:] >= UPPER)
        if ends.mean(axis=0).max() > RAILED:
            share = 100.0 * ends.mean(axis=0).max()
            yield f"{name} is at a voltage limit in {share:.0f} % of its samples"
        figures = {
            "peak_voltage": np.abs(u).max(),
            "peak_slew": np.abs(np.diff(u[start:], axis=0)).max() / DT,
        }
        for key, value in figures.items():
            if value > case.limits.get(key, np.inf) * (1.0 + CLOSE):
                yield f"{name}: {key} {value:.4g} above {case.limits[key]:.4g}"


def line_of(number):
    """Return the line of a study: its exit status and the faults of its gains."""
    case, began = draw(number), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        code, last, tables, result = ended(case, Path(folder))
    seconds = time.perf_counter() - began
    line = {
        "number": number,
        "kind": case.kind,
        "axes": len(case.stages),
        "limits": case.limits,
        "code": code,
        "last": last,
        "seconds": seconds,
        "faults": [],
        "peak": None,
        "delay": None,
    }
    if tables is not None:
        line["faults"], line["peak"], line["delay"] = faults(case, tables, result)
    return line


def summary(lines):
    """Return the bar and the result, one sentence per line."""
    by = Counter(line["code"] for line in lines)
    silent = [line for line in lines if line["code"] == 0 and line["faults"]]
    alarmed = [line for line in lines if line["code"] == 3]
    false = [line["number"] for line in alarmed if not line["faults"]]
    axes = Counter(line["axes"] for line in lines)
    return [
        f"{len(lines)} studies, {axes[1]} of one axis and {axes[3]} of three, in "
        f"{sum(line['seconds'] for line in lines):.0f} s",
        f"{by[0]} ended with 0, {by[3]} with an alarm, "
        f"{len(lines) - by[0] - by[3]} refused",
        f"unsafe without an alarm: {len(silent)} (bar 0) "
        f"{[line['number'] for line in silent]}",
        f"alarms on gains without a fault: {len(false)} {false}",
    ]


def table_of(lines):
    table = Table(title="studies and their gains")
    for head in ("study", "kind", "axes", "status", "Ms", "delay", "faults"):
        table.add_column(
            head, justify="left" if head in ("kind", "faults") else "right"
        )
    for line in lines:
        known = line["peak"] is not None
        table.add_row(
            str(line["number"]),
            line["kind"],
            str(line["axes"]),
            str(line["code"]),
            f"{line['peak']:.3g}" if known else "",
            f"{line['delay']:.3g}" if known else "",
            "; ".join(line["faults"]),
        )
    return table


def main():
    """Run the studies and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--studies", default=f"0:{COUNT}", metavar="FIRST:STOP")
    parser.add_argument("--json", type=Path)
    chosen = parser.parse_args()
    # The studies share compiled programs of any compile time.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_disable_most_optimizations", True)
    console = Console(width=None if sys.stdout.isatty() else 120)
    first, stop = (int(number) for number in chosen.studies.split(":"))
    lines = []
    for number in range(first, stop):
        line = line_of(number)
        lines.append(line)
        word = "; ".join(line["faults"]) or "no fault"
        console.print(
            f"{number}: {line['kind']}, {line['axes']} axes: status {line['code']}, "
            f"{word} ({line['seconds']:.0f} s)",
            soft_wrap=True,
        )
        if chosen.json:
            chosen.json.write_text(json.dumps(lines, indent=1), encoding="utf-8")
    console.print(table_of(lines))
    for sentence in summary(lines):
        console.print(sentence, soft_wrap=True)


if __name__ == "__main__":
    main()
