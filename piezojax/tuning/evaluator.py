"""Evaluation of loops on signals and stages, compiled once per shape of signals."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from ..analysis.constraints import LoopFigures, uses
from ..analysis.stability.differentiable import sensitivities
from ..analysis.stability.operating_point import OperatingPoint
from ..core.feedback import Feedback
from ..core.metrics import Extremes, TrackingFigures
from ..solve.clock import Clock
from ..study import Case, Stage
from .runs import Signals, evaluate


class Evaluator:
    """Simulator of loops on signals, compiled once per shape of signals.

    ``start`` is the first sample that counts; ``clock`` measures the compile time.
    """

    def __init__(self, clock: Clock, case: Case, start: int):
        self._clock, self._case, self._start = clock, case, start
        self._programs: dict[str, Callable] = {}

    def _compiled(self, key: str, function: Callable, *arguments: Any) -> Callable:
        if key not in self._programs:
            self._programs[key] = self._clock.compiled(function, *arguments)
        return self._programs[key]

    def figures(self, loop: Feedback, signals: Signals) -> TrackingFigures:
        """Return the figures [references, draws] of ``loop``."""
        program = self._compiled(
            f"figures {signals.noise.shape}",
            lambda loop, signals: evaluate(lambda x: x, loop, signals, self._start),
            loop,
            signals,
        )
        return program(loop, signals)

    def on_stages(self, loop: Feedback, stages: Stage, signals: Signals) -> LoopFigures:
        """Return the figures of ``loop`` on ``stages``, both with a leading axis."""
        dynamic, static = eqx.partition(stages, eqx.is_array)
        signals = signals.for_another_plant()
        limits = self._case.study.constraints
        beside = Extremes() if uses(limits, "extremes") else None

        def run(loop, dynamic, signals):
            def around(part):
                return eqx.combine(part, static).around(loop)

            def one(part):
                return evaluate(lambda x: x, around(part), signals, self._start, beside)

            figures = jax.lax.map(one, dynamic)
            figures, extremes = figures if beside else (figures, None)
            margins = None
            if uses(limits, "sensitivity"):
                study = self._case.study
                point = OperatingPoint(study.highest, dt=study.dt)
                margins = jax.vmap(lambda part: sensitivities(around(part), point))(
                    dynamic
                )
            return figures, extremes, margins

        count = jax.tree.leaves(dynamic)[0].shape[0]
        program = self._compiled(
            f"{count} stages {signals.noise.shape}", run, loop, dynamic, signals
        )
        return LoopFigures(*program(loop, dynamic, signals), dt=self._case.study.dt)
