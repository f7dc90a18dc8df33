"""Margins of a loop of several axes: one at a time, and all at once."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize

from .conserved import LinearAxes
from .crossings import angle_grid
from .margins import (
    StabilityReport,
    disk_figures,
    hertz,
    largest_singular,
    plain,
    poles_of,
    report_of,
    sensitivity_figures,
)

_SWEEPS = 12
"""Of the balancing: a start only."""

_TOLERANCE = 1e-9
"""To which the largest bound over the grid is searched, relative."""


@dataclass(frozen=True)
class MultiAxisReport:
    """How far a loop of several axes, cut at the plant's inputs, is from instability.

    L is its loop transfer matrix (see ``BrokenLoop``), S = (I+L)^-1, T = L (I+L)^-1.
    All hold for the sampled loop up to the Nyquist frequency. Of an unstable loop only
    the poles are given: all else is None, and there are no ``axes``.

    - ``stable``, ``poles``, ``conserved``, ``slowest_time_constant_s``: as in a
      ``StabilityReport``;
    - ``axes``: a StabilityReport of each axis, cut alone with all others closed. Where
      axes are coupled a loop can be fragile although each of these is robust;
    - ``disk_margin``: alpha, such that gain and phase of all axes may vary at once and
      apart, each within ``disk_gain_margin`` (that factor up, or its inverse) and
      ``disk_phase_margin_deg``. A lower bound: 1 / max over frequency of the least
      largest singular value of D (S - T)/2 D^-1, D diagonal, which does not depend on
      the units of the axes; up to 3 axes and complex perturbations it is exact.
      ``disk_margin_Hz`` is where it is smallest. Source: Seiler, Packard and Gahinet,
      An introduction to disk margins, 2020;
    - ``sensitivity_peak``, ``complementary_peak``: the largest singular values of S and
      T over frequency. They depend on the units of the commands.

    ``reference``, ``command`` and ``branch`` say where the loop was linearised, in the
    units of the axes. Frequencies in Hz, angles in degrees.
    """

    stable: bool
    dt_s: float
    poles: tuple[complex, ...]
    conserved: int
    slowest_time_constant_s: float | None
    axes: tuple[StabilityReport, ...] = ()
    disk_margin: float | None = None
    disk_gain_margin: float | None = None
    disk_phase_margin_deg: float | None = None
    disk_margin_Hz: float | None = None  # noqa: N815
    sensitivity_peak: float | None = None
    sensitivity_peak_Hz: float | None = None  # noqa: N815
    complementary_peak: float | None = None
    complementary_peak_Hz: float | None = None  # noqa: N815
    reference: tuple[float, ...] | None = None
    command: tuple[float, ...] | None = None
    branch: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON: poles as [real, imaginary], infinity None."""
        return plain(dataclasses.asdict(self))


def axes_report_of(loop: LinearAxes) -> MultiAxisReport:
    """Return the report on a loop of several axes that is linear already."""
    found = poles_of(loop)
    if not found["stable"]:
        return MultiAxisReport(**found)
    axes = tuple(report_of(loop.one_cut(axis)) for axis in range(len(loop.C)))
    return MultiAxisReport(**found, axes=axes, **_figures(loop))


def _figures(loop: LinearAxes) -> dict[str, Any]:
    grid = angle_grid(loop)
    figures: dict[str, Any] = sensitivity_figures(loop, grid)
    half = 0.5 * np.eye(len(loop.C))
    worst, angle = _structured_peak(loop, grid, loop.sensitivity(grid) - half)
    figures["disk_margin_Hz"] = hertz(angle, loop.dt)
    return figures | disk_figures(worst)


def _structured_peak(
    loop: LinearAxes, grid: np.ndarray, sampled: np.ndarray
) -> tuple[float, float]:
    """Return the largest structured singular value of (S - T)/2, and where it lies."""
    bounds = largest_singular(balancing(sampled)[1])
    best, at = 0.0, 0
    while True:
        index = int(np.argmax(bounds))
        # What is bounded below the best cannot be the peak.
        if bounds[index] <= best * (1.0 + _TOLERANCE):
            break
        value, d = structured_bound(sampled[index])
        if value > best:
            best, at = value, index
        # What suits one frequency suits its neighbours, and bounds them too.
        others = largest_singular(d[:, None] * sampled / d)
        bounds = np.minimum(bounds, others)
        bounds[index] = value
    low, high = grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]
    half = 0.5 * np.eye(len(loop.C))
    refined: Any = optimize.minimize_scalar(
        lambda x: -structured_bound(loop.sensitivity(np.array([x]))[0] - half)[0],
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-9 * high},
    )
    return max((best, float(grid[at])), (-float(refined.fun), float(refined.x)))


def structured_bound(matrix: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the least largest singular value of D ``matrix`` D^-1, and D [q].

    D is diagonal. The value is an upper bound of the structured singular value for a
    complex number an axis, and that value itself up to 3 axes. Any D gives a bound; the
    search starts at the one that balances rows and columns, and is convex in log D.
    """
    found, balanced = balancing(matrix[None])
    start, matrix = found[0], balanced[0]
    size = len(matrix) - 1
    if size == 0:
        return float(np.linalg.norm(matrix, 2)), start

    def scale(logarithms: np.ndarray) -> np.ndarray:
        return np.exp(np.append(logarithms, 0.0))

    def largest(logarithms: np.ndarray) -> float:
        d = scale(logarithms)
        return float(np.linalg.norm(d[:, None] * matrix / d, 2))

    simplex = np.vstack([np.zeros(size), 0.1 * np.eye(size)])
    best: Any = optimize.minimize(
        largest,
        np.zeros(size),
        method="Nelder-Mead",
        options={"xatol": 1e-8, "fatol": 1e-12, "initial_simplex": simplex},
    )
    return float(best.fun), start * scale(best.x)


def balancing(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return D [m, q] and D M D^-1 of M [m, q, q] with rows as long as columns."""
    size = matrices.shape[-1]
    off = np.where(np.eye(size, dtype=bool), 0.0, np.abs(matrices) ** 2)
    d = np.ones(matrices.shape[:-1])  # squared
    tiny = 1e-30 * (1.0 + off.sum(axis=(-2, -1)))
    for _ in range(_SWEEPS):
        for axis in range(size):
            row = np.sum(off[:, axis] / d, axis=-1) * d[:, axis]
            column = np.sum(off[:, :, axis] * d, axis=-1) / d[:, axis]
            d[:, axis] *= np.sqrt((column + tiny) / (row + tiny))
        d /= d[:, -1:]
    d = np.sqrt(d)
    return d, d[:, :, None] * matrices / d[:, None, :]
