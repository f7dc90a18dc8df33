"""What a plant leaves unexplained, as disturbances of the loop."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..analysis.stability.operating_point import OperatingPoint
from ..analysis.stability.small_motion import sensitivity_impulse
from ..core.arrays import Scalar, as_array
from ..core.feedback import Feedback
from ..identification.residual_record import Part, ResidualRecord, Stretch
from ..signals.missing_hysteresis import missing_hysteresis
from ..study import Case

STRETCHES = 2
"""Number of disturbances for each reference: stretches of the residual, or the assumed
hysteresis and none."""

OVERLAP, LEAST, MOST = 4, 12, 64
"""Starting points in the residual that are tried per length of the reference; fewest
and most starting points in total."""

FAST = 100
"""Samples of the moving mean that is subtracted to compare fast changes: most loops
suppress changes slower than a hundredth of the sampling rate."""

Samples = Float[np.ndarray, " samples"]


class Suppression(NamedTuple):
    """Sensitivity S of a loop of one axis, as its impulse ``response``.

    Errors count from the sample ``first`` on.
    """

    response: Samples
    first: int

    def error(self, disturbance: Samples) -> float:
        """Return the rms error (um) of the linear loop under ``disturbance`` (um)."""
        from scipy.signal import fftconvolve  # slow to import

        error = fftconvolve(disturbance, self.response)[: disturbance.size]
        return float(np.sqrt(np.mean(error[self.first :] ** 2)))


def leaves_unexplained(case: Case) -> bool:
    """Return whether the plant of ``case`` has a residual or lacks a hysteresis."""
    return case.residual is not None or case.assumed_hysteresis > 0.0


def unexplained_disturbances(
    case: Case, time_s: Samples, part: Part, loop: Suppression | None = None
) -> Float[np.ndarray, "references stretches samples *axes"]:
    """Return what the plant of ``case`` leaves unexplained under each reference.

    That is the sum of ``residual_disturbances``, ``gain_error`` and
    ``missing_hysteresis``. The gain is too high under the first stretch and too low
    under the second, and the hysteresis disturbs only the first: gains that rely on one
    of them would be poor on a stage without it.
    """
    total = np.zeros((len(case.references), STRETCHES, *case.references.shape[1:]))
    if case.assumed_hysteresis > 0.0:
        total[:, 0] = missing_hysteresis(case.references, case.assumed_hysteresis)
    if case.residual is not None:
        total += [
            residual_disturbances(case.residual, reference, time_s, part, loop)
            for reference in case.references
        ]
        wrong = gain_error(case.residual, case.references, part)
        total[:, 0] += wrong
        total[:, 1] -= wrong
    return total


def gain_error(
    residual: ResidualRecord,
    references: Float[np.ndarray, "references samples *axes"],
    part: Part,
) -> Float[np.ndarray, "references samples *axes"]:
    """Return the error of a plant whose gain is wrong by the size of its ``residual``.

    A model that errs on the motions of its record may err as much on a reference, which
    the record does not contain. This error has the frequency of the reference: a loop
    whose feedback is too slow for it relies on the model. Stretches of the residual do
    not show that. The size is the rms of the residual, relative to the deviation of the
    simulated output, and at most 1. The error begins at 0, because the loop begins at
    rest.
    """
    left, simulated = (
        np.concatenate([getattr(one, name) for one in residual.parts[part]])
        for name in ("residual", "simulated")
    )
    rms, moved = np.sqrt(np.mean(left**2, axis=0)), np.std(simulated, axis=0)
    size = rms / np.maximum(np.maximum(rms, moved), np.finfo(float).tiny)
    return size.reshape(references.shape[2:]) * (references - references[:, :1])


def residual_disturbances(
    residual: ResidualRecord,
    reference: Float[np.ndarray, "samples ..."],
    time_s: Samples,
    part: Part,
    loop: Suppression | None = None,
) -> Float[np.ndarray, "stretches samples ..."]:
    """Return the worst stretches of ``residual`` under ``reference``, in its unit.

    Without this disturbance, a controller that contains the fitted model would be tuned
    and evaluated as if the stage were that model. The error of a hysteresis model
    depends on the path of the stage. The residual therefore advances with the distance
    that the reference travels, or with time if that advances it farther. It is played
    forwards and backwards until the reference ends. ``time_s`` are the times of the
    samples of the reference, ``part`` names the part of the records.

    Of many starting points, evenly spaced over that part of each record, two are
    chosen: those with the largest error through ``loop``, each as it is or as its
    change since its first sample, whichever is worse. Without ``loop`` they are the one
    with the largest deviation from its mean, and the one with the largest fast
    changes. Several axes share one distance, and one deviation in which each axis is
    divided by the deviation of its residual.
    """
    path = reference.reshape(len(reference), -1)
    stretches = [
        played
        for one in residual.parts[part]
        for played in _played(one, path, time_s / residual.dt, part)
    ]
    if loop is not None:
        every = [one for each in stretches for one in (each, each - each[0])]
        errors = np.array([loop.error(one[:, 0]) for one in every]).reshape(-1, 2)
        largest = np.argsort(errors.max(axis=1), kind="stable")[-STRETCHES:]
        chosen = [every[2 * i + np.argmax(errors[i])] for i in largest]
        return np.stack(chosen).reshape(STRETCHES, *reference.shape)

    whole = np.concatenate([one.residual for one in residual.parts[part]])
    sizes = np.maximum(whole.std(axis=0), np.finfo(float).tiny)

    def slow(stretch: np.ndarray) -> float:
        return float(np.linalg.norm(np.std(stretch, axis=0) / sizes))

    def fast(stretch: np.ndarray) -> float:
        each = [_fast_rms(column) for column in stretch.T]
        return float(np.linalg.norm(each / sizes))

    worst = np.stack([max(stretches, key=slow), max(stretches, key=fast)])
    return worst.reshape(STRETCHES, *reference.shape)


def _played(
    record: Stretch,
    reference: Float[np.ndarray, "samples axes"],
    passed: Samples,
    part: Part,
) -> Iterator[Float[np.ndarray, "samples axes"]]:
    """Yield the residual of ``record`` from each starting point.

    ``passed`` is the time since the start of the reference, in samples of the record.
    """
    # In training the initial loading is left out: it occurs once.
    first = 0 if part == "validate" else _end_of_loading(record.simulated)
    residual = record.residual[first:]
    moved = np.linalg.norm(np.diff(record.simulated[first:], axis=0), axis=1)
    moved = np.maximum(moved, 1e-9 * moved.max())  # a stage at rest
    travelled = np.concatenate([[0.0], np.cumsum(moved)])
    steps = np.diff(reference, axis=0, prepend=reference[:1])
    distance = np.cumsum(np.linalg.norm(steps, axis=1))
    places = np.arange(float(len(residual)))
    count = int(np.clip(OVERLAP * len(residual) / passed[-1], LEAST, MOST))
    for begin in np.linspace(0.0, places[-1], count, endpoint=False):
        start = np.interp(begin, places, travelled)
        by_distance = _place(start + distance, travelled)
        place = _folded(np.maximum(begin + passed, by_distance), places[-1])
        yield np.stack([np.interp(place, places, axis) for axis in residual.T], axis=1)


def _end_of_loading(simulated: Float[np.ndarray, "samples axes"]) -> int:
    """Return the sample of the first half that is farthest from the first sample."""
    half = simulated[: max(1, len(simulated) // 2)]
    return int(np.argmax(np.linalg.norm(half - half[0], axis=1)))


def _place(distance: Samples, travelled: Float[np.ndarray, " places"]) -> Samples:
    """Return the samples at which the record has ``travelled`` each ``distance``.

    The record is played forwards and backwards in turn.
    """
    places = np.arange(float(travelled.size))
    rounds, rest = np.divmod(distance, travelled[-1])
    there = np.interp(rest, travelled, places)
    back = places[-1] - np.interp(travelled[-1] - rest, travelled, places)
    return rounds * places[-1] + np.where(rounds % 2 == 0, there, back)


def _folded(place: Samples, last: float) -> Samples:
    """Return ``place`` folded into 0 to ``last``."""
    phase = np.mod(place, 2.0 * last)
    return np.minimum(phase, 2.0 * last - phase)


def _fast_rms(stretch: Samples) -> float:
    """Return the rms (um) of ``stretch`` about its moving mean of ``FAST`` samples."""
    total = np.concatenate([[0.0], np.cumsum(stretch)])
    size = min(FAST, stretch.size)
    mean = (total[size:] - total[:-size]) / size
    middle = stretch[size // 2 :][: mean.size]
    return float(np.sqrt(np.mean((middle - mean) ** 2)))


def suppression_of(
    loop: Feedback, reference: float, samples: int, first: int, dt: float
) -> Suppression | None:
    """Return the suppression of disturbances around rest at ``reference`` (um).

    The impulse response has ``samples`` samples. None if it does not decay, as that of
    an unstable loop.
    """
    response = np.asarray(_response(loop, as_array(reference), samples, dt))
    late = np.abs(response[samples // 2 :]).max()
    return Suppression(response, first) if late < np.abs(response).max() else None


@eqx.filter_jit
def _response(loop: Feedback, reference: Scalar, samples: int, dt: float) -> Array:
    point = OperatingPoint(reference, dt=dt)
    return sensitivity_impulse(loop, point, samples * dt)[:, 0, 0]
