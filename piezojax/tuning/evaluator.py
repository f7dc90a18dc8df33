"""Evaluation of loops on signals and stages, compiled once per shape and structure."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..analysis.constraints import (
    CONSTRAINTS,
    uses,
    without_unstable,
    worst_excess,
)
from ..analysis.loop_figures import LoopFigures, MarginFigures
from ..analysis.stability.closed_poles import (
    closed_matrices,
    poles_of,
    slowest_oscillation,
    stable,
)
from ..analysis.stability.operating_point import OperatingPoint
from ..analysis.stability.small_motion import duration_of, lines
from ..analysis.step_response import StepFigures, step_ends
from ..core.arrays import as_array
from ..core.feedback import Feedback
from ..core.metrics import ExtremeFigures, Extremes, TrackingFigures
from ..core.rollout import Metric
from ..solve.clock import Clock
from ..solve.multi_start import in_batches, in_threads, rows_of
from ..solve.problem import TOLERANCE
from ..study import Case, Stage
from ..study.ensemble import Part
from .alarms import PEAK
from .data import held, own_stage
from .level_stages import level_stages
from .objective import MARGIN_BLOCK, StepTest, margins_on
from .runs import Signals, evaluate
from .steep_stage import steep_stage

CARRIED = 16
"""Most plants whose margins a search computes at every point."""

SETTLED, MOST = 7.0, 2**17
"""Time constants of an oscillation after which 0.1 % of it is left, and the most
samples of an impulse response. One that lasts longer is truncated; the poles tell
whether the loop is stable."""

RUN_BLOCK = 8
"""Plants on which runs are simulated in one call of a program."""


class Carried(NamedTuple):
    """Part of the plants with limited margins: those whose margins a search computes.

    ``excess`` is the largest ln(value/limit) over all plants and limits. ``peak`` is
    the largest Ms of the plants carried so far if it exceeds its limit, otherwise 0.
    ``stages`` are the plants to carry, and ``places`` their indices among all. If all
    are carried, ``stages`` is None.
    """

    excess: float
    peak: float
    stages: Stage | None
    places: np.ndarray


class Evaluator:
    """Simulator of loops on signals, compiled once per shape and structure of loops.

    ``start`` is the first sample that counts, ``limits`` are those of the study,
    ``model_error`` [lines] bounds the relative error of the plant if its record gives
    a bound; ``step_test`` evaluates the limits on steps. ``margin_stages`` are those on
    which margins are limited, None for the loop's own alone and without such a limit.
    ``clock`` measures the compile time.
    """

    def __init__(self, clock: Clock, case: Case):
        self._clock, self._case = clock, case
        study = case.study
        self.start = study.settled
        self.limits = study.limits
        bound = case.plant_about.error_bound
        frequency = lines(study.dt, case.margin_duration)
        self.model_error = bound and as_array(bound.supported(frequency))
        margins = uses(self.limits, "margins")
        self.margin_stages = drawn_stages(case, "margins") if margins else None
        self.step_test = step_test_of(case)
        # A program takes no more plants than the study draws.
        drawn = study.ensemble.holdout if study.ensemble else 1
        self._most = max(1, drawn, _count(self.margin_stages))

    def figures(self, loop: Feedback, signals: Signals) -> TrackingFigures:
        """Return the figures [references, draws] of ``loop``."""
        return jax.tree.map(lambda x: x[0], self.figures_on(None, loop, signals))

    def figures_on(
        self, stages: Stage | None, loop: Feedback, signals: Signals
    ) -> TrackingFigures:
        """Return the figures [stages, references, draws] of ``loop`` on ``stages``."""
        return self._runs(loop, signals, stages)[0]

    @property
    def limits_on_runs(self) -> list[str]:
        """Names of the limits on runs of the references."""
        return [
            name
            for name in self.limits
            if CONSTRAINTS[name].source in ("tracking", "extremes")
        ]

    def limited(
        self,
        loop: Feedback,
        signals: Signals,
        stages: Stage | None = None,
        margin_stages: Stage | None = None,
    ) -> LoopFigures:
        """Return the figures of the study's limits, with the plants on the first axis.

        The runs are on ``stages``, the margins on ``margin_stages``, both stacked; None
        means the plant of the loop alone.
        """
        tracking, extremes = self._runs(loop, signals, stages)
        steps, dt = self._steps(loop, stages), self._case.study.dt
        if margin_stages is None:
            margins = self._margins(loop, None)
            return LoopFigures(tracking, extremes, margins, steps, dt)
        margins, known = self._margins_of_stable(loop, margin_stages)
        return LoopFigures(tracking, extremes, margins, steps, dt, known)

    def _runs(
        self, loop: Feedback, signals: Signals, stages: Stage | None
    ) -> tuple[TrackingFigures, ExtremeFigures | None]:
        beside = Extremes(self.start) if uses(self.limits, "extremes") else None
        stages = held(own_stage(loop) if stages is None else stages, signals.begins)
        width = min(RUN_BLOCK, self._most)
        found = self._on_each(
            _runs_on, width, stages, loop, signals, self.start, beside
        )
        return found if beside else (found, None)

    def _on_each(self, program: Any, width: int, stages: Stage, *arguments: Any) -> Any:
        """Return ``program(stages, *arguments)`` for any number of stacked stages.

        The compiled program evaluates ``width`` stages at a time. Several such calls
        run in parallel, unless the memory suffices for one stage only.
        """
        dynamic, static = eqx.partition(stages, eqx.is_array)
        first = np.minimum(np.arange(width), _count(stages) - 1)

        def with_arguments(batch):
            return eqx.combine(batch, static), *arguments

        compiled = self._clock.compiled(
            program, *with_arguments(rows_of(dynamic, first))
        )
        found = in_batches(
            lambda batch: compiled(*with_arguments(batch)),
            dynamic,
            width,
            in_threads if width > 1 else map,
        )
        return jax.tree.map(jnp.asarray, found)

    def worst_plants(self, loop: Feedback, before: Carried | None = None) -> Carried:
        """Return the plants that a search from ``loop`` carries: at most ``CARRIED``.

        They are those with the largest excess over the limits on margins. Up to half of
        them are the worst of those carried ``before``, so that a search keeps the
        plants whose limits were active. After a search the margins are those of
        ``limited``, which may be worse than those of the search.
        """
        stages, count = self.margin_stages, _count(self.margin_stages)
        if stages is None or (before is None and count <= CARRIED):
            return Carried(0.0, 0.0, None, np.arange(count))
        if before is None:
            margins = self._margins(loop, stages)
        else:
            margins, _ = self._margins_of_stable(loop, stages)
        assert margins is not None  # with stages some margin is limited
        by = np.asarray(worst_excess(self.limits, margins))
        worst = np.argsort(-by, kind="stable")
        kept = worst[:0] if before is None else worst[np.isin(worst, before.places)]
        peak = self._exceeding_peak(margins, kept)
        first = np.concatenate([worst[: CARRIED // 2], kept[: CARRIED // 2], worst])
        places = first[np.sort(np.unique(first, return_index=True)[1])][:CARRIED]
        part = jax.tree.map(lambda x: x[places], stages) if count > CARRIED else None
        return Carried(float(by[worst[0]]), peak, part, places)

    def _exceeding_peak(self, margins: MarginFigures, places: np.ndarray) -> float:
        """Return the largest Ms of the plants at ``places`` if it exceeds its limit."""
        if PEAK not in margins:
            return 0.0
        peak = float(np.max(np.asarray(margins[PEAK])[places], initial=0.0))
        return peak if peak > self.limits[PEAK] * math.exp(TOLERANCE) else 0.0

    def _margins_of_stable(
        self, loop: Feedback, stages: Stage
    ) -> tuple[MarginFigures | None, np.ndarray]:
        """Return the margins on ``stages``, and which of their loops are stable.

        The poles of the closed loops tell. They also tell how long their impulse
        responses last: the margins are those of longer ones than in a search if needed.
        """
        closed = self._on_margin_stages(_closed_on, loop, stages)
        poles, dt = poles_of(np.asarray(closed)), self._case.study.dt
        known = stable(poles)
        slowest = dt * np.max(slowest_oscillation(poles)[known], initial=0.0)
        duration = duration_of(slowest, dt, SETTLED, MOST)
        margins = self._margins(loop, stages, duration)
        return margins and without_unstable(margins, known), known

    def _margins(
        self, loop: Feedback, stages: Stage | None, duration: float = 0.0
    ) -> MarginFigures | None:
        """Return the margins on each of ``stages``, or None if no limit needs them.

        The impulse responses last for ``duration`` (s), and as long as in a search.
        """
        if not uses(self.limits, "margins"):
            return None
        bound, error = self._case.plant_about.error_bound, self.model_error
        searched = self._case.margin_duration
        if bound is not None and duration > searched:
            frequency = lines(self._case.study.dt, duration)
            error = as_array(bound.supported(frequency))
        duration = max(duration, searched)
        stages = own_stage(loop) if stages is None else stages
        limits = tuple(self.limits)
        return self._on_margin_stages(
            _margins_on, loop, stages, limits, error, duration
        )

    def _on_margin_stages(
        self, program: Any, loop: Feedback, stages: Stage, *arguments: Any
    ) -> Any:
        """Return ``program`` of the loop at the reference of margins on ``stages``."""
        study, reference = self._case.study, as_array(self._case.margin_reference)
        width = 1 if study.axes else min(MARGIN_BLOCK, self._most)
        arguments = loop, reference, study.dt, *arguments
        return self._on_each(program, width, stages, *arguments)

    def _steps(self, loop: Feedback, stages: Stage | None) -> StepFigures | None:
        """Return the figures of steps on ``stages``, or None if no limit needs them."""
        test = self.step_test
        if test is None or not uses(self.limits, "steps"):
            return None
        stages = own_stage(loop) if stages is None else stages
        width = min(RUN_BLOCK, self._most)
        return self._on_each(_steps_on, width, stages, loop, test)


@eqx.filter_jit
def _runs_on(
    stages: Stage, loop: Feedback, signals: Signals, start: int, beside: Metric | None
) -> Any:
    def one(stage: Stage) -> Any:
        around, own = stage.around(loop), signals.on(stage)
        return evaluate(lambda x: x, around, own, start, beside)

    return _of_each(one, stages)


@eqx.filter_jit
def _margins_on(
    stages: Stage,
    loop: Feedback,
    reference: Array,
    dt: float,
    limits: tuple[str, ...],
    model_error: Array | None,
    duration: float,
) -> MarginFigures:
    point = OperatingPoint(reference, dt=dt)
    return margins_on(limits, _around(loop), stages, point, model_error, duration)


@eqx.filter_jit
def _closed_on(stages: Stage, loop: Feedback, reference: Array, dt: float) -> Array:
    """Return the matrices of ``closed_matrices`` on each of ``stages``."""
    point = OperatingPoint(reference, dt=dt)
    return _of_each(lambda stage: closed_matrices(stage.around(loop), point), stages)


def _of_each(function: Callable[[Stage], Any], stages: Stage) -> Any:
    """Return ``function`` of each of the stacked ``stages``, one after another."""
    dynamic, static = eqx.partition(stages, eqx.is_array)
    return jax.lax.map(lambda part: function(eqx.combine(part, static)), dynamic)


@eqx.filter_jit
def _steps_on(stages: Stage, loop: Feedback, test: StepTest) -> StepFigures:
    return test.figures_on(_around(loop), stages)


def _around(loop: Feedback) -> Callable[[Stage | None], Feedback]:
    return lambda stage: stage.around(loop) if stage else loop


def step_test_of(case: Case) -> StepTest | None:
    """Return the step test of ``case``, or None on several axes.

    It is as long as the references.
    """
    study = case.study
    if study.axes is not None:
        return None
    references = case.references
    return StepTest(
        as_array(step_ends(references)),
        as_array(study.sensor.noise_rms),
        references.shape[1],
        study.dt,
    )


def _count(stages: Stage | None) -> int:
    """Return the number of stacked ``stages``, 0 for None."""
    return 0 if stages is None else jax.tree.leaves(stages)[0].shape[0]


def drawn_stages(case: Case, part: Part) -> Stage | None:
    """Return the nominal stage and the drawn stages of ``part``, stacked.

    For "margins" the stages at each level of a scheduled plant follow, and that with
    the largest gain of an assumed hysteresis. None if there is no other stage than the
    nominal one.
    """
    drawn = case.ensemble.stages(part) if case.ensemble else None
    others = [drawn]
    if part == "margins":
        others += [level_stages(case.loop), steep_stage(case)]
    others = [stages for stages in others if stages is not None]
    if not others:
        return None
    return jax.tree.map(
        lambda *parts: jnp.concatenate(parts), own_stage(case.loop), *others
    )
