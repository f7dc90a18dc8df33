"""Laws of hysteresis: those that hold for a model, and those that do not.

A law is a function from a model and an example to a defect, 0 if it holds. Laws in
`keeps` of a row hold within its tolerance on every drawn example; laws in `breaks`
have at least the stated defect on the stated example, and the docstring of the model
documents it. A registered model needs no row: it is tested with its declared laws.
"""

import inspect
import itertools
from typing import NamedTuple

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import piezojax.core.registry
import piezojax.hysteresis
from piezojax import (
    System,
    simulate,
)
from piezojax.core.recipe import Extent
from piezojax.hysteresis import (
    AsymmetricPrandtlIshlinskii,
    BashashJalili,
    BoucWen,
    ColemanHodgdon,
    Duhem,
    Hysteresis,
    NormalisedBoucWen,
    PrandtlIshlinskii,
    Preisach,
    ShapedColemanHodgdon,
    StopPrandtlIshlinskii,
)

SPAN = (0.0, 100.0)  # V
SHARES = 6  # numbers in 0 .. 1 that define an example
SEGMENTS, PARTS = 12, 16  # of every path, and samples per segment
LENGTH = SEGMENTS * PARTS + 1


@jax.jit
def _outputs(system, paths):
    return jax.vmap(lambda p: simulate(system, p, system.init(p[0]))[1])(paths)


def outputs(system, *paths):
    """Return the outputs along two paths; one program per model serves all laws."""
    stacked = np.stack([np.pad(p, (0, LENGTH - p.size), "edge") for p in paths])
    return np.asarray(_outputs(system, stacked))


def through(shares, parts=PARTS):
    """Return inputs (V) along straight segments between corners in 0 .. 1."""
    corners = SPAN[0] + (SPAN[1] - SPAN[0]) * np.asarray(shares)
    at = np.arange((corners.size - 1) * parts + 1) / parts
    return np.interp(at, np.arange(corners.size), corners)


def return_point_memory(system, example):
    """Return the distance (um) between start and end of a minor loop."""
    low, q, p, high = sorted(example[:4])
    start = example[4]
    up = [start, high, low, p, q, p]
    down = [start, low, high, q, p, q]
    y = outputs(system, through(up), through(down))
    return np.max(np.abs(y[:, 5 * PARTS] - y[:, 3 * PARTS]))


def wiping_out(system, example):
    """Return the remaining effect (um) of extrema between two larger ones."""
    low, high = min(example), max(example)
    start, *inner, end = example
    plain = [start] * (len(inner) + 1) + [low, high, end]
    rich = [start, *inner, low, high, end]
    y = outputs(system, through(plain), through(rich))
    return abs(y[0, -1] - y[1, -1])


def congruency(system, example):
    """Return the difference (um) of minor loops between the same two inputs."""
    low, q, p, high = sorted(example[:4])
    start = example[4]
    y = outputs(system, through([start, low, p, q]), through([start, high, q, p, q]))
    # Both fall from p to q, one from the main branch, one inside a loop.
    first = y[0, 2 * PARTS : 3 * PARTS + 1]
    second = y[1, 3 * PARTS : 4 * PARTS + 1]
    return np.max(np.abs((first - first[0]) - (second - second[0])))


def rate_independence(system, example):
    """Return the difference (um) at the corners between two speeds."""
    even = through(example)
    corners = even[::PARTS]
    # Slow at the start of every segment, fast at its end.
    shares = (np.arange(PARTS) / PARTS) ** 2
    uneven = [a + (b - a) * shares for a, b in itertools.pairwise(corners)]
    y = outputs(system, even, np.append(np.concatenate(uneven), corners[-1]))
    at = slice(0, even.size, PARTS)
    return np.max(np.abs(y[0, at] - y[1, at]))


def pauses(system, example):
    """Return the difference (um) at the corners due to pauses."""
    path = through(example)
    y = outputs(system, path, np.repeat(path, 2))
    return np.max(np.abs(y[0, : path.size] - y[1, 1 : 2 * path.size : 2]))


def thermodynamic_sign(system, example):
    """Return the energy (V um) released in a closed counter-clockwise cycle.

    In the third round of a cycle of four corners fading memory has almost vanished. A
    kink between two samples adds an error of about 0.1 V um to the sum.
    """
    path = through([*example[:4]] * 3 + [example[0]])
    last = slice(-4 * PARTS - 1, None)
    v, y = path[last], outputs(system, path, path)[0, last]
    return -np.sum((0.5 * (v[1:] + v[:-1]) - v[0]) * np.diff(y))


LAWS = {
    "return-point memory": return_point_memory,
    "wiping-out": wiping_out,
    "congruency": congruency,
    "rate independence": rate_independence,
    "pauses": pauses,
    "counter-clockwise": thermodynamic_sign,
}
EXACT = 1e-9
LOOP = (0.05, 0.35, 0.6, 0.95, 0.5, 0.2)
SHORT = (0.4, 0.55, 0.4, 0.55, 0.42, 0.5)  # so short that little memory fades
CYCLE = (0.0, 1.0, 0.2, 0.8, 0.0, 1.0)


class Row(NamedTuple):
    """A model, the tolerance (um or V um) of its laws, and defects of broken laws."""

    system: System
    keeps: dict
    breaks: dict


def fading(system, rate, **breaks):
    """Return the row of a differential model: its memory fades and is not wiped out.

    `rate`: at 16 samples per branch; other files test the order of each scheme.
    """
    memory = {
        "return-point memory": (LOOP, 0.02),
        "wiping-out": (SHORT, 0.005),
        "congruency": (LOOP, 0.01),
    }
    kept = {"rate independence": rate, "pauses": EXACT, "counter-clockwise": 0.5}
    return row(system, kept, memory | breaks)


def remembering(system, **breaks):
    """Return the row of a model of extrema: all laws hold to rounding."""
    return row(system, dict.fromkeys(LAWS, EXACT) | {"counter-clockwise": 0.5}, breaks)


def row(system, kept, breaks):
    breaks = {law.replace("_", "-"): example for law, example in breaks.items()}
    return Row(system, {k: v for k, v in kept.items() if k not in breaks}, breaks)


A, B, C = 0.0077, 0.1167, -0.0487
THRESHOLDS, WEIGHTS = (2.0, 7.0, 15.0), (0.02, 0.015, 0.01)
BRANCHES = (-0.45, 0.03, -0.35, 0.05)
ROWS = {
    "ColemanHodgdon, exact": fading(ColemanHodgdon(A, B, C, scheme="exact"), EXACT),
    "ColemanHodgdon": fading(ColemanHodgdon(A, B, C), 2e-3),
    "ShapedColemanHodgdon": fading(
        ShapedColemanHodgdon((0.0, 0.0077, 3e-6), (0.11, 5e-5), C), 2e-3
    ),
    "ShapedColemanHodgdon, weak pull": fading(
        ShapedColemanHodgdon((0.02, 0.006, -2e-5, 1e-7), (0.11, -3e-4, 2e-6), -0.05),
        5e-3,
        counter_clockwise=(CYCLE, 5.0),
    ),
    "Duhem": fading(Duhem(((B,),), ((0.0, A), (C,))), 1e-4),
    "BoucWen": fading(
        BoucWen(0.04, 0.024, 0.016), 1e-3, counter_clockwise=(CYCLE, 50.0)
    ),
    "NormalisedBoucWen": fading(NormalisedBoucWen(0.12, -1.0, 0.04, 0.6, 2.0), 1e-3),
    "NormalisedBoucWen, exact": fading(
        NormalisedBoucWen(0.12, -1.0, 0.04, 0.6, scheme="exact"), EXACT
    ),
    "NormalisedBoucWen, k_w > 0": fading(
        NormalisedBoucWen(0.12, 1.0, 0.04, 0.6, scheme="exact"),
        EXACT,
        counter_clockwise=(CYCLE, 50.0),
    ),
    "PrandtlIshlinskii": remembering(
        PrandtlIshlinskii((0.08, 2e-4), THRESHOLDS, WEIGHTS)
    ),
    "AsymmetricPrandtlIshlinskii": remembering(
        AsymmetricPrandtlIshlinskii(
            (0.05,), THRESHOLDS, WEIGHTS, (0.01, 0.004, 0.02), -20.0, 120.0
        )
    ),
    "StopPrandtlIshlinskii": remembering(
        StopPrandtlIshlinskii((0.15, 2e-4), THRESHOLDS, WEIGHTS)
    ),
    "Preisach": remembering(Preisach(np.tril(np.full((7, 7), 0.4)), *SPAN)),
    "BashashJalili": remembering(
        BashashJalili(0.0, 0.0, 100.0, 12.0, *BRANCHES, depth=6),
        congruency=(LOOP, 0.03),
    ),
    "BashashJalili, alpha > 0": remembering(
        BashashJalili(0.0, 0.0, 100.0, 12.0, 0.45, 0.03, 0.35, 0.05, depth=6),
        congruency=(LOOP, 0.03),
        counter_clockwise=(CYCLE, 20.0),
    ),
}
KEPT = [(name, law) for name, row in ROWS.items() for law in row.keeps]
BROKEN = [(name, law) for name, row in ROWS.items() for law in row.breaks]

shares = st.floats(0.0, 1.0).map(lambda share: round(share, 3))


@pytest.mark.parametrize(("name", "law"), KEPT)
@settings(max_examples=10)
@given(example=st.lists(shares, min_size=SHARES, max_size=SHARES))
def test_the_declared_laws_hold(name, law, example):
    assert LAWS[law](ROWS[name].system, example) <= ROWS[name].keeps[law]


@pytest.mark.parametrize(("name", "law"), BROKEN)
def test_the_broken_laws_are_documented(name, law):
    row = ROWS[name]
    example, least = row.breaks[law]
    assert LAWS[law](row.system, example) >= least
    assert law in " ".join(inspect.getdoc(type(row.system)).lower().split())


def test_every_law_of_every_model_is_in_the_table():
    for name, row in ROWS.items():
        assert sorted([*row.keeps, *row.breaks]) == sorted(LAWS), name


CLAIMED = [
    (kind, law)
    for kind in piezojax.core.registry.parts().values()
    if issubclass(kind, Hysteresis)
    for law in kind.laws
]


@pytest.mark.parametrize(("kind", "law"), CLAIMED)
def test_a_registered_model_satisfies_its_declared_laws(kind, law):
    extent = Extent(*SPAN, (0.0, 0.0), 0.12, 0.0, 12.0, 1e-3, 2.0)
    system = kind.recipe(extent).system
    # A loop has the unit V um, every other law um.
    size = 12.0 * (100.0 if law == "counter-clockwise" else 1.0)
    assert LAWS[law](system, LOOP) <= kind.laws[law] * size
