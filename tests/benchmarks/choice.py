"""Test of the choice of a model on simulated records, and of its parameters.

    python tests/benchmarks/choice.py --json choice.json [--draws N] [--models NAME,...]

A record is simulated with each hysteresis that can be fitted, followed by a lag, with
white sensor noise and parameters of usual size. ``identify_all`` fits every model to it
and chooses one, as ``python -m piezojax.identify RECORD --model all`` does. All records
have one input: a major loop and nested loops at several places, at two rates. The
record of two densities, interpolated by the rate, has more fast loops. The records are
too short for creep. The table has a line for each simulated model:

- the chosen model and its error on the validation part;
- the largest error of a parameter in its standard errors (without the state before the
  record), and the number of parameters that the record determines;
- the error against the output without noise over the validation part, in noise rms.

Recovered means that all parameters are determined and within 4 standard errors, and
that the last figure is below a half. StopPrandtlIshlinskii is equivalent to
PrandtlIshlinskii, so the latter is to be chosen, with the parameters of ``as_plays``.
The neurons of a learned operator may be permuted and change signs. ``--tone`` simulates
records with one sine instead, 900 samples at 10 Hz, which do not determine all models.
"""

import argparse
import itertools
import json
import sys
import time
from pathlib import Path

import choice_records
import numpy as np
from choice_records import NOISE
from rich.console import Console
from rich.table import Table
from scipy.optimize import linear_sum_assignment

from piezojax.hysteresis.learned import LEARNED_PLAYS, NEURONS
from piezojax.identification import (
    identify_all,
)


def as_numbered(values, found):
    """Return the true parameters of a learned operator in the order of the fit.

    Neurons may change places, and their signs: tanh is odd.
    """
    names = [
        [f"hysteresis.mixing.{i}.{j}" for j in range(LEARNED_PLAYS + 2)]
        + [f"hysteresis.bias.{i}", f"hysteresis.output.{i}"]
        for i in range(NEURONS)
    ]
    own = np.array([[values[name] for name in row] for row in names])
    there = np.array([[found[name].value for name in row] for row in names])
    both = np.stack([own, -own])[:, :, None] - there
    distance = np.sum(both**2, axis=-1)  # sign, neuron, place
    places = linear_sum_assignment(distance.min(axis=0))[1]
    numbered = {}
    for neuron, place in enumerate(places):
        sign = (1.0, -1.0)[int(np.argmin(distance[:, neuron, place]))]
        numbered |= dict(zip(names[place], sign * own[neuron], strict=True))
    return values | numbered


def judged(fit, values, clean):
    """Return the errors of a fit relative to the true parameters."""
    found = fit.report.parameters
    if "hysteresis.mixing.0.0" in found:
        values = as_numbered(values, found)
    far, unknown = {}, []
    for path, value in values.items():
        one = found.get(path)
        if one is None or one.standard_error is None:
            unknown.append(path)
        else:
            far[path] = float(abs(one.value - value) / one.standard_error)
    error = (fit.simulated - clean)[fit.validate]
    worst = max(far, key=far.__getitem__) if far else None
    return {
        "worst": worst,
        "worst_in_standard_errors": far.get(worst),
        "undetermined": unknown,
        "parameters": len(values),
        "clean_error_in_noise": float(np.sqrt(np.mean(error**2))) / NOISE,
    }


def recovered(one):
    """Return whether the parameters and the output are recovered."""
    return (
        not one["undetermined"]
        and one["worst_in_standard_errors"] < 4.0
        and one["clean_error_in_noise"] < 0.5
    )


class Lines:
    """Progress on standard error: one line per fit."""

    def __init__(self, name):
        self._name, self._last, self._began = name, "", time.perf_counter()

    def stage(self, text, steps=0):
        del steps
        label = text.split(":")[0]
        if label != self._last:
            seconds = time.perf_counter() - self._began
            print(f"{seconds:6.0f} s  {self._name}: {label}", file=sys.stderr)
            self._last = label

    def advance(self, best, note=""):
        del best, note


def study(name, drive, seed=1, among=None):
    """Return the choice among all models for one record."""
    record, clean = choice_records.made(name, drive, seed)
    model, values = choice_records.expected(name, drive)
    began = time.perf_counter()
    found = identify_all(
        record,
        hysteresis=among,
        train=slice(0, drive.trained),
        progress=Lines(f"{name}, noise {seed}"),
    )
    report = found.report
    row = {
        "truth": name,
        "seed": seed,
        "expected": model,
        "chosen": report.best,
        "validation_rmse_um": report.rows[0].validation_rmse,
        "seconds": time.perf_counter() - began,
        "effective_samples": report.effective_samples,
        "samples": report.samples,
        "rows": [one.model_dump(exclude={"folder"}) for one in report.rows],
    }
    if model in found.fits:
        row |= judged(found.fits[model], values, clean)
        row["recovered"] = recovered(row)
    row["chosen_right"] = report.best == model
    return row


def table(rows):
    """Return the table: a line per simulated model, the worst of all noise draws."""
    shown = Table(title=f"records with {1e3 * NOISE:g} nm of noise")
    for column in ("made by", "chosen", "furthest parameter, s.e."):
        shown.add_column(column)
    for column in (
        "fitted",
        "validation nm",
        "output off, noise",
        "right",
        "recovered",
        "s",
    ):
        shown.add_column(column, justify="right")
    for name in dict.fromkeys(row["truth"] for row in rows):
        own = [row for row in rows if row["truth"] == name]
        fitted = [row for row in own if row.get("worst")]
        worst = max(fitted, key=lambda row: row["worst_in_standard_errors"], default={})
        off = f"{worst.get('worst_in_standard_errors', np.nan):.1f}"
        off += f" {str(worst.get('worst')).removeprefix('hysteresis.')}"
        lost = max((len(row["undetermined"]) for row in fitted), default=0)
        both = [row["chosen_right"] and row.get("recovered", False) for row in own]
        shown.add_row(
            name,
            "\n".join(dict.fromkeys(row["chosen"] for row in own)),
            off + (f", {lost} not determined" if lost else ""),
            str(own[0]["samples"]),
            f"{1e3 * max(row['validation_rmse_um'] for row in own):.2f}",
            f"{max((r['clean_error_in_noise'] for r in fitted), default=np.nan):.2f}",
            f"{sum(row['chosen_right'] for row in own)} of {len(own)}",
            f"{sum(both)} of {len(own)}",
            f"{np.mean([row['seconds'] for row in own]):.0f}",
        )
    return shown


def main():
    """Simulate the records, fit them and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--models", help="only records of these, by commas")
    parser.add_argument("--draws", type=int, default=1, help="of the noise, a model")
    parser.add_argument("--tone", action="store_true", help="one sine as the input")
    parser.add_argument("--among", help="only these hysteresis parts fitted, by commas")
    options = parser.parse_args()
    names = options.models.split(",") if options.models else list(choice_records.NAMES)
    for name in names:
        if name not in choice_records.NAMES:
            known = ", ".join(choice_records.NAMES)
            parser.error(f"{name!r} makes no record; there are {known}")
    among = options.among.split(",") if options.among else None
    rows = []
    draws = range(1, options.draws + 1)
    for seed, name in itertools.product(draws, names):
        drive = choice_records.DRIVES.get(name, choice_records.LOOPS)
        if options.tone:
            drive = choice_records.TONE
        rows.append(study(name, drive, seed, among))
        if options.json:  # the results so far
            options.json.write_text(
                json.dumps({"rows": rows}, indent=2) + "\n", encoding="utf-8"
            )
    Console(width=160).print(table(rows))


if __name__ == "__main__":
    main()
