"""Poles, margins and sensitivity peaks of a discrete loop."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ...core.arrays import Scalar, Signal, as_array
from ...core.feedback import Feedback, LoopState
from ...dynamics import StateSpace
from ...dynamics.linearise import linearise
from .broken_loop import BrokenLoop, FollowedLoop, cut
from .conserved import (
    FollowedReference,
    LinearAxes,
    LinearLoop,
    balanced,
    without_conserved,
)
from .crossings import angle_grid, peak, roots
from .following import Following, following_of
from .operating_point import OperatingPoint


@dataclass(frozen=True)
class StabilityReport:
    """Poles and margins of a discrete loop, cut at the plant's input.

    L is its loop transfer function (see ``BrokenLoop``), S = 1/(1+L), T = L/(1+L). All
    figures are those of the sampled loop up to the Nyquist frequency. For an unstable
    loop only the poles are given, and all else is None. A margin is infinite, and its
    frequency None, if no change of its kind makes the loop unstable.

    - ``stable``: every pole of the closed loop is inside the unit circle;
    - ``poles``: of the closed loop in the z plane, largest first. They leave out the
      ``conserved`` poles at z = 1, which belong to the memory of a hysteresis and which
      no input moves;
    - ``slowest_time_constant_s``: of the pole nearest to the unit circle;
    - ``gain_margin``: smallest factor above 1 on the loop gain that makes the loop
      unstable; ``gain_margin_dB``: the same in dB; ``phase_crossover_Hz``: frequency of
      the oscillation at this gain; ``gain_reduction_margin``: largest factor below 1
      that makes the loop unstable, 0 if there is none;
    - ``phase_margin_deg``: smallest phase, lag or lead, that makes the loop unstable;
      ``gain_crossover_Hz``: frequency of the oscillation at this phase;
    - ``delay_margin_s``, ``delay_margin_samples``: smallest delay that makes the loop
      unstable, exact for whole samples: the loop is stable with any whole number of
      samples below it;
    - ``disk_margin``: alpha, 1 / max |(S - T)/2|. Gain and phase may vary at once
      within ``disk_gain_margin`` (that factor or its inverse) and
      ``disk_phase_margin_deg``. Source: Seiler, Packard and Gahinet, An introduction to
      disk margins, 2020;
    - ``sensitivity_peak``: Ms = max |S|; ``complementary_peak``: Mt = max |T|;
    - ``following``: bandwidth and peak of the response to small motions of the
      reference; None if only L is known.

    ``reference_um``, ``voltage_V`` and ``branch`` are the operating point. Frequencies
    in Hz, angles in degrees.
    """

    stable: bool
    dt_s: float
    poles: tuple[complex, ...]
    conserved: int
    slowest_time_constant_s: float | None
    gain_margin: float | None
    gain_margin_dB: float | None  # noqa: N815
    phase_crossover_Hz: float | None  # noqa: N815
    gain_reduction_margin: float | None
    phase_margin_deg: float | None
    gain_crossover_Hz: float | None  # noqa: N815
    delay_margin_s: float | None
    delay_margin_samples: float | None
    disk_margin: float | None
    disk_gain_margin: float | None
    disk_phase_margin_deg: float | None
    sensitivity_peak: float | None
    sensitivity_peak_Hz: float | None  # noqa: N815
    complementary_peak: float | None
    complementary_peak_Hz: float | None  # noqa: N815
    following: Following | None = None
    reference_um: float | None = None
    voltage_V: float | None = None  # noqa: N815
    branch: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON: poles as [real, imaginary], infinity None."""
        return plain(dataclasses.asdict(self))


def plain(value: Any) -> Any:
    """Return ``value`` for JSON: complex as [real, imaginary], infinity None."""
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return [plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


@eqx.filter_jit
def _linearised(
    loop: Feedback,
    reference: Signal,
    side: Scalar,
    state: LoopState | None,
    dt: float,
    kind: type[BrokenLoop],
) -> tuple[StateSpace, LoopState]:
    broken = cut(loop, reference, side, state, kind)
    return linearise(broken, broken.rest, broken.init(), dt), broken.start


def located_report(
    model: LinearLoop, start: LoopState, point: OperatingPoint
) -> StabilityReport:
    """Return the report on ``model``, including its operating point."""
    return dataclasses.replace(
        report_of(model),
        reference_um=float(point.reference),
        voltage_V=float(start.voltage),
        branch=point.branch,
    )


def linear_loop(loop: Feedback, at: Any = 0.0) -> tuple[LinearLoop, LoopState]:
    """Return L of a loop of one axis as matrices, and the operating state.

    Arguments and errors are those of ``stability_report``; for several axes use
    ``linear_axes``.
    """
    A, B, C, D, dt, start = _matrices(loop, OperatingPoint.at(at), FollowedLoop)
    cut = without_conserved(balanced(LinearLoop(A, B[:, 0], C[0], dt)))
    # The voltage that the actuator returns closes the loop: u = -(C x + D r).
    closed = A - np.outer(B[:, 0], C[0])
    driven = B[:, 1:] - np.outer(B[:, 0], D[0, 1:])
    followed = balanced(FollowedReference.seen_ahead(closed, driven, C[1], dt))
    return cut._replace(followed=without_conserved(followed)), start


def linear_axes(loop: Feedback, at: Any) -> tuple[LinearAxes, LinearAxes, LoopState]:
    """Return L of a loop cut in all its axes as matrices, and the operating state.

    The first L is cut at the plant's inputs, the second at the displacements. Arguments
    and errors are those of ``stability_report``.
    """
    A, B, C, _, dt, start = _matrices(loop, OperatingPoint.at(at), BrokenLoop)
    cut = LinearAxes(A, B, C, dt)
    before, behind = (
        without_conserved(balanced(one)) for one in (cut, _cut_behind(cut))
    )
    return before, behind, start


def _cut_behind(loop: LinearAxes) -> LinearAxes:
    """Return L cut at the displacements, from the loop cut at the plant's inputs.

    Input: the displacements that the sensors read, um. Output: minus those of the
    plant, um. Its S maps a disturbance of the displacements to them. The displacements
    are states of the loop (``BrokenState``).
    """
    axes = len(loop.C)
    read = slice(-2 * axes, -axes)
    A = loop.closed()
    B, A[:, read] = A[:, read].copy(), 0.0
    C = np.zeros_like(loop.C)
    C[:, read] = -np.eye(axes)
    return LinearAxes(A, B, C, loop.dt)


def _matrices(
    loop: Feedback, point: OperatingPoint, kind: type[BrokenLoop]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, LoopState]:
    """Return A, B, C, D and the sample time of ``kind``, and the operating state."""
    reference, dt = point.signal, point.sample_time(loop)
    side = as_array(point.side)
    model, start = _linearised(loop, reference, side, point.state, dt, kind)
    point.check(start)
    A, B, C, D = (np.asarray(m) for m in (model.A, model.B, model.C, model.D))
    if not all(np.isfinite(m).all() for m in (A, B, C, D)):
        shown = ", ".join(f"{float(r):g}" for r in jax.tree.leaves(reference))
        raise ValueError(
            f"the loop has no finite derivative at {shown} um; "
            "it cannot be linearised there"
        )
    axes = len(jax.tree.leaves(start.voltage))
    assert not D[:, :axes].any()  # the plant responds one sample later
    return A, B, C, D, dt, start


def report_of(loop: LinearLoop) -> StabilityReport:
    """Return the report on a linear loop of one axis."""
    found = poles_of(loop)
    figures: dict[str, Any] = dict.fromkeys(_FIGURES)
    if found["stable"]:
        figures |= _figures(loop)
        figures["following"] = loop.followed and following_of(loop.followed)
    return StabilityReport(**(figures | found))


def poles_of(loop: LinearLoop | LinearAxes) -> dict[str, Any]:
    """Return the fields of a report that concern the poles of the closed loop."""
    poles = np.linalg.eigvals(loop.closed())
    poles = poles[np.argsort(-np.abs(poles), kind="stable")]
    largest = float(np.abs(poles).max(initial=0.0))
    stable = largest < 1.0
    speed = -math.log(largest) if 0.0 < largest < 1.0 else math.inf
    return {
        "stable": stable,
        "dt_s": loop.dt,
        "poles": tuple(complex(pole) for pole in poles),
        "conserved": loop.conserved,
        "slowest_time_constant_s": loop.dt / speed if stable else None,
    }


def disk_figures(largest: float) -> dict[str, float]:
    """Return alpha = 1/``largest``, and its margins of gain and phase.

    ``largest`` is the peak of (S - T)/2 over frequency.
    """
    alpha = 1.0 / largest
    return {
        "disk_margin": alpha,
        "disk_gain_margin": (2 + alpha) / (2 - alpha) if alpha < 2 else math.inf,
        "disk_phase_margin_deg": math.degrees(2.0 * math.atan(alpha / 2.0)),
    }


_FIGURES = [
    field.name
    for field in dataclasses.fields(StabilityReport)
    if field.default is dataclasses.MISSING
    and field.name not in ("stable", "dt_s", "poles", "conserved")
]


def sensitivity_figures(
    loop: LinearLoop | LinearAxes, grid: np.ndarray
) -> dict[str, float | None]:
    """Return Ms and Mt of a stable linear loop, and their frequencies in Hz.

    They are the largest singular values of S and T over frequency, with one axis |S|
    and |T|. They are sampled on ``grid`` (rad/sample, see ``angle_grid``) and refined
    by bounded minimisation between neighbours of the highest points. The result is
    exact; ``sensitivity_peak`` is the cheap approximation.
    """
    figures: dict[str, float | None] = {}
    sampled = loop.closed_responses(grid)
    for i, name in enumerate(("sensitivity_peak", "complementary_peak")):

        def largest(x: np.ndarray, i: int = i) -> np.ndarray:
            return largest_singular(loop.closed_responses(x)[i])

        figures[name], angle = peak(largest, grid, largest_singular(sampled[i]))
        figures[f"{name}_Hz"] = hertz(angle, loop.dt)
    return figures


def largest_singular(matrices: np.ndarray) -> np.ndarray:
    """Return the largest singular value [m] of each of ``matrices`` [m, q, q]."""
    if matrices.shape[-1] == 1:
        return np.abs(matrices[:, 0, 0])
    return np.linalg.norm(matrices, 2, axis=(-2, -1))


def _figures(loop: LinearLoop) -> dict[str, float | None]:
    grid = angle_grid(loop)
    response = loop.response(grid)

    def disk(L: np.ndarray) -> np.ndarray:
        return np.abs(0.5 * (1.0 - L) / (1.0 + L))

    worst, _ = peak(lambda x: disk(loop.response(x)), grid, disk(response))
    return (
        sensitivity_figures(loop, grid)
        | disk_figures(worst)
        | _gain_margins(loop, grid, response)
        | _phase_margins(loop, grid, response)
    )


def _gain_margins(
    loop: LinearLoop, grid: np.ndarray, response: np.ndarray
) -> dict[str, float | None]:
    places = roots(
        lambda x: np.imag(loop.response(x)), grid[:-1], np.imag(response)[:-1]
    )
    # L is real at the Nyquist frequency and at 0; a pole can leave the unit circle
    # there too.
    places = np.append(places, np.pi)
    crossing = np.real(loop.response(places))
    if not loop.integrates():
        places = np.append(places, 0.0)
        crossing = np.append(crossing, np.real(loop.response(np.zeros(1))))
    places, crossing = places[crossing < 0.0], crossing[crossing < 0.0]
    factors = -1.0 / crossing
    up, down = factors > 1.0, factors < 1.0
    found = bool(up.any())
    first = int(np.argmin(np.where(up, factors, np.inf))) if found else 0
    margin = float(factors[first]) if found else math.inf
    return {
        "gain_margin": margin,
        "gain_margin_dB": 20.0 * math.log10(margin),
        "phase_crossover_Hz": hertz(float(places[first]), loop.dt) if found else None,
        "gain_reduction_margin": float(factors[down].max(initial=0.0)),
    }


def _phase_margins(
    loop: LinearLoop, grid: np.ndarray, response: np.ndarray
) -> dict[str, float | None]:
    def gain(x: np.ndarray) -> np.ndarray:
        return np.log(np.abs(loop.response(x)) + 1e-300)

    places = roots(gain, grid, np.log(np.abs(response) + 1e-300))
    if places.size == 0:
        return {
            "phase_margin_deg": math.inf,
            "gain_crossover_Hz": None,
            "delay_margin_s": math.inf,
            "delay_margin_samples": math.inf,
        }
    angles = np.angle(loop.response(places))
    lag = np.mod(angles + np.pi, 2.0 * np.pi)
    either = np.pi - np.abs(angles)
    worst = int(np.argmin(either))
    samples = float((lag / places).min())
    return {
        "phase_margin_deg": math.degrees(float(either[worst])),
        "gain_crossover_Hz": hertz(float(places[worst]), loop.dt),
        "delay_margin_s": samples * loop.dt,
        "delay_margin_samples": samples,
    }


def hertz(angle: float, dt: float) -> float:
    """Return the frequency in Hz of an angle in rad/sample; ``dt`` in s."""
    return angle / (2.0 * math.pi * dt)
