"""Search for the voltages of a record that determines given figures best."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from ..core.arrays import as_array
from ..identification.information import Unknowns
from ..signals.excitation import Generator, mixture

TRIALS = 200
"""Number of random records; a descent begins at each of the best."""

ROUGH, ROUND, ROUNDS = 60, 150, 4
"""Largest number of steps of each descent, of a round of the best one afterwards, and
of its rounds. A round begins without the curvature of the one before, because the slope
of a hysteresis jumps and the limits of the range hide slopes."""

SETTLED, GAIN = 1e-6, 0.005
"""Relative change of the loss below which a descent ends, and decrease of the loss in a
round below which no other one follows."""

MEMORY = 20
"""Number of steps from which L-BFGS estimates the curvature."""

VAGUE = 100.0
"""Standard deviation (um) of the zero of the sensor before the record. That of a
parameter is its scale: an error of 100 %, or that of the first fit if it is larger."""


class RecordSearch(eqx.Module):
    """Voltages within limits, and their loss for the promised figures.

    The voltages begin at the middle of the range and are straight between knots that
    lie ``every`` samples apart. A point of the search holds the move from each knot to
    the next, as a share of the largest move ``most`` (V) that the slew rate allows, in
    [-1, 1]; at the limits ``lower`` and ``upper`` (V) a move ends. ``sensitivity`` is
    the sum of those of the figures, ``noise`` the rms noise of the sensor in um.
    """

    unknowns: Unknowns
    sensitivity: Float[Array, "n n"]
    noise: Float[Array, ""]
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    most: Float[Array, ""]
    samples: int = eqx.field(static=True)
    every: int = eqx.field(static=True)

    @property
    def knots(self) -> int:
        """Number of knots behind the first."""
        return -(-(self.samples - 1) // self.every)

    def voltages(self, moves: Float[Array, " knots"]) -> Float[Array, " samples"]:
        """Return the voltages of a point of the search."""
        middle = 0.5 * (self.lower + self.upper)

        def following(voltage: Array, move: Array) -> tuple[Array, Array]:
            end = jnp.clip(voltage + self.most * move, self.lower, self.upper)
            return end, end

        _, ends = jax.lax.scan(following, middle, moves)
        knots = self.every * jnp.arange(self.knots + 1)
        return jnp.interp(
            jnp.arange(self.samples), knots, jnp.concatenate([middle[None], ends])
        )

    def moves(self, voltages: Float[np.ndarray, " samples"]) -> np.ndarray:
        """Return the point of the search nearest to ``voltages``."""
        knots = np.minimum(self.every * np.arange(self.knots + 1), self.samples - 1)
        return np.clip(np.diff(voltages[knots]) / float(self.most), -1.0, 1.0)

    def covariance(self, voltages: Float[Array, " samples"]) -> Float[Array, "n n"]:
        """Return the covariance of the parameters after a record of ``voltages``."""
        found = self.unknowns.information(voltages, self.noise)
        before = jnp.ones(len(found)).at[-1].set(1.0 / VAGUE**2)
        return jnp.linalg.inv(found + jnp.diag(before))[:-1, :-1]

    def loss(self, moves: Float[Array, " knots"]) -> Float[Array, ""]:
        """Return half the logarithm of the summed relative variances of the figures."""
        covariance = self.covariance(self.voltages(moves))
        return 0.5 * jnp.log(jnp.sum(self.sensitivity * covariance))


@eqx.filter_jit
def _loss(search: RecordSearch, moves: Array) -> Array:
    return search.loss(moves)


def _loss_and_slope(
    search: RecordSearch, moves: np.ndarray
) -> tuple[float, np.ndarray]:
    loss, slope = _differentiated(search, as_array(moves))
    return float(loss), np.asarray(slope, float)


@eqx.filter_jit
def _differentiated(search: RecordSearch, moves: Array) -> tuple[Array, Array]:
    return jax.value_and_grad(search.loss)(moves)


@dataclass(frozen=True, order=True)
class Point:
    """A point of the search with its loss."""

    loss: float
    moves: np.ndarray = field(compare=False)


def most_reports(descents: int) -> int:
    """Return the largest number of reports of ``best_voltages``."""
    return TRIALS + descents * ROUGH + ROUNDS * ROUND


def best_voltages(
    search: RecordSearch,
    generator: Generator,
    descents: int,
    random: np.random.Generator,
    report: Callable[[float], None],
) -> Float[np.ndarray, " samples"]:
    """Return the voltages (V) of the least loss that is found.

    L-BFGS with bounds descends a little from the best ``descents`` of ``TRIALS`` random
    records, and then from the best point, with gradients through the simulation. The
    loss has many minima. ``report`` is called with the loss after each record and each
    step.
    """
    points: list[Point] = []
    for _ in range(TRIALS):
        moves = search.moves(mixture(generator, search.samples, random))
        points.append(Point(float(_loss(search, as_array(moves))), moves))
        report(min(points).loss)
    starts = sorted(points)[:descents]
    best = min(_descended(search, start, ROUGH, report) for start in starts)
    for _ in range(ROUNDS):
        before, best = best, _descended(search, best, ROUND, report)
        if before.loss - best.loss < GAIN:
            break
    return np.asarray(search.voltages(as_array(best.moves)))


def _descended(
    search: RecordSearch, start: Point, steps: int, report: Callable[[float], None]
) -> Point:
    found: Any = minimize(
        partial(_loss_and_slope, search),
        start.moves,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-1.0, 1.0)] * start.moves.size,
        callback=lambda intermediate_result: report(float(intermediate_result.fun)),
        options={"maxiter": steps, "maxcor": MEMORY, "ftol": SETTLED},
    )
    return min(start, Point(float(found.fun), found.x))
