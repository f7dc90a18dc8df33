"""Outcome of tuning: the result with its loops, their stability and their limit."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np

from ..analysis.limit import LimitReport, performance_limit
from ..analysis.stability import StabilityReports
from ..core.about import About
from ..core.feedback import Feedback, LoopSample, loop_inputs
from ..core.rollout import simulate
from ..core.system import System
from ..study import Case
from .baselines import Baselines
from .coupling import Coupling, coupling_matrix
from .result import Result
from .runs import Signals

_BEYOND = 1e9  # um or V

Logs = tuple[LoopSample, LoopSample]
"""Samples of a run, of NumPy arrays, before and after tuning."""


@dataclass
class Outcome:
    """Result of tuning with its loops and signals.

    ``before`` and ``after`` are the loops with the gains of the study and with the
    tuned gains; ``holdout`` are the held-out signals. ``baselines`` is None unless a
    budget for them was given. ``stability`` is that of both loops at the highest
    reference. ``limit`` and ``coupling`` are computed when they are first read, so that
    many studies can be tuned without them.
    """

    result: Result
    before: Feedback
    after: Feedback
    case: Case
    holdout: Signals
    baselines: Baselines | None = None
    stability: StabilityReports = field(default_factory=StabilityReports)

    @property
    def controller(self) -> System:
        """Tuned controller."""
        return self.after.controller

    @property
    def about(self) -> About:
        """Origin of the tuned controller, for its file."""
        study = self.case.study
        axes = study.axes
        channels = zip(axes.names, axes.units, strict=True) if axes else ()
        return About(
            study=self.case.name,
            seed=study.seed,
            rate_Hz=study.rate,
            unsafe=self.result.alarms,
            units=dict(channels) or {"measured": "um", "command": "V"},
        )

    @cached_property
    def limit(self) -> LimitReport | str:
        """Limit of linear control for the tuned loop, or the reason for its absence.

        It is that of the tuning references with the hold-out's noise.
        """
        study = self.case.study
        if study.axes is not None:
            return "the limit is known for one axis only"
        names, signals = study.references.tune, self.holdout
        count, disturbance = len(names), signals.disturbance
        try:
            report = performance_limit(
                self.after,
                names,
                signals.references[:count],
                signals.noise[:count],
                None if disturbance is None else disturbance[:count],
                start=round(study.references.settle * study.rate),
                dt=study.dt,
            )
        # A failed analysis must not lose the tuned gains.
        except Exception as error:
            return str(error).partition("\n")[0] or type(error).__name__
        return report if np.isfinite(report.ratio) else "its figures are not finite"

    @cached_property
    def coupling(self) -> tuple[Coupling, Coupling] | None:
        """Coupling of the axes before and after tuning, on the hold-out.

        None for one axis.
        """
        study, result = self.case.study, self.result
        if study.axes is None:
            return None
        before = (result.holdout_before, result.unseen_before, result.coupling_before)
        after = (result.holdout, result.unseen, result.coupling)

        def matrix(parts: Sequence) -> Coupling:
            errors: dict[str, float | None] = {}
            for part in parts:
                errors |= part.per_reference_rms_um if part else {}
            return coupling_matrix(study, errors)

        return matrix(before), matrix(after)

    def logs(self, runs: Iterable[int]) -> dict[int, Logs]:
        """Return the samples of both loops by the number of the reference in ``runs``.

        The noise is the first draw of the hold-out. Samples beyond 1e9 um or V, of a
        run that diverges, are NaN.
        """
        signals = self.holdout

        @jax.jit
        def run(loop: Feedback, index: Any) -> LoopSample:
            reference, noise = signals.references[index], signals.noise[index, 0]
            moved = signals.disturbance
            inputs = loop_inputs(
                reference, noise, None if moved is None else moved[index, 0]
            )
            return simulate(loop, inputs, loop.init(reference[0]))[1]

        return {
            index: jax.tree.map(
                _finite, (run(self.before, index), run(self.after, index))
            )
            for index in sorted(set(runs))
        }


def tracking_rms(log: LoopSample, start: int) -> float:
    """Return the RMS tracking error from sample ``start`` on, NaN if the run diverged.

    The samples are those of one axis; the error is in the unit of the displacement.
    """
    error = np.asarray(log.displacement - log.reference)[start:]
    return float(np.sqrt(np.mean(error**2)))


def _finite(values: jax.Array) -> np.ndarray:
    array = np.asarray(values)
    return np.where(np.abs(array) < _BEYOND, array, np.nan)
