"""Margins of a loop of several axes: each axis alone, and all at once."""

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
"""Sweeps of the balancing, which only starts the search for D."""

_TOLERANCE = 1e-9
"""Relative tolerance of the largest bound over the grid."""


@dataclass(frozen=True)
class MultiAxisReport:
    """Poles and margins of a loop of several axes, cut at the plant's inputs.

    L is its loop transfer matrix (see ``BrokenLoop``), S = (I+L)^-1, T = L (I+L)^-1.
    All figures are those of the sampled loop up to the Nyquist frequency. For an
    unstable loop only the poles are given: all else is None, and ``axes`` is empty.

    - ``stable``, ``poles``, ``conserved``, ``slowest_time_constant_s``: as in a
      ``StabilityReport``;
    - ``axes``: the StabilityReport of each axis, cut alone with all others closed. A
      loop of coupled axes can be fragile although each of these is robust;
    - ``disk_margin``: alpha. Gain and phase of all axes may vary at once and
      independently, each within ``disk_gain_margin`` (that factor or its inverse) and
      ``disk_phase_margin_deg``. Alpha is a lower bound, 1 / max over frequency of
      min over D of the largest singular value of D (S - T)/2 D^-1, D diagonal. It does
      not depend on the units of the axes, and for up to 3 axes and complex
      perturbations it is exact. ``disk_margin_Hz`` is the frequency of the maximum.
      Source: Seiler, Packard and Gahinet, An introduction to disk margins, 2020;
    - ``sensitivity_peak``, ``complementary_peak``: the largest singular values of S and
      T over frequency. They depend on the units of the commands;
    - ``output_sensitivity_peak``: that of S cut at the displacements instead, in the
      units of the axes. A disturbance of the displacement is amplified by this much at
      most.

    ``reference``, ``command`` and ``branch`` are the operating point, in the units of
    the axes. Frequencies in Hz, angles in degrees.
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
    output_sensitivity_peak: float | None = None
    output_sensitivity_peak_Hz: float | None = None  # noqa: N815
    reference: tuple[float, ...] | None = None
    command: tuple[float, ...] | None = None
    branch: str | None = None

    @property
    def largest_sensitivity_peak(self) -> float | None:
        """Larger of the sensitivity peaks of both cuts; None for an unstable loop."""
        peaks = self.sensitivity_peak, self.output_sensitivity_peak
        return max((peak for peak in peaks if peak is not None), default=None)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON: poles as [real, imaginary], infinity None."""
        return plain(dataclasses.asdict(self))


def axes_report_of(
    loop: LinearAxes, behind: LinearAxes | None = None
) -> MultiAxisReport:
    """Return the report on a linear loop of several axes.

    ``behind`` is the same loop, cut at its displacements instead.
    """
    found = poles_of(loop)
    if not found["stable"]:
        return MultiAxisReport(**found)
    axes = tuple(report_of(loop.one_cut(axis)) for axis in range(len(loop.C)))
    figures = _figures(loop)
    if behind is not None:
        peaks = sensitivity_figures(behind, angle_grid(behind))
        for name in ("sensitivity_peak", "sensitivity_peak_Hz"):
            figures[f"output_{name}"] = peaks[name]
    return MultiAxisReport(**found, axes=axes, **figures)


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
    """Return the peak of ``structured_bound`` of (S - T)/2, and its angle.

    ``sampled`` [lines, q, q] is (S - T)/2 on ``grid`` (rad/sample).
    """
    bounds = largest_singular(balancing(sampled)[1])
    best, at = 0.0, 0
    while True:
        index = int(np.argmax(bounds))
        # A frequency whose bound lies below the best value cannot be the peak.
        if bounds[index] <= best * (1.0 + _TOLERANCE):
            break
        value, d = structured_bound(sampled[index])
        if value > best:
            best, at = value, index
        # The D of one frequency bounds all others too, and its neighbours tightly.
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
    """Return min over D of the largest singular value of D ``matrix`` D^-1, and D [q].

    D is diagonal. The minimum is an upper bound of the structured singular value for
    one complex perturbation on each axis, and equals it for up to 3 axes. Every D gives
    a bound. The search starts at the D that balances rows and columns, and the problem
    is convex in log D.
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
    """Return D [m, q] and D M D^-1 of M [m, q, q].

    D is diagonal and makes the off-diagonal norms of each row and column equal.
    """
    size = matrices.shape[-1]
    off = np.where(np.eye(size, dtype=bool), 0.0, np.abs(matrices) ** 2)
    d = np.ones(matrices.shape[:-1])  # squared
    tiny = 1e-30 * (1.0 + off.sum(axis=(-2, -1)))
    for _ in range(_SWEEPS):
        for axis in range(size):
            row = np.sum(off[:, axis] / d, axis=1) * d[:, axis]
            column = np.sum(off[:, :, axis] * d, axis=1) / d[:, axis]
            d[:, axis] *= np.sqrt((column + tiny) / (row + tiny))
        d /= d[:, -1:]
    d = np.sqrt(d)
    return d, d[:, :, None] * matrices / d[:, None, :]
