"""Test of models fitted to two records on a third record of another kind.

    python tests/benchmarks/other_records.py [--stages 0:20] [--model NAME]

Twenty of the forty stages of tests/oracles, which share no code with piezojax, are
recorded three times: sines of 20, 40 or 100 Hz after a step, steps with holds, or a
random walk. Each record has another initial voltage, another path before and another
zero of the sensor. A model is fitted to the whole of two records and validated on the
third by ``pj.validate``. The table has a line for each stage: the error on the third
record in nm and % of its span, the noise of the sensor, the error of the fit, and
whether the bar is met.

The bar is an error of at most 1.5 times the noise or 0.3 % of the span on 18 of 20.

The column "truth" holds the error of the stage itself, without noise and drift, with
only the knowledge of the path before the record that ``validate`` has. No model can be
expected to be below. ``--truth`` prints that column alone, within minutes.
"""

import argparse
import dataclasses
import functools
import itertools
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import piezojax as pj

sys.path.insert(0, str(Path(__file__).parents[1]))

from oracles import forty_stages
from oracles.stages import Stage

from piezojax.identification.validation import default_part

NOISE, SPAN, KEPT = 1.5, 0.3, 18
"""Bar: factor on the noise, % of the span, number of stages."""

SCENARIOS = (
    ("20 Hz", "100 Hz", "40 Hz"),
    ("20 Hz", "40 Hz", "100 Hz"),
    ("steps", "40 Hz", "walk"),
    ("walk", "100 Hz", "steps"),
    ("steps", "walk", "20 Hz"),
)
"""Two records to fit and one for validation, in turn over the stages."""

SECONDS = {"20 Hz": 0.6, "40 Hz": 0.5, "100 Hz": 0.4, "steps": 1.2, "walk": 1.0}


def sines(p, random, frequency, seconds):
    """Return a step and a hold, then a sine whose amplitude changes every 5 cycles."""
    time_s = np.arange(round(seconds * p.rate)) / p.rate
    swing = random.uniform(0.15, 0.4, int(seconds * frequency / 5) + 1)
    size = swing[(time_s * frequency / 5).astype(int)]
    step = 0.1 * (time_s > 0.02)
    wave = size * np.sin(2.0 * np.pi * frequency * np.maximum(time_s - 0.1, 0.0))
    return 0.45 + step - 0.05 + wave


def steps(p, random, seconds):
    """Return steps of random height, held for 20 to 120 ms."""
    parts, samples = [], 0
    while samples < seconds * p.rate:
        held = round(random.uniform(0.02, 0.12) * p.rate)
        parts.append(np.full(held, random.uniform(0.1, 0.9)))
        samples += held
    return np.concatenate(parts)[: round(seconds * p.rate)]


def walk(p, random, seconds):
    """Return a random walk between 5 and 95 %, smoothed over 2 ms."""
    count = round(seconds * p.rate)
    path = 0.5 + np.cumsum(random.normal(0.0, 0.6 / np.sqrt(0.1 * p.rate), count))
    folded = np.abs((path - 0.05) % 1.8 - 0.9)  # reflected at both ends
    width = max(3, round(0.002 * p.rate))
    window = np.hanning(width + 2)[1:-1]
    padded = np.pad(0.05 + folded, (width, width), mode="edge")
    return np.convolve(padded, window / window.sum(), "same")[width:-width]


def voltages(p, kind, random):
    """Return the voltages of a record of a ``kind``, with the path before its start."""
    seconds = SECONDS[kind]
    if kind == "steps":
        share = steps(p, random, seconds)
    elif kind == "walk":
        share = walk(p, random, seconds)
    else:
        share = sines(p, random, float(kind.split()[0]), seconds)
    return p.lower + p.span * share


def record_of(stage, kind, seed):
    """Return a Record of a ``kind`` with random start, previous path and zero."""
    p = stage.parameters
    random = np.random.default_rng([2026, seed])
    u = voltages(p, kind, random)
    first = stage.reset(0.0, seed)
    turns = p.lower + p.span * random.uniform(0.0, 1.0, 3)
    ends = [0.0, *turns, u[0]]
    samples = round(0.1 * p.rate)
    ramp = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, samples))
    before = np.concatenate([a + (b - a) * ramp for a, b in itertools.pairwise(ends)])
    before = np.concatenate(
        [before, np.full(round(random.uniform(0.02, 0.3) * p.rate), u[0])]
    )
    y = stage.respond(np.concatenate([before, u]))[0]
    readings = np.concatenate([[first], y])[before.size : -1]
    zero = random.uniform(-0.1, 0.1) * p.stroke
    return pj.Record(u, readings + zero, stage.dt, source=kind)


def records_of(number):
    """Return stage ``number`` of the twenty, its three records and their kinds."""
    stage = forty_stages.stage(2 * number)
    kinds = SCENARIOS[number % len(SCENARIOS)]
    records = [record_of(stage, kind, 10 * number + i) for i, kind in enumerate(kinds)]
    return stage, records, kinds


def truth_of(stage, records, part):
    """Return the error (% of span) of the stage itself on the last of ``records``.

    As for a model, the state before it is that after a slow motion over three levels of
    the input, with deviations of the creep and a zero, as the samples ``part`` tell.
    """
    p = dataclasses.replace(stage.parameters, noise=0.0, ramp=0.0, walk=0.0, bits=48)
    clean, record = Stage(p), records[-1]
    u, y = record.input, record.output
    ends = (min(r.input.min() for r in records), max(r.input.max() for r in records))
    time_s, span = record.time, np.ptp(y)
    creep = [0.3 * span * g * np.exp(-time_s / t) for t, g in p.creep]
    columns = np.column_stack([np.ones(u.size), *creep])
    least = 1e-4 * span * np.eye(columns.shape[1])[1:]
    inverse = np.linalg.pinv(np.concatenate([columns[part], least]))
    ramp = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 200))
    rest = np.full(round(0.02 * p.rate), u[0])

    def error_after(levels, stop):
        clean.reset(levels[0])
        way = itertools.pairwise([*levels, u[0]])
        path = np.concatenate([*(a + (b - a) * ramp for a, b in way), rest])
        run = clean.respond(np.concatenate([path, u[:stop]]))[2][path.size - 1 : -1]
        amounts = inverse @ np.append((y[:stop] - run)[part], np.zeros(len(least)))
        error = run + columns[:stop] @ amounts - y[:stop]
        return error, np.sum(error[part] ** 2) + np.sum((least @ amounts) ** 2)

    @functools.cache
    def cost(levels):
        return error_after(levels, part.stop)[1]

    low, high = ends[0] - 0.2 * np.ptp(ends), ends[1] + 0.2 * np.ptp(ends)

    def refined(levels):
        step = (high - low) / 16.0
        while step > (high - low) / 1024.0:
            around = [levels]
            for i, way in itertools.product(range(3), (-step, step)):
                moved = min(max(levels[i] + way, low), high)
                around.append((*levels[:i], moved, *levels[i + 1 :]))
            best = min(around, key=cost)
            step, levels = step * (0.5 if best == levels else 1.0), best
        return levels

    grid = np.linspace(low, high, 9).tolist()
    pairs = [(a, a, b) for a, b in itertools.product(grid, grid)]
    levels = refined(min([(float(u[0]),) * 3, *pairs], key=cost))
    pair = levels[1:]
    inserted = [(*pair[:i], a, *pair[i:]) for i in range(3) for a in grid]
    levels = refined(min([levels, *inserted], key=cost))
    error, _ = error_after(levels, u.size)
    return 100.0 * float(np.sqrt(np.mean(error[part.stop :] ** 2))) / span


def line_of(number, model):
    """Return the line of stage ``number`` of the twenty."""
    stage, records, kinds = records_of(number)
    began = time.perf_counter()
    whole = slice(0, max(record.samples for record in records[:2]))
    fit = pj.identify(records[:2], model, train=whole, validate=whole)
    found = pj.validate(fit.system, fit.about, records[2])
    (check,) = found.report.records
    noise = stage.parameters.noise
    return {
        "name": stage.parameters.name,
        "kinds": " + ".join(kinds[:2]) + " -> " + kinds[2],
        "model": fit.report.model,
        "noise": noise,
        "fit": fit.report.validation.rmse,
        "rmse": check.rmse,
        "percent": check.percent_of_span,
        "truth": truth_of(stage, records, slice(*check.estimated)),
        "kept": check.rmse is not None
        and (check.rmse <= NOISE * noise or check.percent_of_span <= SPAN),
        "alarms": found.report.alarms,
        "wall_s": time.perf_counter() - began,
    }


def main():
    """Print the lines and the bar."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--stages", default="0:20", metavar="FIRST:STOP")
    parser.add_argument("--model", default="auto")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--truth", action="store_true")
    chosen = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 140)
    first, stop = (int(number) for number in chosen.stages.split(":"))
    if chosen.truth:
        errors = []
        for number in range(first, stop):
            stage, records, kinds = records_of(number)
            part = default_part(records[-1])
            errors.append(truth_of(stage, records, part))
            name = f"{stage.parameters.name} {kinds[-1]}"
            console.print(f"{name}: {errors[-1]:.3f} % of span", soft_wrap=True)
        kept = sum(error <= SPAN for error in errors)
        console.print(f"{kept} of {len(errors)} stages themselves hold")
        return
    table = Table(title="error on the third record")
    heads = ("nm", "% of span", "truth, %", "noise, nm", "fit, nm", "held")
    for head in ("stage", "records", *heads):
        table.add_column(head, no_wrap=True)
    lines = []
    for number in range(first, stop):
        line = line_of(number, chosen.model)
        lines.append(line)
        error = "diverges" if line["rmse"] is None else f"{1e3 * line['rmse']:.4g}"
        percent = "-" if line["percent"] is None else f"{line['percent']:.3f}"
        row = (
            *(line["name"], line["kinds"], error, percent, f"{line['truth']:.3f}"),
            *(f"{1e3 * line[key]:.3g}" for key in ("noise", "fit")),
            "yes" if line["kept"] else "no",
        )
        table.add_row(*row)
        console.print(*row, line["model"], f"{line['wall_s']:.0f} s", soft_wrap=True)
        for alarm in line["alarms"]:
            console.print(f"    alarm: {alarm}", soft_wrap=True)
        if chosen.json:
            chosen.json.write_text(json.dumps(lines, indent=1), encoding="utf-8")
        jax.clear_caches()
    console.print(table)
    kept = sum(line["kept"] for line in lines)
    console.print(f"{kept} of {len(lines)} hold (bar {KEPT} of 20)")


if __name__ == "__main__":
    main()
