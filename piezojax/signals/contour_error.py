"""Contour error: distance of a stage from its path, independent of its lag."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import Scalar, State
from ..core.limited import Sample
from ..core.metrics import root
from ..core.rollout import Metric

_Point = tuple[Scalar, Scalar]


class ContourFigures(NamedTuple):
    """Root mean square and peak of the contour error, in the unit of the axes."""

    rms: Scalar
    peak: Scalar


class ContourError(Metric):
    """Metric of the distance of the displacement from the path of the reference.

    ``axes`` are the indices of the two axes of the contour, which should have the same
    unit; ``start`` is the first sample counted. Unlike Tracking, it does not count a
    lag along the path.

    The distance is measured from the circle through three successive points of the
    reference, or from their straight line if they lie on one. It is exact on circles
    and lines for any lag; elsewhere it is accurate if error and curvature change little
    over the lag. (The usual estimate, the component of the error across the velocity of
    the reference, counts lag on a curve as contour error.) Where the reference rests or
    reverses, the path is a point, and the whole distance from it counts; at a sharp
    corner the circle is about as small as a step of the reference, and almost the whole
    of a distance that is much larger counts. The last sample is left out, because it
    has no successor. If a run ends before ``start``, the figures are NaN. The gradient
    is 0 where the distance is 0.
    """

    axes: tuple[int, int] = eqx.field(static=True, default=(0, 1))
    start: int = eqx.field(static=True, default=0)

    def init(self) -> State:
        zero = jnp.zeros(())
        origin = (zero, zero)
        return {
            "count": zero,
            "square": zero,
            "peak": zero,
            "before": origin,
            "last": origin,
            "displacement": origin,
        }

    def update(self, total: State, index: Array, output: Sample) -> State:
        first, second = self.axes
        reference = output.reference[first], output.reference[second]
        error = _less(total["displacement"], total["last"])
        square = _square_distance(
            error,
            _less(total["last"], total["before"]),
            _less(reference, total["last"]),
        )
        # The distance is that of the previous sample; the first one has no predecessor.
        inside = (index > self.start) & (index > 1)
        square = jnp.where(inside, square, 0.0)
        return {
            "count": total["count"] + jnp.where(inside, 1.0, 0.0),
            "square": total["square"] + square,
            "peak": jnp.maximum(total["peak"], square),
            "before": total["last"],
            "last": reference,
            "displacement": (output.displacement[first], output.displacement[second]),
        }

    def result(self, total: State) -> ContourFigures:
        count = jnp.maximum(total["count"], 1.0)
        counted = jnp.where(total["count"] > 0.0, 0.0, jnp.nan)
        return ContourFigures(
            rms=root(total["square"] / count) + counted,
            peak=root(total["peak"]) + counted,
        )


def _less(a: _Point, b: _Point) -> _Point:
    return a[0] - b[0], a[1] - b[1]


def _square_distance(error: _Point, arriving: _Point, leaving: _Point) -> Scalar:
    """Return the square distance of ``error`` from a circle.

    The circle passes through the three points -``arriving``, 0 and ``leaving``.
    """
    squares = [a * a + b * b for a, b in (arriving, leaving)]
    # Inversion turns the circle into a line parallel to its tangent at 0.
    tangent = [
        a / _positive(squares[0]) + b / _positive(squares[1])
        for a, b in zip(arriving, leaving, strict=True)
    ]
    steepness = tangent[0] ** 2 + tangent[1] ** 2
    # A path at rest, or one that reverses, has no tangent: it is a point.
    smooth = (squares[0] > 0.0) & (squares[1] > 0.0) & (steepness > 0.0)
    length = jnp.sqrt(jnp.where(smooth, steepness, 1.0))
    across = (tangent[0] * error[1] - tangent[1] * error[0]) / length
    chord = (arriving[0] + leaving[0]) ** 2 + (arriving[1] + leaving[1]) ** 2
    sides = _positive(squares[0]) * _positive(squares[1]) * _positive(chord)
    turn = arriving[0] * leaving[1] - arriving[1] * leaving[0]
    curvature = 2.0 * turn / jnp.sqrt(sides)
    whole = error[0] ** 2 + error[1] ** 2
    # |error - centre| - radius, written so that a line is a circle of curvature 0.
    bend = curvature**2 * whole - 2.0 * curvature * across
    distance = (curvature * whole - 2.0 * across) / (1.0 + root(1.0 + bend))
    return jnp.where(smooth, distance**2, whole)


def _positive(square: Scalar) -> Scalar:
    return jnp.where(square > 0.0, square, 1.0)


def nearest_on(
    points: Float[np.ndarray, "points 2"], path: Float[np.ndarray, "samples 2"]
) -> Float[np.ndarray, "points 2"]:
    """Return the nearest point of the polyline ``path`` to each of ``points``.

    All segments are searched, so the two branches at a crossing of the path are not
    distinguished. The function uses NumPy, for pictures and checks; its cost grows as
    points x samples. The result is NaN for a point that is not finite. Raises
    ValueError if the path has fewer than two points.
    """
    points, path = np.asarray(points, float), np.asarray(path, float)
    if len(path) < 2:
        raise ValueError(f"path has {len(path)} points; it must have 2 or more")
    begin, leg = path[:-1], np.diff(path, axis=0)
    square = np.sum(leg**2, axis=1)
    square = np.where(square > 0.0, square, 1.0)
    nearest = np.full_like(points, np.nan)
    for i in np.flatnonzero(np.all(np.isfinite(points), axis=1)):
        along = np.clip(np.sum((points[i] - begin) * leg, axis=1) / square, 0.0, 1.0)
        places = begin + along[:, None] * leg
        nearest[i] = places[np.argmin(np.sum((points[i] - places) ** 2, axis=1))]
    return nearest


def distance_to(
    points: Float[np.ndarray, "points 2"], path: Float[np.ndarray, "samples 2"]
) -> Float[np.ndarray, " points"]:
    """Return the distance of each point from the polyline ``path``; see
    ``nearest_on``."""
    return np.linalg.norm(points - nearest_on(points, path), axis=1)
