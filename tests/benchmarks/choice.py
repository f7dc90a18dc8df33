"""Is the hysteresis that made a record the one that is chosen, its parameters found?

    python tests/benchmarks/choice.py --json choice.json [--models NAME,...]

Each hysteresis that can be fitted makes a record behind a lag, with white sensor noise
and parameters inside what a laboratory sees; ``identify_all`` fits every model to it
and chooses, as ``python -m piezojax.identify RECORD --model all`` does. All have one
input: a major loop, loops nested in loops at several places, all at two paces. It lasts
less than creep needs to show. A line for each model that made a record:

- the model that was chosen, its error on the validation part;
- the largest distance of a parameter from the truth, in its standard errors (the state
  before the record left out), and how many of the parameters the record determines;
- the error against the output without noise over the validation part, in noise rms.

Recovered: all parameters are determined and within 4 standard errors, and the last is
below a half. StopPrandtlIshlinskii is a way to write PrandtlIshlinskii, so that is what
it is to be chosen as, with the parameters of ``as_plays``.
"""

import argparse
import itertools
import json
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from piezojax import FirstOrderLag, Preisach, Record, identify_all, series
from piezojax.identify import free_run
from piezojax.identify.models import structure
from piezojax.paths import parameters, replace

DT = 4e-4
NOISE = 0.01  # um
LAG = 1.1e-3  # s
OFFSET = -2.0  # um
SLOW, FAST = 0.7, 0.15  # samples a volt
SHORTEST = 5  # samples of a stroke

FIRST = (
    (0, 100, 0, 92, 6, 84, 14, 76, 24, 66, 34, 57, 42, 100, 30, 95, 12, 48, 20, 38, 26)
    + (88, 0, 55, 5, 30, 10, 22, 100, 55, 90, 62, 82, 70, 100, 0, 70, 18, 60, 0, 45, 0)
    + (20, 0, 100, 85, 98, 75, 100, 0)
)
AGAIN = (0, 100, 20, 80, 35, 65, 45, 90, 10, 50, 0, 75, 40, 95, 60, 85, 5, 100, 0)
"""Turning points of the training part, V: slow ones, then fast ones."""

LAST = (0, 97, 15, 62, 28, 89, 51, 73, 3, 41, 9, 100, 37, 81, 22, 0)
LAST_AGAIN = (0, 93, 33, 68, 12, 87, 47, 99, 58, 77, 0, 52, 16)
"""Those of the validation part."""


def strokes(corners, samples_a_volt):
    """The way from corner to corner, at rest in each; without the first sample."""
    pieces = []
    for start, stop in itertools.pairwise(corners):
        samples = max(SHORTEST, round(samples_a_volt * abs(stop - start)))
        share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, samples + 1) / samples)
        pieces.append(start + (stop - start) * share)
    return np.concatenate(pieces)


SEEN = np.concatenate([[0.0], strokes(FIRST, SLOW), strokes(AGAIN, FAST)])
INPUT = np.concatenate([SEEN, strokes(LAST, SLOW), strokes(LAST_AGAIN, FAST)])
TRAIN = slice(0, SEEN.size)
REST = 0.0

FADING = tuple(0.011 * 0.82**i for i in range(10))
PLAYS = {
    **{f"polynomial.{i}": v for i, v in enumerate((0.071, 1.3e-4, -7e-7))},
    **{f"weights.{i}": v for i, v in enumerate(FADING)},
}


def learned():
    """Weights of a learned operator: drawn, but not as the fit's starts are."""
    draw = np.random.default_rng(2026).uniform
    signs = np.array([[1, -1], [-1, 1]])
    return {
        "autoregressive.0": 0.35,
        "autoregressive.1": -0.06,
        "linear.0": 2.6,
        **{f"linear.{j}": v for j, v in enumerate((0.5, 0.4, 0.35, 0.3, 0.25), 1)},
        "linear.6": 0.15,
        **{
            f"mixing.{i}.{j}": float(signs[i % 2, j % 2] * draw(0.3, 1.5))
            for i in range(4)
            for j in range(7)
        },
        **{f"bias.{i}": float(v) for i, v in enumerate((-0.8, 0.5, 0.9, -0.3))},
        **{f"output.{i}": v for i, v in enumerate((0.5, -0.4, 0.6, 0.45))},
    }


TRUTHS = {
    "coleman_hodgdon": {"a": 0.0077, "b": 0.1167, "c": -0.0487},
    "shaped_coleman_hodgdon": {
        "pull.1": 0.0065,
        "pull.2": 2.2e-5,
        "pull.3": -1.7e-7,
        "slope.0": 0.088,
        "slope.1": 5.5e-4,
        "slope.2": -4.5e-6,
        "c": -0.052,
    },
    "prandtl_ishlinskii": PLAYS,
    "asymmetric_prandtl_ishlinskii": {
        **PLAYS,
        **{f"skew.{i}": 0.02 * 0.75**i for i in range(10)},
    },
    "stop_prandtl_ishlinskii": {**PLAYS, "polynomial.0": 0.152},
    "rate_dependent_prandtl_ishlinskii": {**PLAYS, "growth": 2.3e-4},
    "duhem": {
        "reversible.0.0": 0.085,
        "reversible.0.1": 2.4e-4,
        "reversible.1.0": 0.007,
        "irreversible.0.1": 0.0046,
        "irreversible.1.0": -0.034,
    },
    "normalised_bouc_wen": {
        "k_x": 0.141,
        "k_w": -1.37,
        "rho": 0.047,
        "sigma": 0.86,
        "n": 1.65,
    },
    "bashash_jalili": {
        "upper_output": 12.6,
        "rising_alpha": -0.34,
        "rising_tau": 0.052,
        "falling_alpha": -0.47,
        "falling_tau": 0.033,
    },
    "learned_operator": learned(),
    "preisach": {},
}
"""Parameters of each hysteresis by their paths in it; V, um, s."""


def density():
    """Weights of a Preisach model on which its lines differ from place to place."""
    i, j = np.mgrid[0:10, 0:10]
    hump = 0.25 * np.exp(-((i - 6.2) ** 2 + (j - 3.4) ** 2) / 8.0)
    weights = 0.03 + hump + np.where(i == j, 0.45 + 0.03 * j, 0.0)
    return np.tril(weights)


def truth(name):
    """The plant that makes the record, and its parameters by their names in a fit."""
    if name == "preisach":
        hysteresis = Preisach(density(), 0.0, 100.0, OFFSET, REST)
        plant = series(hysteresis=hysteresis, lag=FirstOrderLag(LAG, DT))
        named = {
            f"hysteresis.weights.{i}.{j}": float(hysteresis.weights[i, j])
            for i in range(10)
            for j in range(i + 1)
        }
        return plant, named | {"hysteresis.lowest": OFFSET, "lag.time_constant": LAG}
    lagged = name != "learned_operator"
    shape = structure(name, Record(SEEN, 0.12 * SEEN, DT))
    values = {f"hysteresis.{path}": value for path, value in TRUTHS[name].items()}
    values |= {"calibration.offset": OFFSET}
    values |= {"lag.time_constant": LAG} if lagged else {}
    missing = {p for p in shape.space.paths if "rest_" not in p} - set(values)
    if missing:
        raise ValueError(f"{name}: no truth for {', '.join(sorted(missing))}")
    rest = {path: REST for path in shape.space.paths if "rest_" in path}
    return replace(shape.system, {**rest, **values}), values


def expected(name):
    """What is to be chosen for a record of ``name``, and its parameters."""
    plant, values = truth(name)
    if name == "stop_prandtl_ishlinskii":
        plays = parameters(plant.parts[0].as_plays(), "hysteresis.")
        values |= {path: float(v) for path, v in plays.items() if path in values}
        name = "prandtl_ishlinskii"
    return name if name in ("preisach", "learned_operator") else f"{name}+lag", values


def made(name, seed=1):
    """The record, and the output without noise."""
    plant, _ = truth(name)
    clean = np.asarray(free_run(plant, jnp.asarray(INPUT), REST))
    noise = NOISE * np.random.default_rng(seed).standard_normal(clean.size)
    return Record(INPUT, clean + noise, DT, source=f"made by {name}"), clean


def judged(fit, values, clean):
    """How far a fit is from the truth."""
    found = fit.report.parameters
    far, unknown = {}, []
    for path, value in values.items():
        one = found.get(path)
        if one is None or one.standard_error is None:
            unknown.append(path)
        else:
            far[path] = abs(one.value - value) / one.standard_error
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
    """Whether the parameters and the output are those of the truth."""
    return (
        not one["undetermined"]
        and one["worst_in_standard_errors"] < 4.0
        and one["clean_error_in_noise"] < 0.5
    )


class Lines:
    """Progress on standard error: a line a fit."""

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


def study(name, among=None):
    """One record, all models, and what was chosen."""
    record, clean = made(name)
    model, values = expected(name)
    began = time.perf_counter()
    found = identify_all(record, hysteresis=among, train=TRAIN, progress=Lines(name))
    report = found.report
    row = {
        "truth": name,
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
    """What was found, a line a truth."""
    shown = Table(title=f"records of {INPUT.size} samples, {1e3 * NOISE:g} nm of noise")
    for column in (
        "made by",
        "chosen",
        "validation nm",
        "parameters: furthest off",
    ):
        shown.add_column(column)
    for column in ("output off, noise", "recovered", "s"):
        shown.add_column(column, justify="right")
    for row in rows:
        if row.get("worst") is None:
            off = "not fitted"
        else:
            off = f"{row['worst_in_standard_errors']:.1f} s.e. ({row['worst']})"
            if row["undetermined"]:
                off += f", {len(row['undetermined'])} not determined"
        shown.add_row(
            row["truth"],
            ("" if row["chosen_right"] else "NOT: ") + row["chosen"],
            f"{1e3 * row['validation_rmse_um']:.2f}",
            off,
            f"{row.get('clean_error_in_noise', np.nan):.2f}",
            "yes" if row["chosen_right"] and row.get("recovered") else "no",
            f"{row['seconds']:.0f}",
        )
    return shown


def main():
    """Make the records, fit them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--models", help="only records of these, by commas")
    parser.add_argument("--among", help="only these hysteresis parts fitted, by commas")
    options = parser.parse_args()
    names = options.models.split(",") if options.models else list(TRUTHS)
    for name in names:
        if name not in TRUTHS:
            parser.error(f"{name!r} makes no record; there are {', '.join(TRUTHS)}")
    among = options.among.split(",") if options.among else None
    rows = []
    for name in names:
        rows.append(study(name, among))
        if options.json:  # as far as it got
            options.json.write_text(
                json.dumps({"rows": rows}, indent=2) + "\n", encoding="utf-8"
            )
    Console(width=150).print(table(rows))


if __name__ == "__main__":
    main()
