"""The stability of any loop at an operating point."""

import dataclasses
from collections.abc import Sequence
from typing import Any, overload

import jax
import numpy as np

from ...core.arrays import ScalarLike, as_signal
from ...core.system import Feedback, LoopState
from .margins import StabilityReport, linear_axes, linear_loop, located_report
from .multi_axis import MultiAxisReport, axes_report_of


@overload
def stability_report(
    loop: Feedback,
    reference: ScalarLike = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
) -> StabilityReport: ...


@overload
def stability_report(
    loop: Feedback,
    reference: Sequence[ScalarLike] | np.ndarray,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
) -> MultiAxisReport: ...


def stability_report(
    loop: Feedback,
    reference: Any = 0.0,
    branch: str = "ascending",
    state: LoopState | None = None,
    dt: float | None = None,
) -> StabilityReport | MultiAxisReport:
    """Return the stability of ``loop`` for small motions around ``reference`` (um).

    With a vector or tuple as ``reference``, a number an axis in its unit, a
    MultiAxisReport. ``branch`` is "ascending" or "descending": the side from which the
    slope of a hysteresis is taken, see ``broken_loop``. ``state`` is an operating point
    other than rest on the virgin curve, such as the last state of a simulation; ``dt``
    (s) is needed only if the loop names no sample time.

    Raises ValueError if the loop cannot rest at ``reference``, its derivatives are not
    finite, the sample time is not known or the branch is none.
    """
    signal = as_signal(reference)
    if not isinstance(signal, tuple):
        model, start = linear_loop(loop, reference, branch, state, dt)
        return located_report(model, float(reference), start, branch)
    axes, start = linear_axes(loop, signal, branch, state, dt)
    return dataclasses.replace(
        axes_report_of(axes),
        reference=tuple(float(r) for r in signal),
        command=tuple(float(u) for u in jax.tree.leaves(start.voltage)),
        branch=branch,
    )
