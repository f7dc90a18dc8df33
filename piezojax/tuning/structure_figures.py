"""Figures of a tuned structure: its errors, and the modes of the plant in its loop."""

import math
from collections.abc import Sequence

import numpy as np

from ..dynamics.plant_modes import PlantMode
from ..study import Case
from ..study.with_notches import NOTCH, place_of
from .alarms import HELD_OUT, PEAK, exact_peak
from .outcome import Outcome
from .result import Result, number
from .structure_choice import ModeInLoop, Structure

AROUND = np.linspace(-4.0, 4.0, 33)
"""Lines around a mode, as distances from it in half-widths of its peak."""

Modes = tuple[PlantMode, ...]


def in_loop(
    modes: Sequence[PlantMode], outcome: Outcome
) -> list[tuple[float, float]] | None:
    """Return the contribution of each mode to |L|, and the largest |S| around it.

    The larger value of both branches counts. None if the tuned loop could not be
    linearised.
    """
    loops = outcome.stability.loops.get("after", {}).values()
    if not loops:
        return None
    found = []
    for mode in modes:
        lines = np.minimum(mode.angle * (1.0 + mode.damping * AROUND), math.pi)
        L = np.array([loop.response(lines) for loop in loops])
        part = float(np.max(np.abs(L[:, len(AROUND) // 2])) * mode.share)
        found.append((part, float(np.max(1.0 / np.abs(1.0 + L)))))
    return found


def untuned(count: int, at: Modes, reason: str) -> Structure:
    """Return the row of a structure that was not tuned, with the ``reason``."""
    return Structure(
        notches=count, at_Hz=[mode.frequency for mode in at], reason=reason
    )


def row_of(
    case: Case, at: Modes, modes: Sequence[PlantMode], outcome: Outcome
) -> Structure:
    """Return the figures of a tuned structure."""
    result, place = outcome.result, place_of(case)
    gains, dt = result.gains, case.study.dt

    def notch_gain(where: str, angle: float) -> float:
        frequency, damping, depth = (
            gains[f"{where}.{name}"] for name in ("frequency", "damping", "depth")
        )
        return _notch_gain(frequency, damping, depth, angle, dt)

    wheres = [f"{place}.filter.{NOTCH.format(i)}" for i in range(1, len(at) + 1)]
    seen = in_loop(modes, outcome) or [(math.nan, math.nan)] * len(modes)
    part_of = {mode: part for mode, (part, _) in zip(modes, seen, strict=True)}
    # With |1 + L| at least 1 without the mode, a smaller contribution to |L| cannot
    # make |S| exceed its limit.
    cause = 1.0 - 1.0 / case.study.limits.get(PEAK, math.inf)
    errors = _errors(result)
    known = [error for error in errors if error is not None]
    stable = bool(known) and len(known) == len(errors)
    return Structure(
        notches=len(at),
        at_Hz=[mode.frequency for mode in at],
        notches_Hz=[gains[f"{where}.frequency"] for where in wheres],
        parameters=len(result.gains),
        error_um=float(np.median(known)) if stable else None,
        worst_um=max(known) if stable else None,
        sensitivity_peak=_largest_peak(outcome),
        alarms=len(result.alarms) - _slight(result),
        needless=[
            mode.frequency
            for where, mode in zip(wheres, at, strict=True)
            if part_of[mode] < cause * notch_gain(where, mode.angle)
        ],
        log_errors=[None if error is None else math.log(error) for error in errors],
        modes=[
            ModeInLoop(
                frequency_Hz=mode.frequency,
                damping=mode.damping,
                part_of_loop_gain=number(part),
                sensitivity=number(sensitivity),
                notch=math.prod(notch_gain(where, mode.angle) for where in wheres),
            )
            for mode, (part, sensitivity) in zip(modes, seen, strict=True)
        ],
        gains=result.gains,
        wall_s=result.wall_s,
    )


def _slight(result: Result) -> int:
    """Return the number of limits that held-out plants miss by less than HELD_OUT.

    The gains were not tuned on these plants. With any structure some of them may be
    slightly worse than the plants of tuning.
    """
    outcomes = result.perturbed.constraints.values() if result.perturbed else ()
    count = 0
    for one in outcomes:
        if one.kept or one.value is None:
            continue
        above = one.value / one.limit
        by = above if one.sense == "at most" else 1.0 / above
        count += by < 1.0 + HELD_OUT
    return count


def _errors(result: Result) -> list[float | None]:
    """Return the errors (um) by held-out plant, or by reference of the hold-out."""
    if result.perturbed is not None:
        return list(result.perturbed.geomeans_um)
    parts = [part for part in (result.holdout, result.unseen) if part is not None]
    return [error for part in parts for error in part.per_reference_rms_um.values()]


def _largest_peak(outcome: Outcome) -> float | None:
    """Return the largest Ms on the plants of the hold-out, or that of the nominal one.

    None if it is not finite.
    """
    perturbed = outcome.result.perturbed
    if perturbed is not None and PEAK in perturbed.constraints:
        return perturbed.constraints[PEAK].value
    return number(exact_peak(outcome.stability))


def _notch_gain(
    frequency: float, damping: float, depth: float, angle: float, dt: float
) -> float:
    """Return the gain of a ``Notch`` at ``angle`` (rad/sample).

    It is discretised by the bilinear transform, prewarped at its ``frequency`` (Hz).
    """
    ratio = math.tan(0.5 * angle) / math.tan(math.pi * frequency * dt)
    rest, damped = 1.0 - ratio**2, 2.0j * damping * ratio
    return abs((rest + depth * damped) / (rest + damped))
