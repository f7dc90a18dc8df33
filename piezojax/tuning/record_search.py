"""Search for the voltages of a record that determines given figures best."""

from collections import abc
from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import as_array
from ..identification.information import Unknowns
from ..signals.excitation import Generator, mixture, two_levels

TRIALS = 200
"""Number of random records; a descent begins at each of the best."""

ROUGH, FINE = 60, 1000
"""Numbers of steps of each descent, and of the best one afterwards."""

LARGEST, SMALLEST = 0.02, 2e-4
"""Change of every move by the first and by the last step of a descent."""

MOMENTUM = 0.95
"""Share of the earlier slopes in the direction of a step."""

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

    def covariance(
        self, voltages: Float[Array, " samples"], vagueness: float = 1.0
    ) -> Float[Array, "n n"]:
        """Return the covariance of the parameters after a record of ``voltages``.

        The standard deviations before the record are multiplied by ``vagueness``.
        """
        found = self.unknowns.information(voltages, self.noise)
        before = jnp.ones(len(found)).at[-1].set(1.0 / VAGUE**2) / vagueness**2
        found = found + jnp.diag(before)
        root = jnp.sqrt(jnp.diag(found))
        inverse = jnp.linalg.inv(found / jnp.outer(root, root))
        return (inverse / jnp.outer(root, root))[:-1, :-1]

    def loss(self, moves: Float[Array, " knots"]) -> Float[Array, ""]:
        """Return half the logarithm of the summed relative variances of the figures."""
        covariance = self.covariance(self.voltages(moves))
        return 0.5 * jnp.log(jnp.sum(self.sensitivity * covariance))


@eqx.filter_jit
def _loss(search: RecordSearch, moves: Array) -> Array:
    return search.loss(moves)


@eqx.filter_jit
def _stepped(
    search: RecordSearch, moves: Array, direction: Array, size: Array
) -> tuple[Array, Array, Array]:
    """Return the loss at ``moves``, and the moves and direction of the next step."""
    loss, slope = jax.value_and_grad(search.loss)(moves)
    scale = jnp.maximum(jnp.mean(jnp.abs(slope)), jnp.finfo(float).tiny)
    direction = MOMENTUM * direction - slope / scale
    moved = jnp.clip(moves + size * jnp.sign(direction), -1.0, 1.0)
    return loss, moved, direction


@dataclass(frozen=True, order=True)
class Point:
    """A point of the search with its loss."""

    loss: float
    moves: np.ndarray = field(compare=False)


def _point(loss: Array, moves: np.ndarray) -> Point:
    """Return the point at ``moves``, the worst of all if its loss is not finite."""
    return Point(float(loss) if np.isfinite(loss) else np.inf, moves)


def report_count(descents: int) -> int:
    """Return the number of reports of ``best_voltages``."""
    return TRIALS + descents * ROUGH + (FINE if descents else 0)


class Designed(NamedTuple):
    """Voltages (V) of the least loss that a search found, and whether it was ended."""

    voltages: Float[np.ndarray, " samples"]
    interrupted: bool


def best_voltages(
    search: RecordSearch,
    generator: Generator,
    descents: int,
    random: np.random.Generator,
    report: abc.Callable[[float], None],
) -> Designed:
    """Search for the voltages of the least loss.

    Descents begin at the best ``descents`` of ``TRIALS`` random records; the best of
    them continues. Without descents it is the best random record. ``report`` is called
    with the least loss so far after each record and each step. Ctrl-C ends the search
    with the best record so far. Raises ValueError if no random record has a finite
    loss.
    """
    best, interrupted = Point(np.inf, np.zeros(search.knots)), False
    try:
        for point in _points(search, generator, descents, random):
            best = min(best, point)
            report(best.loss)
    except KeyboardInterrupt:
        if best.loss == np.inf:
            raise
        interrupted = True
    return Designed(np.asarray(search.voltages(as_array(best.moves))), interrupted)


def _points(
    search: RecordSearch,
    generator: Generator,
    descents: int,
    random: np.random.Generator,
) -> abc.Iterator[Point]:
    """Yield the points of the random records and of the descents."""
    points = []
    for trial in range(TRIALS):
        drawn = (mixture, two_levels)[trial % 2]
        moves = search.moves(drawn(generator, search.samples, random))
        points.append(_point(_loss(search, as_array(moves)), moves))
        yield points[-1]
    if min(points).loss == np.inf:
        raise ValueError(
            "the plant, or its change with its parameters, is not finite in any of the "
            "random records: no record can be designed for this model"
        )
    rough = []
    for start in sorted(points)[:descents]:
        rough.append((yield from _descent(search, start, ROUGH)))
    if rough:
        yield from _descent(search, min(rough), FINE)


def _descent(
    search: RecordSearch, best: Point, steps: int
) -> abc.Generator[Point, None, Point]:
    """Yield the points of a descent from ``best`` with momentum, return the best.

    A step changes all moves equally, by the sign of the direction (Bernstein et al.,
    signSGD, ICML 2018). Most moves of a good record are the largest that are allowed,
    and the slope of a hysteresis jumps: a line search along the slope, as in L-BFGS,
    ends at the first jump.
    """
    moves, direction = as_array(best.moves), jnp.zeros(search.knots)
    shares = 0.5 + 0.5 * np.cos(np.linspace(0.0, np.pi, steps))
    for size in SMALLEST + (LARGEST - SMALLEST) * shares:
        loss, moved, direction = _stepped(search, moves, direction, as_array(size))
        point = _point(loss, np.asarray(moves))
        best, moves = min(best, point), moved
        yield point
    return best
