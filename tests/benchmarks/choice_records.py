"""Simulated records of each hysteresis, with its parameters, for choice.py."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from piezojax import (
    Record,
    series,
)
from piezojax.core.paths import parameters, replace
from piezojax.dynamics import (
    FirstOrderLag,
)
from piezojax.hysteresis import (
    Preisach,
    RateDependentPreisach,
)
from piezojax.identification import free_run
from piezojax.identification.chain import structure

NOISE = 0.01  # um
LAG = 1.1e-3  # s
OFFSET = -2.0  # um
SLOW, FAST = 0.7, 0.15  # samples per volt
SHORTEST = 5  # samples of a stroke

FIRST = (
    (0, 100, 0, 92, 6, 84, 14, 76, 24, 66, 34, 57, 42, 100, 30, 95, 12, 48, 20, 38, 26)
    + (88, 0, 55, 5, 30, 10, 22, 100, 55, 90, 62, 82, 70, 100, 0, 70, 18, 60, 0, 45, 0)
    + (20, 0, 100, 85, 98, 75, 100, 0)
)


def walk(height, step=10):
    """Return corners up to 100 V and back to 0 in loops of ``height``, step by step."""
    ways = range(0, 100 - height, step)
    up = [corner for k in ways for corner in (k + height, k + step)]
    return (*up, 100, *(100 - corner for corner in up), 0)


AGAIN = (0, 100, 20, 80, 35, 65, 45, 90, 10, 50, 0, 75, 40, 95, 60, 85, 5, 100, 0)
"""Turning points (V) of the training part: slow ones, then fast ones."""

MORE = (*walk(30), *walk(50), *np.random.default_rng(0).integers(0, 101, 40), 0)
"""Further fast turning points, for models with a separate memory at that rate."""

LAST = (0, 97, 15, 62, 28, 89, 51, 73, 3, 41, 9, 100, 37, 81, 22, 0)
LAST_AGAIN = (0, 93, 33, 68, 12, 87, 47, 99, 58, 77, 0, 52, 16)
"""Turning points of the validation part."""


def strokes(corners, samples_a_volt):
    """Return the input between corners, at rest in each, without the first sample."""
    pieces = []
    for start, stop in itertools.pairwise(corners):
        samples = max(SHORTEST, round(samples_a_volt * abs(stop - start)))
        share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, samples + 1) / samples)
        pieces.append(start + (stop - start) * share)
    return np.concatenate(pieces)


class Drive(NamedTuple):
    """An input from rest at 0 V, its sample time, and the number of samples to fit."""

    input: np.ndarray
    dt: float
    trained: int

    @property
    def seen(self):
        """Return the fitted part as a record of a stage without hysteresis."""
        return Record(
            self.input[: self.trained], 0.12 * self.input[: self.trained], self.dt
        )


def loops(again):
    """Return a Drive: FIRST and LAST slowly, ``again`` and LAST_AGAIN fast."""
    seen = np.concatenate([[0.0], strokes(FIRST, SLOW), strokes(again, FAST)])
    judged = [strokes(LAST, SLOW), strokes(LAST_AGAIN, FAST)]
    return Drive(np.concatenate([seen, *judged]), 4e-4, seen.size)


LOOPS = loops(AGAIN)
TONE = Drive(50.0 - 50.0 * np.cos(2.0 * np.pi * 0.01 * np.arange(900)), 1e-3, 600)
REST = 0.0

FADING = tuple(0.011 * 0.82**i for i in range(10))
PLAYS = {
    **{f"polynomial.{i}": v for i, v in enumerate((0.071, 1.3e-4, -7e-7))},
    **{f"weights.{i}": v for i, v in enumerate(FADING)},
}


def learned():
    """Return random weights of a learned operator, drawn unlike the starts of a fit."""
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
    "dahl_frictions": {
        "polynomial.0": 0.131,
        "polynomial.1": 1.1e-4,
        **{f"heights.{i}": v for i, v in enumerate((5.1, 3.2, 0.2))},
        **{f"rates.{i}": v for i, v in enumerate((0.017, 0.062, 0.31))},
        **{f"exponents.{i}": v for i, v in enumerate((1.3, 0.9, 1.6))},
    },
    "bashash_jalili": {
        "upper_output": 12.6,
        "rising_alpha": -0.34,
        "rising_tau": 0.052,
        "falling_alpha": -0.47,
        "falling_tau": 0.033,
    },
    "learned_operator": learned(),
}
"""Parameters of each hysteresis by path; V, um, s."""

CELLS = 10
HALF_WAY = 7e3  # V/s


def density(alpha=6.2, beta=3.4, along=0.03):
    """Return weights of a Preisach model that vary over the triangle."""
    i, j = np.mgrid[0:CELLS, 0:CELLS]
    hump = 0.25 * np.exp(-((i - alpha) ** 2 + (j - beta) ** 2) / 8.0)
    weights = 0.03 + hump + np.where(i == j, 0.45 + along * j, 0.0)
    return np.tril(weights)


def preisach(drive):
    """Return a model with one density."""
    del drive
    return Preisach(density(), 0.0, 100.0, OFFSET, REST)


def rate_dependent_preisach(drive):
    """Return a model with two densities; the fast one has its maximum elsewhere."""
    fast = density(alpha=4.1, beta=2.2, along=0.01)
    return RateDependentPreisach(preisach(drive), fast, HALF_WAY, drive.dt)


DRIVES = {"rate_dependent_preisach": loops((*AGAIN, *MORE))}
"""Inputs of models for which LOOPS does not suffice."""

WHOLE = {"preisach": preisach, "rate_dependent_preisach": rate_dependent_preisach}
"""Models that are not parts of a chain."""

NAMES = (*TRUTHS, *WHOLE)


def truth(name, drive=LOOPS):
    """Return the plant of the record, and its parameters by their names in a fit."""
    if name in WHOLE:
        hysteresis = WHOLE[name](drive)
        plant = series(hysteresis=hysteresis, lag=FirstOrderLag(LAG, drive.dt))
        known = parameters(plant)
        named = {
            f"{path}.{i}.{j}": float(known[path][i, j])
            for path in known
            if path.endswith("weights")
            for i, j in zip(*np.tril_indices(CELLS), strict=True)
        }
        fitted = ("lowest", "hysteresis.rate", "time_constant")
        others = {p: float(v) for p, v in known.items() if p.endswith(fitted)}
        return plant, named | others
    lagged = name != "learned_operator"
    shape = structure(name, drive.seen)
    values = {f"hysteresis.{path}": value for path, value in TRUTHS[name].items()}
    values |= {"calibration.offset": OFFSET}
    values |= {"lag.time_constant": LAG} if lagged else {}
    missing = {p for p in shape.space.paths if "rest_" not in p} - set(values)
    if missing:
        raise ValueError(f"{name}: no truth for {', '.join(sorted(missing))}")
    rest = {path: REST for path in shape.space.paths if "rest_" in path}
    return replace(shape.system, {**rest, **values}), values


def expected(name, drive=LOOPS):
    """Return the model to be chosen for a record of ``name``, and its parameters."""
    plant, values = truth(name, drive)
    if name == "stop_prandtl_ishlinskii":
        plays = parameters(plant.parts[0].as_plays(), "hysteresis.")
        values |= {path: float(v) for path, v in plays.items() if path in values}
        name = "prandtl_ishlinskii"
    return name if name in (*WHOLE, "learned_operator") else f"{name}+lag", values


def made(name, drive=LOOPS, seed=1):
    """Return the record, and the output without noise."""
    plant, _ = truth(name, drive)
    clean = np.asarray(free_run(plant, jnp.asarray(drive.input), REST))
    noise = NOISE * np.random.default_rng(seed).standard_normal(clean.size)
    return Record(drive.input, clean + noise, drive.dt, source=f"made by {name}"), clean
