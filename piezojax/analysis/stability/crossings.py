"""Frequency grid, zero crossings and peaks of the response of a loop."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import optimize

from .conserved import FollowedReference, LinearAxes, LinearLoop

PER_DECADE = 400
"""Grid points per decade, without the additional ones around the poles."""

_AROUND = np.concatenate(
    [-np.geomspace(30.0, 0.03, 40), [0.0], np.geomspace(0.03, 30.0, 40)]
)
_PEAKS = 8  # number of local maxima on the grid that are refined

Function = Callable[[np.ndarray], np.ndarray]


def angle_grid(
    loop: LinearLoop | LinearAxes | FollowedReference, per_decade: int = PER_DECADE
) -> np.ndarray:
    """Return angles (rad/sample) from far below the slowest pole to pi.

    The grid is logarithmic, and denser around each pole of the open and the closed
    loop, so that no resonance falls between two points.
    """
    poles = np.concatenate(
        [np.linalg.eigvals(loop.A), np.linalg.eigvals(loop.closed())]
    )
    poles = poles[np.abs(poles) > 1e-6]
    logs = np.log(poles.astype(complex))
    rates = np.abs(logs)[np.abs(logs) > 1e-9]
    slowest = 1e-3 * rates.min(initial=1e-2)
    count = int(per_decade * np.log10(np.pi / slowest))
    around = np.abs(np.imag(logs))[:, None] + np.abs(np.real(logs))[:, None] * _AROUND
    near = np.unique(around[(around > slowest) & (around < np.pi)])
    return np.unique(
        np.concatenate([np.geomspace(slowest, np.pi, count), near, [np.pi]])
    )


def roots(function: Function, grid: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the zeros of ``function``, one in each interval with a change of sign.

    ``values`` are those of ``function`` on ``grid``.
    """
    places = np.flatnonzero(values[:-1] * values[1:] < 0.0)
    found = [_root(function, grid[i], grid[i + 1]) for i in places]
    return np.array([*found, *grid[values == 0.0]])


def _root(function: Function, low: float, high: float) -> float:
    """Return the zero between ``low`` and ``high``, to rounding."""

    def at(x: float) -> float:
        return float(function(np.array([x]))[0])

    ends = at(low), at(high)
    if ends[0] * ends[1] >= 0.0:
        # The sign on the grid was that of a rounding error.
        return low if abs(ends[0]) < abs(ends[1]) else high
    found: Any = optimize.brentq(at, low, high, xtol=1e-15, rtol=np.float64(1e-14))
    return float(found)


def peak(
    function: Function, grid: np.ndarray, values: np.ndarray
) -> tuple[float, float]:
    """Return the largest value of ``function`` and its argument.

    ``values`` are those of ``function`` on ``grid``.
    """
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:]))
    highest = (inner + 1)[np.argsort(values[inner + 1])[::-1][:_PEAKS]]
    best = int(np.argmax(values))
    found = [(float(values[best]), float(grid[best]))]
    for i in highest:
        low, high = grid[i - 1], grid[i + 1]
        refined: Any = optimize.minimize_scalar(
            lambda x: -float(function(np.array([x]))[0]),
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-12 * high},
        )
        found.append((-float(refined.fun), float(refined.x)))
    return max(found)
