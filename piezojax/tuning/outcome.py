"""Outcome of tuning: the result with its loops, their stability and their limit."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..analysis.constraints import CONSTRAINTS
from ..analysis.limit import LimitReport, performance_limit
from ..analysis.stability import StabilityReports
from ..analysis.step_response import NAMES as STEPS
from ..analysis.step_response import figures_of, step_ends, step_reference
from ..core.about import About
from ..core.arrays import as_array
from ..core.axes import axis_of
from ..core.feedback import Feedback, LoopSample, loop_inputs
from ..core.paths import parameters
from ..core.rollout import simulate
from ..core.serial import to_data
from ..core.system import System, resolve
from ..study import Case
from .alarms import exact_figures, exact_peak
from .baselines import Baselines
from .coupling import Coupling, coupling_matrix
from .drive import Drive, drive_of
from .result import Result
from .runs import RunNoise, Signals
from .step_tests import StepResult, StepRun

_BEYOND = 1e9  # um or V

NOMINAL = "the nominal one only"

Logs = tuple[LoopSample, LoopSample]
"""Samples of a run, of NumPy arrays, before and after tuning."""


@dataclass
class Outcome:
    """Result of tuning with its loops and signals.

    ``before`` and ``after`` are the loops with the gains of the study and with the
    tuned gains; ``holdout`` are the held-out signals. ``baselines`` is None unless a
    budget for them was given. ``stability`` is that of both loops at the highest
    reference. ``limit``, ``coupling`` and ``drive`` are computed when they are first
    read, so that many studies can be tuned without them.
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
        references = np.asarray(self.holdout.references)
        samples = references.reshape(-1, study.axis_count if axes else 1)
        return About(
            study=self.case.name,
            study_sha256=self.case.sha256,
            seed=study.seed,
            rate_Hz=study.rate,
            judged=self.judged,
            plants=study.ensemble.ranges if study.ensemble else [NOMINAL],
            actuator=to_data(self.after.actuator),
            reference_ranges=[(float(x.min()), float(x.max())) for x in samples.T],
            unsafe=self.result.alarms,
            units=dict(channels) or {"measured": "um", "command": "V"},
            parameter_units={
                path: self.case.unit(f"controller.{path}")
                for path in parameters(self.controller)
            },
        )

    @property
    def judged(self) -> list[str]:
        """Margins of the tuned loop, a sentence each; none if they are not known."""
        figures = [found for found in exact_figures(self.stability).values() if found]
        peak = exact_peak(self.stability)
        if not np.isfinite(peak):
            return []
        disk = min(found["disk_margin"] or 0.0 for found in figures)
        found = [f"tuned loop: sensitivity peak {peak:.4g}, disk margin {disk:.4g}"]
        drawn = self.result.perturbed
        outcomes = [
            *(("tuning", each) for each in self.result.constraints.items()),
            *(
                ("held-out", each)
                for each in (drawn.constraints if drawn else {}).items()
            ),
        ]
        return found + [
            f"{name} {CONSTRAINTS[name].quantity(outcome.value)} on the worst of "
            f"{outcome.of} {kind} plants"
            for kind, (name, outcome) in outcomes
            if outcome.of > 1 and outcome.value is not None
        ]

    @cached_property
    def limit(self) -> LimitReport | str:
        """Limit of linear control for the tuned loop, or the reason for its absence.

        It is that of the tuning references with the hold-out's noise.
        """
        study = self.case.study
        if study.axes is not None:
            return "the limit is known for one axis only"
        if (
            study.sensor.measured_noise is not None
            or study.disturbance.input is not None
        ):
            return "the limit is known for white sensor noise and no input disturbance"
        names, signals = study.references.tune, self.holdout
        count, disturbance = len(names), signals.disturbance
        try:
            report = performance_limit(
                self.after,
                names,
                signals.references[:count],
                signals.noise[:count],
                None if disturbance is None else disturbance[:count],
                start=study.settled,
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

    @cached_property
    def drive(self) -> tuple[dict[str, Drive], dict[str, Drive]]:
        """Figures of the voltage at the piezo by axis, before and after tuning.

        The name of the only axis is "piezo".
        """
        before, after = (self._drive(loop) for loop in (self.before, self.after))
        return before, after

    def _drive(self, loop: Feedback) -> dict[str, Drive]:
        study, signals = self.case.study, self.holdout
        count = len(signals.references)
        logs = [self._log(loop, index) for index in range(count)]
        level = jnp.broadcast_to(signals.references[0, 0], signals.references[0].shape)
        held = _log(loop, level, signals.run_noise.of(0, 0).undisturbed())
        voltages = [
            _at_piezo(self.case.amplifier, log.voltage) for log in (*logs, held)
        ]
        names = study.axes.names if study.axes else ("piezo",)
        found = {}
        for axis, name in enumerate(names):
            every = [axis_of(v, axis) if study.axes else v for v in voltages]
            *runs, constant = (_finite(voltage) for voltage in every)
            capacitance = study.actuator.capacitance
            found[name] = drive_of(
                runs,
                constant,
                study.dt,
                study.settled,
                study.by_axis(capacitance)[axis] if capacitance is not None else None,
            )
        return found

    @cached_property
    def step_runs(self) -> tuple[dict[str, StepRun], dict[str, StepRun]]:
        """Runs of the steps by their name, before and after tuning.

        They are as long as the references, without noise and disturbance. There are
        none on several axes, and none if all references rest at one position.
        """
        signals, dt = self.holdout, self.case.study.dt
        if self.case.study.axes is not None or not np.ptp(signals.references):
            return {}, {}
        samples = signals.references.shape[1]
        quiet = jax.tree.map(jnp.zeros_like, signals.run_noise.of(0, 0))
        ends = step_ends(np.asarray(signals.references))

        def run(loop: Feedback, pair: np.ndarray) -> StepRun:
            reference = step_reference(as_array(pair), samples)
            log = _log(loop, reference, quiet)
            time = dt * np.arange(-1, samples - 1)
            low, high = map(float, pair)
            return StepRun((low, high), time, _finite(log.displacement))

        before, after = (
            {name: run(loop, pair) for name, pair in zip(STEPS, ends, strict=True)}
            for loop in (self.before, self.after)
        )
        return before, after

    @cached_property
    def steps(self) -> tuple[dict[str, StepResult], dict[str, StepResult]]:
        """Figures of ``step_runs``."""
        noise = self.case.study.by_axis(self.case.study.sensor.noise_rms)[0]
        before, after = (
            {
                name: StepResult.of(
                    run,
                    figures_of(
                        as_array(run.displacement),
                        as_array(run.ends),
                        self.case.study.dt,
                        noise,
                    ),
                )
                for name, run in runs.items()
            }
            for runs in self.step_runs
        )
        return before, after

    def logs(self, runs: Iterable[int]) -> dict[int, Logs]:
        """Return the samples of both loops by the number of the reference in ``runs``.

        The noise is the first draw of the hold-out. Samples beyond 1e9 um or V, of a
        run that diverges, are NaN.
        """
        return {
            index: jax.tree.map(
                _finite, (self._log(self.before, index), self._log(self.after, index))
            )
            for index in sorted(set(runs))
        }

    def _log(self, loop: Feedback, index: int) -> LoopSample:
        signals = self.holdout
        return _log(loop, signals.references[index], signals.run_noise.of(index, 0))


@jax.jit
def _log(loop: Feedback, reference: Any, run_noise: RunNoise) -> LoopSample:
    inputs = loop_inputs(reference, *run_noise)
    return simulate(loop, inputs, loop.init(reference[0]))[1]


@jax.jit
def _at_piezo(amplifier: System | None, voltage: Any) -> Any:
    """Return the voltage behind ``amplifier``, which starts at rest."""
    if amplifier is None:
        return voltage
    first = jax.tree.map(lambda u: u[0], voltage)
    return simulate(amplifier, voltage, resolve(amplifier).init(first))[1]


def tracking_rms(log: LoopSample, start: int) -> float:
    """Return the RMS tracking error from sample ``start`` on, NaN if the run diverged.

    The samples are those of one axis; the error is in the unit of the displacement.
    """
    error = np.asarray(log.displacement - log.reference)[start:]
    return float(np.sqrt(np.mean(error**2)))


def _finite(values: jax.Array) -> np.ndarray:
    array = np.asarray(values)
    return np.where(np.abs(array) < _BEYOND, array, np.nan)
